"""Effects in inverse dynamics: torques that overcome them, on the motor side and on the link side."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effect_bench import JOINTS, MECHANISM, mechanism
from effect_oracles import ORACLES, SLOW, Now

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import effect_space, library
from droid_jax.model.joint_friction import joint_friction_effect, joint_friction_space
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_physics
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.batching import over_population
from droid_jax.simulate.inverse_dynamics import motion_path, path_replay
from droid_jax.simulate.measured_motion import Motion
from droid_jax.simulate.replay import Replay

MOTOR, LINK = TorqueSide.MOTOR, TorqueSide.LINK
STEERING = ("clock_rate", "command_delay", "joint_backlash", "joint_compliance", "profile_acceleration",
            "profile_speed", "torque_speed_line", "velocity_feedforward")  # fmt: skip
COULOMB = 0.15  # N m: the friction that a link-side sensor sees already, in one row of each comparison
TOLERANCE = 1e-4  # N m: float32, 6e-8 of inertias times accelerations and of 9 N m of weight, summed


def prescribed(scene: Scene, side: TorqueSide, gravity: bool) -> Motion:
    """Random states with all signs of angle and speed, some nearly at rest."""
    rng = np.random.default_rng(6)
    size = (80, len(scene.joints))
    speed = rng.normal(0, 1.0, size)
    speed[::4] *= 0.02
    return Motion(
        joints=scene.joints,
        time=0.01 * np.arange(len(speed)),
        position=rng.uniform(-0.3, 1.0, size),
        velocity=speed,
        acceleration=rng.normal(0, 3.0, size),
        torque=TorqueConvention(side, gravity),
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return mechanism()


def inverse_replay(scene: Scene, motion: Motion, effects: Sequence[Effect] = ()) -> Replay:
    """Torques of one prescribed motion."""
    replay, path = path_replay(scene, motion.torque, effects, motion.joints), motion_path(scene, motion)
    return lambda physics: replay(physics, path)


class Inverse:
    """The inverse replay with all its possible effects, and the sensor's friction."""

    def __init__(self, scene: Scene, side: TorqueSide, gravity: bool) -> None:
        self.scene, self.side = scene, side
        self.motion = prescribed(scene, side, gravity)
        effects = [e for e in library(scene) if e.name not in STEERING]
        self.space: Space = effect_space(effects) + joint_friction_space(JOINTS)
        replay = inverse_replay(scene, self.motion, [*effects, joint_friction_effect(JOINTS)])
        self.run = over_population(lambda v: replay(make_physics(scene, self.space, v)))

    @functools.cached_property
    def links(self) -> np.ndarray:
        """[T, J] N m that weight, springs and the other joints' motion put onto the gears."""
        return -self.asked(gravity=True)

    def asked(self, gravity: bool) -> np.ndarray:
        """[T, J] N m that the links ask of undamped joints, but for their acceleration."""
        spec = mujoco.MjSpec.from_string(MECHANISM)
        for joint in spec.joints:
            joint.damping[:] = 0.0
        return mj_inverse(spec, replace(self.motion, acceleration=0.0 * self.motion.acceleration), gravity)

    def torque(self, *rows: dict[str, float]) -> np.ndarray:
        """[P, T, J] N m"""
        return self.run(np.array([self.space.values(row) for row in rows])).torque.astype(float)

    def by_formula(self, function: Callable, v: dict[str, float], load: np.ndarray) -> np.ndarray:
        """[T, J] of an oracle's force or loss; NaN where it has none."""
        out = np.full(load.shape, np.nan)
        slowed = self.scene.model.dof_damping[self.scene.joint_dofs] * self.motion.velocity
        motor = load - slowed if self.side is MOTOR else load
        motor = motor + self.asked(True) - self.asked(self.motion.torque.gravity)  # the gear carries the weight
        moments = (self.motion.position, self.motion.velocity, load, motor, self.links)
        for k, numbers in enumerate(zip(*moments, strict=True)):
            q, w, torque, motor, links = (dict(zip(JOINTS, n.tolist(), strict=True)) for n in numbers)
            for joint, value in function(v, Now(q, w, torque, {}, motor, links)).items():
                out[k, JOINTS.index(joint)] = value
        return out


@pytest.fixture(
    scope="module", params=[(MOTOR, True), pytest.param((LINK, False), marks=pytest.mark.slow)], ids=["motor", "link"]
)
def inverse(request: pytest.FixtureRequest, scene: Scene) -> Inverse:
    return Inverse(scene, *request.param)


def mj_inverse(spec: mujoco.MjSpec, motion: Motion, gravity: bool) -> np.ndarray:
    """[T, J] N m of the links of an MJCF."""
    for body in spec.bodies:
        body.gravcomp = 0
    for joint in spec.joints:
        joint.frictionloss = 0
    spec.option.gravity = [0, 0, -9.81 * gravity]
    model = spec.compile()
    data = mujoco.MjData(model)
    dofs = [int(model.joint(j).dofadr[0]) for j in JOINTS]
    out = []
    for moment in zip(motion.position, motion.velocity, motion.acceleration, strict=True):
        data.qpos[dofs], data.qvel[dofs], data.qacc[dofs] = moment
        mujoco.mj_inverse(model, data)
        out.append(data.qfrc_inverse[dofs].copy())
    return np.array(out)


@pytest.mark.parametrize("name", [n for n, o in ORACLES.items() if o.force])
def test_forces_have_to_be_overcome(inverse: Inverse, name: str):
    oracle = ORACLES[name]
    neutral, got = inverse.torque({}, dict(oracle.values))
    push = np.nan_to_num(inverse.by_formula(oracle.force, oracle.values, neutral))
    np.testing.assert_allclose(got - neutral, -push, atol=TOLERANCE)
    assert np.abs(push).max() > 100 * TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("coulomb", [0.0, COULOMB])
@pytest.mark.parametrize("name", [n for n, o in ORACLES.items() if o.loss])
def test_friction_has_to_be_overcome(inverse: Inverse, name: str, coulomb: float):
    """In addition to the MJCF's friction on the motor side, and to the sensor's on the link side."""
    oracle = ORACLES[name]
    seen = {f"coulomb[{j}]": coulomb for j in JOINTS}
    neutral, got = inverse.torque(seen, {**seen, **oracle.values})
    scene = inverse.scene
    motors = scene.model.dof_frictionloss[scene.joint_dofs]
    own = np.broadcast_to(motors if inverse.side is MOTOR else np.full(len(JOINTS), coulomb), neutral.shape)
    direction = np.sign(inverse.motion.velocity)
    behind = coulomb * np.tanh(inverse.motion.velocity / SLOW)  # as the bench's own effect reads it
    more = inverse.by_formula(oracle.loss, oracle.values, neutral - behind)
    loss = np.where(np.isnan(more), own, np.maximum(own + more, 0.0))
    expected = (loss - own) * direction
    np.testing.assert_allclose(got - neutral, expected, atol=TOLERANCE)
    assert np.abs(expected).max() > 100 * TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, o in ORACLES.items() if o.read])
def test_sensor_effects_are_applied(inverse: Inverse, name: str):
    oracle = ORACLES[name]
    neutral, got = inverse.torque({}, dict(oracle.values))
    np.testing.assert_allclose(got, oracle.read(oracle.values, inverse.motion.time, neutral), atol=TOLERANCE)
    assert np.abs(got - neutral).max() > 100 * TOLERANCE


@pytest.mark.parametrize("name", ["payload", "free_payload"])
def test_a_payload_is_carried(inverse: Inverse, name: str):
    oracle = ORACLES[name]
    neutral, got = inverse.torque({}, dict(oracle.values))
    loaded = mujoco.MjSpec.from_string(MECHANISM)
    oracle.edit(loaded, oracle.values)
    gravity = inverse.motion.torque.gravity
    expected = mj_inverse(loaded, inverse.motion, gravity)
    expected -= mj_inverse(mujoco.MjSpec.from_string(MECHANISM), inverse.motion, gravity)
    expected -= np.nan_to_num(inverse.by_formula(oracle.beside, oracle.values, neutral))
    np.testing.assert_allclose(got - neutral, expected, atol=TOLERANCE)
    assert np.abs(expected).max() > 100 * TOLERANCE


def test_a_path_contains_encoder_readings(inverse: Inverse):
    """Torques are those of the true pose; a torque without gravity had that of the read pose subtracted."""
    oracle = ORACLES["encoder_offset"]
    neutral, got = inverse.torque({}, dict(oracle.values))
    read, off = inverse.motion, np.array([oracle.values.get(f"encoder_offset[{j}]", 0.0) for j in JOINTS])
    true = replace(read, position=read.position + off)

    def asked(motion: Motion, gravity: bool) -> np.ndarray:
        return mj_inverse(mujoco.MjSpec.from_string(MECHANISM), motion, gravity)

    def weight(motion: Motion) -> np.ndarray:
        return asked(motion, True) - asked(motion, False)

    expected = asked(true, True) - asked(read, True)
    if not read.torque.gravity:
        expected = asked(true, False) - asked(read, False) + weight(true) - weight(read)
    np.testing.assert_allclose(got - neutral, expected, atol=TOLERANCE)
    assert np.abs(expected).max() > 100 * TOLERANCE


def test_firm_friction_has_no_effect(inverse: Inverse):
    neutral, got = inverse.torque({}, dict(ORACLES["soft_friction"].values))
    np.testing.assert_array_equal(got, neutral)


def test_servo_gains_have_no_effect(inverse: Inverse):
    neutral, got = inverse.torque({}, dict(ORACLES["servo_gain"].values))
    np.testing.assert_array_equal(got, neutral)


def test_these_are_all_effects(scene: Scene):
    """A new effect must be added to one of these lists."""
    left = {n for n, o in ORACLES.items() if not (o.force or o.loss or o.read)}
    assert left == {"payload", "free_payload", "servo_gain", "encoder_offset", "soft_friction", *STEERING}
    assert {e.name for e in library(scene)} == {*ORACLES}


@pytest.mark.parametrize("name", STEERING)
def test_effects_on_commands_are_refused_by_name(scene: Scene, name: str):
    given = prescribed(scene, MOTOR, True)
    with pytest.raises(ValueError, match=f"effects {name} change commands, which a prescribed motion"):
        inverse_replay(scene, given, library(scene, ["drag", name, "torque_bias"]))


def test_all_effects_on_commands_are_listed(scene: Scene):
    with pytest.raises(ValueError, match=", ".join(STEERING)):
        inverse_replay(scene, prescribed(scene, LINK, False), library(scene))
