"""Initial poses of motions, and messages for uncertain ones."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
from two_link import ARM, JOINTS, arm, measured, motion, recording

from droid_jax.cost.cost import _same_start, followed, make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.model.effect_interface import Effect
from droid_jax.model.fields import joint_damping
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.preflight.preflight import check_range, geared, open_loop, warn_if_moving
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Channel, Recording, ServoGains
from droid_jax.simulate.initial_state import DEFAULT_START
from droid_jax.simulate.replay import Drive, make_drive
from droid_jax.simulate.servo_gains import gains_note

SPACE = Space((joint_damping(arm(), "elbow", name="elbow_damping", std=0.1, high=50.0),))

AJAR = DEFAULT_START.ajar


@pytest.fixture(scope="module")
def scene() -> Scene:
    return arm()


def test_the_start_is_stated_else_measured_else_commanded(scene: Scene):
    _, command = motion()

    def start(**changes) -> list[float]:
        return make_drive(scene, recording(**changes)).qpos0.tolist()

    assert start() == [0.0, -0.3]
    assert start(qpos0={"elbow": 0.7}, channels=measured(0.2)) == pytest.approx([0.25, 0.7])
    assert start(qpos0={}, channels=measured(0.2, ("shoulder",))) == pytest.approx([0.25, command[0, 1]])
    assert start(qpos0={}) == pytest.approx([0.0, -0.3])


@pytest.mark.parametrize(("late", "jerky", "warned"), [(0.0, 0, False), (0.15, 0, True), (0.0, 1, False)])
def test_a_recording_that_begins_in_motion_is_warned_of(scene: Scene, late: float, jerky: int, warned: bool):
    """A replay starts at rest.  Sensor noise and a quick start from rest cause no warning."""
    time, _ = motion(2.0)
    swing = 0.4 * (1 - np.cos(2 * (time + late))) + jerky * 0.3 * np.clip(time / 0.1, 0, 1) ** 3
    path = np.stack([swing, np.full_like(time, -0.3)], axis=1)
    values = path + np.random.default_rng(2).normal(0, 2e-5, (3, *path.shape))
    position = Channel("position", "rad", JOINTS, time, values, np.ones(values.shape, bool))
    torque = replace(position, name="torque", unit="N m")
    cut = recording(time=time, command=path, channels={"position": position, "torque": torque}, qpos0={})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        followed(scene, cut, CompareConfig())
    found = [str(w.message) for w in said if "begins at rest" in str(w.message)]
    assert len(found) == warned
    assert all("'wave' begins while shoulder moves" in text for text in found)


def in_degrees(fine: Recording, measured: bool) -> Recording:
    """The same motion with its commands, or with measured positions, in degrees."""
    wrong = np.rad2deg(fine.command)
    if not measured:
        return replace(fine, command=wrong)
    seen = Channel("position", "rad", JOINTS, fine.time, wrong[None].repeat(2, 0), np.ones((2, *wrong.shape), bool))
    return replace(fine, channels={**fine.channels, "position": seen})


def test_a_recording_made_in_python_is_checked_like_one_from_a_file(scene: Scene):
    fine = recording()
    torque = fine.channels["torque"]
    values = torque.values.copy()
    values[0, 3, 1] = np.nan
    broken = replace(fine, channels={"torque": replace(torque, values=values)})
    with pytest.raises(ValueError, match=r"channel 'torque', repeat 0, row 3, column 'elbow': expected a finite"):
        make_cost(scene, SPACE, [broken])


def test_a_parameter_that_nothing_reads_is_refused(scene: Scene):
    """A misspelled name would be a parameter that no data constrain."""
    wrong = Space((*SPACE.parameters, Parameter("torque_offset[elbo]", "N m", 0.0, 0.1, -1.0, 1.0)))
    with pytest.raises(ValueError, match=r"parameters torque_offset\[elbo\] write no field.*torque_offset\[elbow\]"):
        make_cost(scene, wrong, [recording()])
    effect = Effect("slip", (wrong["torque_offset[elbo]"],), observe=lambda theta, rollout: rollout)
    make_cost(scene, wrong, [recording()], effects=[effect])


@pytest.mark.parametrize("limited", ["true", "false"])
@pytest.mark.parametrize("measured", [False, True])
def test_degrees_are_detected(measured: bool, limited: str):
    """With and without a limit of the joint in the replay."""
    xml = ARM.format(gravcomp='gravcomp="1"', friction=f'limited="{limited}" range="-2 2"', sensor="")
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "arm", joints=JOINTS)
    fine = recording()
    make_cost(scene, SPACE, [fine])
    said = "shoulder is measured at" if measured else "elbow is sent to"
    with pytest.raises(ValueError, match=said + r" .* far outside its range -2 \.\. 2 rad: are these degrees"):
        make_cost(scene, SPACE, [in_degrees(fine, measured)])
    with pytest.raises(ValueError, match=r"elbow starts at -17.* far outside its range"):
        check_range(scene, replace(fine, qpos0={"elbow": -17.2}))


def test_normalised_positions_and_encoder_counts_are_named(scene: Scene):
    fine = recording()
    percent = replace(fine, command=60.0 * np.sin(5.0 * fine.time)[:, None] * np.ones(2))
    with pytest.warns(UserWarning, match=r"turns: are these degrees\? Or normalised to -100 \.\. 100, or 0 \.\. 100\?"):
        check_range(scene, percent)
    counts = replace(fine, command=np.round(2048.0 + 300.0 * np.sin(5.0 * fine.time)[:, None] * np.ones(2)))
    with pytest.warns(UserWarning, match=r"turns: are these degrees\? Or encoder counts\?"):
        check_range(scene, counts)


def test_degrees_slightly_outside_of_a_range_are_detected(scene: Scene):
    """Eight degrees are twice the range of an arm that turns by four radians; a servo's overshoot is smaller."""
    xml = ARM.format(gravcomp='gravcomp="1"', friction='range="-2 2"', sensor="")
    limited = compile_scene(mujoco.MjSpec.from_string(xml), "arm", joints=JOINTS)
    fine = recording()
    for q in (2.3, 5.0, -5.9):
        with pytest.warns(UserWarning, match=rf"elbow starts at {q:g}, outside its range -2 \.\. 2 rad: are these deg"):
            check_range(limited, replace(fine, qpos0={"elbow": q}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_range(limited, replace(fine, qpos0={"elbow": 2.1}))


@pytest.mark.parametrize("measured", [False, True])
def test_degrees_of_a_hinge_without_range_are_warned_of(scene: Scene, measured: bool):
    """A wheel may turn often, so it is a warning."""
    fine = recording()
    said = "elbow is measured at" if measured else "elbow is sent to"
    with pytest.warns(UserWarning, match=rf"'wave': {said} .* turns: are these degrees\?"):
        check_range(scene, in_degrees(fine, measured))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_range(scene, fine)


def motors() -> Scene:
    """The arm with a motor, not a servo, at its shoulder."""
    xml = ARM.format(gravcomp='gravcomp="1"', friction="", sensor="")
    xml = xml.replace('<position name="s" joint="shoulder" kp="60"/>', '<motor name="s" joint="shoulder"/>')
    return compile_scene(mujoco.MjSpec.from_string(xml), "arm", joints=JOINTS)


def test_commands_without_position_feedback_are_called_torques(scene: Scene):
    said = "the actuators of shoulder have no position feedback: the commands of recording 'wave' are taken as"
    with pytest.warns(UserWarning, match=said):
        followed(motors(), recording(gains=None), CompareConfig())
    assert not open_loop(scene, recording())


def test_an_unknown_start_is_refused():
    driven = motors()
    with pytest.raises(ValueError, match="does not say where shoulder starts"):
        make_drive(driven, recording(qpos0={}, gains=None))
    started = make_drive(driven, recording(qpos0={}, gains=None, channels=measured(0.2)))
    np.testing.assert_allclose(started.qpos0, [0.25, 0.25])


def test_an_object_starts_at_its_measured_angle_unless_within_noise(scene: Scene):
    spec = mujoco.MjSpec.from_string(ARM.format(gravcomp='gravcomp="1"', friction="", sensor=""))
    door = spec.worldbody.add_body(name="door", pos=[0, 2, 0])
    door.add_joint(name="hinge", axis=[0, 0, 1])
    door.add_geom(size=[0.1, 0, 0])
    scene = compile_scene(spec, "arm and door", joints=JOINTS, object_joint="hinge")
    time, _ = motion()

    def start(angle: float, **named: float) -> float:
        seen = np.full((2, len(time), 1), angle) + 0.1 * time[:, None]
        camera = Channel("object_angle", "rad", ("lid",), time, seen, np.ones(seen.shape, bool))
        channels = {**recording().channels, "object_angle": camera}
        drive = make_drive(scene, recording(channels=channels, qpos0={**recording().qpos0, **named}))
        return float(drive.qpos0[scene.qpos("hinge")])

    assert start(0.005) == 0.0 and start(0.4) == pytest.approx(0.4) and start(0.4, hinge=0.1) == 0.1


def test_repeats_of_a_door_that_is_just_ajar_share_a_replay():
    """Near `ajar` the mean of some repeats is set to the scene's pose, and that of others is not."""
    door, demonstration = door_scene(), load_recording(demonstration_path("A"))
    time = demonstration.time[::30]

    def seen(angle: float) -> Drive:
        values = np.full((2, len(time), 1), angle)
        channel = Channel("object_angle", "rad", ("hinge",), time, values, np.ones(values.shape, bool))
        return make_drive(door, replace(demonstration, channels={"object_angle": channel}), weigh=False)

    shut, ajar, open_ = (seen(angle) for angle in (AJAR - 1e-3, AJAR + 1e-3, 2 * AJAR))
    assert shut.qpos0[door.qpos("hinge")] == 0.0 and ajar.qpos0[door.qpos("hinge")] > AJAR
    one_motion = partial(_same_start, door, config=DEFAULT_START)
    assert one_motion(shut, ajar) and one_motion(ajar, shut) and not one_motion(shut, open_)
    assert not one_motion(open_, seen(2 * AJAR + 0.015))  # neither is put back: these are two motions


COUPLED = """<mujoco><worldbody><body><joint name="shoulder" axis="0 1 0"/><geom size=".1" pos="0 0 .2"/>
  <body pos="0 0 .4"><joint name="elbow" axis="0 1 0"/><geom size=".1" pos="0 0 .2"/>
    <body pos="0 0 .2"><joint name="mimic" axis="0 1 0" ref="0.1"/><geom size=".05" pos="0 0 .1"/></body>
    <body pos="0 0 .3"><joint name="last" axis="0 1 0"/><geom size=".05" pos="0 0 .1"/></body></body></body></worldbody>
  <equality><joint joint1="last" joint2="mimic" polycoef="0 2 1 0 0"/>
    <joint joint1="{first}" joint2="{second}" polycoef="0.05 -2 0 0 0"/></equality>
  <actuator><position joint="shoulder" kp="80" kv="5"/><position joint="elbow" kp="80" kv="5"/></actuator></mujoco>"""


@pytest.mark.parametrize("driver", ["elbow", "mimic"])
def test_a_coupled_joint_starts_at_its_coupled_position(driver: str):
    """Otherwise the replay begins with a violated constraint, which pulls the joints together."""
    first, second = ("mimic", "elbow") if driver == "elbow" else ("elbow", "mimic")
    scene = compile_scene(
        mujoco.MjSpec.from_string(COUPLED.format(first=first, second=second)), "coupled", joints=("shoulder", "elbow")
    )
    heavy = {"torque": replace(recording().torque, gravity=True), "gains": None}
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = make_drive(scene, recording(qpos0={"shoulder": 0.2, "elbow": 0.4}, **heavy)).qpos0
    mujoco.mj_fwdPosition(model, data)
    rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    assert rows.sum() == 2 and np.abs(data.efc_pos[rows]).max() < 1e-9
    assert data.qpos[scene.qpos("elbow")] == 0.4 and abs(data.qpos[scene.qpos("mimic")]) > 0.1
    near = float(data.qpos[scene.qpos("mimic")]) + 0.003
    stated = make_drive(scene, recording(qpos0={"shoulder": 0.2, "elbow": 0.4, "mimic": near}, **heavy)).qpos0
    assert stated[scene.qpos("mimic")] == near  # what a recording says is not touched
    with pytest.raises(ValueError, match=r"starts where <joint> of (mimic|elbow) and (mimic|elbow) .* is open by "):
        make_drive(scene, recording(qpos0={"shoulder": 0.2, "elbow": 0.4, "mimic": 0.3}, **heavy))


def test_commands_of_a_servo_with_a_gear_are_controls_and_reported():
    spec = arm().spec.copy()
    for actuator in spec.actuators:
        actuator.gear[0] = 50.0
    scene = compile_scene(spec, "geared", joints=JOINTS)
    assert "the servos of elbow, shoulder have a gear" in geared(scene, recording())
    assert not geared(arm(), recording())
    kp = np.array([60.0, 25.0])
    given = recording(gains=ServoGains(kp * 50.0**2, np.zeros(2)))  # N m/rad at the joint
    assert not gains_note(scene, given)
    assert "shoulder 60 in place of 150000" in gains_note(scene, recording(gains=ServoGains(kp, np.zeros(2))))


def test_the_scatter_of_coupled_joints_is_allowed():
    """Starts that differ by a milliradian differ by fifty at a rotor behind a gear; they share a replay."""
    text = (
        COUPLED.format(first="mimic", second="elbow").replace("0.05 -2 0 0 0", "0 50 0 0 0").replace("0 2 1 0 0", "0 1")
    )
    scene = compile_scene(mujoco.MjSpec.from_string(text), "geared", joints=("shoulder", "elbow"))
    heavy = {"torque": replace(recording().torque, gravity=True), "gains": None}
    one, other = (make_drive(scene, recording(qpos0={"shoulder": 0.2, "elbow": q}, **heavy)) for q in (0.4, 0.401))
    assert np.abs(one.qpos0 - other.qpos0).max() == pytest.approx(0.05)
    assert _same_start(scene, one, other, DEFAULT_START)
    stated = {"shoulder": 0.2, "elbow": 0.401, "mimic": float(other.qpos0[scene.qpos("mimic")]) + 0.2}
    assert not _same_start(scene, one, make_drive(scene, recording(qpos0=stated, **heavy)), DEFAULT_START)


@pytest.mark.parametrize(("speed", "warned"), [(0.0, 0), (0.4, 1)])
def test_a_slow_log_from_rest_is_no_log_in_motion(speed: float, warned: int):
    """At 50 Hz six rows are a tenth of a second, in which a servo reaches its speed."""
    time = np.arange(200) * 0.02
    path = speed * time + 0.4 * np.maximum(time - 0.02, 0.0) ** 2 / (0.05 + np.maximum(time - 0.02, 0.0))
    values = np.stack([path, 0 * path], axis=1)[None] + np.random.default_rng(0).normal(0, 2e-4, (2, 200, 2))
    position = Channel("position", "rad", JOINTS, time, values, np.ones(values.shape, bool))
    slow = recording(time=time, command=values[0], channels={"position": position})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_if_moving(slow)
    assert len(said) == warned
