"""Actuators without a command, such as a gripper with a tendon in a log of the arm, hold their start."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from droid_jax.cost.cost import make_cost
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.preflight.preflight import left_alone
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.initial_state import holding_controls
from droid_jax.simulate.replay import make_drive
from droid_jax.synthetic.robot import _control

ARM = """
<mujoco>
  <option integrator="implicitfast" timestep="0.002"/>
  <worldbody>
    <body pos="0 0 1">
      <inertial mass="2" pos="0 0 -0.2" diaginertia="0.02 0.02 0.005"/>
      <joint name="shoulder" axis="0 1 0" damping="1" armature="0.1"/>
      <body name="finger_a" pos="0 0.02 -0.4">
        <inertial mass="0.2" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="a" type="slide" axis="0.3 1 0"/>
      </body>
      <body name="finger_b" pos="0 -0.02 -0.4">
        <inertial mass="0.2" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="b" type="slide" axis="0.3 -1 0"/>
      </body>
      <body name="thumb" pos="0.05 0 -0.4">
        <inertial mass="0.1" pos="0 0 -0.05" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="thumb" axis="0 1 0" armature="0.01"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="both"><joint joint="a" coef="0.5"/><joint joint="b" coef="0.5"/></fixed></tendon>
  <equality><joint joint1="a" joint2="b"/></equality>
  <actuator>
    <general joint="shoulder" gainprm="300" biastype="affine" biasprm="0 -300 -20"/>
    <general name="grip" tendon="both" ctrlrange="0 255" ctrllimited="true" gainprm="0.8" biastype="affine"
             biasprm="0 -5000 -50" forcerange="-40 40" forcelimited="true"/>
    <position joint="thumb" kp="20" kv="1"/>
  </actuator>
</mujoco>
"""
START = {"shoulder": 0.2, "a": 0.02, "b": 0.02, "thumb": 0.3}
GRIP = 125.0  # 0.8 of it is the 100 N that 0.02 m ask for
TIME = np.arange(0.0, 0.6, 0.002)
PATH = 0.2 + 0.4 * (1 - np.cos(2 * np.pi * TIME / 0.6))


def scene() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(ARM), "arm", joints=["shoulder"])


def by_hand(steps: int = 8) -> np.ndarray:
    """[T] N m at the shoulder, by mj_step with all controls given."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.timestep = 0.002 / steps
    data, torque = mujoco.MjData(model), np.empty(len(TIME))
    for joint, value in START.items():
        data.qpos[model.joint(joint).qposadr[0]] = value
    fine = np.interp(np.arange(len(TIME) * steps) * model.opt.timestep, TIME, PATH)
    for k, sent in enumerate(fine):
        data.ctrl[:] = sent, GRIP, START["thumb"]
        mujoco.mj_step(model, data)
        if k % steps == 0:
            torque[k // steps] = data.qfrc_actuator[0]
    return torque


def recording(**more: np.ndarray) -> Recording:
    """The arm's command and torque; more: further command columns."""
    torque = by_hand()[None, :, None]
    names = ("shoulder", *more)
    return Recording(
        name="wave", time=TIME, command=np.column_stack([PATH, *more.values()]), command_names=names,
        channels={"torque": Channel("torque", "N m", ("shoulder",), TIME, torque, np.isfinite(torque))},
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True), qpos0=START,
    )  # fmt: skip


def with_positions(given: Recording, names: tuple[str, ...], scatter: float = 0.0) -> Recording:
    """The recording with measured positions of joints that do not move, in four repeats."""
    torque = given.channels["torque"]
    values = np.repeat(torque.values, 4, axis=0)
    still = np.tile([START[n] for n in names], (4, len(TIME), 1)) + scatter * np.arange(4)[:, None, None]
    channels = {
        "torque": replace(torque, values=values, mask=np.ones(values.shape, bool)),
        "position": Channel("position", "rad", names, TIME, still, np.ones(still.shape, bool)),
    }
    return replace(given, channels=channels, qpos0={"shoulder": START["shoulder"]})


def space(arm: Scene) -> Space:
    return Space((joint_damping(arm, "shoulder", std=0.5, high=9.0),))


def test_holding_controls_exert_no_force():
    arm = scene()
    model, data = arm.model, mujoco.MjData(arm.model)
    qpos = arm.initial_qpos(START)
    data.qpos[:], data.ctrl[:] = qpos, holding_controls(arm, qpos)
    mujoco.mj_forward(model, data)
    assert data.actuator_force == pytest.approx(np.zeros(3), abs=1e-9)
    assert data.ctrl == pytest.approx([0.2, GRIP, 0.3])
    far = holding_controls(arm, arm.initial_qpos({"a": 1.0, "b": 1.0}))
    assert far[1] == 255.0  # its range ends there


@pytest.mark.slow
def test_actuators_without_command_hold_and_are_reported():
    arm = scene()
    with pytest.warns(UserWarning, match="'wave' has not all commands: grip, thumb held where the motion starts"):
        cost = make_cost(arm, space(arm), [recording()])
    torque = cost.rollouts(np.array([[1.0]]))[0].torque[0, :, 0]
    assert np.max(np.abs(torque - by_hand())) < 0.02 * np.max(np.abs(by_hand()))
    given = make_drive(arm, recording(grip=np.full(len(TIME), 30.0)))
    assert np.all(given.command[:, 1] == 30.0) and np.all(given.command[:, 2] == 0.3)


def test_a_measured_joint_needs_its_command():
    whole = compile_scene(mujoco.MjSpec.from_string(ARM), "arm")
    assert whole.joints == ("shoulder", "thumb")
    with pytest.raises(ValueError, match="needs a command for shoulder, thumb; missing: thumb; given: shoulder"):
        make_drive(whole, recording())


def test_a_motor_without_command_gets_zero_and_is_reported():
    spec = mujoco.MjSpec.from_string(ARM.replace('<position joint="thumb" kp="20" kv="1"/>', '<motor joint="thumb"/>'))
    arm = compile_scene(spec, "arm", joints=["shoulder"])
    assert left_alone(arm, recording()) == (
        "recording 'wave' has not all commands: grip held where the motion starts; thumb given 0 (no position feedback)"
    )
    with pytest.raises(ValueError, match="does not say where thumb starts"):  # a commanded torque gives no position
        make_drive(arm, replace(recording(thumb=np.zeros(len(TIME))), qpos0={"shoulder": 0.2}))


@pytest.mark.filterwarnings("ignore:recording 'wave' has not all commands")
def test_held_joints_start_at_their_measured_position_in_each_part():
    arm, whole = scene(), with_positions(recording(), ("shoulder", "thumb", "a", "b"), scatter=1e-5)
    first, last = whole.repeats_subset([0, 1]), whole.repeats_subset([2, 3])
    drive = make_drive(arm, first)
    assert drive.qpos0 == pytest.approx(arm.initial_qpos(START), abs=1e-4)
    assert drive.command[0] == pytest.approx([0.2, GRIP, 0.3], rel=1e-3)
    cost = make_cost(arm, space(arm), [first], engine="mujoco")
    row = np.array([[1.0]])
    assert cost.against([last])(row) == pytest.approx(cost(row), rel=1e-3)
    with pytest.raises(ValueError, match="holds other commands"):
        cost.against([replace(last, command=last.command + 0.01)])


def test_the_synthetic_robot_needs_all_commands():
    arm = scene()
    with pytest.raises(ValueError, match="the synthetic robot needs a command for grip, thumb too"):
        _control(arm, recording(), 0.001, 0.0)
