"""Policies: ONNX, and training on several devices."""

from __future__ import annotations

import importlib.util
import itertools
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from droid_jax.policy import control
from droid_jax.policy.control import ACTIONS, LAYOUT, OBSERVED, SHAPES, Interface, Policy, load_policy
from droid_jax.policy.export import CLOSE, difference, export, to_onnx
from droid_jax.policy.parallel import AXIS, RandomisedEnvs, wrapped
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


def test_another_policys_model_differs(policy):
    """Another policy's ONNX model is detected."""
    other = replace(policy, biases=(policy.biases[0] + 1e-3, *policy.biases[1:]))
    assert difference(other, to_onnx(policy)) > CLOSE


def test_one_observation_or_many(policy):
    session = onnxruntime.InferenceSession(to_onnx(policy), providers=["CPUExecutionProvider"])
    (one,) = session.run(None, {"observation": np.zeros((1, OBSERVED), np.float32)})
    (many,) = session.run(None, {"observation": np.zeros((5, OBSERVED), np.float32)})
    assert one.shape == (1, ACTIONS) and many.shape == (5, ACTIONS)
    np.testing.assert_allclose(one[0], policy.act(np.zeros(OBSERVED)), atol=CLOSE)


def test_the_metadata_describe_the_numbers(policy):
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


def test_a_policy_that_differs_in_onnx_is_not_written(policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("droid_jax.policy.export.difference", lambda policy, model: np.nan)
    with pytest.raises(ValueError, match="it is not written"):
        export(tmp_path / "out", policy)
    assert not (tmp_path / "out").exists()


# ----- physics of environments side by side: each its own, on every device others, the same after a stop


COUNT = 3


class Physics(NamedTuple):
    """One field that varies, one that does not."""

    stiffness: Any
    gravity: Any


class Spring(Env):
    """Observes its own physics."""

    sys: Any = Physics(jnp.zeros(()), jnp.full(2, 9.81))

    def reset(self, rng):
        return State(None, self._observe(), jnp.zeros(()), jnp.zeros(()), {})

    def step(self, state, action):
        return state.replace(obs=self._observe(), reward=action)  # pyright: ignore[reportAttributeAccessIssue]

    def _observe(self):
        return jnp.append(self.sys.gravity, self.sys.stiffness)

    observation_size = action_size = 3
    backend = "none"


def randomise(sys: Physics, rng) -> tuple[Physics, Any]:
    return Physics(jax.vmap(jax.random.uniform)(rng), sys.gravity), Physics(0, None)


def stiffnesses(doors: RandomisedEnvs, devices: int, act: bool) -> np.ndarray:
    """[devices, COUNT] observed stiffness of the environments of each device at reset, or after a step."""

    def run(rng):
        state = doors.reset(rng)
        return (doors.step(state, jnp.zeros(COUNT)) if act else state).obs

    rng = jax.random.split(jax.random.PRNGKey(5), (devices, COUNT))
    seen = jax.pmap(run, axis_name=AXIS, devices=jax.local_devices()[:devices])(rng)
    np.testing.assert_allclose(seen[..., :2], 9.81)
    return np.asarray(seen[..., 2])


@pytest.mark.parametrize("act", [False, True])
def test_environments_on_all_devices_have_different_physics(act: bool):
    assert jax.local_device_count() >= 2
    env = Spring()
    found = stiffnesses(RandomisedEnvs(env, randomise, COUNT, 2, jax.random.PRNGKey(1)), 2, act)
    assert len(np.unique(found)) == 2 * COUNT
    np.testing.assert_array_equal(
        stiffnesses(RandomisedEnvs(env, randomise, COUNT, 2, jax.random.PRNGKey(1)), 2, act), found
    )
    assert not np.intersect1d(
        stiffnesses(RandomisedEnvs(env, randomise, COUNT, 2, jax.random.PRNGKey(2)), 2, act), found
    ).size
    assert env.sys is Spring.sys  # as it was


def test_without_a_mapped_axis_the_device_index_is_zero():
    doors = RandomisedEnvs(Spring(), randomise, COUNT, 2, jax.random.PRNGKey(1))
    alone = jax.jit(doors.reset)(jax.random.split(jax.random.PRNGKey(0), COUNT)).obs[:, 2]
    np.testing.assert_array_equal(alone, doors.physics.stiffness[:COUNT])


def test_draws_are_the_same_in_each_training_and_brax_evaluates_nothing():
    """brax wraps the environment a second time, for evaluations that it does not run."""
    keys, drawn = jax.random.split(jax.random.PRNGKey(0), COUNT), list[int]()

    def counted(sys, rng):
        drawn.append(len(rng))
        return randomise(sys, rng)

    wrap_env, again = wrapped(counted, 2, 1), wrapped(randomise, 2, 1)
    env, unused = (wrap_env(Spring(), 10, 1, partial(randomise, rng=keys)) for _ in range(2))
    assert drawn == [2 * COUNT] and unused.reset(keys[:1]).obs.shape == (1,)
    alike = again(Spring(), 10, 1, partial(randomise, rng=keys))
    np.testing.assert_array_equal(alike.reset(keys).obs, env.reset(keys).obs)


def test_brax_gets_one_environment_for_each_of_its_keys():
    keys = jax.random.split(jax.random.PRNGKey(0), COUNT)
    env = wrapped(randomise, 2, 1)(Spring(), 10, 1, partial(randomise, rng=keys))
    assert env.reset(keys).obs.shape == (COUNT, 3)
    alike = wrapped(None, 2, 1)(Spring(), 10, 1, None)
    np.testing.assert_array_equal(alike.reset(keys).obs[:, 2], np.zeros(COUNT))


@pytest.mark.parametrize("drawn", [None, randomise])
def test_episodes_of_a_training_begin_in_different_phases(drawn: Any):
    """The first ones are shorter, all later ones whole."""
    length, many = 10, 64
    keys = jax.random.split(jax.random.PRNGKey(0), many)
    env = wrapped(drawn, 1, 1)(Spring(), length, 1, partial(randomise, rng=keys))
    state, done = env.reset(keys), list[np.ndarray]()
    phase = np.asarray(state.info["steps"])
    assert set(phase.astype(int)) == set(range(length))
    for _ in range(3 * length):
        state = env.step(state, jnp.zeros(many))
        done.append(np.asarray(state.done))
    ended = np.array(done).T > 0
    np.testing.assert_array_equal(ended.argmax(axis=1), length - 1 - phase)
    assert all((np.diff(np.flatnonzero(row)) == length).all() for row in ended)
