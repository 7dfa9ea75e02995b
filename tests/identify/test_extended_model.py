"""The extended model as a thing to hand on: the same costs again, a Gaussian over everything, MJCF where MJCF can."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from small_gap import JOINTS, SCENE, Small, small, small_scene

import droid_jax as dj
from droid_jax.cost.cost import make_cost
from droid_jax.discrepancy.fitting import FinalModel
from droid_jax.discrepancy.results import extended
from droid_jax.identify.extended_model import Extended, load_extended, save_extended
from droid_jax.identify.gaussian import prior
from droid_jax.model.effects.candidate import Candidate, EffectKey
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.model.mjcf import fitted_mjcf
from droid_jax.model.parameters import Parameter, Space, Write
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene, compile_scene, load_scene

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def saved(found: Small, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("extended")
    save_extended(folder, extended(found.case, found.own))
    return folder / "extended.json"


def with_effects(scene: Scene, base: Space, **values: float) -> Extended:
    """A made-up extended model whose effects have these values, each at the location of its first coefficient."""
    effects = library(scene, sorted({e.name for e in library(scene) for n in values if n in _names(e)}))
    parts = [
        Candidate(e.name, location, names, {n: values[n] for n in e.shape_parameters if n in values})
        for e in effects
        for location, names in e.locations.items()
        if set(names) & set(values)
    ]
    space = base + effect_space(effects).select(values)
    gaussian = prior(space)
    return Extended(ready(scene), tuple(parts), effects, space.values({**values}), gaussian)


def _names(effect: Any) -> set[str]:
    return {p.name for p in effect.parameters}


# ----- there and back


def test_a_model_without_an_mjcf_is_still_saved(tmp_path: Path):
    """One moment of inertia exceeds the sum of the other two, which the compiler refuses and the replay accepts."""
    scene, _ = small_scene()
    body = int(scene.model.jnt_bodyid[scene.id("joint", JOINTS[0])])
    inertia = Parameter("inertia", "kg m^2", 50.0, 1.0, 0.0, 99.0, writes=(Write("body_inertia", (body, 1)),))
    (tmp_path / "extended.xml").write_text("of a run before, started over")
    save_extended(tmp_path, with_effects(scene, Space((inertia,)), hinge_preload=0.7))
    written = json.loads((tmp_path / "extended.json").read_text())["mjcf"]
    assert written["file"] is None and "inertia" in written["error"] and not (tmp_path / "extended.xml").exists()
    again = load_extended(tmp_path / "extended.json", scene)
    assert dict(zip(again.space.names, again.values, strict=True)) == {"inertia": 50.0, "hinge_preload": 0.7}


@pytest.mark.slow
def test_the_cost_is_that_of_the_search(found: Small, saved: Path):
    """It is compiled with one effect instead of the full library, which may change it by 3e-4 N m."""
    scene, _ = small_scene()
    model = load_extended(saved, scene)
    assert [e.name for e in model.effects] == ["hinge_preload"]
    assert tuple(p.key for p in model.parts) == found.verdict.effects
    cost = make_cost(model.scene, model.space, [found.recordings["validation"]], effects=model.effects)
    case, whole = found.case, found.verdict.model.values
    own = case.validation.cost.distances(whole[None])[0, 0]
    assert cost(model.values[None])[0] == pytest.approx(own, abs=3e-4)
    without = model.space.values({**dict(zip(model.space.names, model.values, strict=True)), "hinge_preload": 0.0})
    assert cost(without[None])[0] > own + 0.3


def test_the_values_are_those_of_the_fit_and_the_gaussian_is_centred_on_them(found: Small, saved: Path):
    scene, base = small_scene()
    model = load_extended(saved, scene)
    assert model.space.names == (*base.names, "hinge_preload")
    whole = found.case.full_space
    np.testing.assert_array_equal(model.values, found.verdict.model.values[whole.columns(model.space)])
    low, high = model.gaussian.interval(0.9)
    assert np.all(low <= model.values + 1e-9) and np.all(model.values <= high + 1e-9)
    assert np.all(np.diag(model.gaussian.cov) < found.verdict.model.refined.prior**2 * 1.01)
    samples = model.gaussian.sample(0, 50)
    assert samples.shape == (50, len(model.space))


def test_effects_join_a_space_from_where_they_were_found(saved: Path):
    scene, base = small_scene()
    model = load_extended(saved, scene)
    (parameter,) = model.effect_space.parameters
    (plain,) = library(scene, ["hinge_preload"])[0].parameters
    assert parameter == replace(plain, mean=float(model.values[-1]))
    assert len(base + model.effect_space) == len(base) + 1


def test_a_model_without_effects_is_the_base_model(found: Small, tmp_path: Path):
    save_extended(tmp_path, extended(found.case, FinalModel(found.base, (found.case.train,))))
    scene, base = small_scene()
    model = load_extended(tmp_path / "extended.json", scene)
    assert (model.parts, model.effects, model.lacking) == ((), (), ())
    assert model.space.names == base.names
    with pytest.raises(ValueError, match="names no effect"):
        _ = model.effect_space


def test_shapes_and_locations_are_restored(tmp_path: Path):
    scene, base = small_scene()
    values = {"latch_torque": 1.2, "latch_width": 0.05, "latch_exponent": 1.5, "torque_gain[elbow]": 0.04}
    save_extended(tmp_path, with_effects(scene, base, **values))
    model = load_extended(tmp_path / "extended.json", scene)
    assert [(p.effect, p.location) for p in model.parts] == [("latch", "door"), ("torque_gain", "elbow")]
    assert (
        model.parts[0].shape_parameters == {"latch_width": 0.05, "latch_exponent": 1.5}
        and model.parts[1].shape_parameters == {}
    )
    assert dict(zip(model.effect_space.names, model.effect_space.mean.tolist(), strict=True)) == values
    assert model.lacking == (EffectKey("latch", "door"), EffectKey("torque_gain", "elbow"))


# ----- MJCF


def test_effects_that_mjcf_cannot_express_are_listed(tmp_path: Path):
    """The MJCF holds the base parameters only."""
    scene, base = small_scene()
    save_extended(tmp_path, with_effects(scene, base, latch_torque=1.2, hinge_preload=0.5))
    content = json.loads((tmp_path / "extended.json").read_text())
    assert content["mjcf"] == {"file": "extended.xml", "lacks": ["latch at door"]}
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "extended.xml"))
    assert model.joint("door").damping[0] == pytest.approx(content["values"]["door_damping"], rel=1e-4)
    assert model.body("forearm").mass[0] == pytest.approx(content["values"]["forearm_mass"], rel=1e-4)


@pytest.mark.parametrize("degrees", [False, True])
def test_laws_that_mjcf_can_express_are_in_the_mjcf(degrees: bool):
    """A preload is a spring with another reference, dry friction is frictionloss."""
    scene, base = small_scene()
    scene.spec.compiler.degree = degrees
    values = {"hinge_preload": 0.5, "joint_coulomb[elbow]": 0.2}
    without, model = (with_effects(scene, base, **v) for v in (dict.fromkeys(values, 0.0), values))
    assert model.lacking == ()
    plain, written = (
        mujoco.MjModel.from_xml_string(fitted_mjcf(m.scene, m.space, m.values, m.effects)) for m in (without, model)
    )
    more = written.dof_frictionloss - plain.dof_frictionloss
    assert more.tolist() == pytest.approx([0.0, 0.2, 0.0], abs=1e-6)
    for angle in (-0.4, 0.0, 1.1):
        passive = []
        for m in (plain, written):
            data = mujoco.MjData(m)
            data.joint("door").qpos = angle
            mujoco.mj_forward(m, data)
            passive.append(data.joint("door").qfrc_passive[0])
        assert passive[1] - passive[0] == pytest.approx(-0.5, abs=1e-5)


def test_a_preload_without_a_spring_is_not_in_the_mjcf():
    scene, base = small_scene()
    stiff = base.select([n for n in base.names if n != "door_stiffness"])
    spec = scene.spec.copy()
    for joint in spec.joints:
        joint.stiffness = np.zeros_like(joint.stiffness)
    scene = compile_scene(spec, "slack", joints=scene.joints, object_joint="door")
    model = with_effects(scene, stiff, hinge_preload=0.5)
    assert model.lacking == (EffectKey("hinge_preload", "door"),)
    fitted_mjcf(model.scene, model.space, model.values, model.effects)


@pytest.mark.parametrize(
    "values",
    [{"payload_mass": 0.3}, {"servo_gain[elbow]": 0.2}, {"payload_mass": 0.3, "servo_gain[shoulder]": -0.1}],
)
def test_effects_that_only_write_numbers_are_in_the_mjcf(values: dict[str, float]):
    scene, base = small_scene()
    model = with_effects(scene, base, **values)
    assert model.lacking == ()
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(model.scene, model.space, model.values))
    expected = make_c_model(scene, model.space, model.values)
    for field in ("body_mass", "body_inertia", "body_ipos", "actuator_gainprm", "actuator_biasprm", "dof_damping"):
        np.testing.assert_allclose(getattr(written, field), getattr(expected, field), rtol=1e-4, atol=1e-9)
    assert not np.allclose(expected.body_mass, scene.model.body_mass) or "payload_mass" not in values


def test_softer_contacts_are_in_the_mjcf():
    """The built-in door's pads."""
    scene = dj.door_scene()
    model = with_effects(scene, dj.door_space(scene), contact_softness=0.7)
    assert model.lacking == ()
    written = mujoco.MjModel.from_xml_string(fitted_mjcf(model.scene, model.space, model.values))
    expected = make_c_model(scene, model.space, model.values)
    np.testing.assert_allclose(written.pair_solref, expected.pair_solref, rtol=1e-4)
    assert np.allclose(expected.pair_solref[:, 0], 1.7 * scene.model.pair_solref[:, 0])
    assert written.ngeom > scene.model.ngeom  # its visual geoms too
    for kind, names in (("body", ("door", "knob", "hand")), ("joint", ("hinge",))):
        for name in names:
            for field in {"body": ("mass", "inertia"), "joint": ("damping", "stiffness")}[kind]:
                own = getattr(getattr(expected, kind)(name), field)
                np.testing.assert_allclose(getattr(getattr(written, kind)(name), field), own, rtol=1e-3)


# ----- files that are not as they should be


def test_a_missing_file(tmp_path: Path):
    with pytest.raises(ValueError, match=r"no\.json: there is no such file"):
        load_extended(tmp_path / "no.json", small_scene()[0])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda c: c.clear(), "expected a JSON object with format"),
        (lambda c: c.update(version=1), "version 2"),
        (lambda c: c.pop("values"), "missing keys: values"),
        (lambda c: c["values"].pop("hinge_preload"), "'values': missing keys: hinge_preload"),
        (lambda c: c["values"].update(hinge_preload=99.0), "not inside its bounds"),
        (lambda c: c["effects"][0].update(effect="gravity_waves"), "unknown effects gravity_waves; valid: .*latch"),
        (lambda c: c["gaussian"].update(cov=[[1.0]]), "cov must have shape"),
        (lambda c: c.update(scene=3), "'scene' must be an object, got 3"),
        (lambda c: c["effects"][0].update(coefficients=None), "entry 0, 'coefficients' must be a list, got None"),
        (lambda c: c["effects"][0].update(coefficients=[]), "'hinge_preload' has no coefficients"),
        (lambda c: c["effects"][0].update(coefficients=["x"]), "parameters that the space lacks: x"),
        (lambda c: c["effects"][0].update(colour="red"), "'effects', entry 0: unknown keys: colour"),
        (lambda c: c["space"][-1].update(writes=[{"field": "body_mass", "index": [1], "mode": "set", "gain": 1}]),
         "'hinge_preload' is not in this version's library"),
        (lambda c: c["space"][0]["writes"][0].update(index=[1, 1]), "'forearm_mass' writes body_mass.*another scene"),
        (lambda c: c["space"][0]["writes"][0].update(field="made_up"), "writes made_up, which the model of"),
    ],
)  # fmt: skip
def test_a_damaged_file(saved: Path, tmp_path: Path, change: Any, expected: str):
    content = json.loads(saved.read_text())
    change(content)
    path = tmp_path / "extended.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=expected) as raised:
        load_extended(path, small_scene()[0])
    assert str(path) in str(raised.value)


def test_another_scene_is_refused(saved: Path):
    """Parameters write by index, so in another scene they would write other numbers."""
    with pytest.raises(ValueError, match="fitted with another scene"):
        load_extended(saved, load_scene(SCENE, object_joint="door", joints=JOINTS[:2]))
    with pytest.raises(ValueError, match="fitted with another scene"):
        load_extended(saved, dj.door_scene())


def test_half_a_file_is_not_json(saved: Path, tmp_path: Path):
    (tmp_path / "extended.json").write_text(saved.read_text()[:200])
    with pytest.raises(ValueError, match=r"extended\.json"):
        load_extended(tmp_path / "extended.json", small_scene()[0])


# ----- the document


@pytest.mark.slow
def test_the_three_lines_of_the_document_run(found: Small, saved: Path, monkeypatch: pytest.MonkeyPatch):
    """The lines of docs/gap.md, with this test's folder as runs/gap."""
    text = (ROOT / "docs" / "gap.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert "runs/gap/extended.json" in code
    scene, _ = small_scene()
    names: dict[str, Any] = {"scene": scene, "recording": found.recordings["validation"]}
    exec(code.replace("runs/gap/extended.json", str(saved)), names)
    own = found.case.validation.cost.distances(found.verdict.model.values[None])[0, 0]
    assert names["costs"][0] == pytest.approx(own, abs=3e-4)
