"""Parameters of elements that have several numbers, no limit, or no place in the model."""

from __future__ import annotations

import textwrap

import mujoco
import numpy as np
import pytest

from droid_jax.model import fields
from droid_jax.model.fields import body_position, joint_damping, joint_frictionloss, model_parameter
from droid_jax.model.mjcf import fitted_mjcf, unwritten
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, compile_scene

XML = """<mujoco><worldbody>
  <body name="arm"><joint name="swing" axis="0 1 0" {limits}/><geom size=".05" pos="0 0 .3" mass="1"/>
    <body name="hand" pos="0 0 .6"><joint name="wrist" type="ball" damping="0.1" frictionloss="0.2"/>
      <geom size=".05" pos="0 0 .1" mass="1"/></body></body>
  <body name="table" mocap="true" pos="1 0 0"><geom type="box" size=".1 .1 .1"/></body>
  </worldbody><actuator><position name="servo" joint="swing" kp="9" {servo}/></actuator></mujoco>"""


def scene(limits: str = "", servo: str = "") -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(XML.format(limits=limits, servo=servo)), "arm", joints=["swing"])


def test_the_example_of_the_modules_docstring_runs():
    """As a reader would type it, in a scene that has what it names."""
    spec = mujoco.MjSpec.from_string(
        """<mujoco><worldbody><geom name="knob" size=".1" pos="1 0 0"/>
        <body name="forearm"><joint name="elbow" axis="0 1 0"/><geom name="pad" size=".05" pos="0 0 .3" mass="1"/>
        </body></worldbody><contact><pair name="left_near" geom1="knob" geom2="pad"/></contact></mujoco>"""
    )
    names = {"scene": compile_scene(spec, "arm", joints=["elbow"]), "Space": Space, **vars(fields)}
    exec(textwrap.dedent(str(fields.__doc__).split("\n\n")[1]), names)
    assert names["space"].names == ("elbow_damping", "forearm_mass", "grip")


def test_a_balls_number_is_one_for_all_its_degrees_of_freedom():
    """As MJCF states it, so that what is fitted can be written."""
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
def test_a_limit_that_the_model_was_compiled_without_is_refused(field: str, element: str, limited: dict[str, str]):
    """In the replay it would never act, and the written MJCF would switch it on."""
    with pytest.raises(ValueError, match=f"{element!r} was compiled without the limit that {field} is of"):
        model_parameter(scene(), field, element, 1, unit="-", std=0.1, high=9.0)
    model_parameter(scene(**limited), field, element, 1, unit="-", std=0.1, high=9.0)


def test_the_place_of_a_mocap_body_is_no_parameter():
    with pytest.raises(ValueError, match="'table' is a mocap body"):
        body_position(scene(), "table", 2, std=0.1, limit=0.5)
    body_position(scene(), "hand", 2, std=0.1, limit=0.5)
