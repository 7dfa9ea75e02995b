"""Parameters of a user's scene from a file, and messages about mistakes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from droid_jax.model.parameter_file import friction_joints, load_parameters
from droid_jax.model.parameters import Mode, Role, Scaling, Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, compile_scene

XML = """<mujoco><worldbody><body name="arm"><joint name="elbow" axis="0 1 0" damping="1"/>
  <geom name="bone" type="capsule" size=".02 .1"/></body></worldbody>
  <actuator><position name="elbow" joint="elbow" kp="20"/></actuator></mujoco>"""
GOOD = {"field": "dof_damping", "element": "elbow", "std": 0.5, "high": 9}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(XML), "arm")


def loaded(folder: Path, scene: Scene, entry: dict[str, Any]):
    (folder / "parameters.json").write_text(json.dumps([entry]))
    return load_parameters(folder / "parameters.json", scene)


def test_a_file_is_utf_8_whatever_wrote_it(tmp_path: Path, scene: Scene):
    """Editors on Windows may write a byte order mark or another encoding."""
    path, text = tmp_path / "parameters.json", json.dumps([{**GOOD, "name": "Öl"}], ensure_ascii=False)
    path.write_text(text, encoding="utf-8-sig")
    assert load_parameters(path, scene).names == ("Öl",)
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=r"parameters\.json: not a text file in UTF-8, byte \d+ cannot be read"):
        load_parameters(path, scene)


def test_an_entry_is_read(tmp_path: Path, scene: Scene):
    more = {"mode": "scale", "scaling": "log", "log_offset": 0.1, "width": 0.5, "nuisance": True, "low": 0, "mean": 2}
    parameter = loaded(tmp_path, scene, {**GOOD, **more, "name": "oil", "unit": "-", "group": "Arm"})["oil"]
    assert parameter.writes[0].mode is Mode.SCALE and parameter.scaling is Scaling.LOG
    assert (parameter.width, parameter.nuisance, parameter.group) == (0.5, True, "Arm")
    height = {"field": "body_pos", "element": "arm", "std": 0.01, "low": -1, "high": 1, "column": 2}
    assert loaded(tmp_path, scene, height)["arm_pos"].writes[0].index == (scene.id("body", "arm"), 2)


def test_a_negative_gain_starts_at_the_models(tmp_path: Path):
    """A servo's damping is minus its third bias: 2 for -2 in the file."""
    servo = mujoco.MjSpec.from_string(XML.replace('kp="20"', 'kp="20" kv="2"'))
    scene = compile_scene(servo, "arm", joints=["elbow"])
    entry = {"field": "actuator_biasprm", "element": "elbow", "column": 2, "std": 0.5, "high": 9, "mode": "negative"}
    assert loaded(tmp_path, scene, entry)["elbow_biasprm"].mean == 2.0


def test_a_mass_scales_its_inertia_also_with_a_stated_mode(tmp_path: Path, scene: Scene):
    entry = {"field": "body_mass", "element": "arm", "std": 0.1, "high": 3.0}
    plain, stated = loaded(tmp_path, scene, entry), loaded(tmp_path, scene, {**entry, "mode": "set"})
    assert plain == stated and len(stated["arm_mass"].writes) == 4 and stated["arm_mass"].unit == "kg"


def test_a_servos_gain_and_the_commands_delay_have_no_element(tmp_path: Path, scene: Scene):
    gain = loaded(tmp_path, scene, {"servo": "elbow", "std": 0.05, "high": 2.0})["elbow_servo_scale"]
    assert (gain.mean, gain.low, gain.high) == (1.0, 0.5, 2.0)
    assert {w.field for w in gain.writes} == {"actuator_gainprm", "actuator_biasprm"}
    delay = loaded(tmp_path, scene, {"sensor": "time_offset", "std": 0.002, "high": 0.1})["time_offset"]
    assert (delay.mean, delay.std, delay.low, delay.high, delay.nuisance) == (0.0, 0.002, -0.1, 0.1, True)
    assert not loaded(tmp_path, scene, {"sensor": "time_offset", "std": 1e-3, "high": 0.1, "nuisance": False}).nuisance[
        0
    ]
    for entry, says in (
        ({"servo": "wrist", "std": 0.05}, "no actuator drives 'wrist'"),
        ({"servo": "elbow"}, "missing std"),
        ({"servo": "elbow", "sensor": "coulomb", "std": 0.05}, "one of field, sensor, servo, motor, inertia and like"),
        ({"sensor": "time_offset", "std": 0.05}, "missing high"),
        ({"sensor": "time_offset", "std": 0.05, "high": 1.0, "name": "lag"}, "leave name out"),
        ({"sensor": "coulomb", "element": "elbow", "std": 0.5, "high": 5, "name": "dry"}, "leave name out"),
        ({"servo": "elbow", "std": 0.05, "column": 0}, "leave column out"),
        ({"motor": "kt", "element": "elbow", "std": 0.05}, "unknown motor term 'kt'"),
        ({"motor": "resistance", "std": 0.05}, "missing element"),
        ({"motor": "resistance", "element": "elbow", "std": 0.05, "mode": "set"}, "leave mode out"),
        ({"servo": "elbow", "std": 0.05, "element": "elbow", "mode": "set"}, "leave element, mode out"),
        ({"sensor": "coulomb", "element": "elbow", "std": 0.5, "high": 5, "mode": "scale"}, "leave mode out"),
        ({"field": "body_mass", "element": "arm", "std": 0.5, "high": 5, "column": 0}, "leave column out"),
    ):
        with pytest.raises(ValueError, match=says):
            loaded(tmp_path, scene, entry)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"column": 0}, 'dof_damping has one number for each joint: leave "column" out'),
        ({"field": "body_pos", "element": "arm"}, 'body_pos has 3 numbers for each body: give "column", 0 to 2'),
        ({"field": "body_pos", "element": "arm", "column": 7}, 'give "column", 0 to 2, got 7'),
        ({"field": "body_inertia", "element": "arm", "column": -1}, 'give "column", 0 to 2, got -1'),
        (
            {"field": "geom_size", "element": "bone", "column": "1"},
            "'column' must be a whole number or a list, got '1'",
        ),
        ({"std": "a"}, "'std' must be a number, got 'a'"),
        ({"std": True}, "'std' must be a number, got True"),
        ({"width": "x", "scaling": "log", "log_offset": 0.1}, "'width' must be a number, got 'x'"),
        ({"width": 0, "scaling": "log", "log_offset": 0.1}, "width must be above 0, got 0"),
        ({"nuisance": "false"}, "'nuisance' must be true or false, got 'false'"),
        ({"name": 5}, "'name' must be text, got 5"),
        ({"element": 3}, "'element' must be text or a list, got 3"),
        ({"mode": "sett"}, "'mode' must be one of set, negative, scale, divide, add, got 'sett'"),
        ({"scaling": 1}, "'scaling' must be one of linear, log, got 1"),
        ({"field": "actuator_damping", "element": "elbow"}, "'actuator_damping' cannot be a parameter: MJX"),
        ({"field": "jnt_stiffnesspoly", "column": 0}, "'jnt_stiffnesspoly' cannot be a parameter: MJX"),
        ({"field": "geom_contype", "element": "bone"}, "'geom_contype' cannot be a parameter: MJX"),
        ({"field": "body_gravcomp", "element": "arm"}, "compiled without gravity compensation"),
        ({"field": "actuator_biasprm", "column": 2, "low": -9}, "was compiled with a velocity gain"),
        ({"field": "actuator_gainprm", "column": 0, "high": 99}, "vary both with servo_scale"),
        ({"field": "actuator_biasprm", "column": 1, "low": -99}, "vary both with servo_scale"),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, scene: Scene, changes: dict[str, Any], says: str):
    with pytest.raises(ValueError) as caught:
        loaded(tmp_path, scene, {**GOOD, **changes})
    assert says in str(caught.value) and "parameters.json, entry 1: " in str(caught.value)


def test_nan_is_refused_with_the_files_name(tmp_path: Path, scene: Scene):
    with pytest.raises(ValueError, match=r"parameters\.json: NaN is no number of JSON"):
        loaded(tmp_path, scene, {**GOOD, "log_offset": float("nan")})
    with pytest.raises(ValueError, match=r"parameters\.json: entry 0, 'std': a whole number beyond 2\^63"):
        loaded(tmp_path, scene, {**GOOD, "std": 10**400})


def test_a_repeated_name_is_refused_with_both_entries(tmp_path: Path, scene: Scene):
    path = tmp_path / "parameters.json"
    path.write_text(json.dumps([GOOD, {**GOOD, "name": "oil"}, GOOD]))
    with pytest.raises(ValueError, match=r"parameters\.json, entry 3: 'elbow_damping' is entry 1 already"):
        load_parameters(path, scene)


def test_the_gravity_compensation_of_a_compensated_scene_is_a_parameter(tmp_path: Path):
    spec = mujoco.MjSpec.from_string(XML.replace('<body name="arm">', '<body name="arm" gravcomp="1">'))
    space = loaded(tmp_path, compile_scene(spec, "arm"), {**GOOD, "field": "body_gravcomp", "element": "arm"})
    np.testing.assert_array_equal(space.mean, [1.0])


TWO = """<mujoco><worldbody><body name="arm"><joint name="elbow" axis="0 1 0" damping="1" armature="0.02"/>
  <geom type="capsule" size=".02 .1"/><body name="hand"><joint name="wrist" axis="0 1 0" damping="2" armature="0.02"/>
  <geom type="capsule" size=".02 .1"/></body></body></worldbody>
  <actuator><position name="elbow" joint="elbow" kp="20" forcerange="-3 3"/>
  <position name="wrist" joint="wrist" kp="8"/></actuator></mujoco>"""


def test_a_list_of_joints_makes_one_parameter_that_they_share(tmp_path: Path):
    scene = compile_scene(mujoco.MjSpec.from_string(TWO), "arm")
    both, options = ["elbow", "wrist"], {"std": 0.01, "high": 1.0}
    (rotor,) = loaded(tmp_path, scene, {"field": "dof_armature", "element": both, **options}).parameters
    assert (rotor.name, rotor.mean) == ("elbow_armature+wrist_armature", pytest.approx(0.02))
    (gain,) = loaded(tmp_path, scene, {"servo": both, "name": "gain", "std": 0.1}).parameters
    (limit,) = loaded(
        tmp_path,
        scene,
        {
            "field": "actuator_forcerange",
            "element": "elbow",
            "column": [0, 1],
            "mode": "scale",
            "name": "limit",
            **options,
        },
    ).parameters
    model = make_c_model(scene, Space((rotor, gain, limit)), np.array([0.05, 1.1, 0.5]))
    np.testing.assert_allclose(model.dof_armature, 0.05)
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], [22.0, 8.8])
    np.testing.assert_allclose(model.actuator_biasprm[:, 1], [-22.0, -8.8])
    np.testing.assert_allclose(model.actuator_forcerange[0], [-1.5, 1.5])


def test_each_equals_separate_entries(tmp_path: Path):
    """Also with several columns of each joint, and for sensors, which have fixed names."""
    limited = TWO.replace('kp="8"', 'kp="8" forcerange="-1 1"')
    scene, both = compile_scene(mujoco.MjSpec.from_string(limited), "arm"), ["elbow", "wrist"]
    entries = (
        ({"field": "dof_damping", "std": 0.1, "high": 9.0, "unit": "N m s/rad"}, "element", "oil"),
        ({"field": "actuator_forcerange", "column": [0, 1], "std": 0.1, "high": 9.0, "mode": "scale"}, "element", "l"),
        ({"servo": "", "std": 0.1}, "servo", "gain"),
        ({"motor": "stall_torque", "std": 0.1}, "element", "stall"),
        ({"sensor": "coulomb", "std": 0.1, "high": 1.0}, "element", ""),
    )
    for entry, key, name in entries:
        together = {**entry, key: both, "each": True, **({"name": name} if name else {})}
        apart = [{**entry, key: j, **({"name": f"{name}_{j}"} if name else {})} for j in both]
        expected = [loaded(tmp_path, scene, one).parameters[0] for one in apart]
        assert list(loaded(tmp_path, scene, together).parameters) == expected
    for wrong in ({"element": "elbow"}, {"element": []}):
        with pytest.raises(ValueError, match='"each" needs a list of elements; element is'):
            loaded(tmp_path, scene, {**GOOD, **wrong, "each": True})


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (
            {"field": "dof_damping"},
            'elbow_damping is 1 in the model and wrist_damping is 2: state a common mean.*"scale"',
        ),
        ({"sensor": "coulomb"}, "a sensor's term belongs to one joint"),
        ({"field": "dof_damping", "element": []}, "element: the list is empty"),
        ({"field": "dof_damping", "element": ["elbow", "knee"]}, "unknown joint 'knee'"),
    ],
)
def test_invalid_shared_parameters_are_refused(tmp_path: Path, entry: dict[str, Any], said: str):
    scene = compile_scene(mujoco.MjSpec.from_string(TWO), "arm")
    with pytest.raises(ValueError, match=r"parameters\.json, entry 1: .*" + said):
        loaded(tmp_path, scene, {"element": ["elbow", "wrist"], "std": 0.1, "high": 9.0, **entry})


def test_joints_that_share_a_friction_loss_each_get_their_row(tmp_path: Path):
    (tmp_path / "parameters.json").write_text(
        json.dumps([{"field": "dof_frictionloss", "element": ["elbow", "wrist"], "std": 0.1, "high": 1.0}])
    )
    assert friction_joints(tmp_path / "parameters.json") == ("elbow", "wrist")


def test_an_entry_like_another_replaces_it(tmp_path: Path, scene: Scene):
    path = tmp_path / "parameters.json"
    path.write_text(json.dumps([{**GOOD, "name": "oil"}, {"like": "oil", "name": "old oil", "std": 0.2}]))
    oil, old = load_parameters(path, scene).parameters
    assert (old.unit, old.low, old.high, old.mean) == (oil.unit, oil.low, oil.high, oil.mean)
    assert (old.std, old.writes, old.role) == (0.2, (), Role.STANDS_FOR) and oil.writes
    for entry, said in (
        ({"like": "grease", "name": "old"}, "no entry before it has the name 'grease'; names are: oil"),
        ({"like": "oil"}, "missing name"),
        ({"like": "oil", "name": "old", "column": 1}, "leave column out"),
    ):
        path.write_text(json.dumps([{**GOOD, "name": "oil"}, entry]))
        with pytest.raises(ValueError, match=f"entry 2: {said}"):
            load_parameters(path, scene)
