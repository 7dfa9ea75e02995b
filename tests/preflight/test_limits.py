"""Findings about commands and torques beyond limits, and about joints that creep while friction holds them."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from droid_jax.model.scene import Scene, compile_scene
from droid_jax.preflight.creep import HOLDING_SOLIMP, creep_note, creep_per_load, creeping
from droid_jax.preflight.preflight import check_range, clipped_commands, command_notes, exceeded_torques
from droid_jax.recordings.recording import Channel, Recording, ServoGains, TorqueConvention, TorqueSide

TIME = np.arange(0.0, 10.0, 0.01)
HINGE = """<mujoco><option integrator="implicitfast" timestep="0.002" {option}/><worldbody>
  <body><joint name="j" axis="0 1 0" armature="{armature}" {joint}/>
    <inertial mass="1e-6" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
  <actuator>{actuator}</actuator></mujoco>"""


def hinge(joint: str = "", actuator: str = '<motor joint="j"/>', armature: float = 0.03, option: str = "") -> Scene:
    xml = HINGE.format(joint=joint, actuator=actuator, armature=armature, option=option)
    return compile_scene(mujoco.MjSpec.from_string(xml), "bench", joints=["j"])


def log(command: np.ndarray, torque: np.ndarray, position: np.ndarray | None = None) -> Recording:
    def channel(name: str, unit: str, values: np.ndarray) -> Channel:
        noise = np.random.default_rng(0).normal(0, 1e-5, (2, len(TIME), 1))
        return Channel(name, unit, ("j",), TIME, values[None, :, None] + noise, np.ones((2, len(TIME), 1), bool))

    channels = {"torque": channel("torque", "N m", torque)}
    if position is not None:
        channels["position"] = channel("position", "rad", position)
    return Recording(
        "hold", TIME, command[:, None], ("j",), channels, TorqueConvention(TorqueSide.MOTOR, True), {"j": 0.0}
    )


# ----- limits


def test_the_share_of_commands_beyond_ctrlrange_is_said():
    scene = hinge(actuator='<position joint="j" kp="80" kv="4" ctrlrange="-0.1 0.1" ctrllimited="true"/>')
    sent = np.where(TIME < 2.5, 0.05, 0.6)
    said = clipped_commands(scene, log(sent, 0.1 * np.sin(TIME)))
    assert "leave the actuator's ctrlrange at j in 75 % of the samples (they run 0.05 .. 0.6" in said
    assert said in command_notes(scene, log(sent, 0.1 * np.sin(TIME)))
    assert not clipped_commands(scene, log(np.clip(sent, -0.1, 0.1), 0.1 * np.sin(TIME)))
    scene.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    assert not clipped_commands(scene, log(sent, 0.1 * np.sin(TIME)))


@pytest.mark.parametrize(
    ("joint", "actuator"),
    [
        ("", '<position joint="j" kp="80" kv="4" forcerange="-1 1" forcelimited="true"/>'),
        ("", '<position joint="j" kp="8" kv="4" gear="10" forcerange="-.1 .1" forcelimited="true"/>'),
        ('actuatorfrclimited="true" actuatorfrcrange="-1 1"', '<position joint="j" kp="80" kv="4"/>'),
    ],
)
def test_the_share_of_torques_beyond_the_actuators_limits_is_said(joint: str, actuator: str):
    scene = hinge(joint, actuator)
    torque = np.where(TIME < 6.0, 0.5, -4.0) + 0.01 * np.sin(TIME)
    said = exceeded_torques(scene, log(np.sin(TIME), torque))
    assert "exceed what the actuators of scene 'bench' can do" in said and "j in 40 % of the samples (up to 4" in said
    assert "limits -1 .. 1" in said
    assert not exceeded_torques(scene, log(np.sin(TIME), np.clip(torque, -1.02, 1.02)))  # noise on top of a limit


def test_actuators_without_limits_have_none_to_exceed():
    assert not exceeded_torques(hinge(), log(np.sin(TIME), 1e3 * np.sin(TIME)))


def test_an_objects_angle_in_degrees_is_outside_of_its_range():
    """Regression: the angle was not checked, and 60 degrees were read as ten turns of the door."""
    spec = hinge().spec.copy()
    door = spec.worldbody.add_body(name="door")
    door.add_joint(name="hinge", axis=[0, 0, 1], range=[0, 90], limited=mujoco.mjtLimited.mjLIMITED_TRUE)
    door.add_geom(size=[0.1, 0, 0])
    scene = compile_scene(spec, "door", joints=["j"], object_joint="hinge")
    fine, opened = log(np.sin(TIME), np.sin(TIME)), 0.5 * (1 - np.cos(TIME))[None, :, None] + np.zeros((2, 1, 1))

    def seen(angle: np.ndarray) -> Recording:
        channel = Channel("object_angle", "rad", ("hinge",), TIME, angle, np.ones(angle.shape, bool))
        return replace(fine, channels={**fine.channels, "object_angle": channel})

    check_range(scene, seen(opened))
    with pytest.raises(ValueError, match=r"hinge is measured at 57.* far outside its range 0 \.\. 1.571 rad"):
        check_range(scene, seen(np.rad2deg(opened)))


# ----- creep


def crept(scene: Scene, torque: float) -> float:
    """rad/s at which plain C MuJoCo creeps under a constant torque."""
    data = mujoco.MjData(scene.model)
    data.ctrl[:] = torque
    for _ in range(1000):
        mujoco.mj_step(scene.model, data)
    begin = float(data.qpos[0])
    for _ in range(1000):
        mujoco.mj_step(scene.model, data)
    return (float(data.qpos[0]) - begin) / (1000 * scene.model.opt.timestep)


@pytest.mark.parametrize(
    ("armature", "joint", "option"),
    [
        (0.03, 'frictionloss="0.3"', ""),
        (0.002, 'frictionloss="0.3"', ""),
        (0.03, f'frictionloss="0.3" solimpfriction="{HOLDING_SOLIMP}"', ""),
        (0.03, 'frictionloss="0.3" solreffriction="0.05 1" solimpfriction=".7 .8 .001 .5 2"', ""),
        (0.03, 'frictionloss="0.3" solreffriction="-100 -40"', ""),
        (0.03, 'frictionloss="0.3" solreffriction="0.001 1"', ""),
        (0.03, 'frictionloss="0.3"', 'cone="pyramidal" gravity="0 0 0"'),
    ],
)
def test_the_speed_of_creep_is_that_of_mujoco(armature: float, joint: str, option: str):
    scene = hinge(joint, armature=armature, option=option)
    assert 0.2 * creep_per_load(scene.model, 0) == pytest.approx(crept(scene, 0.2), rel=0.02)


def test_a_joint_that_creeps_under_the_load_it_holds_is_said_beforehand():
    """A case from the field: armature 0.03, friction loss 0.3, 0.2 N m held for ten seconds."""
    scene = hinge('frictionloss="0.3"')
    held = log(np.full_like(TIME, 0.2), np.full_like(TIME, 0.2), np.zeros_like(TIME))
    (creep,) = creeping(scene, held)
    assert creep.load == pytest.approx(0.2, rel=0.01)
    assert creep.speed == pytest.approx(7.04e-3, rel=0.02) and creep.distance == pytest.approx(0.070, rel=0.03)
    said = creep_note(scene, held)
    assert "j by 7 mrad/s at the 0.2 N m that it holds for 10 s (70 mrad in all" in said
    assert f'solimpfriction="{HOLDING_SOLIMP}"' in said and said in command_notes(scene, held)
    assert not creep_note(hinge(f'frictionloss="0.3" solimpfriction="{HOLDING_SOLIMP}"'), held)
    assert not creep_note(hinge(), held)  # without friction nothing is held


def test_of_a_scene_that_holds_it_is_said_what_its_mjcf_would_do():
    hard = hinge(f'frictionloss="0.3" solimpfriction="{HOLDING_SOLIMP}"')
    still = log(np.full_like(TIME, 0.2), np.full_like(TIME, 0.2), np.zeros_like(TIME))
    said = creep_note(replace(hard, held=("j",)), still)
    assert "would creep in its MJCF" in said and "j by 7 mrad/s at the 0.2 N m" in said
    assert "--joint-friction scene" in said and "0.007 mrad/s when mended" in said


def test_a_load_by_weight_counts_and_one_that_the_motor_carries_does_not():
    scene = hinge('frictionloss="0.3" stiffness="2" springref="5.7296"')
    still, moving = np.zeros_like(TIME), np.sin(TIME)
    (creep,) = creeping(scene, log(still, still, still))
    assert creep.load == pytest.approx(0.2, rel=0.02)  # the spring's
    assert not creeping(scene, log(still, np.full_like(TIME, -0.2), still))  # the motor holds against it
    assert not creeping(scene, log(still, still, moving))  # it never stands still


def test_creep_is_said_where_it_is_visible_alone():
    scene = hinge('frictionloss="0.3"', actuator='<position joint="j" kp="100" kv="1"/>')
    held = np.where(TIME < 5.0, 0.0, 0.3)
    lag = np.where(TIME < 5.0, 0.0, 0.3 - 0.002)
    (creep,) = creeping(scene, log(held, np.where(TIME < 5.0, 0.0, 0.2), lag)) or (None,)
    assert creep is None  # 2 mrad of 100 N m/rad are all that a servo can creep, within the tracking error of a step
    soft = hinge('frictionloss="0.3"', actuator='<position joint="j" kp="5" kv="1"/>')
    found = creeping(soft, log(held, np.where(TIME < 4.0, 0.0, 0.2), np.where(TIME < 4.0, 0.0, 0.26)))
    assert found and found[0].distance <= 0.3 / 5.0


def test_a_servo_creeps_by_the_gain_that_the_recording_states():
    """Regression: the scene's stiff servo was used, which creeps too little."""
    scene = hinge('frictionloss="0.3"', actuator='<position joint="j" kp="100" kv="1"/>')
    held, torque = np.where(TIME < 4.0, 0.0, 0.3), np.where(TIME < 4.0, 0.0, 0.2)
    right = log(held, torque, np.where(TIME < 4.0, 0.0, 0.26))
    assert not creep_note(scene, right)
    assert creep_note(scene, replace(right, gains=ServoGains(np.array([5.0]), np.array([1.0]))))


def test_a_fit_that_finds_more_friction_creeps_more():
    scene = hinge('frictionloss="0.01"')
    held = log(np.full_like(TIME, 0.2), np.full_like(TIME, 0.2), np.zeros_like(TIME))
    assert creeping(scene, held)[0].load == pytest.approx(0.01)
    fitted = scene.model.__copy__()
    fitted.dof_frictionloss[:] = 0.3
    assert creeping(scene, held, fitted)[0].load == pytest.approx(0.2, rel=0.01)


def test_a_log_without_commands_creeps_nowhere():
    held = log(np.full_like(TIME, 0.2), np.full_like(TIME, 0.2), np.zeros_like(TIME))
    bare = replace(held, command=np.zeros((0, 0)), command_names=(), time=np.zeros(0))
    assert not creeping(hinge('frictionloss="0.3"'), bare)
