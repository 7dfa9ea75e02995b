"""Episodes in simulation: what is counted, until when, and that physics differ."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from droid_jax import runtime
from droid_jax.door.environment import DoorEnv
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space
from droid_jax.door.task import Task
from droid_jax.identify.gaussian import prior
from droid_jax.policy.control import SHAPES, Interface, Policy
from droid_jax.policy.evaluate import TRIALS, batch_of_episodes, simulated
from droid_jax.policy.randomise import randomised


class Door(NamedTuple):
    """One field that varies, one that does not."""

    width: Any
    height: Any


BLANK: Any = Interface(**{name: np.zeros(shape) for name, shape in SHAPES.items()})  # type: ignore[arg-type]


class Opening(Env):
    """A door that opens by its width and its height, and by the policy's action."""

    sys: Any = Door(jnp.zeros(()), jnp.ones(()))
    task, interface = SimpleNamespace(steps=2), BLANK
    observation_size, action_size, backend = 1, 1, "none"

    def reset(self, rng):
        nothing = jnp.zeros(())
        metrics = dict.fromkeys(("angle", "success", "grip", "blown_up"), nothing)
        return State(None, jnp.ones(1), nothing, nothing, metrics)

    def step(self, state, action):
        angle = self.sys.width + self.sys.height + action[0]
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            reward=angle, metrics={**state.metrics, "angle": angle}
        )


def network(weight: float) -> Policy:
    """A policy whose action is tanh of its observation times a weight."""
    weights = (np.full((1, 18), weight),)
    return Policy(np.zeros(1), np.ones(1), weights, (np.zeros(18),), BLANK)


def draws(sys: Door, rng: Any) -> tuple[Door, Door]:
    return Door(jax.vmap(jax.random.uniform)(rng), sys.height), Door(0, None)  # type: ignore[arg-type]


@pytest.mark.parametrize("episodes", [5, 70])
def test_outcomes_do_not_depend_on_the_devices(monkeypatch: pytest.MonkeyPatch, episodes: int):
    """Rows that fill up devices and blocks are not counted."""
    env: Any = Opening()
    assert len(jax.local_devices()) > 1
    many = simulated(network(0.5), env, draws, episodes)
    physics = jax.random.split(jax.random.fold_in(jax.random.key(0), TRIALS))[1]
    played = batch_of_episodes(env, draws, episodes, physics)(network(0.5), jax.random.key(1))
    assert played.reward == pytest.approx(2 * many.angle.mean())  # of two steps
    monkeypatch.setattr(runtime, "devices_mesh", lambda: jax.sharding.Mesh(np.array(jax.local_devices()[:1]), ("a",)))
    one = simulated(network(0.5), env, draws, episodes)
    assert many.angle.shape == (episodes,) and len(np.unique(many.angle)) == episodes
    np.testing.assert_array_equal(one.angle, many.angle)


def test_another_policy_on_other_doors_is_the_same_program(monkeypatch: pytest.MonkeyPatch):
    """Policies and physics are inputs of the program, whose compilation takes longer than the episodes."""
    programs, jit = list[str](), jax.jit

    def spied(function: Any, **options: Any) -> Any:
        made = jit(function, **options)

        def run(*arguments: Any) -> Any:
            programs.append(made.lower(*arguments).as_text())
            return made(*arguments)

        return run if function.__name__ == "run" else made

    monkeypatch.setattr(jax, "jit", spied)
    env: Any = Opening()
    cases = ((0.5, 0, 3), (0.2, 1, 3), (0.5, 0, 70), (0.5, 0, 100))  # the last two have 64 rows on each of two devices
    found = [simulated(network(weight), env, draws, count, seed) for weight, seed, count in cases]
    assert programs[0] == programs[1] != programs[2] == programs[3]
    widths = [trials.angle - 1.0 - np.tanh(weight) for trials, weight in zip(found[:2], (0.5, 0.2), strict=True)]
    assert len(np.unique(np.round(widths, 5))) == 6 and np.min(widths) > 0 and np.max(widths) < 1
    alone = simulated(network(0.5), env, None, 2)
    np.testing.assert_allclose(alone.angle, 1.0 + np.tanh(0.5), rtol=1e-6)


def test_a_policy_is_not_judged_on_the_doors_on_which_it_was_selected(monkeypatch: pytest.MonkeyPatch):
    """With partitionable keys the parts of a split key are those of `fold_in`, from which a training draws."""
    used = list[np.ndarray]()

    def batch(env, randomise, episodes, physics):
        used.append(np.asarray(jax.random.key_data(physics)))
        return lambda policy, start: used.append(np.asarray(jax.random.key_data(start))) or SimpleNamespace(trials=None)

    monkeypatch.setattr("droid_jax.policy.evaluate.batch_of_episodes", batch)
    monkeypatch.setattr("droid_jax.policy.evaluate.differing", lambda one, other: [])
    any_of: Any = SimpleNamespace(interface=None)
    simulated(any_of, any_of, None, 3, seed=4)
    training = [np.asarray(jax.random.key_data(jax.random.fold_in(jax.random.key(4), k))) for k in range(100)]
    assert len(used) == 2 and not any(np.array_equal(one, other) for one in used for other in training)


def test_a_policy_of_another_robot_is_refused():
    env: Any = Opening()
    other = replace(network(0.5), interface=replace(BLANK, knob=np.eye(4), reach=0.2))
    with pytest.raises(ValueError, match="trained for another robot, door or task: reach, knob differ"):
        simulated(other, env, None, 2)


@jax.tree_util.register_static
class Still:
    """A policy that keeps the arm at rest and the fingers open."""

    def __init__(self, interface: Interface):
        self.interface = interface

    def act(self, observation: Any, numbers: Any) -> Any:
        return numbers.concatenate([numbers.zeros((len(observation), 7)), numbers.ones((len(observation), 2))], axis=1)


@pytest.mark.slow
def test_a_hand_at_rest_opens_nothing_and_steps_count_until_success():
    scene = door_scene(timestep=0.004, limits=True)
    env, randomise = DoorEnv(scene, Task(steps=10)), randomised(scene, prior(door_space(scene)))
    found = simulated(Still(env.interface), env, randomise, 3)  # type: ignore[arg-type]
    assert not found.success.any() and (found.steps == 10).all() and (found.grip == 0).all()
    assert (np.abs(found.angle) < 0.01).all() and (found.stopped == "").all()
    env.task = replace(env.task, opened=-1.0, force=0.0, held=0.06)  # any hand that faces the door succeeds
    at_once = simulated(Still(env.interface), env, None, 2)  # type: ignore[arg-type]
    assert at_once.success.all() and (at_once.steps == 3).all() and (at_once.grip == 1).all()
