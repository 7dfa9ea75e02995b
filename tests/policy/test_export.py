"""A policy to take along: ONNX against the JAX policy, and a folder that is whole."""

from __future__ import annotations

import importlib.util
import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from droid_jax.policy import control
from droid_jax.policy.control import ACTIONS, LAYOUT, OBSERVED, SHAPES, Interface, Policy, load_policy
from droid_jax.policy.export import CLOSE, difference, export, to_onnx
from droid_jax.storage import WRITTEN

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


@pytest.fixture(scope="module")
def policy() -> Policy:
    rng = np.random.default_rng(0)
    sizes = (OBSERVED, 64, 64, 2 * ACTIONS)
    weights = tuple(np.float32(rng.normal(size=s) / np.sqrt(s[0])) for s in itertools.pairwise(sizes))
    biases = tuple(np.float32(0.1 * rng.normal(size=s)) for s in sizes[1:])
    ones = {name: np.ones(shape) for name, shape in SHAPES.items()}  # limits of zero would be refused
    interface = Interface(**{**ones, "period": 0.02, "reach": 0.1, "width": 0.04})  # type: ignore[arg-type]
    mean, std = np.float32(rng.normal(size=OBSERVED)), np.float32(rng.uniform(0.1, 2, OBSERVED))
    return Policy(mean, std, weights, biases, interface)


def test_onnx_acts_as_jax_does(policy):
    assert difference(policy, to_onnx(policy)) <= CLOSE


def test_the_difference_is_seen(policy):
    """Another policy's file is not taken for this one's."""
    other = replace(policy, biases=(policy.biases[0] + 1e-3, *policy.biases[1:]))
    assert difference(other, to_onnx(policy)) > CLOSE


def test_one_observation_or_many(policy):
    session = onnxruntime.InferenceSession(to_onnx(policy), providers=["CPUExecutionProvider"])
    (one,) = session.run(None, {"observation": np.zeros((1, OBSERVED), np.float32)})
    (many,) = session.run(None, {"observation": np.zeros((5, OBSERVED), np.float32)})
    assert one.shape == (1, ACTIONS) and many.shape == (5, ACTIONS)
    np.testing.assert_allclose(one[0], policy.act(np.zeros(OBSERVED)), atol=CLOSE)


def test_the_file_says_what_its_numbers_mean(policy):
    notes = {p.key: p.value for p in onnx.load_from_string(to_onnx(policy)).metadata_props}
    assert json.loads(notes["observation"]) == list(LAYOUT) and len(json.loads(notes["action"])) == ACTIONS
    assert (notes["period, s"], notes["reach, rad"], notes["width, m"]) == ("0.02", "0.1", "0.04")


def test_the_folder_holds_all_a_robot_needs(policy, tmp_path: Path):
    assert export(tmp_path / "out", policy) <= CLOSE
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"policy.npz", "policy.onnx", "control.py", WRITTEN}
    assert (tmp_path / "out" / "control.py").read_text() == Path(control.__file__).read_text()
    observation = np.linspace(-1, 1, OBSERVED)
    np.testing.assert_array_equal(
        load_policy(tmp_path / "out" / "policy.npz").act(observation), policy.act(observation)
    )


def test_without_onnx_it_says_what_to_install(policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "onnx" else find(name))
    with pytest.raises(ValueError, match=r"export needs onnx: in the checkout, pip install .* '.\[export\]'"):
        export(tmp_path, policy)


def test_a_policy_that_onnx_does_not_follow_is_not_written(policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("droid_jax.policy.export.difference", lambda policy, model: np.nan)
    with pytest.raises(ValueError, match="it is not written"):
        export(tmp_path / "out", policy)
    assert not (tmp_path / "out").exists()
