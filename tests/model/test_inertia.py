"""Inertia that no body can have: said of bounds, refused of means, left out of searches and draws.

And the whole inertia of a body as ten parameters, whose every value is one that a body can have.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from droid_jax.identify import apply_fit
from droid_jax.identify.gaussian import prior
from droid_jax.identify.neutral_result import write_neutral
from droid_jax.model.fields import body_mass, body_mass_scale, model_parameter
from droid_jax.model.inertia import (
    TERMS,
    WEIGHTS,
    check_inertia,
    free_inertias,
    inertia_parameters,
    inertia_possible,
    inertial_fields,
    possible_draws,
    root_of,
)
from droid_jax.model.mjcf import fitted_files, fitted_mjcf
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model, make_physics
from droid_jax.model.scene import Scene, compile_scene

XML = """<mujoco><option integrator="implicitfast"/><worldbody>
  <body name="a"><joint name="j" axis="0 1 0" frictionloss="1e-6"/>
    <inertial mass="1" pos="0 0 -.1" diaginertia=".005 .005 .005"/></body></worldbody>
  <actuator><position joint="j" kp="30" kv="1"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(XML), "arm")


def moment(scene: Scene, column: int, **more: float) -> Parameter:
    numbers: dict[str, Any] = {"std": 0.01, "high": 0.5, **more}
    return model_parameter(scene, "body_inertia", "a", column, name=f"i{column}", unit="kg m2", **numbers)


def test_inconsistent_bounds_are_warned_of(scene: Scene):
    with pytest.warns(
        UserWarning, match=r"the bounds of i0 allow moments that body 'a' of scene 'arm' cannot have \(0\.5"
    ):
        check_inertia(scene, Space((moment(scene, 0),)))
    narrow = Space(tuple(moment(scene, k, low=0.003, high=0.006) for k in range(3)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_inertia(scene, narrow)


def test_inconsistent_means_are_refused(scene: Scene):
    with pytest.raises(ValueError, match=r"the initial means of i0 give body 'a' .*0\.02, 0\.005, 0\.005 kg m2"):
        check_inertia(scene, Space((moment(scene, 0, mean=0.02),)))


def test_a_mass_that_scales_its_inertia_is_consistent(scene: Scene):
    space = Space((body_mass(scene, "a", std=0.3, high=5.0), body_mass_scale(scene, "a")))
    assert len(free_inertias(Space((body_mass_scale(scene, "a"),)))) == 0
    assert bool(np.all(inertia_possible(scene, space, space.mean[None])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_inertia(scene, space)


@pytest.mark.parametrize("numbers", [np, jnp])
def test_the_check_agrees_on_host_and_device(scene: Scene, numbers):
    space = Space((moment(scene, 0), moment(scene, 1)))
    rows = np.array([[0.005, 0.005], [0.02, 0.005], [0.002, 0.002], [0.02, 0.019], [0.01, 0.005]])
    found = np.asarray(inertia_possible(scene, space, numbers.asarray(rows)))
    assert found.tolist() == [True, False, False, True, True]


def test_draws_are_consistent(scene: Scene):
    space = Space(tuple(moment(scene, k, low=1e-4) for k in range(3)))
    rng, gaussian = np.random.default_rng(0), prior(space)
    plain = gaussian.sample(np.random.default_rng(1), 500)
    assert not np.all(inertia_possible(scene, space, plain))
    values = possible_draws(scene, space, lambda n: gaussian.sample(rng, n), 500)
    assert values.shape == (500, 3) and np.all(inertia_possible(scene, space, values))
    assert np.all(2 * values.max(axis=1) <= values.sum(axis=1) * 1.001)
    never = Space((moment(scene, 0, mean=0.009, low=0.008, high=0.5),))
    with pytest.raises(ValueError, match="hardly any draw for scene 'arm'"):
        possible_draws(scene, never, lambda n: np.full((n, 1), 0.4), 3, rounds=2)


def test_a_logarithm_that_starts_without_effect_is_warned_of(scene: Scene, tmp_path: Path):
    entry = {"field": "dof_frictionloss", "element": "j", "std": 0.1, "low": 1e-6, "high": 2.0, "scaling": "log"}
    file = tmp_path / "p.json"
    file.write_text(json.dumps([entry]))
    with pytest.warns(UserWarning, match="'j_frictionloss' is searched in the logarithm from 1e-06"):
        load_parameters(file, scene)
    file.write_text(json.dumps([{**entry, "log_offset": 0.05}]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_parameters(file, scene)


# ----- the whole inertia

LIMB = """<mujoco><option integrator="implicitfast"/><worldbody>
  <body name="upper"><joint name="lift" axis="0 1 0"/>
    <inertial mass="2" pos=".1 .02 -.1" quat=".9 .1 .3 .2" diaginertia=".02 .015 .008"/>
    <body name="ball" pos="0 0 -.4"><joint name="turn" axis="1 0 0"/><geom size=".05" mass=".5"/></body></body>
  </worldbody>
  <actuator><position joint="lift" kp="30" kv="1"/><position joint="turn" kp="30" kv="1"/></actuator></mujoco>"""
terms_strategy = st.lists(st.floats(-1.0, 1.0), min_size=10, max_size=10).map(np.array)


@pytest.fixture(scope="module")
def limb() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(LIMB), "limb")


def both_bodies(limb: Scene) -> Space:
    return Space(inertia_parameters(limb, "upper") + inertia_parameters(limb, "ball"))


def tensor(numbers: dict[str, Any]) -> np.ndarray:
    """[3, 3] moments about the centre of mass, in the body's frame."""
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, np.asarray(numbers["body_iquat"], float))
    axes = turned.reshape(3, 3)
    return axes @ np.diag(np.asarray(numbers["body_inertia"], float)) @ axes.T


def of(model: Any, body: int) -> dict[str, Any]:
    return {f: np.asarray(getattr(model, f)[body]) for f in WEIGHTS}


def assert_alike(one: dict[str, Any], two: dict[str, Any], rtol: float) -> None:
    np.testing.assert_allclose(one["body_mass"], two["body_mass"], rtol=rtol)
    np.testing.assert_allclose(one["body_ipos"], two["body_ipos"], rtol=rtol, atol=0.1 * rtol)
    size = np.abs(tensor(two)).max()
    np.testing.assert_allclose(tensor(one), tensor(two), atol=rtol * size)


@given(terms=terms_strategy)
@settings(deadline=None, max_examples=50)
def test_every_value_is_consistent(limb: Scene, terms: np.ndarray):
    numbers = inertial_fields(limb.model, 1, terms)
    moments = numbers["body_inertia"]
    assert numbers["body_mass"] == pytest.approx(2.0 * np.exp(2 * terms[0])) and np.all(moments > 0)
    assert 2 * moments.max() < moments.sum() and np.linalg.norm(numbers["body_iquat"]) == pytest.approx(1.0)
    on_device = inertial_fields(limb.model, 1, jnp.asarray(terms, jnp.float32), jnp)
    assert_alike({f: np.asarray(v) for f, v in on_device.items()}, numbers, 2e-4)


@given(terms=terms_strategy, other=terms_strategy)
@settings(deadline=None, max_examples=30)
def test_every_consistent_body_has_its_values(limb: Scene, terms: np.ndarray, other: np.ndarray):
    """From any body to any other: the terms are the logarithm of the factor between both roots."""
    aim, model = inertial_fields(limb.model, 1, terms), mujoco.MjSpec.from_string(LIMB).compile()
    for field, number in inertial_fields(limb.model, 1, other).items():
        getattr(model, field)[1] = number
    factor = np.linalg.solve(root_of(*of(model, 1).values()), root_of(*aim.values()))
    size, whole = np.log(factor[3, 3]), factor / factor[3, 3]
    found = [size, *np.log(np.diag(whole)[:3]), whole[0, 1], whole[1, 2], whole[0, 2], *whole[:3, 3]]
    assert_alike(inertial_fields(model, 1, np.array(found)), aim, 1e-7)


def test_zero_is_the_body_itself(limb: Scene):
    for body in (1, 2):
        assert_alike(inertial_fields(limb.model, body, np.zeros(10)), of(limb.model, body), 1e-12)


def test_a_replay_has_the_inertia_of_an_mjcf_that_states_it(limb: Scene):
    """In C, whose shortcuts for a centred inertial frame must be disabled, in MJX, and in a fit's files."""
    space = both_bodies(limb)
    values = np.random.default_rng(2).normal(0.0, 0.3, 20)
    spec = limb.spec.copy()
    for body in (1, 2):
        numbers, element = inertial_fields(limb.model, body, values[10 * (body - 1) : 10 * body]), spec.bodies[body]
        element.explicitinertial, element.mass = True, float(numbers["body_mass"])
        element.ipos, element.iquat = numbers["body_ipos"].tolist(), numbers["body_iquat"].tolist()
        element.inertia = numbers["body_inertia"].tolist()
    stated, found = spec.compile(), make_c_model(limb, space, values)
    qpos, full = np.array([0.7, -0.4]), []
    for model in (stated, found, mujoco.MjModel.from_xml_string(fitted_mjcf(limb, space, values))):
        data, matrix = mujoco.MjData(model), np.zeros((2, 2))
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        full.append((matrix, data.qfrc_bias.copy(), model.dof_invweight0, model.body_subtreemass))
    for other in full[1:]:
        for one, two in zip(full[0], other, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-8)  # a text has six digits
    physics = jax.jit(lambda row: make_physics(limb, space, row).model)(jnp.asarray(values, jnp.float32))
    for body in (1, 2):
        assert_alike(of(physics, body), of(stated, body), 1e-5)
    np.testing.assert_allclose(physics.dof_invweight0, stated.dof_invweight0, rtol=1e-5)


def test_the_neutral_result_writes_the_same(limb: Scene, tmp_path: Path):
    """Fitted values and draws, into a model and a spec; earlier writes are replaced."""
    space = both_bodies(limb)
    gaussian = prior(space)
    values = np.random.default_rng(3).normal(0.0, 0.2, 20)
    assert write_neutral(tmp_path, limb, gaussian, values, main="fitted.xml") == ""
    fit = apply_fit.load(tmp_path / "fitted.json")
    mass = next(row for row in fit["table"] if row["field"] == "body_mass" and row["name"] == "upper")
    assert mass["value"] == pytest.approx(2.0 * np.exp(2 * values[0])) and mass["interval"][0] < 2.0
    model, spec = mujoco.MjSpec.from_string(LIMB).compile(), mujoco.MjSpec.from_string(LIMB)
    drawn = apply_fit.apply(model, fit, sample=4)
    expected = make_c_model(limb, space, np.array([drawn[name] for name in space.names]))
    for body in (1, 2):
        assert_alike(of(model, body), of(expected, body), 1e-9)
    np.testing.assert_allclose(model.dof_M0, expected.dof_M0, rtol=1e-9)
    apply_fit.apply(model, fit)
    apply_fit.apply(spec, fit)
    expected, from_file = make_c_model(limb, space, values), mujoco.MjModel.from_xml_path(str(tmp_path / "fitted.xml"))
    for made in (model, spec.compile(), from_file):
        for body in (1, 2):
            assert_alike(of(made, body), of(expected, body), 1e-5)
    worlds = apply_fit.batch(model, fit, 3)
    assert {"body_mass", "body_ipos", "body_inertia"} <= worlds.keys() and worlds["body_mass"].shape == (3, 3)
    assert fitted_files(limb, space, values).changes


def test_a_file_states_an_inertia_in_one_entry(limb: Scene, tmp_path: Path):
    file = tmp_path / "p.json"
    file.write_text(json.dumps([{"inertia": "upper", "std": 0.2}, {"servo": "lift", "std": 0.1}]))
    space = load_parameters(file, limb)
    assert space.names[:2] == ("inertia_mass[upper]", "inertia_stretch_x[upper]") and len(space) == len(TERMS) + 1
    assert space["inertia_shift_z[upper]"].std == 0.2 and bool(np.all(inertia_possible(limb, space, space.mean[None])))
    for entries, said in (
        ([{"inertia": "upper", "std": 0.2, "column": 1}], "leave column out"),
        ([{"inertia": "none", "std": 0.2}], "none"),
        ([{"inertia": "upper", "std": 0.2}] * 2, "entry 2: 'inertia_mass\\[upper\\]' is entry 1 already"),
        (
            [{"inertia": "upper", "std": 0.2}, {"field": "body_mass", "element": "upper", "std": 1, "high": 9}],
            "'upper_mass' and inertia_mass\\[upper\\] both write the inertia of body 'upper'",
        ),
    ):
        file.write_text(json.dumps(entries))
        with pytest.raises(ValueError, match=said):
            load_parameters(file, limb)


def test_a_rod_has_no_whole_inertia():
    rod = LIMB.replace(".02 .015 .008", ".02 .02 1e-12")
    with pytest.raises(ValueError, match="those of a point, a rod or a plate"):
        inertia_parameters(compile_scene(mujoco.MjSpec.from_string(rod), "rod"), "upper")
