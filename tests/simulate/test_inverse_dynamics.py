"""The inverse replay against mj_inverse and closed forms from the C engine."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from droid_jax import runtime
from droid_jax.cost.cost import make_cost
from droid_jax.door.scene import ARM, door_scene
from droid_jax.door.space import torque_offsets
from droid_jax.identify.holdout import split_repeats
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.fields import body_mass, joint_damping, joint_encoder_offset, joint_frictionloss
from droid_jax.model.joint_friction import sensor_parameter
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model, make_physics
from droid_jax.model.quiet_mjx import mjx
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.model.step import gear_torques
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.compiled import compiled_replay
from droid_jax.simulate.inverse_dynamics import motion_path, path_replay, prescribed_joints
from droid_jax.simulate.measured_motion import Motion
from droid_jax.simulate.replay import Replay, torque_offset_effect

MOTOR, LINK = TorqueSide.MOTOR, TorqueSide.LINK
PLANAR = """<mujoco><compiler angle="radian"/><worldbody>
  <body {gravcomp}><joint name="a" axis="0 1 0" armature="0.1" damping="2" {spring}/>
    <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="2"/>
    <body name="elbow" pos=".3 0 0" {gravcomp}><joint name="b" axis="0 1 0" armature="0.05" damping="1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .2 0 .1" mass="1" contype="0"/></body></body>
</worldbody><actuator><position joint="a" kp="9"/><position joint="b" kp="9"/></actuator>{more}</mujoco>"""
TENDON = """<tendon><fixed stiffness="20" damping="3" springlength="0.1">
  <joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>"""


def motion(scene: Scene, side: TorqueSide, gravity: bool, count: int = 40) -> Motion:
    rng = np.random.default_rng(2)
    ids = [scene.id("joint", j) for j in scene.joints]
    low, high = scene.model.jnt_range[ids].T if scene.model.jnt_range[ids].any() else (-1.0, 1.0)
    size = (count, len(scene.joints))
    return Motion(
        joints=scene.joints,
        time=0.01 * np.arange(count),
        position=rng.uniform(low, high, size),
        velocity=rng.normal(0, 1.0, size),
        acceleration=rng.normal(0, 3.0, size),
        torque=TorqueConvention(side, gravity),
    )


def inverse_replay(scene: Scene, motion: Motion, effects: Sequence[Effect] = ()) -> Replay:
    """Torques of one prescribed motion."""
    replay, path = path_replay(scene, motion.torque, effects, motion.joints), motion_path(scene, motion)
    return lambda physics: replay(physics, path)


def replayed(scene: Scene, space: Space, values: np.ndarray, given: Motion, *effects: Effect) -> Rollout:
    replay = inverse_replay(scene, given, effects)
    compiled = jax.jit(lambda v: replay(make_physics(scene, space, v)), compiler_options=runtime.compiler_options())
    return jax.tree.map(np.asarray, compiled(jnp.asarray(values, jnp.float32)))


def expected(model: mujoco.MjModel, scene: Scene, given: Motion) -> np.ndarray:
    """[T, J] N m by mj_inverse, with the parts that the convention excludes removed from the model."""
    model = model.__copy__()
    model.body_gravcomp[:] = 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if not given.torque.gravity:
        model.opt.gravity[:] = 0
    friction = model.dof_frictionloss[scene.joint_dofs] * np.sign(given.velocity)
    if given.torque.side is LINK:
        model.dof_armature[scene.joint_dofs] = 0
        model.dof_damping[scene.joint_dofs] = 0
        friction = 0 * friction
    data, out = mujoco.MjData(model), []
    for q, v, a in zip(given.position, given.velocity, given.acceleration, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[scene.joint_qpos], data.qvel[scene.joint_dofs], data.qacc[scene.joint_dofs] = q, v, a
        mujoco.mj_inverse(model, data)
        out.append(data.qfrc_inverse[scene.joint_dofs].copy())
    return np.array(out) + friction


@pytest.fixture(scope="module")
def panda() -> tuple[Scene, Space]:
    scene = door_scene()
    names = [joint_damping(scene, j, name=f"damping_{j}", std=1.0, high=100.0) for j in ARM]
    return scene, Space((*names, body_mass(scene, "link3", std=0.5, high=10.0), *torque_offsets(ARM)))


# float32 dynamics: 6e-8 of inertias times accelerations and of 60 N m of weight
TOLERANCE = 3e-4


@pytest.mark.slow  # compiles for half a minute; the planar arm below holds all four
@pytest.mark.parametrize(
    ("side", "gravity"),
    [
        (LINK, True),
        (MOTOR, False),
        (MOTOR, True),
        (LINK, False),
    ],
)
def test_the_panda_against_mj_inverse(panda: tuple[Scene, Space], side: TorqueSide, gravity: bool):
    scene, space = panda
    values = space.values({"damping_panda_joint2": 3.0, "link3_mass": 4.5})
    given = motion(scene, side, gravity)
    got = replayed(scene, space, values, given)
    np.testing.assert_allclose(got.torque, expected(make_c_model(scene, space, values), scene, given), atol=TOLERANCE)
    assert got.finite
    np.testing.assert_allclose(got.position, given.position, rtol=1e-6)
    np.testing.assert_allclose(got.velocity, given.velocity, rtol=1e-6)


def planar(*, gravcomp: bool = True, spring: str = "", more: str = "", joints: Sequence[str] | None = None) -> Scene:
    xml = PLANAR.format(gravcomp='gravcomp="1"' if gravcomp else "", spring=spring, more=more)
    return compile_scene(mujoco.MjSpec.from_string(xml), "planar", joints=joints)


def check_planar(scene: Scene, side: TorqueSide, gravity: bool) -> None:
    """With a torque offset: sensor effects are applied."""
    space = Space(torque_offsets(scene.joints))
    given, off = motion(scene, side, gravity), np.array([0.0, 0.3])
    values = space.values({"torque_offset[b]": off[1]})
    got = replayed(scene, space, values, given, torque_offset_effect(scene.joints))
    np.testing.assert_allclose(got.torque - off, expected(scene.model, scene, given), atol=5e-5)


@pytest.mark.parametrize(
    ("gravcomp", "side", "gravity"),
    [
        (False, MOTOR, True),
        (True, LINK, True),
        pytest.param(True, MOTOR, False, marks=pytest.mark.slow),
        pytest.param(False, LINK, False, marks=pytest.mark.slow),
    ],
)
def test_gravity_follows_the_recordings_convention(gravcomp: bool, side: TorqueSide, gravity: bool):
    """The MJCF's gravity compensation must not change the compared torque."""
    check_planar(planar(gravcomp=gravcomp), side, gravity)


@pytest.mark.slow
@pytest.mark.parametrize("side", [MOTOR, LINK])
def test_springs_act_on_both_sides_and_dry_friction_on_the_motor_side(side: TorqueSide):
    """A joint's spring, a tendon's, and a friction loss that opposes the motion."""
    check_planar(planar(spring='stiffness="5" springref="0.3" frictionloss="0.7"', more=TENDON), side, False)


@pytest.mark.parametrize(("side", "gravity"), [(MOTOR, True), pytest.param(LINK, False, marks=pytest.mark.slow)])
def test_plain_c_follows_the_same_equation(side: TorqueSide, gravity: bool):
    """Masses, springs, tendons, friction at rest and sensor friction, along two motions."""
    scene = planar(spring='stiffness="5" springref="0.3" frictionloss="0.7"', more=TENDON)
    sensed = [
        sensor_parameter(scene.joints, term, "b", std=0.1, high=2.0)
        for term in ("viscous", "coulomb", "torque_offset", "torque_gain")
    ]
    parameters = [body_mass(scene, "elbow", std=0.3, high=5.0), joint_frictionloss(scene, "a", std=0.3, high=3.0)]
    if gravity:  # else only MJX knows the weight that was taken out where the encoder says
        parameters.append(joint_encoder_offset(scene, "a", std=0.1, high=0.5))
    space = Space((*parameters, *sensed))
    values = np.tile(space.mean, (4, 1))
    values[1:, 0], values[2:, 1:] = 1.7, 0.2
    given = motion(scene, side, gravity)
    given = replace(
        given, rest=np.abs(given.velocity) < 0.4, measured=np.random.default_rng(3).normal(size=given.velocity.shape)
    )
    later = replace(given, position=given.position[::-1])
    for follows in (given, later):
        one, other = (compiled_replay(e, scene, space, follows, ()) for e in ("mjx", "mujoco"))
        mjx, c = one(values), other(values)
        np.testing.assert_allclose(c.torque, mjx.torque, atol=5e-5)
        assert np.asarray(c.finite).all() and np.ptp(np.asarray(c.torque), axis=0).max() > 0.1
        paths = jax.tree.map(lambda a: jnp.stack([a, a]), motion_path(scene, follows))
        np.testing.assert_allclose(other.torques(paths), np.stack([mjx.torque[0]] * 2), atol=5e-5)  # at the means
        if side is LINK:  # MJX compiles them again
            np.testing.assert_allclose(other.torques(paths), one.torques(paths), atol=5e-5)


@pytest.mark.parametrize("gravcomp", [True, False])
def test_gear_torques_contain_the_weight_for_both_conventions(gravcomp: bool):
    """The gears' torques equal those of the servo replay at the same instant, for both gravity conventions."""
    scene = planar(gravcomp=gravcomp)
    data, rng = mujoco.MjData(scene.model), np.random.default_rng(4)
    data.qpos[:], data.qvel[:], data.ctrl[:] = rng.normal(0.0, 0.5, (3, 2))
    mujoco.mj_forward(scene.model, data)
    servo = np.array(gear_torques(scene.mjx, mjx.put_data(scene.model, data), jnp.asarray(data.qvel)))
    moment = (data.qpos, data.qvel, data.qacc)
    given = motion(scene, MOTOR, gravity=False, count=1)
    given = replace(
        given, **dict(zip(("position", "velocity", "acceleration"), (m[None] for m in moment), strict=True))
    )
    space = Space(tuple(Parameter(name, "-", 0.0, 1.0, -1.0, 1.0) for name in ("motor", "links")))
    pushed = Effect(
        "pushed", force=lambda theta, state: -theta["motor"] * state.gear[0] - theta["links"] * state.gear[1]
    )
    replay = inverse_replay(scene, given, [pushed])
    torque = jax.jit(jax.vmap(lambda v: replay(make_physics(scene, space, v)).torque[0]))(jnp.eye(3, 2, -1))
    found = torque[1:] - torque[0]
    np.testing.assert_allclose(found, servo, atol=1e-4)
    assert np.abs(servo[1]).max() > 1.0


def test_plain_c_refuses_unsupported_effects():
    scene = planar()
    pull = Effect("pull", force=lambda theta, state: state.qvel)
    space = Space(torque_offsets(scene.joints))
    with pytest.raises(ValueError, match="effects depend on the state: pull; use MJX"):
        compiled_replay("mujoco", scene, space, motion(scene, LINK, True), [pull])
    turned = Space((joint_encoder_offset(scene, "a", std=0.1, high=0.5),))
    with pytest.raises(
        ValueError, match="subtracted gravity at the positions that encoders read, not at the true ones; use MJX"
    ):
        compiled_replay("mujoco", scene, turned, motion(scene, LINK, False), ())


def log(columns: Sequence[str], holes: bool = False) -> Recording:
    """Two seconds of the planar arm without commands."""
    time = np.arange(0.0, 2.0, 0.005)
    values = np.stack([1.0 + 0.5 * np.sin(1.5 * time), 0.4 * np.sin(2.0 * time)], axis=1)[None, :, : len(columns)]
    mask = np.ones(values.shape, bool)
    mask[:, 100:120, 0] = not holes
    channels = {"position": Channel("position", "rad", tuple(columns), time, values, mask)}
    return Recording("log", np.zeros(0), np.zeros((0, 0)), (), channels, TorqueConvention(LINK, True), qpos0={})


def test_a_joint_that_carries_a_measured_one_moves_with_the_log():
    """Torques of the second joint only are compared, but the first one tilts and accelerates it."""
    whole, part = planar(), planar(joints=["b"])
    assert prescribed_joints(part, log(["a", "b"])) == ("b", "a")
    given = motion(whole, LINK, True)
    turned = {name: getattr(given, name)[:, ::-1] for name in ("position", "velocity", "acceleration")}
    space = Space(torque_offsets(["b"]))
    got = replayed(part, space, space.mean, replace(given, joints=("b", "a"), **turned))
    np.testing.assert_allclose(got.torque, expected(whole.model, whole, given)[:, 1:], atol=5e-5)
    np.testing.assert_allclose(got.position, given.position[:, 1:], rtol=1e-6)


def test_a_carrier_without_positions_is_warned_of():
    part = planar(joints=["b"])
    for recording in (log(["b"]), log(["a", "b"], holes=True)):
        with pytest.warns(UserWarning, match="does not hold the positions of a throughout, which carry"):
            assert prescribed_joints(part, recording) == ("b",)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert prescribed_joints(planar(joints=["a"]), log(["a"])) == ("a",)  # nothing carries it


def test_a_joint_with_gaps_in_its_positions_is_warned_of():
    """After one lost sample the replay holds it at its first position for the whole log."""
    part, whole = planar(joints=["a"]), log(["a", "b"])
    mask = whole.channels["position"].mask.copy()

    def holed() -> Recording:
        return replace(whole, channels={"position": replace(whole.channels["position"], mask=mask)})

    mask[:, 100, 1] = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert prescribed_joints(part, holed()) == ("a", "b")
    mask[:, 100:120, 1] = False
    with pytest.warns(UserWarning, match=r"positions of b for a part of the time: .*--start S --end S"):
        assert prescribed_joints(part, holed()) == ("a",)


@pytest.mark.parametrize("part", ["command", "servo"])
def test_effects_on_servos_are_refused_along_a_prescribed_motion(part: str):
    scene = planar()
    effect = Effect("backlash", **{part: lambda *_: None})
    with pytest.raises(ValueError, match="backlash"):
        inverse_replay(scene, motion(scene, MOTOR, False), [effect])


def test_air_and_water_are_refused():
    xml = PLANAR.format(gravcomp="", spring="", more='<option density="1000" integrator="Euler"/>')
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "pool", engine="mujoco")
    with pytest.raises(ValueError, match="a replay of scene 'pool' has no air or water"):
        inverse_replay(scene, motion(scene, MOTOR, False))


LOCKED = """<mujoco><compiler angle="radian"/><worldbody>
  <body><joint name="torso" axis="0 1 0"/><geom size=".1" pos="0 0 .3" mass="3"/>
    <body pos="0 0 .4"><joint name="arm" axis="0 1 0"/>
      <geom size=".05" pos="0 0 .3" mass="1"/></body></body></worldbody>
  <actuator><position joint="arm" kp="9"/></actuator></mujoco>"""


def standing(qpos0: dict[str, float]) -> Recording:
    time = np.arange(0.0, 3.0, 0.005)
    path = (0.3 * np.sin(2 * time))[None, :, None]
    channels = {
        name: Channel(name, unit, ("arm",), time, path, np.ones(path.shape, bool))
        for name, unit in (("position", "rad"), ("torque", "N m"))
    }
    return Recording("log", np.zeros(0), np.zeros((0, 0)), (), channels, TorqueConvention(MOTOR, True), qpos0=qpos0)


def test_a_joint_that_is_not_in_the_log_has_its_stated_position():
    """Its position changes the weight at the other joint."""
    scene = compile_scene(mujoco.MjSpec.from_string(LOCKED), "locked")
    space = Space((joint_damping(scene, "arm", name="damping", std=0.1, high=5.0),))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cost = make_cost(scene, space, [standing({"torso": 0.7})])
    rollout = cost.rollouts(np.zeros((1, 1)))[0]
    weight = -1.0 * 9.81 * 0.3 * np.sin(0.7 + np.asarray(rollout.position)[0, :, 0])
    inertia = (0.3**2 + 0.4 * 0.05**2) * np.gradient(
        np.gradient(np.asarray(rollout.position)[0, :, 0], rollout.time[0]), rollout.time[0]
    )
    np.testing.assert_allclose(np.asarray(rollout.torque)[0, 5:-5, 0], (weight + inertia)[5:-5], atol=0.01)
    with pytest.warns(UserWarning, match="holds them still as in the scene"):
        make_cost(scene, space, [standing({})])
    with pytest.raises(ValueError, match="unknown joint 'waist'"):
        make_cost(scene, space, [standing({"torso": 0.7, "waist": 1.0})]).rollouts(np.zeros((1, 1)))


def test_a_log_of_a_floating_robot_is_refused():
    scene = compile_scene(
        mujoco.MjSpec.from_string(LOCKED.replace('<joint name="torso" axis="0 1 0"/>', "<freejoint/>")), "walks"
    )
    with pytest.raises(
        ValueError, match=r"the joint of body .* of scene 'walks' \(a free or ball joint\) carries measured"
    ):
        prescribed_joints(scene, standing({}))


def test_a_part_of_a_log_keeps_stated_positions():
    """Its end is held out.  A joint that was measured, but not there, does not stand at its first position."""
    whole = standing({"torso": 0.7, "arm": 0.0})
    part = whole.window(2.0, 3.0)
    assert part.qpos0["torso"] == 0.7 and part.qpos0["arm"] == pytest.approx(0.3 * np.sin(4.0), abs=1e-3)
    fitted, held, _ = split_repeats(whole, 0.3)
    assert fitted.qpos0["torso"] == held.qpos0["torso"] == 0.7


def test_a_carrier_with_a_gap_is_warned_of_though_its_start_is_known():
    """A ROS bag's log states qpos0 of all measured joints."""
    scene = compile_scene(mujoco.MjSpec.from_string(LOCKED), "locked")
    log = standing({"torso": 0.0, "arm": 0.0})
    path = log.channels["position"]
    values = np.concatenate([path.values, path.values], axis=2)
    mask = np.ones(values.shape, bool)
    mask[:, 100:120, 1] = False
    holed = replace(path, columns=("arm", "torso"), values=values, mask=mask)
    with pytest.warns(UserWarning, match="the positions of torso throughout"):
        assert prescribed_joints(scene, replace(log, channels={**log.channels, "position": holed})) == ("arm",)
