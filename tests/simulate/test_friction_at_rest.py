"""Set-valued friction at rest, against closed forms and an exact integrator."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from droid_jax.cost.cost import make_cost
from droid_jax.identify.pipeline import IdentifyConfig, identify_parameters
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.fields import joint_damping, joint_frictionloss
from droid_jax.model.joint_friction import joint_friction_effect, joint_friction_space
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_physics
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.inverse_dynamics import motion_path, path_replay
from droid_jax.simulate.measured_motion import Motion
from droid_jax.simulate.rest import RestConfig, at_rest, derivative_noise, white_noise
from experiments.friction_at_rest import Truth, drawn, exact, recorded, studied

MOTOR, LINK = TorqueSide.MOTOR, TorqueSide.LINK
LOSS, WEIGHT = 0.3, 1.0 * 9.81 * 0.2  # N m; at the horizontal
HINGE = """<mujoco><worldbody><body><joint name="j" axis="0 -1 0" frictionloss="{loss}"/>
<inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>
<actuator><position joint="j" kp="1"/></actuator></mujoco>"""


@functools.cache
def hinge(loss: float = LOSS) -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(HINGE.format(loss=loss)), "hinge")


def held(measured: float, side: TorqueSide = MOTOR, **changes: object) -> Motion:
    """A joint at rest in the horizontal pose, with a measured torque of `measured` N m."""
    still = np.zeros((4, 1))
    motion = Motion(
        joints=("j",), time=0.01 * np.arange(4), position=still, velocity=still, acceleration=still,
        torque=TorqueConvention(side, True), rest=np.ones((4, 1), bool), measured=np.full((4, 1), measured),
    )  # fmt: skip
    return replace(motion, **changes)


@functools.cache
def replay_of(scene: Scene, convention: TorqueConvention, effects: tuple[Effect, ...]) -> Callable[..., Rollout]:
    return jax.jit(path_replay(scene, convention, effects, ("j",)))


def torque(scene: Scene, motion: Motion, effects: tuple[Effect, ...] = (), **theta: float) -> float:
    """N m, replayed torque of the first row; theta: coulomb."""
    space = Space((joint_frictionloss(scene, "j", std=0.1, high=1.0),)) + joint_friction_space(("j",))
    values = space.values({f"{name}[j]": value for name, value in theta.items()})
    physics = make_physics(scene, space, np.asarray(values, np.float32))
    if not theta:
        physics = replace(physics, theta={k: v for k, v in physics.theta.items() if "coulomb" not in k})
    replay = replay_of(scene, motion.torque, effects)  # motions of one kind share a program
    return float(replay(physics, motion_path(scene, motion)).torque[0, 0])


@pytest.mark.parametrize(
    ("measured", "expected"),
    [
        (WEIGHT + 0.2, WEIGHT + 0.2),  # friction can hold it: nothing is left
        (WEIGHT - 0.2, WEIGHT - 0.2),
        (WEIGHT + 0.5, WEIGHT + LOSS),  # it can not: what is left is the distance to the interval
        (WEIGHT - 0.5, WEIGHT - LOSS),
    ],
)
def test_the_residual_at_rest_is_the_distance_to_the_interval(measured: float, expected: float):
    assert torque(hinge(), held(measured)) == pytest.approx(expected, abs=1e-5)


def test_noise_within_the_slack_gives_no_residual():
    slack = {"torque_slack": np.array([0.03]), "acceleration_slack": np.array([0.04 / 0.05])}  # inertia 0.05 kg m^2
    assert torque(hinge(), held(WEIGHT + 0.5, **slack)) == pytest.approx(WEIGHT + LOSS + 0.05, abs=1e-5)


def test_sensor_friction_is_set_valued_too():
    effects = (joint_friction_effect(("j",), jnp.sign),)
    on_link = held(WEIGHT + 0.2, LINK)
    assert torque(hinge(), on_link, effects, coulomb=0.25) == pytest.approx(WEIGHT + 0.2, abs=1e-5)
    assert torque(hinge(), on_link, effects, coulomb=0.15) == pytest.approx(WEIGHT + 0.15, abs=1e-5)


def test_a_joint_without_friction_has_no_interval():
    scene = hinge(0.0)
    path = motion_path(scene, held(WEIGHT + 0.2))
    replay = replay_of(scene, TorqueConvention(MOTOR, True), ())
    space = Space((joint_damping(scene, "j", std=0.1, high=1.0),))
    physics = make_physics(scene, space, np.asarray(space.mean, np.float32))
    assert float(replay(physics, path).torque[0, 0]) == pytest.approx(WEIGHT, abs=1e-5)


def test_a_moving_joint_has_coulomb_friction():
    speed = np.full((4, 1), 0.5)
    moving = held(WEIGHT, rest=np.zeros((4, 1), bool), velocity=speed)
    assert torque(hinge(), moving) == pytest.approx(WEIGHT + LOSS, abs=1e-5)
    assert torque(hinge(), replace(moving, velocity=-speed)) == pytest.approx(WEIGHT - LOSS, abs=1e-5)


def test_noise_of_derivatives_against_draws():
    rate, cutoff, deviation = 200.0, 20.0, 1e-4
    rng = np.random.default_rng(0)
    noise = deviation * rng.standard_normal((40000, 1))
    frequency = np.fft.rfftfreq(len(noise), 1 / rate)[:, None]
    spectrum = np.where(frequency < cutoff, np.fft.rfft(noise, axis=0), 0.0)
    low = np.fft.irfft(spectrum, len(noise), axis=0)
    assert white_noise(noise - low, rate, cutoff) == pytest.approx(deviation, rel=0.03)
    for order in range(3):
        derived = np.fft.irfft(spectrum * (2j * np.pi * frequency) ** order, len(noise), axis=0)
        expected = derivative_noise(np.array([deviation]), order, rate, cutoff)
        assert expected == pytest.approx(derived.std(axis=0), rel=0.05)


def test_which_samples_are_at_rest():
    clock = np.arange(0.0, 6.0, 0.01)
    speed = np.where((clock > 2) & (clock < 3), 0.0, 1.0)[:, None]
    found = at_rest(np.zeros(1), speed, 0.01, 200.0, 20.0, RestConfig())[:, 0]
    edges = 2.0 / 20.0  # two periods of 50 ms
    inside = (clock > 2 - edges + 0.02) & (clock < 3 + edges - 0.02)
    assert found[inside].all() and not found[(clock < 2 - edges - 0.02) | (clock > 3 + edges + 0.02)].any()
    turning = np.where((clock > 2) & (clock < 2.06), 0.0, 1.0)[:, None]  # less than 1.5 periods of 50 ms
    assert at_rest(np.zeros(1), turning, 0.01, 200.0, 20.0, RestConfig()).sum() == np.sum(turning == 0.0)
    noisy = at_rest(np.array([1e-2]), 0.2 * speed, 0.01, 200.0, 20.0, RestConfig())  # its speed's noise is 0.34 rad/s
    assert noisy.all()


def test_the_exact_integrator_does_not_creep():
    """A load 0.05 N m below a friction of 0.1 N m moves nothing, whereas MuJoCo's soft friction creeps."""
    position, force = exact(Truth(0.05, 0.1, 0.01), np.full(5000, 0.05 / 8.0))
    assert np.ptp(position[2500:]) == 0.0
    assert abs(force[-1] - 0.5 * 9.81 * 0.1 * np.sin(position[-1])) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_friction_and_damping_of_a_hinge_that_holds(seed: int):
    """By exact integration (even seeds) and by C MuJoCo (odd).  With sign(v) at rest, friction is biased by 10 %."""
    scene, space = studied()
    recording, truth = recorded(seed, "a")
    assert truth == drawn(np.random.default_rng([seed, 0]))
    found = identify_parameters(
        scene, space, [recording], config=IdentifyConfig(search=CmaConfig(population=16, generations=8))
    )
    deviations = found.full_gaussian.interval(0.9)
    for k, value in enumerate((truth.damping, truth.friction)):
        low, high = (bound[k] for bound in deviations)
        assert high - low < 0.1 * value
        assert abs(found.best[k] - value) < 1.5 * (high - low)


@pytest.mark.slow
def test_residuals_at_rest_are_not_used_for_noise():
    scene, space = studied()
    recording, _ = recorded(2, "a")
    cost = make_cost(scene, space, [recording])
    moves = cost.comparisons[0].channel("torque").moves
    assert 0.5 < moves.mean() < 0.9
    estimated = cost.with_estimated_noise(space.mean)
    noise = 1.0 / estimated.comparisons[0].channel("torque").noise.weight[0, 0]
    left = cost.comparisons[0].channel("torque").noise.mean - cost.smoothed(space.mean[None])[0][0]
    assert noise >= np.sqrt(np.mean(left[moves] ** 2))
