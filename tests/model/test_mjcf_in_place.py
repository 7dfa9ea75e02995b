"""The fitted MJCF is the user's file with changed numbers."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from droid_jax.model.fields import (
    body_mass,
    body_position,
    capsule_radius,
    joint_damping,
    joint_frictionloss,
    model_parameter,
    servo_scale,
)
from droid_jax.model.mjcf import FittedFiles, fitted_files
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, load_scene

MAIN = """<mujoco model="mine">
  <!-- my robot -->
  <compiler   angle='degree'  meshdir="shapes"/>
  <include file="parts/arm.xml"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>   <!-- the floor -->
    <body name="cart" pos="0  0 1"><joint name="rail" type="slide" range="-1 1" damping="0.5"/><geom size=".1"/></body>
  </worldbody>
  <asset><mesh name="wedge" file="wedge.obj"/></asset>
  <actuator>
    <position joint="swing" kp="30" dampratio="1"/>
    <velocity name="push" joint="rail" kv="2"/>
  </actuator>
</mujoco>
"""
ARM = """<mujocoinclude>
  <default><default class="servo"><joint damping="2" armature=".01" frictionloss="0.1"/></default></default>
  <worldbody>
    <body name="arm" pos="0 0 .5" childclass="servo">
      <body name="tip" pos="0 0 .3">
        <joint name="twist" range="-45 60"/>
        <inertial pos="0 0 .1" mass="0.30" diaginertia=".01 .01 .002"/>
        <geom name="bone" type="capsule" fromto="0 0 0 0 0 .2" size=".03"/>
      </body>
      <joint name="swing" axis="0 1 0"/>
      <geom type="box" size=".02 .02 .2"/>
      <geom type="mesh" mesh="wedge"/>
    </body>
  </worldbody>
</mujocoinclude>
"""
WEDGE = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
NUMBERS = ("dof_damping", "dof_frictionloss", "dof_armature", "jnt_range", "body_mass", "body_inertia", "body_ipos",
           "body_pos", "geom_size", "geom_pos", "actuator_gainprm", "actuator_biasprm")  # fmt: skip


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "parts").mkdir()
    (tmp_path / "shapes").mkdir()
    (tmp_path / "robot.xml").write_text(MAIN)
    (tmp_path / "parts" / "arm.xml").write_text(ARM)
    (tmp_path / "shapes" / "wedge.obj").write_text(WEDGE)
    return load_scene(tmp_path / "robot.xml")


def written(made: FittedFiles, folder: Path) -> mujoco.MjModel:
    """The model of the files, in a separate folder."""
    for name, text in made.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return mujoco.MjModel.from_xml_path(str(folder / next(iter(made.files))))


def every_kind(scene: Scene) -> Space:
    return Space((
        joint_damping(scene, "swing", std=1.0, high=20.0),
        joint_frictionloss(scene, "twist", std=0.1, high=3.0),
        model_parameter(scene, "jnt_range", "twist", 1, unit="rad", std=0.1, high=2.0),
        body_mass(scene, "tip", std=0.1, high=3.0),
        body_position(scene, "cart", 2, std=0.1, limit=0.5),
        capsule_radius(scene, "bone", std=0.001, limit=0.01),
        servo_scale(scene, "swing"),
        model_parameter(scene, "actuator_gear", "push", 0, unit="-", std=0.1, high=9.0),
    ))  # fmt: skip


def test_only_numbers_change_and_the_model_is_the_fitted_one(scene: Scene, tmp_path: Path):
    space = every_kind(scene)
    values = space.mean + 0.7 * space.std
    made = fitted_files(scene, space, values)
    assert made.in_place, made.reason
    model, expected = written(made, tmp_path / "elsewhere"), make_c_model(scene, space, values)
    for name in NUMBERS:
        np.testing.assert_allclose(getattr(model, name), getattr(expected, name), rtol=1e-6, atol=2e-6, err_msg=name)
    main, arm = made.files["fitted.xml"], made.files["fitted_parts/arm.xml"]
    for text, own in ((main, MAIN), (arm, ARM)):
        lines = list(zip(text.splitlines(), own.splitlines(), strict=True))  # no line comes or goes
        assert 0 < sum(a != b for a, b in lines) < len(lines) / 2
    assert "<!-- the floor -->" in main and "angle='degree'" in main and 'pos="0  0 1' not in main
    assert 'class="servo"><joint damping="2" armature=".01" frictionloss="0.1"/>' in arm  # of the others too
    assert "diaginertia" in arm and 'range="-45 ' in arm


def test_hard_friction_is_written_into_the_users_file(tmp_path: Path, scene: Scene):
    """For joints that the scene holds; others keep the file's impedance."""
    held = load_scene(tmp_path / "robot.xml", hold=True)
    assert set(held.held) == {"swing", "twist"}
    space = Space((joint_damping(held, "swing", std=1.0, high=20.0),))
    made = fitted_files(held, space, space.mean + 0.7 * space.std)
    assert made.in_place, made.reason
    model = written(made, tmp_path / "elsewhere")
    np.testing.assert_allclose(model.dof_solimp, held.model.dof_solimp)
    assert np.ptp(model.dof_solimp[:, 0]) > 0.09  # the rail has no friction
    changes = {(c.name, c.index): (c.before, c.after) for c in made.changes if c.attribute == "solimpfriction"}
    assert changes == {(n, i): (soft, 0.9999) for n in held.held for i, soft in enumerate((0.9, 0.95))}
    assert "solimpfriction" not in made.files["fitted.xml"] and made.files["fitted_parts/arm.xml"].count("0.9999") == 4


def test_the_patch_changes_the_users_files(scene: Scene, tmp_path: Path):
    """By the program `patch`, if there is one; without paths, which only the copy needs."""
    import shutil
    import subprocess

    space = every_kind(scene)
    made = fitted_files(scene, space, space.mean + 0.7 * space.std)
    assert str(tmp_path) not in made.patch
    if shutil.which("patch") is None:
        pytest.skip("there is no program `patch`")
    subprocess.run(["patch", "-p1"], input=made.patch, text=True, cwd=tmp_path, check=True)
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    expected = make_c_model(scene, space, space.mean + 0.7 * space.std)
    for name in NUMBERS:
        np.testing.assert_allclose(getattr(again, name), getattr(expected, name), rtol=1e-6, atol=2e-6, err_msg=name)


def test_the_patch_finds_files_above_names_with_spaces_and_ends_without_a_line(tmp_path: Path):
    """Regressions: the program `patch` could not apply them."""
    import shutil
    import subprocess

    (tmp_path / "robots").mkdir()
    (tmp_path / "common").mkdir()
    (tmp_path / "common" / "my arm.xml").write_text(ARM.replace('<geom type="mesh" mesh="wedge"/>', "").rstrip())
    main = MAIN.replace("parts/arm.xml", "../common/my arm.xml").replace(' meshdir="shapes"', "")
    main = main.replace('<asset><mesh name="wedge" file="wedge.obj"/></asset>', "")
    (tmp_path / "robots" / "robot.xml").write_text(main.rstrip())
    scene = load_scene(tmp_path / "robots" / "robot.xml")
    space = Space((joint_damping(scene, "swing", std=1.0, high=20.0), servo_scale(scene, "swing")))
    made = fitted_files(scene, space, space.mean + 0.7 * space.std)
    assert made.in_place and "+++ b/common/my arm.xml" in made.patch
    if shutil.which("patch") is None:
        pytest.skip("there is no program `patch`")
    subprocess.run(["patch", "-p1"], input=made.patch, text=True, cwd=tmp_path, check=True)
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "robots" / "robot.xml"))
    expected = make_c_model(scene, space, space.mean + 0.7 * space.std)
    np.testing.assert_allclose(again.dof_damping, expected.dof_damping, rtol=1e-6)


@pytest.mark.parametrize("stated", ["meshdir", "texturedir"])
def test_one_stated_folder_of_assets_leaves_the_other_where_it_was(tmp_path: Path, stated: str):
    """Regression: only the stated one was made absolute, and the scene was written by MuJoCo."""
    (tmp_path / "tex").mkdir()
    folder = tmp_path / ("tex" if stated == "meshdir" else ".")
    (folder / "wedge.obj").write_text(WEDGE)
    main = f"""<mujoco><compiler {stated}="tex"/><asset><mesh name="wedge" file="wedge.obj"/></asset><worldbody>
    <body><joint name="swing" damping="1"/><geom type="mesh" mesh="wedge"/></body></worldbody></mujoco>"""
    (tmp_path / "robot.xml").write_text(main)
    scene = load_scene(tmp_path / "robot.xml")
    space = Space((joint_damping(scene, "swing", std=1.0, high=20.0),))
    assert fitted_files(scene, space, space.mean + 0.5).in_place


def test_changes_say_where_a_number_came_from(scene: Scene):
    space = Space((joint_damping(scene, "swing", std=1.0, high=20.0), servo_scale(scene, "swing")))
    made = fitted_files(scene, space, np.array([3.0, 1.1]))
    by = {(c.element, c.attribute): c for c in made.changes}
    damping, gain = by["joint", "damping"], by["actuator", "kp"]
    assert (damping.before, damping.after, damping.file, damping.line) == (2.0, 3.0, "arm.xml", 10)
    assert damping.origin == "default class 'servo', arm.xml line 2"
    assert (gain.before, gain.file, gain.line, gain.origin) == (30.0, "robot.xml", 11, "")
    assert gain.after == pytest.approx(33.0)
    assert 'kv="' in made.files["fitted.xml"] and "dampratio" not in made.files["fitted.xml"]  # of the old gain


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("<geom size=", '<replicate count="2" offset="1 0 0"><site/></replicate><geom size=', "replicate"),
        ('angle=\'degree\'', "angle='degree' settotalmass='3'", "makes another"),
        ('<position joint="swing" kp="30" dampratio="1"/>', '<motor joint="swing" gear="3"/>', ""),
    ],
)  # fmt: skip
def test_other_changes_are_written_by_mujoco(tmp_path: Path, scene: Scene, old: str, new: str, reason: str):
    """With the reason; the model is the fitted one."""
    (tmp_path / "robot.xml").write_text(MAIN.replace(old, new))
    other = load_scene(tmp_path / "robot.xml", engine="mujoco")
    space = Space((body_mass(other, "tip", std=0.1, high=3.0),))
    values = 1.2 * space.mean
    made = fitted_files(other, space, values)
    assert made.in_place == (not reason) and reason in made.reason
    model, expected = written(made, tmp_path / "elsewhere"), make_c_model(other, space, values)
    np.testing.assert_allclose(model.body_mass, expected.body_mass, rtol=1e-4)
    assert [c.attribute for c in made.changes if c.name == "tip"].count("mass") == 1


def test_a_file_that_was_changed_meanwhile_is_not_edited(scene: Scene, tmp_path: Path):
    (tmp_path / "robot.xml").write_text(MAIN.replace('kp="30"', 'kp="50"'))
    space = Space((joint_damping(scene, "swing", std=1.0, high=20.0),))
    made = fitted_files(scene, space, np.array([3.0]))
    assert not made.in_place and "actuator_" in made.reason


def test_a_body_without_inertial_gets_one(scene: Scene, tmp_path: Path):
    space = Space((body_mass(scene, "cart", std=0.1, high=90.0),))
    made = fitted_files(scene, space, 1.5 * space.mean)
    assert made.in_place, made.reason
    assert "<inertial" in made.files["fitted.xml"]
    model = written(made, tmp_path / "elsewhere")
    assert model.body("cart").mass[0] == pytest.approx(1.5 * space.mean[0])
