"""A space that was made for another scene is refused by name: it writes rows, and there they are something else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import droid_jax as dj
from droid_jax.identify.gaussian import prior
from droid_jax.model.fields import body_mass, check_space, joint_damping, servo_scale
from droid_jax.model.parameters import Parameter, Scaling, Space, Write
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention


def arm(folder: Path, *joints: str) -> Scene:
    """Links below one another, each on a hinge with a servo without a name."""
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


def test_rows_that_are_not_there(one: Scene, two: Scene) -> None:
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


def test_a_space_out_of_a_file_is_checked_alike(one: Scene, two: Scene, tmp_path: Path) -> None:
    path = tmp_path / "gaussian.json"
    prior(Space((joint_damping(two, "elbow", std=0.5, high=10.0),))).save(path)
    space = dj.load_gaussian(path).space
    check_space(two, space)
    with pytest.raises(ValueError, match="belongs to another scene"):
        check_space(one, space)
    with pytest.raises(ValueError, match="belongs to another scene"):
        dj.randomised(one, dj.load_gaussian(path))


def test_its_own_scene_and_one_with_more_joints_behind_are_taken(two: Scene, tmp_path: Path) -> None:
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
