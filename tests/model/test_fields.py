"""Parameters of a scene."""

from __future__ import annotations

import textwrap
from pathlib import Path

import mujoco
import numpy as np
import pytest

import droid_jax as dj
from droid_jax.identify.gaussian import prior
from droid_jax.model import fields
from droid_jax.model.fields import (
    body_mass,
    body_position,
    check_space,
    joint_damping,
    joint_frictionloss,
    model_parameter,
    servo_scale,
)
from droid_jax.model.mjcf import fitted_mjcf, unwritten
from droid_jax.model.parameters import Parameter, Scaling, Space, Write
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention

XML = """<mujoco><worldbody>
  <body name="arm"><joint name="swing" axis="0 1 0" {limits}/><geom size=".05" pos="0 0 .3" mass="1"/>
    <body name="hand" pos="0 0 .6"><joint name="wrist" type="ball" damping="0.1" frictionloss="0.2"/>
      <geom size=".05" pos="0 0 .1" mass="1"/></body></body>
  <body name="table" mocap="true" pos="1 0 0"><geom type="box" size=".1 .1 .1"/></body>
  </worldbody><actuator><position name="servo" joint="swing" kp="9" {servo}/></actuator></mujoco>"""


def scene(limits: str = "", servo: str = "") -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(XML.format(limits=limits, servo=servo)), "arm", joints=["swing"])


def test_the_example_of_the_modules_docstring_runs():
    """In a scene with the named elements."""
    spec = mujoco.MjSpec.from_string(
        """<mujoco><worldbody><geom name="knob" size=".1" pos="1 0 0"/>
        <body name="forearm"><joint name="elbow" axis="0 1 0"/><geom name="pad" size=".05" pos="0 0 .3" mass="1"/>
        </body></worldbody><contact><pair name="left_near" geom1="knob" geom2="pad"/></contact></mujoco>"""
    )
    names = {"scene": compile_scene(spec, "arm", joints=["elbow"]), "Space": Space, **vars(fields)}
    exec(textwrap.dedent(str(fields.__doc__).split("\n\n")[1]), names)
    assert names["space"].names == ("elbow_damping", "forearm_mass", "grip")


def test_a_balls_number_is_one_for_all_its_degrees_of_freedom():
    """As in MJCF, so that a fitted value can be written."""
    arm = scene()
    damping = joint_damping(arm, "wrist", std=0.5, high=5.0)
    dry = joint_frictionloss(arm, "wrist", std=0.5, high=5.0)
    space = Space((damping, dry, joint_damping(arm, "swing", std=0.5, high=5.0)))
    values = np.array([2.0, 0.7, 0.3])
    model = make_c_model(arm, space, values)
    np.testing.assert_allclose(model.dof_damping, [0.3, 2.0, 2.0, 2.0])
    np.testing.assert_allclose(model.dof_frictionloss[1:], 0.7)
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(arm, space, values))
    np.testing.assert_allclose(written.dof_damping, model.dof_damping)
    assert unwritten(arm, space) == ()


@pytest.mark.parametrize(
    ("field", "element", "limited"),
    [
        ("jnt_range", "swing", {"limits": 'range="-1 1"'}),
        ("jnt_actfrcrange", "swing", {"limits": 'actuatorfrcrange="-5 5"'}),
        ("actuator_forcerange", "servo", {"servo": 'forcerange="-5 5"'}),
        ("actuator_ctrlrange", "servo", {"servo": 'ctrlrange="-1 1"'}),
    ],
)
def test_an_inactive_limit_is_refused(field: str, element: str, limited: dict[str, str]):
    """It would not act in the replay, but would be active in a written MJCF."""
    with pytest.raises(ValueError, match=f"{element!r} was compiled without the limit {field},"):
        model_parameter(scene(), field, element, 1, unit="-", std=0.1, high=9.0)
    model_parameter(scene(**limited), field, element, 1, unit="-", std=0.1, high=9.0)


def test_the_pose_of_a_mocap_body_is_no_parameter():
    with pytest.raises(ValueError, match="'table' is a mocap body"):
        body_position(scene(), "table", 2, std=0.1, limit=0.5)
    body_position(scene(), "hand", 2, std=0.1, limit=0.5)


# ----- a space that was made for another scene is refused by name: it writes rows, and there they are something else


def arm(folder: Path, *joints: str) -> Scene:
    """A chain of links, each on a hinge with an unnamed servo."""
    body = ""
    for joint in reversed(joints):
        body = (
            f'<body name="{joint}_link" pos="0 0 -0.3"><joint name="{joint}" axis="0 1 0" damping="0.1"/>'
            f'<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>{body}</body>'
        )
    servos = "".join(f'<position joint="{joint}" kp="40" kv="1"/>' for joint in joints)
    path = folder / f"{'_'.join(joints)}.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody><actuator>{servos}</actuator></mujoco>")
    return dj.load_scene(path)


def log(joint: str) -> Recording:
    time = np.arange(20) * 0.01
    values = np.zeros((2, 20, 1))
    channel = Channel("torque", "N m", (joint,), time, values, np.ones(values.shape, bool))
    return Recording("log", time, np.zeros((20, 1)), (joint,), {"torque": channel}, TorqueConvention("motor", True))  # pyright: ignore


@pytest.fixture
def two(tmp_path: Path) -> Scene:
    return arm(tmp_path, "shoulder", "elbow")


@pytest.fixture
def one(tmp_path: Path) -> Scene:
    return arm(tmp_path, "j")


def test_rows_that_do_not_exist(one: Scene, two: Scene) -> None:
    space = Space((joint_damping(two, "elbow", std=0.5, high=10.0),))
    with pytest.raises(ValueError, match=r"'elbow_damping' writes dof_damping\[1\] of 'elbow', but in .j. "):
        dj.make_cost(one, space, log("j"))
    with pytest.raises(ValueError, match=r"'elbow_damping'.*belongs to another scene"):
        dj.identify_parameters(one, space, log("j"))


@pytest.mark.parametrize("make", [joint_damping, servo_scale])
def test_rows_of_another_joint(one: Scene, two: Scene, make) -> None:
    options = {"std": 0.5, "high": 10.0} if make is joint_damping else {}
    space = Space((make(two, "shoulder", **options),))
    with pytest.raises(ValueError, match=r"but in .j. that entry is of .j.: it belongs to another scene"):
        dj.make_cost(one, space, log("j"))


def test_rows_of_another_body_and_fields_that_no_model_has(one: Scene, two: Scene) -> None:
    with pytest.raises(ValueError, match=r"'elbow_link_mass'.*belongs to another scene"):
        check_space(one, Space((body_mass(two, "elbow_link", std=0.5, high=5.0),)))
    for field in ("colour", "__class__", "nv"):
        made = Parameter("a", "-", 1.0, 1.0, 0.0, 2.0, (Write(field, (0,)),))
        with pytest.raises(ValueError, match=f"'a' writes {field}, which the model of 'j' does not have"):
            check_space(one, Space((made,)))


def test_a_space_of_a_file_is_checked_too(one: Scene, two: Scene, tmp_path: Path) -> None:
    path = tmp_path / "gaussian.json"
    prior(Space((joint_damping(two, "elbow", std=0.5, high=10.0),))).save(path)
    space = dj.load_gaussian(path).space
    check_space(two, space)
    with pytest.raises(ValueError, match="belongs to another scene"):
        check_space(one, space)
    with pytest.raises(ValueError, match="belongs to another scene"):
        dj.randomised(one, dj.load_gaussian(path))


def test_its_scene_and_one_with_further_joints_are_accepted(two: Scene, tmp_path: Path) -> None:
    longer = arm(tmp_path, "shoulder", "elbow", "wrist")
    space = Space(
        (
            joint_damping(two, "elbow", std=0.5, high=10.0),
            servo_scale(two, "elbow"),
            Parameter("x", "-", 0.1, 0.1, 0.0, 1.0, (Write("dof_damping", (0,)),), scaling=Scaling.LINEAR),
        )
    )
    for scene in (two, longer):
        check_space(scene, space)
