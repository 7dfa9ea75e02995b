"""A fitted scene as MJCF is read by MuJoCo as the very model that was fitted."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import droid_jax as dj
from droid_jax.model.door import door_nuisances
from droid_jax.model.fields import body_mass
from droid_jax.model.mjcf import fitted_mjcf
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import compile_scene

FIELDS = (
    "dof_damping",
    "dof_frictionloss",
    "jnt_stiffness",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_pos",
    "body_quat",
)
GEOMS = """<mujoco>
  <compiler inertiafromgeom="true"/>
  <worldbody><body name="arm"><joint name="swing" axis="0 1 0"/>
    <geom type="box" size=".02 .02 .3" pos="0 0 .3"/><geom type="sphere" size=".05" mass="0.7"/>
    <body name="tip" pos="0 0 .6"><joint name="turn" axis="1 0 0"/><geom type="capsule" size=".02 .1"/></body></body>
  </worldbody>
  <actuator><position name="swing" joint="swing" kp="50"/><position name="turn" joint="turn" kp="20"/></actuator>
</mujoco>"""


def test_the_built_in_door_comes_back_as_it_was_fitted() -> None:
    """All parameters of the door and all nuisances away from their means."""
    scene = dj.door_scene()
    space = dj.door_space(scene) + door_nuisances(scene)
    values = np.clip(space.mean + 0.5 * space.std, space.low, space.high)
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, values))
    expected = make_c_model(scene, space, values)
    assert not np.allclose(expected.body_mass, scene.model.body_mass)
    heavy = expected.body_mass > 0  # of the others no centre counts
    for field in FIELDS:  # bodies and joints keep their order
        rows = heavy if field == "body_ipos" else slice(None)
        np.testing.assert_allclose(getattr(written, field)[rows], getattr(expected, field)[rows], rtol=1e-3, atol=1e-6)
    assert [written.body(i).name for i in range(written.nbody)] == [expected.body(i).name for i in range(written.nbody)]
    np.testing.assert_allclose(written.pair_friction, expected.pair_friction, rtol=1e-3)
    np.testing.assert_allclose(written.actuator_gainprm, expected.actuator_gainprm, rtol=1e-3)


@pytest.mark.parametrize("heavier", ["arm", "tip"])
def test_a_mass_that_geoms_make_up(heavier: str) -> None:
    """The other body keeps what its geoms weigh."""
    scene = compile_scene(mujoco.MjSpec.from_string(GEOMS), "geoms")
    space = Space((body_mass(scene, heavier, std=0.2, high=50.0),))
    values = 1.3 * space.mean
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, values))
    expected = make_c_model(scene, space, values)
    for field in FIELDS:
        np.testing.assert_allclose(getattr(written, field), getattr(expected, field), rtol=1e-4, atol=1e-9)
    assert expected.body(heavier).mass[0] == pytest.approx(1.3 * scene.model.body(heavier).mass[0])


def test_what_has_no_name_is_written_too() -> None:
    """Bodies and contact pairs, as MJCF allows."""
    pairs = '<contact><pair geom1="bar" geom2="end" friction="1 1 0.1 0 0"/></contact></mujoco>'
    nameless = GEOMS.replace('<body name="tip" ', "<body ").replace("</mujoco>", pairs)
    nameless = nameless.replace('<geom type="sphere"', '<geom name="bar" type="sphere"')
    scene = compile_scene(
        mujoco.MjSpec.from_string(nameless.replace('<geom type="capsule"', '<geom name="end" type="capsule"')), "geoms"
    )
    space = Space((body_mass(scene, "arm", std=0.2, high=50.0),))
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, 1.3 * space.mean))
    expected = make_c_model(scene, space, 1.3 * space.mean)
    for field in (*FIELDS, "pair_friction"):
        np.testing.assert_allclose(getattr(written, field), getattr(expected, field), rtol=1e-4, atol=1e-9)
