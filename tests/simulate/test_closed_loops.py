"""Closed loops and floating bases at the start of a commanded motion."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from droid_jax.model.scene import Scene, compile_scene, load_scene
from droid_jax.preflight.preflight import closed_loop
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.closed_loops import OPEN, open_loops
from droid_jax.simulate.inverse_dynamics import prescribed_joints
from droid_jax.simulate.replay import make_drive

TIME = np.arange(0.0, 1.0, 0.01)

FOUR_BAR = """<mujoco><option integrator="implicitfast"/><worldbody>
  <body name="crank" pos="0 0 1"><joint name="crank" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" contype="0" conaffinity="0"/>
    <body name="coupler" pos="0 0 -.1"><joint name="coupler" axis="0 1 0" {coupler}/>
      <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01" contype="0" conaffinity="0"/>
      <body name="rocker" pos=".2 0 0"><joint name="rocker" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 .15" size=".01" contype="0" conaffinity="0"/></body></body></body>
  </worldbody>
  <equality>{equality}</equality>
  <actuator><position joint="crank" kp="30" kv="1"/>{more}</actuator></mujoco>"""
CONNECT = '<connect name="pin" body1="rocker" anchor="0 0 .15"/>'


def four_bar(equality: str = CONNECT, more: str = "", coupler: str = "") -> Scene:
    xml = FOUR_BAR.format(equality=equality, more=more, coupler=coupler)
    return compile_scene(mujoco.MjSpec.from_string(xml), "four-bar", joints=["crank"])


def recording(joints: tuple[str, ...] = ("crank",), start: float = 0.0, **changes) -> Recording:
    command = np.tile(start + 0.1 * np.sin(2 * np.pi * TIME)[:, None], (1, len(joints)))
    torque = np.sin(TIME)[None, :, None]
    channel = Channel("torque", "N m", ("crank",), TIME, torque, np.ones(torque.shape, bool))
    return replace(
        Recording(
            name="turn", command_names=joints, time=TIME, command=command, qpos0=dict.fromkeys(joints, start),
            torque=TorqueConvention(TorqueSide.MOTOR, True), channels={"torque": channel},
        ),
        **changes,
    )  # fmt: skip


@pytest.mark.parametrize("start", [0.0, 0.6, -0.5, 1.2])
def test_passive_joints_close_a_loop_at_the_start(start: float):
    scene = four_bar()
    drive = make_drive(scene, recording(start=start))
    assert drive.qpos0[scene.qpos("crank")] == start
    assert not open_loops(scene, drive.qpos0)
    if start:
        said = closed_loop(scene, recording(start=start))
        assert "<connect> 'pin' would be open by 0." in said and "start where they close it" in said
        data = mujoco.MjData(scene.model)  # and stands there: the first step is no blow
        data.qpos[:] = drive.qpos0
        data.ctrl[:] = start
        scene.model.opt.gravity[:] = 0
        mujoco.mj_forward(scene.model, data)
        assert np.abs(data.qacc).max() < 1e-3
    else:
        assert closed_loop(scene, recording(start=start)) == ""


def test_a_linkage_stays_on_the_branch_of_the_scene():
    """A rocker can close the loop in two ways.  The expected one is reached by a slow turn of the crank."""
    scene = four_bar()
    pose = make_drive(scene, recording(start=0.6)).qpos0
    for small in np.linspace(0.0, 0.6, 7):
        before = make_drive(scene, recording(start=float(small))).qpos0
    np.testing.assert_allclose(pose, before, atol=1e-6)
    assert np.abs(pose).max() < 1.0


@pytest.mark.parametrize(
    ("equality", "says"),
    [
        (CONNECT, "<connect> 'pin'"),
        ('<connect body1="rocker" anchor="0 0 .15"/>', "<connect> of rocker and world"),
        ('<weld body1="rocker"/>', "<weld> of rocker and world"),
        ('<joint joint1="rocker" joint2="crank"/>', "<joint> of rocker and crank"),
    ],
)
def test_a_loop_that_nothing_can_close_is_refused_with_the_distance(equality: str, says: str):
    """All joints are stated, so none is free to move."""
    stated = recording(start=0.6, qpos0={"crank": 0.6, "coupler": 0.0, "rocker": 0.0})
    with pytest.raises(
        ValueError, match=rf"recording 'turn' starts where {says} of scene 'four-bar' is open by 0\.\d+"
    ):
        make_drive(four_bar(equality), stated)


def test_a_loop_out_of_reach_is_refused():
    with pytest.raises(ValueError, match="no joint that nobody commands, measures or states can close it"):
        make_drive(four_bar(CONNECT.replace(".15", ".05")), recording(start=1.6))


def test_an_inactive_equality_is_ignored():
    assert not open_loops(four_bar(CONNECT.replace("/>", ' active="false"/>')), np.array([0.6, 0.0, 0.0]))


def test_encoders_of_a_loop_may_have_small_errors():
    stated = recording(start=0.0, qpos0={"crank": 0.01, "coupler": 0.0, "rocker": 0.0})
    assert 0 < open_loops(four_bar(), make_drive(four_bar(), stated).qpos0)[0].turn < OPEN


def test_a_log_without_commands_warns_of_a_loop_that_it_ignores():
    position = Channel(
        "position", "rad", ("crank",), TIME, 0.1 * np.sin(TIME)[None, :, None], np.ones((1, 100, 1), bool)
    )
    torque = recording().channels["torque"]
    log = recording(
        joints=(), command=np.zeros((0, 0)), time=np.zeros(0), channels={"torque": torque, "position": position}
    )
    with pytest.warns(UserWarning, match=r"the replay ignores <connect> 'pin' of scene 'four-bar'"):
        assert prescribed_joints(four_bar(), log) == ("crank",)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prescribed_joints(four_bar('<joint joint1="rocker" joint2="coupler"/>'), log)


# ----- floating bases

LEG = """<mujoco><option integrator="implicitfast"/><worldbody>{floor}
  <body name="stand" mocap="true" pos="0 0 {height}"/>
  <body name="base" pos="0 0 {height}">{joint}<geom type="box" size=".2 .1 .05" mass="7"/>
    <body name="thigh" pos=".2 .15 0"><joint name="crank" axis="0 1 0" damping="1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/></body></body></worldbody>
  <equality>{equality}</equality><actuator><position joint="crank" kp="30" kv="1"/>{more}</actuator></mujoco>"""
FLOOR = '<geom type="plane" size="3 3 .1"/>'


def leg(joint: str, floor: str = "", equality: str = "", more: str = "", height: float = 0.5) -> Scene:
    xml = LEG.format(joint=joint, floor=floor, equality=equality, more=more, height=height)
    return compile_scene(mujoco.MjSpec.from_string(xml), "leg", joints=["crank"])


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        (dict(joint='<freejoint name="float"/>'), r"the free joint float, .*moves by 0\.4\d* m"),
        (dict(joint="<freejoint/>"), "the free joint the joint of body 'base'"),
        (dict(joint='<freejoint name="float"/>', floor=FLOOR, height=1.5), r"the free joint float, .*moves by 0\.4"),
        (dict(joint='<joint name="socket" type="ball"/>'), "the ball joint socket"),
    ],
)
def test_a_floating_base_that_nothing_holds_is_refused(scene: dict, says: str):
    with pytest.raises(ValueError, match=rf"nothing in scene 'leg' holds {says}.*weld it to the world"):
        make_drive(leg(**scene), recording())


def test_a_balanced_base_is_refused_too():
    """Its centre of mass is at the joint, so it stands still until a command turns it."""
    scene = leg(joint='<joint name="socket" type="ball" damping="1"/>')
    scene.model.opt.gravity[:] = 0
    with pytest.raises(ValueError, match=r"the ball joint socket.* every command moves it"):
        make_drive(scene, recording())


@pytest.mark.parametrize(
    "scene",
    [
        dict(joint=""),
        dict(joint='<freejoint name="float"/>', floor=FLOOR, height=0.06),
        dict(joint='<freejoint name="float"/>', equality='<weld body1="base" body2="stand"/>'),
        dict(joint='<freejoint name="float"/>', equality='<weld body1="base"/>'),
        dict(joint='<joint name="socket" type="ball" stiffness="3000" damping="30"/>'),
    ],
)
def test_a_base_that_something_holds_is_replayed(scene: dict):
    make_drive(leg(**scene), recording())


def test_a_floating_object_without_measured_joints_is_no_base():
    """A manipulated object may be free."""
    xml = FOUR_BAR.format(equality="", more="", coupler="").replace(
        "</worldbody>", '<body pos="1 0 1"><freejoint/><geom size=".1"/></body></worldbody>'
    )
    make_drive(compile_scene(mujoco.MjSpec.from_string(xml), "table", joints=["crank"]), recording())


def test_a_urdf_without_servos_says_where_to_add_them(tmp_path: Path):
    """The message also mentions the equality of its mimic joint."""
    inertia = '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="{{0}}"><inertial><mass value="1"/>{inertia}</inertial></link>'
    joint = (
        '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="9" velocity="9"/>{3}</joint>'
    )
    parts = [link.format(name) for name in ("base", "a", "b")]
    parts += [joint.format("crank", "base", "a", ""), joint.format("finger", "a", "b", '<mimic joint="crank"/>')]
    file = tmp_path / "arm.urdf"
    file.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    said = "a URDF has none: save it as MJCF and add them there; its 1 <mimic> became"
    with pytest.raises(ValueError, match=said):
        make_drive(load_scene(file, joints=["crank"]), recording())
