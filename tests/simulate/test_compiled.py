"""One compiled program for replays that differ in numbers only; a time loop, alone and in a batch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pendulum import pendulum, swung
from two_link import MOTOR, arm, motion, recording

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.door.space import torque_offsets
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.effects.registry import library
from droid_jax.model.fields import joint_damping
from droid_jax.model.joint_friction import joint_friction_space
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_physics
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording, TorqueSide
from droid_jax.simulate import compiled
from droid_jax.simulate.batching import time_loop
from droid_jax.simulate.replay import TORQUE_OFFSETS, make_drive, servo_replay, with_sensor_model


@pytest.fixture(scope="module")
def scene() -> Scene:
    return arm()


def space_of(scene: Scene, high: float = 9.0) -> Space:
    return Space((joint_damping(scene, "elbow", std=0.5, high=high),))


def pull(size: float, traced: list[float]) -> Effect:
    """A constant torque that counts the traces of its program."""

    def force(theta, state):
        traced.append(size)
        return jnp.full_like(state.qvel, size)

    return Effect("pull", force=force)


def made(scene: Scene, log: Recording, effect: Effect, high: float = 9.0) -> Cost:
    return make_cost(scene, space_of(scene, high), log, effects=[effect], check=False)


def torque(cost: Cost) -> np.ndarray:
    return cost.rollouts(cost.space.mean[None])[0].torque[0]


@pytest.fixture(scope="module")
def base(scene: Scene) -> tuple[Effect, list[float], np.ndarray]:
    """An effect that counts the traces of its program, and the torque that it gives; compiled once for all tests."""
    traced = list[float]()
    effect = pull(0.0, traced)
    return effect, traced, torque(made(scene, recording(), effect))


def test_other_commands_starts_and_bounds_share_a_program(
    scene: Scene, base: tuple[Effect, list[float], np.ndarray], monkeypatch: pytest.MonkeyPatch
):
    """Another effect has its own program, here of the length of the motion, which changes no replay."""
    effect, traced, first = base
    count, command = len(traced), motion()[1]
    slower = recording(name="slower", command=0.5 * command + 0.5 * command[0])
    other = torque(made(scene, slower, effect, high=5.0))
    assert count and len(traced) == count
    assert np.abs(other - first).max() > 0.1
    monkeypatch.setattr(compiled, "MIN_ROWS", 1)
    assert compiled.capacity(1024) == 1024 and compiled.capacity(1025) == 2048
    own = list[float]()
    alone = torque(made(scene, slower, pull(0.0, own)))
    assert own and len(traced) == count
    np.testing.assert_array_equal(other, alone)


@pytest.mark.slow
def test_another_effect_does_not(scene: Scene, base: tuple[Effect, list[float], np.ndarray]):
    _, traced, first = base
    loaded = torque(made(scene, recording(), pull(1.0, traced)))
    assert 1.0 in traced and np.abs(loaded - first).max() > 0.1


@pytest.mark.slow
def test_other_scenes_and_conventions_do_not(scene: Scene, base: tuple[Effect, list[float], np.ndarray]):
    effect, _, first = base
    on_the_link = replace(MOTOR, side=TorqueSide.LINK)
    assert np.abs(torque(made(scene, recording(torque=on_the_link), effect)) - first).max() > 0.01
    rough = arm(friction=0.5)
    assert np.abs(torque(made(rough, recording(), effect)) - first).max() > 0.1


def test_other_lengths_share_a_program_and_are_replayed_to_their_own_end(
    scene: Scene, base: tuple[Effect, list[float], np.ndarray]
):
    effect, traced, whole = base
    count = len(traced)
    time, command = motion(0.6)
    noise = np.random.default_rng(1).normal(size=(2, len(time), 2))
    seen = replace(recording().channel("torque"), time=time, values=noise, mask=np.ones(noise.shape, bool))
    short = recording(time=time, command=command, channels={"torque": seen})
    np.testing.assert_allclose(torque(made(scene, short, effect)), whole[: len(time)], atol=1e-4)
    assert len(traced) == count


def summed(traced: list[int]) -> Any:
    """`steps` steps of x + rate * k from a start; counts the traces of its step."""

    def step(sample: Any, k: jax.Array, state: jax.Array) -> jax.Array:
        traced.append(1)
        rate, fixed = sample
        return state + rate * k + fixed

    return lambda rate, start, steps: time_loop(step, (rate, 2.0), start, steps)


RATES = jnp.array([1.0, -0.5, 3.0])


def test_sensor_friction_is_added_before_sensor_errors(scene: Scene):
    """A gain error scales, and crosstalk reads, a torque that contains Coulomb friction."""
    effects, base = library(scene, ["torque_crosstalk"]), joint_friction_space(scene.joints)
    made_with = compiled.with_sensors(scene, base, make_drive(scene, recording()), effects)
    assert {e.name for e in made_with} == {"joint friction", "torque_crosstalk", TORQUE_OFFSETS}
    theta = {"coulomb[shoulder]": 2.0, "crosstalk_before[elbow]": 0.25, "torque_offset[shoulder]": 8.0}
    still = jnp.zeros((5, 2))
    motion = Rollout(still[:, 0], still, still, still + 1.0, still[:, 0], still[:, :0], jnp.array(True))
    seen = with_sensor_model(motion, {n: jnp.float32(v) for n, v in theta.items()}, made_with, 0.002)
    np.testing.assert_allclose(seen.torque, np.tile([10.0, 0.5], (5, 1)))


def test_a_batch_is_its_rows_and_traces_a_step_twice():
    traced = list[int]()
    loop = summed(traced)
    batch = jax.jit(jax.vmap(lambda rate, steps: loop(rate, jnp.float32(0.5), steps), in_axes=(0, None)))(RATES, 5)
    assert len(traced) == 2  # for its shapes, and for the batch
    np.testing.assert_array_equal(batch, 0.5 + 10.0 * RATES + 2.0 * 5)  # 0 + 1 + 2 + 3 + 4 = 10
    alone = [jax.jit(loop)(rate, jnp.float32(0.5), 5) for rate in RATES]
    np.testing.assert_array_equal(batch, jnp.stack(alone))


def test_different_starts_and_zero_steps():
    loop, starts = summed([]), jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(jax.vmap(lambda r, s: loop(r, s, 0))(RATES, starts), starts)
    np.testing.assert_array_equal(jax.vmap(lambda r, s: loop(r, s, 2))(RATES, starts), starts + RATES + 4.0)


def test_a_loop_has_forward_derivatives():
    """In jax.jacfwd rows differ in their tangents only, and the loop's primal is not batched."""

    def ended(x: jax.Array) -> jax.Array:
        return time_loop(lambda rate, k, now: now * rate, x[0], x[1], 3)  # x1 x0^3

    x = jnp.array([2.0, 0.5])
    np.testing.assert_allclose(jax.jacfwd(ended)(x), [3 * 0.5 * 4.0, 8.0])
    np.testing.assert_allclose(jax.vmap(jax.jacfwd(ended))(jnp.stack([x, 2 * x])), [[6.0, 8.0], [48.0, 64.0]])


@pytest.mark.slow
def test_the_documented_replay_has_forward_derivatives():
    """The example of docs/your-robot.md: positions by a damping against differences, and torques by an offset."""
    scene = pendulum()
    space = Space((joint_damping(scene, "swing", std=0.05, high=1.0), *torque_offsets(scene.joints)))
    drive = make_drive(scene, swung("a", 1.0, 0.7))
    replay = servo_replay(scene, drive, compiled.with_sensors(scene, space, drive, ()))

    def traces(values: jax.Array) -> jax.Array:
        rollout = replay(make_physics(scene, space, values))
        return jnp.stack([rollout.position[:, 0], rollout.torque[:, 0]])

    at, step = jnp.asarray(space.mean, jnp.float32), jnp.array([1e-3, 0.0])
    slopes = np.asarray(jax.jit(jax.jacfwd(traces))(at))
    both = jax.jit(jax.vmap(traces))(jnp.stack([at + step, at - step]))
    expected = np.asarray(both[0, 0] - both[1, 0]) / 2e-3
    np.testing.assert_allclose(slopes[0, :, 0], expected, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(slopes[1, :, 1], 1.0)


def test_rows_with_different_numbers_of_steps_are_refused():
    loop = summed([])
    with pytest.raises(ValueError, match="the same number of steps"):
        jax.vmap(lambda rate, steps: loop(rate, jnp.float32(0.0), steps))(RATES, jnp.array([1, 2, 3]))
