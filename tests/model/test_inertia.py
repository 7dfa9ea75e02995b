"""Inertia that no body can have: said of bounds, refused of means, left out of searches and draws."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from droid_jax.identify.gaussian import prior
from droid_jax.model.fields import body_mass, body_mass_scale, model_parameter
from droid_jax.model.inertia import check_inertia, free_inertias, inertia_possible, possible_draws
from droid_jax.model.parameter_file import load_parameters
from droid_jax.model.parameters import Parameter, Space
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


def test_bounds_that_no_body_can_have_are_said(scene: Scene):
    with pytest.warns(
        UserWarning, match=r"the bounds of i0 hold moments that body 'a' of scene 'arm' cannot have \(0\.5"
    ):
        check_inertia(scene, Space((moment(scene, 0),)))
    narrow = Space(tuple(moment(scene, k, low=0.003, high=0.006) for k in range(3)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_inertia(scene, narrow)


def test_means_that_no_body_can_have_are_refused(scene: Scene):
    with pytest.raises(ValueError, match=r"the initial means of i0 give body 'a' .*0\.02, 0\.005, 0\.005 kg m2"):
        check_inertia(scene, Space((moment(scene, 0, mean=0.02),)))


def test_a_mass_that_scales_its_inertia_is_no_matter(scene: Scene):
    space = Space((body_mass(scene, "a", std=0.3, high=5.0), body_mass_scale(scene, "a")))
    assert len(free_inertias(scene, Space((body_mass_scale(scene, "a"),)))) == 0
    assert bool(np.all(inertia_possible(scene, space, space.mean[None])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_inertia(scene, space)


@pytest.mark.parametrize("numbers", [np, jnp])
def test_rows_are_judged_alike_on_host_and_device(scene: Scene, numbers):
    space = Space((moment(scene, 0), moment(scene, 1)))
    rows = np.array([[0.005, 0.005], [0.02, 0.005], [0.002, 0.002], [0.02, 0.019], [0.01, 0.005]])
    found = np.asarray(inertia_possible(scene, space, numbers.asarray(rows)))
    assert found.tolist() == [True, False, False, True, True]


def test_draws_are_those_of_bodies(scene: Scene):
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


def test_a_logarithm_that_starts_where_nothing_is_felt_is_said(scene: Scene, tmp_path: Path):
    entry = {"field": "dof_frictionloss", "element": "j", "std": 0.1, "low": 1e-6, "high": 2.0, "scaling": "log"}
    file = tmp_path / "p.json"
    file.write_text(json.dumps([entry]))
    with pytest.warns(UserWarning, match="'j_frictionloss' is searched in the logarithm from 1e-06"):
        load_parameters(file, scene)
    file.write_text(json.dumps([{**entry, "log_offset": 0.05}]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_parameters(file, scene)
