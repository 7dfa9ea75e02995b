"""Training with brax: its missing function, checkpoints, and a short run that continues."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from droid_jax.door.environment import DoorEnv
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space
from droid_jax.door.task import Task
from droid_jax.identify.gaussian import prior
from droid_jax.policy.control import OBSERVED
from droid_jax.policy.evaluate import Played
from droid_jax.policy.randomise import randomised
from droid_jax.policy.train import (
    _NAMES,
    PRESETS,
    TrainConfig,
    TrainProgress,
    _brax,
    _devices,
    evaluations_left,
    from_tree,
    put_replicated,
    replicated,
    to_tree,
    train,
)
from droid_jax.policy.trials import BLOWN_UP, Trials

SHORT = TrainConfig(
    steps=1024, envs=32, unroll=4, batch=8, minibatches=4, epochs=2, evaluations=3, eval_envs=4, hidden=(8, 8)
)


def test_the_replacement_of_braxs_missing_function_puts_a_copy_on_every_device():
    devices = jax.local_devices()
    found = put_replicated({"a": np.arange(3.0), "b": 2}, devices)
    assert found["a"].shape == (len(devices), 3) and found["b"].shape == (len(devices),)
    doubled = jax.pmap(lambda x: 2 * x)(found["a"])
    np.testing.assert_array_equal(doubled, 2 * np.tile(np.arange(3.0), (len(devices), 1)))


def test_jax_is_restored():
    new, old = SimpleNamespace(), SimpleNamespace(device_put_replicated="its own")
    with replicated(new):
        assert new.device_put_replicated is put_replicated
    assert not hasattr(new, "device_put_replicated")
    with replicated(old):
        assert old.device_put_replicated is put_replicated
    assert old.device_put_replicated == "its own"


def test_networks_are_restored_from_a_tree_and_others_refused():
    blank = ({"mean": np.zeros(3)}, {"kernel": np.zeros((3, 2))}, {"kernel": np.zeros((3, 1))})
    full = ({"mean": np.ones(3)}, {"kernel": np.full((3, 2), 2.0)}, {"kernel": np.full((3, 1), 3.0)})
    found = from_tree(blank, to_tree(full))
    np.testing.assert_array_equal(found[1]["kernel"], full[1]["kernel"])
    other = ({"mean": np.ones(3)}, {"kernel": np.zeros((4, 2))}, {"kernel": np.zeros((3, 1))})
    with pytest.raises(ValueError, match=r"holds a layer of shape \(4, 2\), this network one of \(3, 2\)"):
        from_tree(blank, to_tree(other))
    with pytest.raises(ValueError, match="holds another network"):
        from_tree(blank, {**to_tree(full), "actor": {"bias": np.zeros(2)}})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"envs": 33}, "must be a multiple of the 33 environments"),
        ({"devices": 99}, "99 devices were requested, there are"),
        ({"devices": 0}, "devices must be at least 1, got 0"),
        ({"steps": 0}, "steps must be at least 1, got 0"),
        ({"evaluations": 0}, "evaluations must be at least 1, got 0"),
    ],
)
def test_inconsistent_settings_are_refused(changes, said: str):
    with pytest.raises(ValueError, match=said):
        train(object.__new__(DoorEnv), config=replace(SHORT, **changes))


def test_the_number_of_devices_divides_the_environments(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 6)
    assert _devices(SHORT) == 4
    with pytest.raises(ValueError, match="32 environments do not divide among 5 devices"):
        _devices(replace(SHORT, devices=5))
    monkeypatch.setattr(jax, "local_device_count", lambda: 16)
    with pytest.raises(ValueError, match="8 unrolls of a minibatch do not divide among 16 devices"):
        _devices(replace(SHORT, devices=16))


@pytest.mark.parametrize("devices", [1, 2, 4, 8, 64, 128])
@pytest.mark.parametrize("preset", PRESETS)
def test_presets_use_all_devices(monkeypatch: pytest.MonkeyPatch, preset: str, devices: int):
    """At most as many as the batch has unrolls, since brax divides the batch among devices."""
    monkeypatch.setattr(jax, "local_device_count", lambda: devices)
    assert _devices(PRESETS[preset]) == min(devices, PRESETS[preset].batch)


def test_the_remaining_time_follows_from_the_rate():
    now = TrainProgress(step=1000, of=4000, seconds=9.0, rate=0.0, reward=0.0, success=0.0)
    assert replace(now, rate=150.0).remaining == 20.0 and now.remaining == float("inf")
    assert replace(now, rate=150.0, step=4096).remaining == 0.0  # whole rounds may be more than was asked for


def played(monkeypatch: pytest.MonkeyPatch, *evaluations: tuple[int, float, float, float]) -> list[int]:
    """brax's PPO replaced by evaluations (step, success, reward, a weight of the actor); returns those that ran."""
    from droid_jax.policy import train as module

    ran = list[int]()

    def ppo(policy_params_fn, **_):
        for step, _, _, weight in evaluations:
            ran.append(step)
            policy_params_fn(step, None, ({"mean": np.zeros(2)}, {"w": np.full(2, weight)}, {"v": np.zeros(1)}))

    def batch(env, randomise, episodes, physics):
        def played(policy, start):
            _, success, reward, weight = evaluations[len(ran) - 1]
            assert np.isfinite(weight), "weights that are no numbers are not evaluated"
            nothing, blown_up = np.zeros(4), np.array([BLOWN_UP, "", "", ""])
            return Played(Trials(np.full(4, success), nothing, nothing, nothing, blown_up), reward)

        return played

    monkeypatch.setattr(module.ppo, "train", ppo)
    monkeypatch.setattr(module, "batch_of_episodes", batch)
    monkeypatch.setattr(module, "policy_of", lambda normaliser, actor, sizes, interface: actor["w"][0])
    return ran


MADE_UP: Any = SimpleNamespace(task=SimpleNamespace(steps=10), interface=None)


def test_the_best_trained_policy_is_kept(monkeypatch: pytest.MonkeyPatch):
    """Success counts first, then reward.  The untrained policy has the highest reward of those without success."""
    played(monkeypatch, (0, 0.0, 900.0, 0.0), (100, 0.0, 5.0, 1.0), (200, 0.0, 8.0, 2.0), (300, 0.0, 7.0, 3.0))
    found = _brax(MADE_UP, None, SHORT, None, 0, lambda now: None, lambda step, tree: None)
    assert found.policy == 2.0
    assert [(now.step, now.blown_up) for now in found.history] == [(0, 0.25), (100, 0.25), (200, 0.25), (300, 0.25)]


def test_evaluations_draw_other_physics_than_training(monkeypatch: pytest.MonkeyPatch):
    """Otherwise the best policy would be selected on its training draws.  Starts are new in each evaluation."""
    drawn, starts = list[np.ndarray](), list[np.ndarray]()

    def raw(keys: Any) -> np.ndarray:
        return np.asarray(jax.random.key_data(keys))

    def randomise(sys: Any, rng: Any) -> Any:
        drawn.append(raw(rng))
        return jnp.zeros(len(rng)), 0

    played(monkeypatch, (0, 0.0, 0.0, 0.0), (100, 0.5, 5.0, 1.0))
    from droid_jax.policy import train as module

    ppo, count = module.ppo.train, SHORT.eval_envs

    def wrapping(wrap_env_fn, **hooks):
        keys = jax.random.split(jax.random.PRNGKey(0), count)
        wrap_env_fn(SimpleNamespace(sys=None), 10, 1, partial(randomise, rng=keys))
        ppo(**hooks)

    def batch(env, randomise, episodes, physics):
        randomise(None, jax.random.split(physics, episodes))
        nothing = np.zeros(4)
        return lambda policy, start: (
            starts.append(raw(start)) or Played(Trials(nothing, nothing, nothing, nothing, nothing), 0.0)
        )

    monkeypatch.setattr(module.ppo, "train", wrapping)
    monkeypatch.setattr(module, "batch_of_episodes", batch)
    _brax(MADE_UP, randomise, replace(SHORT, devices=1), None, 0, lambda now: None, lambda step, tree: None)
    assert [len(keys) for keys in drawn] == [count, count] and (drawn[0] != drawn[1]).any()
    assert len(starts) == 2 and (starts[0] != starts[1]).any()


def test_the_rate_counts_the_evaluations_too(monkeypatch: pytest.MonkeyPatch):
    """brax's own rate leaves them out."""
    played(monkeypatch, (0, 0.0, 0.0, 0.0), (100, 0.0, 5.0, 1.0), (300, 0.0, 8.0, 2.0))
    clock = iter([2.0, 12.0, 32.0, 52.0])
    monkeypatch.setattr("droid_jax.policy.train.time", SimpleNamespace(monotonic=lambda: next(clock)))
    found = _brax(MADE_UP, None, replace(SHORT, steps=400), None, 0, lambda now: None, lambda step, tree: None)
    assert [(now.rate, now.remaining) for now in found.history] == [(0.0, float("inf")), (5.0, 60.0), (10.0, 10.0)]


@pytest.mark.parametrize("evaluations", [2, 8, 16])
def test_a_run_that_was_stopped_has_as_many_evaluations_as_one_that_was_not(evaluations: int):
    config = TrainConfig(evaluations=evaluations)
    part = config.steps // (evaluations - 1)
    for over in range(evaluations - 1):
        assert over + evaluations_left(config, config.steps - over * part) == evaluations
    assert evaluations_left(config, 1) == 2


@pytest.mark.parametrize(("asked", "rounds"), [(20_000, 5), (70_000, 18), (4_000_000, 15 * 66)])
def test_actions_are_rounded_up_to_whole_rounds(asked: int, rounds: int):
    """Also in a run that continues."""
    config = TrainConfig(steps=asked)
    one = config.batch * config.minibatches * config.unroll
    parts = evaluations_left(config, asked) - 1
    part = -(-asked // (parts * one)) * one  # brax's
    assert parts * part == rounds * one
    assert evaluations_left(config, asked - part) - 1 == parts - 1  # where it was stopped after the first


@pytest.mark.parametrize("preset", PRESETS.values())
def test_presets_have_their_number_of_evaluations(preset: TrainConfig):
    assert evaluations_left(preset, preset.steps) == preset.evaluations


def test_nan_weights_end_the_training_and_the_best_policy_is_kept(monkeypatch: pytest.MonkeyPatch):
    untrained, good, none = (0, 0.0, 0.0, 0.0), (100, 0.5, 5.0, 1.0), (200, 0.0, np.nan, np.nan)
    ran = played(monkeypatch, untrained, good, none, (300, 1.0, 1.0, 3.0))
    saved = list[int]()
    found = _brax(MADE_UP, None, SHORT, None, 0, lambda now: None, lambda step, tree: saved.append(step))
    assert found.policy == 1.0 and ran == [0, 100, 200] and saved == [100]
    played(monkeypatch, untrained, none)
    with pytest.raises(ValueError, match=r"ended in NaN or infinite weights.*another --seed"):
        _brax(MADE_UP, None, SHORT, None, 0, lambda now: None, lambda step, tree: None)


def test_training_ends_after_repeated_success(monkeypatch: pytest.MonkeyPatch):
    config = replace(SHORT, steps=1000, enough=0.98, held=2)
    # 0.965 together; then 0.985, but 0.97 in the last; then 0.985 with 1.0 in the last.
    good = [(100, 0.93, 1.0, 1.0), (200, 1.0, 1.0, 2.0), (300, 0.97, 1.0, 3.0), (400, 1.0, 1.0, 4.0)]
    ran = played(monkeypatch, (0, 0.0, 0.0, 0.0), *good, (500, 1.0, 9.0, 5.0))
    kept = dict[int, Any]()
    found = _brax(MADE_UP, None, config, None, 0, lambda now: None, kept.__setitem__)
    assert found.held and ran == [0, 100, 200, 300, 400] and found.policy == 4.0
    again = played(monkeypatch, (0, 0.0, 0.0, 0.0))
    monkeypatch.setattr("droid_jax.policy.train._blank", lambda env, config: None)
    monkeypatch.setattr("droid_jax.policy.train.from_tree", lambda blank, tree: tuple(map(tree.get, _NAMES)))
    resumed = _brax(MADE_UP, None, config, kept[400], 400, lambda now: None, kept.__setitem__)
    assert resumed.held and not again and resumed.policy == 4.0
    ran = played(monkeypatch, (0, 0.0, 0.0, 0.0), *good, (500, 1.0, 9.0, 5.0))
    whole = _brax(MADE_UP, None, replace(config, held=0), None, 0, lambda now: None, lambda step, tree: None)
    assert not whole.held and ran[-1] == 500


def made_up(scene: str = "one", effects: tuple[str, ...] = ()) -> Any:
    """An environment with the attributes that `train` uses."""
    own = SimpleNamespace(name="door", sha256=scene)
    named = tuple(SimpleNamespace(name=e) for e in effects)
    return SimpleNamespace(task=Task(steps=10), interface=None, scene=own, start=np.zeros(2), effects=named)


@pytest.mark.parametrize(
    ("env", "config", "differs"),
    [
        (made_up("another"), SHORT, "scene"),
        (made_up(effects=("latch",)), SHORT, "effects"),
        (made_up(), replace(SHORT, hidden=(4, 4)), "config"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(monkeypatch, tmp_path: Path, env, config: TrainConfig, differs: str):
    played(monkeypatch, (0, 0.0, 0.0, 0.0), (100, 0.5, 5.0, 1.0))
    train(made_up(), None, SHORT, checkpoints=tmp_path)
    with pytest.raises(ValueError, match=f"belongs to another run: it differs in {differs}"):
        train(env, None, config, checkpoints=tmp_path)


# orbax leaves cancelled reads behind when a file is damaged; their complaint is not ours
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_training_continues_from_the_last_valid_checkpoint(monkeypatch, tmp_path: Path):
    blank = ({"mean": np.zeros(2)}, {"w": np.zeros(2)}, {"v": np.zeros(1)})
    monkeypatch.setattr("droid_jax.policy.train._blank", lambda env, config: blank)
    played(monkeypatch, (0, 0.0, 0.0, 0.0), (100, 0.5, 5.0, 1.0), (200, 0.6, 6.0, 2.0))
    train(made_up(), None, SHORT, checkpoints=tmp_path)
    for file in (p for p in (tmp_path / "200").rglob("*") if p.is_file()):
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    ran = played(monkeypatch, (0, 0.5, 5.0, 1.0), (100, 0.4, 4.0, 3.0))
    with pytest.warns(UserWarning, match="is damaged and was passed over"):
        found = train(made_up(), None, SHORT, checkpoints=tmp_path)
    assert ran == [0, 100] and [now.step for now in found.history] == [0, 100, 200]
    assert [now.success for now in found.history] == [0.0, 0.5, 0.4] and found.policy == 1.0


@pytest.mark.slow
def test_a_short_run_is_saved_and_continues(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    scene = door_scene(timestep=0.004, limits=True)
    env, randomise = DoorEnv(scene, Task(steps=20)), randomised(scene, prior(door_space(scene)))
    with jax.log_compiles(), caplog.at_level("WARNING"):
        first = train(env, randomise, SHORT, checkpoints=tmp_path)
    assert caplog.text.count("Compiling jit(run)") == 1  # for three evaluations
    assert [now.step for now in first.history] == [0, 512, 1024]
    assert first.policy.mean.shape == (OBSERVED,) and np.abs(first.policy.mean).max() > 0.1
    assert all(0.0 <= now.success <= 1.0 and np.isfinite(now.reward) for now in first.history)
    longer = train(env, randomise, replace(SHORT, steps=2048), checkpoints=tmp_path)
    assert longer.history[:3] == first.history and longer.history[-1].step == 2048
    assert longer.history[3].seconds > first.history[-1].seconds
    done = train(env, randomise, SHORT, checkpoints=tmp_path)
    assert done.history == longer.history
    np.testing.assert_array_equal(done.policy.weights[0], longer.policy.weights[0])
    with pytest.raises(ValueError, match="belongs to another run: it differs in task"):
        train(DoorEnv(scene, Task(steps=30)), randomise, SHORT, checkpoints=tmp_path)


@pytest.mark.slow
def test_a_diverging_environment_is_counted_and_training_continues():
    """The first door diverges: its episodes end at once, those of the others continue."""
    scene = door_scene(timestep=0.004, limits=True)
    usual, hinge = randomised(scene, prior(door_space(scene))), scene.dof("hinge")

    def randomise(sys: Any, rng: Any) -> tuple[Any, Any]:
        physics, axes = usual(sys, rng)
        damping = physics.model.dof_damping.at[0, hinge].set(-1e6)
        return replace(physics, model=physics.model.replace(dof_damping=damping)), axes

    found = train(DoorEnv(scene, Task(steps=20)), randomise, SHORT)
    assert [(now.step, now.blown_up) for now in found.history] == [(0, 0.25), (512, 0.25), (1024, 0.25)]
    assert all(np.isfinite(now.reward) for now in found.history)
    layers = (found.policy.mean, found.policy.std, *found.policy.weights, *found.policy.biases)
    assert all(np.isfinite(layer).all() for layer in layers) and np.abs(found.policy.mean).max() < 10.0
