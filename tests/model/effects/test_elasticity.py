"""Elastic joints, and effects along a chain of bodies."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from effect_bench import ARM, door, mechanism

from droid_jax.discrepancy.candidates import machine_scale
from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.door.scene import door_scene
from droid_jax.model.effect_interface import Effect, Rollout, State
from droid_jax.model.effects.effect_scaling import scale_of, usual_torques
from droid_jax.model.effects.kinematics import turned
from droid_jax.model.effects.registry import library
from droid_jax.model.fields import servo_scale, time_offset
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_physics
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.compiled import compiled_replay, window_program
from droid_jax.simulate.replay import Drive, servo_motion, traced_part


@pytest.mark.parametrize("scale", [1.0, 1.4])
def test_backlash_has_no_torque_inside_and_compliance_is_linear(scale: float):
    scene = mechanism()
    space = Space(tuple(servo_scale(scene, joint, std=0.3) for joint in ARM))
    model = make_physics(scene, space, jnp.full(len(space), scale, jnp.float32)).model
    still = jnp.zeros(scene.model.nv, jnp.float32)
    state = State(jnp.float32(0.0), jnp.asarray(scene.initial_qpos({}), jnp.float32), still, still, model)
    rows = [scene.command_names.index(joint) for joint in ARM]
    ahead = jnp.zeros(scene.model.nu).at[np.array(rows)].set(0.002)  # rad, of where the joints are
    ctrl = ahead + state.qpos[np.array([scene.qpos(j) for j in scene.command_names])]
    backlash, compliance = library(scene, ["joint_backlash", "joint_compliance"])
    assert backlash.servo is not None and compliance.servo is not None

    def torque(given) -> np.ndarray:
        length = state.qpos[np.array([scene.qpos(j) for j in scene.command_names])]
        return np.asarray(model.actuator_gainprm[:, 0] * given + model.actuator_biasprm[:, 1] * length)[rows]

    stiffness = scale * scene.model.actuator_gainprm[rows, 0]
    np.testing.assert_allclose(torque(ctrl), 0.002 * stiffness, rtol=1e-4)
    play = backlash.servo({f"joint_backlash[{j}]": 0.006 for j in ARM}, state, ctrl)
    np.testing.assert_allclose(torque(play), 0.0, atol=1e-5)
    soft = compliance.servo({f"joint_compliance[{j}]": 1e-3 for j in ARM}, state, ctrl)
    np.testing.assert_allclose(torque(soft), 0.002 / (1.0 / stiffness + 1e-3), rtol=1e-4)


SERVO = """<mujoco><worldbody><body><joint name="{joint}" type="{kind}" axis="1 0 0" damping="9"/><geom size=".1"/>
  </body></worldbody><actuator><position name="{joint}" joint="{joint}" kp="{kp}" gear="{gear}"/></actuator></mujoco>"""


def servo_of(**numbers: object) -> Scene:
    xml = SERVO.format(**{"joint": "j", "kind": "hinge", "kp": 20, "gear": 1, **numbers})
    return compile_scene(mujoco.MjSpec.from_string(xml), "servo", joints=["j"])


def test_a_servo_without_gain_has_no_gear_that_yields():
    """Regression: a log of a robot in damping mode, kp = 0, had no finite replay."""
    scene = servo_of()
    still = jnp.zeros(1, jnp.float32)
    physics = scene.mjx
    off = physics.replace(actuator_gainprm=0 * physics.actuator_gainprm, actuator_biasprm=0 * physics.actuator_biasprm)
    state = State(jnp.float32(0.0), still, still, still, off)
    for effect in library(scene, ["joint_backlash", "joint_compliance"]):
        assert effect.servo is not None
        theta = {f"{effect.name}[j]": jnp.float32(1e-3)}
        np.testing.assert_allclose(effect.servo(theta, state, still + 0.3), [0.3], rtol=1e-6)


def test_a_stiff_servo_has_a_gear_that_is_as_stiff():
    """Regression: its least compliance was twice the servo's own, at which nothing could be named."""
    (effect,) = library(servo_of(kind="slide", kp=1e5), ["joint_compliance"])
    assert effect.minimum_size < 0.05 / 1e5 and effect.parameters[0].high == pytest.approx(1 / 1e5)


@pytest.mark.parametrize("name", ["profile_speed", "profile_acceleration"])
def test_a_profile_is_the_joints_behind_a_gear(name: str):
    """Regression: the limit was one of the control, which is the joint's position times the gear."""
    (effect, geared) = (library(servo_of(gear=gear), [name])[0] for gear in (1, 50))
    assert effect.profile is not None and geared.profile is not None
    command, theta = jnp.linspace(0.0, 1.0, 200)[:, None] ** 2, {f"{name}[j]": jnp.float32(0.9)}
    expected = effect.profile(theta, command, 0.002)
    assert float(jnp.max(jnp.abs(expected - command))) > 0.1
    np.testing.assert_allclose(geared.profile(theta, 50 * command, 0.002) / 50, expected, atol=1e-5)


def test_the_recorded_position_of_an_elastic_joint_is_the_motors():
    """The servo's encoder is on the motor."""
    scene = mechanism()
    (effect,) = library(scene, ["joint_compliance"])
    assert effect.observe is not None
    time, joints = jnp.linspace(0.0, 2.0, 101), len(scene.joints)
    torque = jnp.sin(3 * time)[:, None] * jnp.arange(1.0, joints + 1)
    still, none = jnp.zeros((101, joints)), jnp.zeros((101, 0), bool)
    rollout = Rollout(time, torque, still, still, jnp.zeros(101), none, jnp.array(True))
    joint = ARM[0]
    column = scene.joints.index(joint)
    seen = effect.observe({f"joint_compliance[{joint}]": jnp.float32(1e-3)}, rollout)
    np.testing.assert_allclose(seen.position[:, column], 1e-3 * torque[:, column], rtol=1e-5)
    slope = 3e-3 * (column + 1) * np.cos(3 * np.asarray(time))
    np.testing.assert_allclose(seen.velocity[1:-1, column], slope[1:-1], atol=1e-5 * joints)
    others = np.delete(np.arange(joints), column)
    assert not np.any(seen.position[:, others]) and np.array_equal(seen.torque, torque)


# ----- a motion that begins under a load

KP, MASS, REACH = 60.0, 0.8, 0.25  # N m/rad, kg, m
HELD = 0.3  # rad, of the link, below the horizontal
WEIGHT = MASS * 9.81 * REACH * np.cos(HELD)  # N m
COMPLIANCE = 2e-3  # rad/(N m)
PERIOD = 0.002  # s


def weighted(limit: float = 1e3) -> Scene:
    """A level hinge with a servo and a weight, which pulls to positive angles."""
    return compile_scene(
        mujoco.MjSpec.from_string(
            f"""<mujoco><option timestep="{PERIOD}" integrator="implicitfast"/><worldbody><body>
            <joint name="j" axis="0 1 0" armature="0.02" damping="0.4"/><geom size="0.02" pos="{REACH} 0 0"
            mass="{MASS}" contype="0" conaffinity="0"/></body></worldbody><actuator><position name="j" joint="j"
            kp="{KP}" kv="0.8" forcerange="{-limit} {limit}"/></actuator></mujoco>"""
        ),
        "weight",
        joints=("j",),
    )


def compliant(scene: Scene) -> tuple[tuple[Effect, ...], Space]:
    effects = library(scene, ["joint_compliance"])
    return effects, Space(tuple(p for e in effects for p in e.parameters))


def holding(steps: int, compliance: float = COMPLIANCE) -> Drive:
    """The weight at rest: the servo's torque holds it, and the recorded position is the motor's."""
    recorded = HELD - compliance * WEIGHT
    command = np.full((steps, 1), recorded - WEIGHT / KP)
    return Drive(command, np.array([recorded]), PERIOD, TorqueConvention(TorqueSide.MOTOR, gravity=True))


def test_a_weight_on_a_compliant_joint_begins_below_its_encoder_and_rests():
    """Closed form: the link is lower than the recorded position by torque times compliance."""
    scene, drive = weighted(), holding(300)
    effects, space = compliant(scene)
    rows = np.tile(space.values({"joint_compliance[j]": COMPLIANCE}), (2, 1))
    recorded = compiled_replay("mjx", scene, space, drive, effects)(rows)
    position, torque = (np.asarray(trace)[0, :, 0] for trace in (recorded.position, recorded.torque))
    assert position[0] == pytest.approx(drive.qpos0[0], abs=3e-7)
    np.testing.assert_allclose(position, drive.qpos0[0], atol=2e-6)
    np.testing.assert_allclose(torque, -WEIGHT, rtol=1e-4)

    motion, inputs = servo_motion(scene, drive, effects), traced_part(scene, drive)
    link = jax.jit(lambda values: motion(make_physics(scene, space, values), *inputs, 300).position[:, 0])
    of_link = np.asarray(link(jnp.asarray(rows[0], jnp.float32)))
    np.testing.assert_allclose(of_link, HELD, atol=2e-6)
    assert of_link[0] - position[0] == pytest.approx(COMPLIANCE * WEIGHT, rel=1e-4)
    # The start has the derivative of the closed form, the weight's torque, at neutral too.
    for at in (0.0, COMPLIANCE):
        slope = np.asarray(jax.jacfwd(link)(jnp.array([at], jnp.float32)))[:, 0]
        assert np.isfinite(slope).all()
        assert slope[0] == pytest.approx(WEIGHT, rel=1e-4)


def test_a_servo_at_its_limit_begins_with_the_twist_of_that_torque():
    scene, drive = weighted(limit=1.0), holding(5)
    effects, space = compliant(scene)
    rows = np.tile(space.values({"joint_compliance[j]": COMPLIANCE}), (2, 1))
    found = compiled_replay("mjx", scene, space, drive, effects)(rows)
    assert float(found.torque[0, 0, 0]) == pytest.approx(-1.0)
    assert float(found.position[0, 0, 0]) == pytest.approx(drive.qpos0[0], abs=3e-7)


def test_a_rigid_joint_under_load_begins_where_it_did():
    """At neutral a replay is that without the effect."""
    scene, drive = weighted(), holding(200, compliance=0.0)
    drive = replace(drive, command=drive.command + 0.1 * np.sin(20.0 * drive.time)[:, None])
    effects, space = compliant(scene)
    neutral = compiled_replay("mjx", scene, space, drive, effects)(np.tile(space.mean, (2, 1)))
    without = compiled_replay("mjx", scene, Space((time_offset(),)), drive, ())(np.zeros((2, 1)))
    np.testing.assert_array_equal(neutral.position[:, 0], without.position[:, 0])
    np.testing.assert_allclose(neutral.position, without.position, atol=1e-6)
    np.testing.assert_allclose(neutral.torque, without.torque, atol=1e-4)


@pytest.mark.parametrize("begin", [0, 240, 300])
def test_a_window_of_a_compliant_joint_begins_where_the_motion_is(begin: int):
    """From recorded positions and speeds, at rest and in motion."""
    scene, steps, still = weighted(), 200, 150
    effects, space = compliant(scene)
    whole = holding(600)
    goal = 0.3 * np.sin(5.0 * PERIOD * np.maximum(np.arange(600) - still, 0))
    whole = replace(whole, command=whole.command + goal[:, None])
    rows = np.tile(space.values({"joint_compliance[j]": COMPLIANCE}), (2, 1))
    of_motion = compiled_replay("mjx", scene, space, whole, effects)(rows)
    position, velocity = (np.asarray(trace)[0, :, 0] for trace in (of_motion.position, of_motion.velocity))
    early = 0.5 * (velocity[begin - 1] + velocity[begin]) if begin else 0.0  # half a step before the position
    earlier = 10
    table = np.r_[
        np.repeat(whole.command[:1], max(earlier - begin, 0), axis=0), whole.command[max(begin - earlier, 0) :]
    ]
    window = window_program(scene, space, whole, effects, earlier, steps)
    start, speed, gains = np.full((2, 1), position[begin]), np.full((2, 1), early), np.ones((2, 1, 2))
    found = window(
        rows, np.tile(table[None, : earlier + steps], (2, 1, 1)), start, gains, speed, np.full(2, begin * PERIOD)
    )
    replayed = np.asarray(found.position)[0, :, 0]
    twist = COMPLIANCE * np.abs(np.asarray(of_motion.torque)[0, begin, 0])
    off = np.abs(replayed - position[begin : begin + steps]).max()
    assert off < (0.1 if begin else 1e-3) * twist


def test_the_prior_of_compliance_is_relative_to_the_servo():
    """A percent of a servo's compliance or more, also for a soft servo."""
    scene = mechanism()
    (effect,) = library(scene, ["joint_compliance"])
    for parameter, joint in zip(effect.parameters, ARM, strict=True):
        k = scene.model.actuator_gainprm[scene.command_names.index(joint), 0]
        assert 0.01 < k * SelectionConfig().sensitivity_step * parameter.std < 0.1
        assert -0.5 <= k * parameter.low < 0.0 and effect.minimum_size <= 0.2 * parameter.std < parameter.high
    assert min(k * effect.minimum_size for k in scene.model.actuator_gainprm[:, 0]) > 0.001


# ----- axes and rotations of an arm's own kinematics against MuJoCo's


@pytest.mark.parametrize(("scene", "body"), [(mechanism, "hand"), (door, "hand"), (door, "door")])
def test_axes_and_rotation_are_mujocos(scene, body: str):
    made: Scene = scene()
    model, data, rng = made.model, mujoco.MjData(made.model), np.random.default_rng(0)
    number = made.id("body", body)
    links = turned(made, number)
    assert links is not None
    carried = {number}
    while number := int(model.body_parentid[number]):
        carried.add(number)
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    turning = [j for j in hinges if int(model.jnt_bodyid[j]) in carried]
    assert len(turning) in (1, 2, 7)
    for _ in range(5):
        data.qpos[:] = rng.uniform(-1, 1, model.nq)
        mujoco.mj_kinematics(model, data)
        axes, rotation = links(data.qpos.astype(np.float32), model.qpos0)
        expected = np.zeros((model.nv, 3))
        expected[model.jnt_dofadr[turning]] = data.xaxis[turning]
        np.testing.assert_allclose(axes, expected, atol=2e-6)
        np.testing.assert_allclose(rotation, data.xmat[made.id("body", body)].reshape(3, 3), atol=2e-6)


def test_a_floating_body_has_none():
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='ball'><freejoint/><geom size='1'/>"
        "<body name='arm'><joint name='j'/><geom size='1'/></body></body></worldbody></mujoco>"
    )
    scene = compile_scene(spec, "flies", joints=("j",))
    assert turned(scene, scene.id("body", "arm")) is None


# ----- a motor at its full voltage, and the sizes of effects on other machines


@pytest.mark.parametrize("kv", [0.0, 30.0])
@pytest.mark.parametrize("timestep", [0.001, 0.004])
def test_a_motor_at_its_full_voltage_stays_on_its_line(kv: float, timestep: float):
    """Also where the servo damps: a motor at its limit does not."""
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep="{timestep}" integrator="implicitfast"/><worldbody><body>
        <joint name="j" axis="0 0 1" armature="0.4"/><geom size="0.05" mass="0.1" contype="0" conaffinity="0"/></body>
        </worldbody><actuator><position joint="j" kp="1000" kv="{kv}"/></actuator></mujoco>"""
    )
    scene = compile_scene(spec, "motor", joints=("j",))
    effects = library(scene, ["torque_speed_line"])
    space = Space(tuple(p for e in effects for p in e.parameters))
    command = np.r_[np.zeros(5), np.full(round(0.15 / timestep), 3.0)][:, None]
    drive = Drive(command, np.zeros(1), timestep, TorqueConvention(TorqueSide.MOTOR, gravity=True))
    values = space.values({"torque_speed_line[j]": 0.1, "torque_speed_slope": 1.0})
    slope = usual_torques(scene, ["j"])[0]  # N m s/rad, of a slope of 1 s/rad
    found = compiled_replay("mjx", scene, space, drive, effects)(np.tile(values, (2, 1)))
    torque, speed = (np.asarray(trace)[0, 8:, 0] for trace in (found.torque, found.velocity))
    np.testing.assert_allclose(torque, 10.0 - slope * speed, atol=0.02 * 10.0)  # at full voltage all the time
    assert slope * speed[-1] > 3.0


def test_the_scale_of_a_machine_is_rounded_towards_a_panda():
    assert [scale_of(x) for x in (0.0, 54.0, 20.0, 150.0, 200.0, 5.0, 0.9)] == [1.0, 1.0, 1.0, 1.0, 3.0, 1.0, 0.3]
    assert machine_scale(door_scene(springs=1), []) == 1.0
    model = mechanism()
    weight = (1.5 * 0.15 + 1.1 * 0.3 + 0.5 * 0.125 + 0.6 * 0.25) * 9.81  # N m of the arm, held out straight
    assert 0.7 * weight < usual_torques(model, ["shoulder"])[0] < 2.0 * weight


def test_measured_torques_count_for_the_scale_too():
    scene, time = mechanism(), np.linspace(0.0, 1.0, 50)
    torque = np.full((1, 50, 3), 600.0, np.float32)
    channel = Channel("torque", "N m", scene.joints, time, torque, np.ones(torque.shape, bool))
    log = Recording(
        "log", time, np.zeros((50, 0)), (), {"torque": channel}, TorqueConvention(TorqueSide.MOTOR, True), {}
    )
    assert (machine_scale(scene, []), machine_scale(scene, [log])) == (1.0, 10.0)
