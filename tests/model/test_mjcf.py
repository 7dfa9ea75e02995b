"""MuJoCo reads the MJCF of a fitted scene as the fitted model."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import droid_jax as dj
from droid_jax.door.space import door_nuisances
from droid_jax.model.fields import body_mass, joint_damping
from droid_jax.model.mjcf import fitted_mjcf, unwritten
from droid_jax.model.parameters import Parameter, Space, Write
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, compile_scene, load_scene

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
    """All parameters of the door and all nuisances differ from their means."""
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
def test_a_mass_that_comes_from_geoms(heavier: str) -> None:
    """The other body keeps the mass of its geoms."""
    scene = compile_scene(mujoco.MjSpec.from_string(GEOMS), "geoms")
    space = Space((body_mass(scene, heavier, std=0.2, high=50.0),))
    values = 1.3 * space.mean
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, values))
    expected = make_c_model(scene, space, values)
    for field in FIELDS:
        np.testing.assert_allclose(getattr(written, field), getattr(expected, field), rtol=1e-4, atol=1e-9)
    assert expected.body(heavier).mass[0] == pytest.approx(1.3 * scene.model.body(heavier).mass[0])


@pytest.mark.parametrize(
    "turned", ['diaginertia=".03 .025 .02" euler="20 30 40"', 'fullinertia=".03 .025 .02 .001 .002 .003"']
)
def test_a_mass_that_the_body_states(turned: str) -> None:
    """Its inertia has the orientation of the file, by any attribute."""
    stated = GEOMS.replace('<compiler inertiafromgeom="true"/>', "").replace(
        '<joint name="swing"', f'<inertial pos="0 .1 .2" mass="2" {turned}/><joint name="swing"'
    )
    scene = compile_scene(mujoco.MjSpec.from_string(stated), "stated")
    space = Space((body_mass(scene, "arm", std=0.2, high=50.0),))
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, 1.3 * space.mean))
    expected = make_c_model(scene, space, 1.3 * space.mean)
    for field in (*FIELDS, "body_iquat"):
        np.testing.assert_allclose(getattr(written, field), getattr(expected, field), rtol=1e-4, atol=1e-5)


def test_elements_without_names_are_written() -> None:
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


# Frames, Euler angles, degrees, ends of a capsule, a servo that inherits its range, and looks that weigh something.
TURNED = """<mujoco>
  <worldbody><frame pos="1 0 0" euler="0 0 90"><body name="arm" pos="0 1 0" euler="0 0 30">
    <joint name="swing" axis="0 1 0" range="-45 60" damping="1" armature=".02"/>
    <geom name="look" type="box" size=".03 .03 .03" pos=".2 0 0" group="2" contype="0" conaffinity="0"/>
    <frame pos="0 0 .5"><geom name="bone" type="capsule" fromto="0 0 0 0 0 .2" size=".03"/></frame></body></frame>
    <geom name="floor" type="plane" size="1 1 .1"/></worldbody>
  <contact><pair geom1="bone" geom2="floor"/></contact>
  <actuator><position name="swing" joint="swing" kp="50" inheritrange="1"/></actuator>
</mujoco>"""
WRITTEN = [
    ("dof_armature", (0,), 0.07), ("dof_damping", (0,), 2.0), ("jnt_range", (0, 1), 0.9), ("jnt_axis", (0, 0), 0.1),
    ("body_pos", (1, 0), 0.4), ("body_quat", (1, 3), 0.2), ("body_ipos", (1, 2), 0.55),
    ("body_inertia", (1, 0), 0.0691),
    ("geom_friction", (1, 0), 0.3), ("geom_size", (1, 1), 0.15), ("geom_pos", (1, 0), 0.01),
    ("pair_solimp", (0, 2), 0.003), ("pair_solref", (0, 0), 0.03), ("actuator_gear", (0, 0), 1.2),
    ("actuator_forcerange", (0, 1), 3.0), ("actuator_biasprm", (0, 2), -4.0),
]  # fmt: skip


def one(scene: Scene, field: str, index: tuple[int, ...], value: float) -> Space:
    return Space((Parameter(field, "-", value, 0.1, value - 9.0, value + 9.0, writes=(Write(field, index),)),))


@pytest.mark.parametrize(("field", "index", "value"), WRITTEN)
def test_every_field_that_has_an_attribute_is_written(field: str, index: tuple[int, ...], value: float):
    """Nothing else changes, whichever attributes the file uses; visual geoms come last."""
    scene = compile_scene(mujoco.MjSpec.from_string(TURNED), "turned")
    index = (scene.id("geom", "bone"), *index[1:]) if field.startswith("geom_") else index
    space = one(scene, field, index, value)
    assert unwritten(scene, space) == ()
    expected = make_c_model(scene, space, space.mean)
    assert getattr(expected, field)[index] != getattr(scene.model, field)[index]
    written = compile_scene(mujoco.MjSpec.from_string(fitted_mjcf(scene, space, space.mean)), "written").model
    for name in (*FIELDS, "dof_armature", "jnt_range", "jnt_axis", "geom_friction", "geom_size", "geom_pos",
                 "pair_solimp", "pair_solref", "actuator_gear", "actuator_biasprm", "actuator_ctrlrange"):  # fmt: skip
        axis = getattr(expected, name) / (np.linalg.norm(expected.jnt_axis) if name == "jnt_axis" else 1.0)
        np.testing.assert_allclose(getattr(written, name), axis, rtol=1e-4, atol=1e-6, err_msg=name)


def test_the_mass_of_visual_geoms_is_kept():
    """It counts in the file as in the replay."""
    scene = compile_scene(mujoco.MjSpec.from_string(TURNED), "turned")
    space = one(scene, "dof_damping", (0,), 2.0)
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, space.mean))
    np.testing.assert_allclose(written.body_mass, scene.model.body_mass, rtol=1e-5)
    assert written.body("arm").mass[0] > 0.2 + 1000 * 0.2 * np.pi * 0.03**2  # the bone alone, about


def test_parameters_that_mjcf_cannot_express_are_listed():
    scene = compile_scene(mujoco.MjSpec.from_string(TURNED), "turned")
    offset = Parameter("time_offset", "s", 0.0, 0.1, -1.0, 1.0)
    space = one(scene, "dof_damping", (0,), 2.0) + one(scene, "actuator_acc0", (0,), 2.0) + Space((offset,))
    assert unwritten(scene, space) == ("actuator_acc0", "time_offset")
    fitted_mjcf(scene, space, space.mean)


def test_an_inconsistent_inertia_is_refused():
    """A replay accepts a moment fitted about one axis that exceeds the sum of the others."""
    scene = compile_scene(mujoco.MjSpec.from_string(TURNED), "turned")
    space = one(scene, "body_inertia", (1, 1), 5.0)
    with pytest.raises(ValueError, match=r"^the fitted values make no MJCF: .*inertia.*A \+ B >= C.*arm"):
        fitted_mjcf(scene, space, space.mean)


def test_values_of_another_shape_are_refused():
    scene = compile_scene(mujoco.MjSpec.from_string(TURNED), "turned")
    space = one(scene, "dof_damping", (0,), 2.0)
    with pytest.raises(ValueError, match=r"expected values \[1\], one for each of \('dof_damping',\), got \[3\]"):
        fitted_mjcf(scene, space, np.ones(3))


# of a box whose corners go through z first, then y, then x
FACES = "f 1 2 4\nf 1 4 3\nf 5 8 6\nf 5 7 8\nf 1 6 2\nf 1 5 6\nf 3 4 8\nf 3 8 7\nf 1 3 7\nf 1 7 5\nf 2 6 8\nf 2 8 4\n"


def test_meshes_are_found_from_any_folder(tmp_path: Path):
    """meshdir is relative to the file; the written file is elsewhere."""
    (tmp_path / "robot" / "parts").mkdir(parents=True)
    corners = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    (tmp_path / "robot" / "parts" / "cube.obj").write_text(corners + FACES)
    (tmp_path / "robot" / "robot.xml").write_text(
        """<mujoco><compiler meshdir="parts"/><asset><mesh name="cube" file="cube.obj" scale=".1 .1 .1"/></asset>
        <worldbody><body name="arm"><joint name="swing" axis="0 1 0" damping="1"/><geom type="mesh" mesh="cube"/></body>
        </worldbody><actuator><position joint="swing" kp="50"/></actuator></mujoco>"""
    )
    scene = load_scene(tmp_path / "robot" / "robot.xml")
    space = one(scene, "dof_damping", (0,), 2.0)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "fitted.xml").write_text(fitted_mjcf(scene, space, space.mean))
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "run" / "fitted.xml"))
    assert written.nmeshvert == 8 and written.dof_damping[0] == 2.0
    assert unwritten(scene, one(scene, "geom_size", (0, 0), 0.2)) == ("geom_size",)


DUMMY = '<body name="tool"><joint name="tool" axis="0 0 1"/></body>'  # as of a URDF: it weighs what boundmass says
WORKED_OUT = """<mujoco>{compiler}<worldbody><body name="arm"><joint name="swing" axis="0 1 0" {joint}/>
    <geom size=".05" pos="0 0 .3" mass="1"/>
    <body name="tip" pos="0 0 .6"><joint name="turn" axis="1 0 0"/>
      <geom size=".05" pos="0 0 .1" mass="1"/>{dummy}</body></body>
  </worldbody><actuator><position joint="swing" kp="100" {servo}/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("changes", "values"),
    [
        ({"servo": 'dampratio="1"'}, {"arm_mass": 3.0}),
        ({"joint": 'springdamper="0.5 1"'}, {"arm_mass": 3.0}),
        ({"joint": 'springdamper="0.5 1"'}, {"arm_mass": 3.0, "damping": 3.0}),
        ({"compiler": '<compiler boundmass="0.5"/>'}, {"arm_mass": 0.2}),
        ({"compiler": '<compiler settotalmass="4"/>'}, {"arm_mass": 3.0}),
        ({"compiler": '<compiler boundmass=".01" boundinertia=".001"/>', "dummy": DUMMY}, {"arm_mass": 3.0}),
    ],
)
@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
def test_numbers_derived_from_masses_are_written(changes: dict, values: dict):
    """A damping ratio, a spring's period and a bound on masses would be derived from the fitted masses."""
    text = WORKED_OUT.format(**{"compiler": "", "joint": "", "servo": "", "dummy": "", **changes})
    scene = compile_scene(mujoco.MjSpec.from_string(text), "worked out")
    space = Space(
        (body_mass(scene, "arm", name="arm_mass", std=0.2, high=50.0),)
        + ((joint_damping(scene, "swing", name="damping", std=1.0, high=50.0),) if "damping" in values else ())
    )
    expected = make_c_model(scene, space, space.values(values))
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, space.values(values)))
    assert expected.body_mass[1] == values["arm_mass"]
    for field in (*FIELDS, "actuator_gainprm", "actuator_biasprm"):
        np.testing.assert_allclose(getattr(written, field), getattr(expected, field), rtol=1e-3, atol=1e-6)


def test_the_shape_of_a_mesh_is_unchanged(tmp_path: Path):
    """Its compiled pose contains the mesh's frame, which would be applied twice."""
    corners = [(x, y, z) for x in (0, 2) for y in (0, 1) for z in (0, 3)]
    (tmp_path / "brick.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + FACES)
    (tmp_path / "arm.xml").write_text(
        """<mujoco><asset><mesh name="brick" file="brick.obj" scale=".1 .1 .1"/></asset>
        <worldbody><body name="arm"><joint name="swing" axis="0 1 0"/>
        <geom name="bone" type="mesh" mesh="brick" euler="10 0 0"/></body></worldbody>
        <actuator><motor joint="swing"/></actuator></mujoco>"""
    )
    scene = load_scene(tmp_path / "arm.xml")
    space = one(scene, "geom_pos", (scene.id("geom", "bone"), 2), 0.2)
    assert unwritten(scene, space) == ("geom_pos",)
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, space.mean))
    np.testing.assert_allclose(written.geom_pos, scene.model.geom_pos, atol=1e-6)
    np.testing.assert_allclose(written.geom_quat, scene.model.geom_quat, atol=1e-6)


def test_the_rest_length_of_a_tendon_is_written():
    """By default it is the length at qpos0, which a moved body changes."""
    xml = """<mujoco><worldbody><site name="wall" pos="0 0 1"/>
      <body name="arm" pos="0 0 .2"><joint name="swing" axis="0 1 0"/><geom size=".05" pos="0 0 .3" mass="1"/>
      <site name="tip" pos=".1 0 .2"/></body></worldbody>
      <tendon><spatial stiffness="9"><site site="wall"/><site site="tip"/></spatial></tendon>
      <actuator><motor joint="swing"/></actuator></mujoco>"""
    scene = compile_scene(mujoco.MjSpec.from_string(xml), "strung")
    space = one(scene, "body_pos", (1, 2), 0.3)
    expected = make_c_model(scene, space, space.mean)
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(scene, space, space.mean))
    assert abs(written.tendon_length0[0] - expected.tendon_lengthspring[0, 0]) > 0.05
    np.testing.assert_allclose(written.tendon_lengthspring, expected.tendon_lengthspring, rtol=1e-4)
