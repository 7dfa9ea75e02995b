"""The servo replay of a small arm against closed forms: commands, offsets, conventions, errors."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from two_link import ARM, JOINTS, KP, MOTOR, arm, measured, motion, recording

from droid_jax import runtime
from droid_jax.cost.cost import make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.door.space import torque_offsets
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.model.fields import joint_damping, servo_scale, time_offset
from droid_jax.model.joint_friction import joint_friction_effect, joint_friction_space
from droid_jax.model.parameters import Scaling, Space
from droid_jax.model.physics import make_physics
from droid_jax.model.scene import Scene, compile_scene, with_options
from droid_jax.recordings.recording import Channel, ServoGains, TorqueConvention, TorqueSide
from droid_jax.simulate.batching import over_population
from droid_jax.simulate.c_reference import c_replay
from droid_jax.simulate.effect_laws import apply_sensor_model
from droid_jax.simulate.replay import (
    Drive,
    make_drive,
    servo_replay,
    torque_offset_effect,
)
from droid_jax.simulate.servo_gains import gains_note, servo_factors

SPACE = Space(
    (time_offset(), *torque_offsets(JOINTS), joint_damping(arm(), "elbow", name="elbow_damping", std=0.1, high=50.0))
)


ROWS = [
    {},
    {"time_offset": 0.0137},
    {"time_offset": -0.0071},
    {"torque_offset[elbow]": 0.5, "torque_offset[shoulder]": -0.25},
    {"elbow_damping": 4.0},
    {"time_offset": 0.014},
]


def weighed_arm(gravcomp: bool, friction: float, motors: bool) -> Scene:
    """The arm; motors: whether they compensate its weight (actuatorgravcomp)."""
    given = dict(gravcomp='gravcomp="1"' if gravcomp else "", friction=f'frictionloss="{friction}"', sensor="")
    xml = ARM.format(**given).replace('axis="0 1 0"', f'axis="0 1 0" actuatorgravcomp="{str(motors).lower()}"')
    return compile_scene(mujoco.MjSpec.from_string(xml), "arm", joints=JOINTS)


@functools.cache
def replayed(
    torque: TorqueConvention = MOTOR,
    *,
    gravcomp: bool = True,
    friction: float = 0.0,
    motors: bool = False,
    **options: float,
) -> Rollout:
    """ROWS on one arm, in one program, since each program compiles for seconds."""
    scene = weighed_arm(gravcomp, friction, motors)
    replay = servo_replay(
        scene, make_drive(scene, recording(torque=torque)), (torque_offset_effect(JOINTS),), **options
    )
    batch = over_population(lambda values: replay(make_physics(scene, SPACE, values)))
    return batch(np.array([SPACE.values(row) for row in ROWS]))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return arm()


@pytest.fixture(scope="module")
def drive(scene: Scene) -> Drive:
    return make_drive(scene, recording())


@pytest.fixture(scope="module")
def rollout() -> Rollout:
    return replayed()


def servo_torque(position: np.ndarray, delay: float) -> np.ndarray:
    """kp (command(t - delay) - q), with the command constant beyond its ends."""
    time, command = motion()
    late = np.stack([np.interp(time - delay, time, c) for c in command.T], axis=1)
    return np.array([KP[j] for j in JOINTS]) * (late - position)


def test_torque_is_the_servos_law(rollout: Rollout):
    np.testing.assert_allclose(rollout.torque[0], servo_torque(rollout.position[0], 0.0), atol=2e-5)
    assert np.abs(rollout.torque[0]).max() > 1.0


@pytest.mark.parametrize("row", [1, 2])
def test_a_time_offset_delays_the_command(rollout: Rollout, row: int):
    delay = ROWS[row]["time_offset"]
    expected = servo_torque(rollout.position[row], delay)
    np.testing.assert_allclose(rollout.torque[row], expected, atol=5e-5)
    assert np.abs(expected - servo_torque(rollout.position[row], 0.0)).max() > 0.1


def test_a_delayed_command_gives_a_delayed_motion(rollout: Rollout):
    """Seven whole steps give the same trajectory 14 ms later (the arm starts at rest)."""
    np.testing.assert_allclose(rollout.position[5, 7:], rollout.position[0, :-7], atol=1e-5)


def test_torque_offsets_are_added_to_their_joint(rollout: Rollout):
    np.testing.assert_array_equal(rollout.position[3], rollout.position[0])
    np.testing.assert_allclose(rollout.torque[3] - rollout.torque[0], np.tile([-0.25, 0.5], (501, 1)), atol=1e-6)


def test_parameters_reach_the_model(rollout: Rollout):
    assert np.abs(rollout.position[4] - rollout.position[0]).max() > 0.01
    assert rollout.finite.all()


def test_columns_are_matched_by_name(scene: Scene, drive: Drive, rollout: Rollout):
    _, command = motion()
    swapped = make_drive(
        scene,
        recording(
            command=command[:, ::-1],
            command_names=JOINTS[::-1],
            gains=ServoGains(np.array([25.0, 60.0]), np.array([1.0, 3.0])),
        ),
    )
    np.testing.assert_allclose(swapped.command, drive.command, atol=1e-12)
    np.testing.assert_array_equal(swapped.stiffness, drive.stiffness)
    np.testing.assert_allclose(drive.command[:, 0], command[:, 1], atol=1e-12)  # actuators: elbow first


def test_a_coarse_late_command_is_resampled_onto_the_steps(scene: Scene):
    """100 Hz from t = 3 s is interpolated linearly to 500 Hz from 0."""
    time, command = motion(1.0, 100.0)
    coarse = make_drive(scene, recording(time=time + 3.0, command=command, channels={}))
    assert len(coarse.time) == 501 and coarse.time[0] == 0.0
    np.testing.assert_allclose(coarse.command[::5, 1], command[:, 0], atol=1e-12)
    np.testing.assert_allclose(coarse.command[2, 1], 0.6 * command[0, 0] + 0.4 * command[1, 0], atol=1e-12)


# ----- parity with plain C


def rms(array: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(array))))


def c_rollout(scene: Scene, drive: Drive, *, delay: float, **options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and actuator torque before each step, by mj_step."""
    model = with_options(scene, **options).model
    data = mujoco.MjData(model)
    data.qpos[:] = drive.qpos0
    sub = round(drive.timestep / model.opt.timestep)
    clock = np.arange(len(drive.command) * sub) * model.opt.timestep - delay
    out = np.empty((3, len(clock), 2))
    for k, at in enumerate(clock):
        data.ctrl[:] = [np.interp(at, drive.time, c) for c in drive.command.T]
        out[0, k], out[1, k] = data.qpos[scene.joint_qpos], data.qvel[scene.joint_dofs]
        mujoco.mj_step(model, data)
        out[2, k] = data.qfrc_actuator[scene.joint_dofs]
    return out[0, ::sub], out[1, ::sub], out[2, ::sub]


@pytest.mark.slow
def test_parity_replay_is_mj_step(scene: Scene, drive: Drive):
    got = replayed(parity=True)
    position, velocity, torque = c_rollout(scene, drive, delay=0.001)
    np.testing.assert_allclose(got.torque[0], torque, atol=5e-5)
    np.testing.assert_allclose(got.position[0], position + 0.001 * velocity, atol=2e-6)


def test_the_c_replay_is_mj_step(scene: Scene, drive: Drive):
    got = c_replay(scene, SPACE, drive)(SPACE.mean[None])
    position, velocity, torque = c_rollout(scene, drive, delay=0.001)
    np.testing.assert_allclose(got.torque[0], torque, atol=1e-12)
    np.testing.assert_allclose(got.position[0], position + 0.001 * velocity, atol=1e-12)
    reported = velocity[:-1] + 0.5 * np.diff(velocity, axis=0)
    np.testing.assert_allclose(got.velocity[0, :-1], reported, atol=1e-12)


@pytest.mark.slow  # quick with effects: tests/model/effects/test_parity.py
def test_the_c_replay_equals_the_parity_replay(scene: Scene, drive: Drive):
    in_c, parity = c_replay(scene, SPACE, drive)(SPACE.mean[None]), replayed(parity=True)
    for channel in ("torque", "position", "velocity"):
        np.testing.assert_allclose(getattr(in_c, channel)[0, :-1], getattr(parity, channel)[0, :-1], atol=5e-5)


@pytest.mark.slow
def test_without_delay_both_equal_what_mj_step_logs(scene: Scene, drive: Drive):
    logged = c_rollout(scene, drive, delay=0.0)
    in_c = c_replay(scene, SPACE, drive, late=0.0)(SPACE.mean[None])
    mjx = replayed(parity=True, late=0.0)
    for rollout, atol in ((in_c, (1e-12, 1e-12, 1e-12)), (mjx, (2e-6, 1e-4, 5e-5))):
        reported = (rollout.position[0], rollout.velocity[0], rollout.torque[0])
        for got, expected, within in zip(reported, logged, atol, strict=True):
            np.testing.assert_allclose(got, expected, atol=within)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_a_cost_can_replay_as_mj_step_logs(scene: Scene, drive: Drive, engine: str):
    """The cost of what MuJoCo itself logged is zero then, a hundredth of the cost as a robot's log."""
    *_, torque = c_rollout(scene, drive, delay=0.0)
    values = np.stack([torque, torque])
    channel = Channel("torque", "N m", JOINTS, drive.time, values, np.ones(values.shape, bool))
    logged = recording(channels={"torque": channel})

    def cost(engine: str, mj_step: bool) -> float:
        made = make_cost(scene, SPACE, [logged], engine=engine, config=CompareConfig(mj_step=mj_step))
        return float(made(SPACE.mean[None])[0])

    as_logged = cost(engine, True)
    assert as_logged < 2e-5
    assert as_logged < 0.01 * cost("mujoco", False)


IDLE = "parameters time_offset change nothing where no recording holds commands"


def test_mj_step_needs_commands(scene: Scene):
    time, path = motion(2.0)
    values = np.stack([path, path])
    position = Channel("position", "rad", JOINTS, time, values, np.ones(values.shape, bool))
    channels = {"position": position, "torque": replace(position, name="torque", unit="N m")}
    alone = recording(time=np.zeros(0), command=np.zeros((0, 0)), command_names=(), channels=channels, gains=None)
    with pytest.raises(ValueError, match="mj_step replays commands"), pytest.warns(UserWarning, match=IDLE):
        make_cost(scene, SPACE, [alone], config=CompareConfig(mj_step=True))
    with pytest.raises(ValueError, match="no commands and no measured positions: there is no motion"):
        make_cost(scene, SPACE, [replace(alone, channels={"torque": channels["torque"]})])


def test_the_replay_is_closer_to_the_continuous_arm_than_the_c_engine(scene: Scene, drive: Drive, rollout: Rollout):
    """Against C at 20 microseconds.  C at 2 ms has its first-order error, with and without delay."""
    _, _, truth = c_rollout(scene, drive, delay=0.0, timestep=2e-5, integrator=mujoco.mjtIntegrator.mjINT_RK4)
    first_order = min(rms(c_rollout(scene, drive, delay=d)[2] - truth) for d in (0.0, 0.001))
    assert rms(rollout.torque[0] - truth) < 0.1 * first_order


def test_sensors_of_the_mjcf_do_not_disturb_the_c_replay(scene: Scene, drive: Drive):
    busy = arm(sensor='<jointpos joint="elbow"/><actuatorfrc actuator="s"/>')
    expected = c_replay(scene, SPACE, drive)(SPACE.mean[None])
    got = c_replay(busy, SPACE, drive)(SPACE.mean[None])
    np.testing.assert_array_equal(got.torque, expected.torque)
    np.testing.assert_array_equal(got.position, expected.position)


def test_the_c_replay_keeps_every_option(drive: Drive):
    light = with_options(arm(gravcomp=False), gravity=[0.0, 0.0, -1.6])
    got = c_replay(light, SPACE, drive)(SPACE.mean[None])
    np.testing.assert_allclose(got.torque[0], c_rollout(light, drive, delay=0.001)[2], atol=1e-12)


# ----- torque conventions


def inverse(scene: Scene, q: np.ndarray, v: np.ndarray, a: np.ndarray, *, armature: bool, gravity: bool) -> np.ndarray:
    """[T, 2] N m of rigid links, from C: M(q) a + c(q, v) [+ g(q)]."""
    model = scene.model.__copy__()
    if not armature:
        model.dof_armature[:] = 0
    if not gravity:
        model.opt.gravity[:] = 0
    data, out, M = mujoco.MjData(model), np.empty_like(q), np.zeros((2, 2))
    for k in range(len(q)):
        data.qpos[:], data.qvel[:] = q[k], v[k]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        out[k] = M @ a[k] + data.qfrc_bias
    return out


@pytest.mark.slow
@pytest.mark.parametrize(("gravity", "friction"), [(False, 0.0), (True, 0.4)])
def test_link_side_torque_is_inverse_dynamics_of_the_links(gravity: bool, friction: float):
    """Without rotor inertia, joint damping and the joint's dry friction; with gravity if stated."""
    scene = arm(friction=friction)
    got = replayed(TorqueConvention(TorqueSide.LINK, gravity), friction=friction)
    h = float(scene.model.opt.timestep)
    q = got.position[0].astype(float)
    acceleration = (q[2:] - 2 * q[1:-1] + q[:-2]) / h**2
    velocity = (q[2:] - q[:-2]) / (2 * h)
    expected = inverse(scene, q[1:-1], velocity, acceleration, armature=False, gravity=gravity)
    off = got.torque[0, 1:-1] - expected
    # Second differences of float32 positions: 6e-8 / h^2 = 0.015 rad/s^2, on 0.3 kg m^2.
    assert np.sqrt(np.mean(off**2)) < 0.01, np.sqrt(np.mean(off**2, axis=0))
    assert np.sqrt(np.mean((servo_torque(q, 0.0)[1:-1] - expected) ** 2)) > 0.3  # what the motor's side reads


@pytest.mark.slow  # quick with effects: test_effects_enter_at_their_place
def test_motor_side_with_gravity_adds_the_compensated_weight(scene: Scene, rollout: Rollout):
    heavy = replayed(TorqueConvention(TorqueSide.MOTOR, True))
    np.testing.assert_array_equal(heavy.position[0], rollout.position[0])
    q = heavy.position[0].astype(float)
    weight = inverse(scene, q, 0 * q, 0 * q, armature=True, gravity=True)
    np.testing.assert_allclose(heavy.torque[0] - rollout.torque[0], weight, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [False, True])
def test_weight_that_the_motors_compensate_is_counted_once(gravity: bool):
    """Only with actuatorgravcomp the motors' torque contains the weight."""
    convention = TorqueConvention(TorqueSide.MOTOR, gravity)
    by_motors, elsewhere = replayed(convention, motors=True), replayed(convention)
    q = by_motors.position[0].astype(float)
    weight = inverse(weighed_arm(True, 0.0, True), q, 0 * q, 0 * q, armature=True, gravity=True)
    np.testing.assert_allclose(by_motors.position[0], elsewhere.position[0], atol=1e-5)
    np.testing.assert_allclose(by_motors.torque[0], elsewhere.torque[0], atol=1e-3)
    servo = servo_torque(by_motors.position[0], 0.0) + gravity * weight
    np.testing.assert_allclose(by_motors.torque[0], servo, atol=2e-4)
    assert np.abs(weight).max() > 3.0


@pytest.mark.slow
def test_uncompensated_weight_is_refused_for_torques_without_gravity():
    heavy = arm(gravcomp=False)
    with pytest.raises(ValueError, match=r"'wave' says that its torque excludes gravity.*shoulder, elbow.*gravcomp"):
        make_drive(heavy, recording())
    torque = replayed(TorqueConvention(TorqueSide.MOTOR, gravity=True), gravcomp=False)
    np.testing.assert_allclose(torque.torque[0], servo_torque(torque.position[0], 0.0), atol=2e-5)
    make_drive(with_options(heavy, gravity=[0, 0, 0]), recording())
    make_drive(arm(), recording())
    only_position = CompareConfig(channels={"position": 1.0})
    make_cost(heavy, SPACE, [recording(channels=measured(0.2))], engine="mujoco", config=only_position)


def test_vertical_axes_carry_no_weight():
    xml = ARM.format(gravcomp="", friction="", sensor="").replace('axis="0 1 0"', 'axis="0 0 1"')
    make_drive(compile_scene(mujoco.MjSpec.from_string(xml), "arm", joints=JOINTS), recording())


# ----- servos with a velocity gain

LIMITS = {"free": ("", ""), "actuator": ("", 'forcerange="-2 2"'), "joint": ('actuatorfrcrange="-2 2"', "")}
PENDULUM = """<body gravcomp="1" pos="0 {y} 0"><joint name="{name}" axis="0 1 0" armature="0.1" damping="0.5" {joint}/>
  <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.5" mass="2" contype="0" conaffinity="0"/></body>"""
SERVO = '<position name="{name}" joint="{name}" kp="600" kv="50" {actuator}/>'
NOTHING = Space((time_offset(),))


def pendulums(*names: str) -> Scene:
    """Two pendulums, each with its force limit."""
    bodies = [PENDULUM.format(name=n, y=k, joint=LIMITS[n][0]) for k, n in enumerate(names)]
    servos = [SERVO.format(name=n, actuator=LIMITS[n][1]) for n in names]
    xml = f"""<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>{"".join(bodies)}</worldbody>
    <actuator>{"".join(servos)}</actuator></mujoco>"""
    return compile_scene(mujoco.MjSpec.from_string(xml), "pendulums", joints=names)


def swung(scene: Scene, command: np.ndarray, **options) -> Rollout:
    """The replay of one command [T] for all pendulums, at 4 ms."""
    count = len(scene.joints)
    drive = Drive(np.tile(command[:, None], (1, count)), np.zeros(count), 0.004, MOTOR)
    replay = servo_replay(scene, drive, **options)
    return over_population(lambda values: replay(make_physics(scene, NOTHING, values)))(NOTHING.mean[None])


def pendulums_c(scene: Scene, command: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Torque and position [T, J] of plain C."""
    model = with_options(scene, timestep=step).model
    data, sub = mujoco.MjData(model), round(0.004 / step)
    out = np.empty((2, len(command), model.nv))
    for k in range(len(command) * sub):
        data.ctrl[:] = np.interp(k * step, np.arange(len(command)) * 0.004, command)
        position = data.qpos.copy()
        mujoco.mj_step(model, data)
        if k % sub == 0:
            out[:, k // sub] = data.qfrc_actuator, position
    return out[0], out[1]


@pytest.fixture(scope="module")
def free_and_limited() -> tuple[Rollout, np.ndarray, np.ndarray]:
    """The replay at 4 ms, and the torque and position of plain C at 0.05 ms."""
    scene, time = pendulums(*LIMITS), np.arange(251) * 0.004
    command = 0.3 * np.sin(6 * time) * np.clip(time / 0.3, 0, 1)
    return swung(scene, command), *pendulums_c(scene, command, 5e-5)


def test_a_servos_velocity_gain_acts_at_the_time_of_the_position(free_and_limited):
    """The torque is the servo's at the mean velocity of the step; with that before the step it is wrong by a tenth."""
    got, torque, _ = free_and_limited
    assert rms(got.torque[0, :, 0] - torque[:, 0]) < 0.02 * rms(torque[:, 0])


@pytest.mark.parametrize("limit", ["actuator", "joint"])
def test_a_servo_at_its_force_limit_damps_nothing(free_and_limited, limit: str):
    """At the limit neither its torque nor the motion depends on its velocity gain."""
    got, torque, position = free_and_limited
    k = list(LIMITS).index(limit)
    assert np.mean(np.abs(torque[:, k]) >= 2.0) > 0.2 and got.torque[..., k].max() <= 2.0
    np.testing.assert_allclose(got.position[0, :, k], position[:, k], atol=0.02 * np.ptp(position[:, k]))


@pytest.mark.slow
def test_parity_with_a_velocity_gain_is_mj_step():
    scene, time = pendulums("actuator"), np.arange(251) * 0.004
    command = 0.3 * np.sin(6 * time)
    torque, _ = pendulums_c(scene, np.interp(time - 0.002, time, command), 0.004)
    np.testing.assert_allclose(swung(scene, command, parity=True).torque[0], torque, atol=1e-3)


# ----- effects


def test_effects_enter_at_their_place(scene: Scene, rollout: Rollout):
    """A constant force, two command laws and an observation, each against its closed form.

    The second law, a delay of 20 ms, gets the command changed by the first.  The torque contains gravity.
    """
    drive = make_drive(scene, recording(torque=TorqueConvention(TorqueSide.MOTOR, True)))
    seen = {}

    def force(theta, state):
        seen["shapes"] = (state.qpos.shape, state.qvel.shape, state.load.shape)
        return jnp.array([0.0, 6.0])

    kick = Effect("kick", force=force)
    hold = Effect("hold", command=lambda theta, time, look: 0.5 * (look(time) + look(time - 0.01)))
    late = Effect("late", command=lambda theta, time, look: look(time - 0.02))
    double = Effect("double", observe=lambda theta, r: replace(r, torque=2.0 * r.torque))
    physics = make_physics(scene, SPACE, jnp.asarray(SPACE.mean, jnp.float32))
    replay = servo_replay(scene, drive, (kick, hold, late, double))
    got = jax.jit(replay, compiler_options=runtime.compiler_options())(physics)
    position = np.asarray(got.position, float)
    weight = inverse(scene, position, 0 * position, 0 * position, armature=True, gravity=True)
    torque = np.asarray(got.torque) / 2.0 - weight
    assert np.abs(weight).max() > 1.0
    assert seen["shapes"] == ((2,), (2,), (2,))
    np.testing.assert_allclose(torque, 0.5 * (servo_torque(position, 0.02) + servo_torque(position, 0.03)), atol=2e-4)
    # at rest the servo gives way until kp dq = 6 N m
    assert torque[-1, 1] - rollout.torque[0, -1, 1] < -1.0


def test_the_c_replay_refuses_unsupported_effects(scene: Scene, drive: Drive):
    kick = Effect("kick", force=lambda theta, state: state.qvel)
    with pytest.raises(ValueError, match="effects depend on the state: kick"):
        c_replay(scene, SPACE, drive, [kick])
    for convention in (TorqueConvention(TorqueSide.LINK, False), TorqueConvention(TorqueSide.MOTOR, True)):
        with pytest.raises(ValueError, match="it gives actuator torques: motor-side"):
            c_replay(scene, SPACE, replace(drive, torque=convention))


# ----- a cost over such replays


@pytest.mark.slow
def test_a_cost_accepts_only_other_repeats_of_the_same_motion(scene: Scene):
    cost = make_cost(scene, SPACE, [recording()])
    elsewhere = {"shoulder": 0.5, "elbow": -0.3}
    for other in (
        recording(command=motion()[1] + 0.1),
        recording(torque=TorqueConvention(TorqueSide.LINK, False)),
        recording(torque=TorqueConvention(TorqueSide.MOTOR, True)),
    ):
        with pytest.raises(ValueError, match="other commands than 'wave' had, measured another torque"):
            cost.against([other])
    softer = cost.against([recording(gains=ServoGains(np.array([60.0, 20.0]), np.array([3.0, 1.0])))])
    at = SPACE.mean[None]
    assert np.abs(softer.rollouts(at)[0].position - cost.rollouts(at)[0].position).max() > 0.01
    near = cost.against([recording(qpos0={"shoulder": 0.0008, "elbow": -0.3})])  # measured starts scatter
    np.testing.assert_array_equal(near.drives[0].qpos0, cost.drives[0].qpos0)  # pyright: ignore
    moved = cost.against([recording(qpos0=elsewhere)]).rollouts(SPACE.mean[None])[0]  # each starts where it starts
    anew = make_cost(scene, SPACE, [recording(qpos0=elsewhere)]).rollouts(SPACE.mean[None])[0]
    assert moved.position[0, 0].tolist() == pytest.approx([0.5, -0.3])
    np.testing.assert_allclose(moved.torque, anew.torque, atol=1e-4)


def test_a_cost_keeps_its_steps(scene: Scene):
    """Another config must not change mj_step."""
    cost = make_cost(scene, SPACE, recording(), config=CompareConfig(mj_step=True))
    with pytest.raises(ValueError, match="compiled with another mj_step"):
        cost.against([recording()], CompareConfig())


@pytest.mark.slow
def test_joint_friction_that_is_given_as_an_effect_counts_once(scene: Scene):
    friction = joint_friction_space(JOINTS).select(["coulomb[elbow]"])
    values = np.array([[0.5]])
    own = make_cost(scene, friction, [recording()]).rollouts(values)[0]
    given = make_cost(scene, friction, [recording()], effects=(joint_friction_effect(JOINTS),)).rollouts(values)[0]
    np.testing.assert_allclose(given.torque, own.torque, atol=1e-6)


@pytest.mark.parametrize("engine", ["mujoco", pytest.param("mjx", marks=pytest.mark.slow)])
def test_a_stated_gain_replaces_the_scenes(engine: str):
    """As if the scene had it: stiffness, and damping if the servo has a velocity gain."""
    kp, kd = np.array([90.0, 10.0]), np.array([3.0, 2.0])  # shoulder, elbow
    spec = arm().spec.copy()
    for actuator in spec.actuators:
        actuator.biasprm[2] = -1.0
    scene = compile_scene(spec, "damped", joints=JOINTS)
    for actuator in spec.actuators:
        own = JOINTS.index(actuator.target)
        actuator.gainprm[0], actuator.biasprm[1], actuator.biasprm[2] = kp[own], -kp[own], -kd[own]
    written = compile_scene(spec, "written", joints=JOINTS)
    stated, plain = recording(gains=ServoGains(kp, kd)), recording(gains=None)
    space = Space((servo_scale(scene, "elbow", std=0.1),))
    values = np.array([[1.0], [1.2]])  # a parameter acts on the stated gain
    got = make_cost(scene, space, [stated], engine=engine).rollouts(values)[0]
    expected = make_cost(written, space, [plain], engine=engine).rollouts(values)[0]
    unstated = make_cost(scene, space, [plain], engine=engine).rollouts(values)[0]
    np.testing.assert_allclose(got.position, expected.position, atol=2e-6)
    np.testing.assert_allclose(got.torque, expected.torque, atol=2e-4)
    assert np.abs(got.position - unstated.position).max() > 0.05
    note = gains_note(scene, stated)
    assert "shoulder 90 in place of 60" in note and "elbow 10 in place of 25" in note and not gains_note(scene, plain)
    assert "damping of shoulder 3 in place of 1" in note  # which was not said


def test_damping_that_is_not_stated_is_the_scenes():
    """Stated stiffness without damping keeps the velocity gain."""
    spec = arm().spec.copy()
    for actuator in spec.actuators:
        actuator.biasprm[2] = -1.5
    scene = compile_scene(spec, "damped", joints=JOINTS)
    kp = np.array([60.0, 10.0])
    drive = make_drive(scene, recording(gains=ServoGains(kp)))
    np.testing.assert_allclose(servo_factors(scene, drive), [[10 / 25, 1.0], [1.0, 1.0]])  # elbow first
    assert "damping" not in gains_note(scene, recording(gains=ServoGains(kp)))
    off = gains_note(scene, recording(gains=ServoGains(np.array([60.0, 25.0]), np.array([0.0, 1.5]))))
    assert "the scene's: damping of shoulder 0 in place of 1.5" in off


def test_stated_damping_without_velocity_gain_is_reported(scene: Scene):
    assert "for elbow it uses the joint's damping, not the stated one" in gains_note(
        scene, recording(gains=ServoGains(np.array([90.0, 25.0]), np.array([3.0, 7.0])))
    )


# ----- what is refused


def test_friction_effects_without_a_friction_row_are_refused():
    """MJX has constraint rows only for friction in the compiled model, so that 5 N m would have no effect."""
    bare = arm()
    effects = library(bare, ["joint_coulomb"])
    with pytest.raises(ValueError, match=r"'joint_coulomb' raises dry friction of shoulder, elbow, .*ready\(scene\)"):
        make_cost(bare, effect_space(effects), recording(), effects=effects)
    one = effect_space(effects).select(["joint_coulomb[elbow]"])
    with pytest.raises(ValueError, match="raises dry friction of elbow, which"):
        make_cost(bare, one, recording(), effects=effects)
    make_cost(ready(bare), one, recording(), effects=effects)
    make_cost(bare, SPACE, recording(), effects=effects)  # at neutral, where they do nothing


def test_a_model_that_was_changed_after_it_was_compiled_is_refused():
    """MJX would have the old numbers and other code the new ones."""
    scene = arm()
    scene.model.dof_damping[:] = 2.0  # before it is compiled nothing is mixed
    make_cost(scene, SPACE, recording())
    other = with_options(scene, timestep=0.004)
    scene.model.opt.timestep = 0.004
    with pytest.raises(ValueError, match=r"model of scene 'arm' was changed after it was .*with_options"):
        make_cost(scene, SPACE, recording())
    make_cost(other, SPACE, recording())


def test_a_recording_without_commands_is_refused(scene: Scene):
    log = recording(time=np.zeros(0), command=np.zeros((0, 0)), command_names=())
    with pytest.raises(ValueError, match=r"'wave' holds no commands.*measured motion"):
        make_drive(scene, log)


def test_gains_of_an_actuator_that_is_no_servo_are_refused():
    """A motor has no gain that a stated one could replace."""
    spec = arm().spec.copy()
    spec.actuators[1].set_to_motor()
    scene = compile_scene(spec, "driven", joints=JOINTS)
    stated = make_drive(arm(), recording(gains=ServoGains(np.array([60.0, 25.0]), np.array([3.0, 1.0]))))
    with pytest.raises(ValueError, match="no position servo; make it a <position> servo in the MJCF"):
        servo_replay(scene, stated)


def test_missing_and_foreign_columns_are_named(scene: Scene):
    _, command = motion()
    with pytest.raises(ValueError, match="missing: elbow; given: shoulder"):
        make_drive(scene, recording(command=command[:, :1], command_names=("shoulder",), gains=None))
    with pytest.raises(ValueError, match="unknown: wrist"):
        more = np.concatenate([command, command[:, :1]], axis=1)
        make_drive(scene, recording(command=more, command_names=(*JOINTS, "wrist"), gains=None))
    with pytest.raises(ValueError, match=r"recording 'wave', qpos0: unknown joint 'wrist'.*shoulder, elbow"):
        make_drive(scene, recording(qpos0={"wrist": 0.0}))


@pytest.mark.parametrize(("left", "says"), [(0, "has no actuators"), (1, "has no actuator for shoulder")])
def test_commanded_joints_without_an_actuator_are_refused(left: int, says: str):
    xml = ARM.format(gravcomp="", friction="", sensor="")
    start, end = xml.index("<actuator>"), xml.index("<sensor>")
    kept = '<actuator><position name="e" joint="elbow" kp="25"/></actuator>' * left
    bare = compile_scene(mujoco.MjSpec.from_string(xml[:start] + kept + xml[end:]), "bare")
    with pytest.raises(ValueError, match=f"scene 'bare' {says}, and recording 'wave' holds commands"):
        make_drive(bare, recording(gains=None))


@pytest.mark.parametrize(("option", "says"), [('integrator="RK4"', "Euler"), ('cone="elliptic"', "pyramidal")])
def test_unsupported_options_are_refused_with_the_scenes_name(option: str, says: str):
    xml = ARM.format(gravcomp='gravcomp="1"', friction="", sensor="").replace('integrator="implicitfast"', option)
    odd = compile_scene(mujoco.MjSpec.from_string(xml), "odd", joints=JOINTS, engine="mujoco")
    with pytest.raises(ValueError, match=f"a replay of scene 'odd' .*{says}"):
        servo_replay(odd, make_drive(odd, recording()))


def test_a_cost_takes_one_recording_and_is_written_in_a_line(scene: Scene):
    space = Space((joint_damping(scene, "elbow", std=0.1, high=50.0),))
    assert repr(make_cost(scene, space, recording())) == "<Cost of wave over 1 parameters of scene 'arm'>"


# ----- replays that blow up


UNSTABLE = Space(
    (joint_damping(arm(), "elbow", name="elbow_damping", std=1.0, low=-2000.0, high=50.0, scaling=Scaling.LINEAR),)
)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_a_diverging_replay_costs_the_penalty_and_affects_no_other(engine: str):
    """Negative damping of 1500 N m s/rad makes the arm diverge within a few steps."""
    scene = arm()
    cost = make_cost(scene, UNSTABLE, [recording()], engine=engine)
    good = np.array([[1.0], [2.0]])
    mixed = np.array([[1.0], [-1500.0], [2.0]])
    np.testing.assert_array_equal(cost(mixed)[[0, 2]], cost(good))
    assert cost(mixed)[1] == cost.comparisons[0].config.non_finite_cost == 1000.0
    np.testing.assert_array_equal(cost.failed(mixed), [False, True, False])
    np.testing.assert_array_equal(cost.rollouts(mixed)[0].finite, [True, False, True])
    z = cost.whitened(mixed)
    assert np.isnan(z[1]).all() and np.isfinite(z[[0, 2]]).all()


@pytest.mark.parametrize("trace", ["torque", "position", "velocity", "object_angle"])
def test_a_rollout_with_nan_is_not_finite(trace: str):
    still = Rollout(*np.zeros((7, 5, 2)))
    assert apply_sensor_model(still, {}, ()).finite
    broken = getattr(still, trace).copy()
    broken[3, 1] = np.inf
    assert not apply_sensor_model(replace(still, **{trace: broken}), {}, ()).finite


def test_actuators_with_a_state_are_refused():
    """The time loop does not carry activations, so a filtered actuator would be reset at each step."""
    xml = ARM.format(gravcomp='gravcomp="1"', friction="", sensor="").replace(
        '<position name="s" joint="shoulder" kp="60"/>',
        '<position name="s" joint="shoulder" kp="60" timeconst="0.1"/>',
    )
    with pytest.raises(ValueError, match=r"activation|state"):
        filtered = compile_scene(mujoco.MjSpec.from_string(xml), "arm", joints=JOINTS)
        servo_replay(filtered, make_drive(filtered, recording()))
