"""Policies as arrays: brax's network is the reference, and invalid files are refused with a reason."""

from __future__ import annotations

import functools
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks

from droid_jax.door.environment import waiting_pose
from droid_jax.door.policy_interface import interface_of
from droid_jax.door.scene import door_scene
from droid_jax.door.task import Task
from droid_jax.policy.control import ACTIONS, FORMAT, LAYOUT, OBSERVED, Interface, Policy, load_policy
from droid_jax.policy.network import layer_sizes, policy_of, save_policy

HIDDEN = (64, 64)


@pytest.fixture(scope="module")
def networks():
    make = functools.partial(ppo_networks.make_ppo_networks, activation=jnp.tanh)
    return make(
        OBSERVED,
        ACTIONS,
        running_statistics.normalize,
        policy_hidden_layer_sizes=HIDDEN,
        value_hidden_layer_sizes=HIDDEN,
    )


@pytest.fixture(scope="module")
def parameters(networks):
    """A normaliser after some updates, and an actor's initial weights."""
    normaliser = running_statistics.init_state(specs.Array((OBSERVED,), jnp.dtype("float32")))
    seen = 3.0 + 2.0 * jax.random.normal(jax.random.key(0), (500, OBSERVED))
    return running_statistics.update(normaliser, seen), networks.policy_network.init(jax.random.key(1))


@pytest.fixture(scope="module")
def interface() -> Interface:
    scene, task = door_scene(limits=True), Task()
    return interface_of(scene, task, waiting_pose(scene, task))


@pytest.fixture(scope="module")
def policy(parameters, interface) -> Policy:
    return policy_of(*parameters, layer_sizes(HIDDEN), interface)


def test_it_acts_as_braxs_deterministic_policy(networks, parameters, policy):
    act = ppo_networks.make_inference_fn(networks)((*parameters, None), deterministic=True)
    observations = 3.0 + 4.0 * np.random.default_rng(2).normal(size=(200, OBSERVED)).astype(np.float32)
    expected, _ = act(jnp.asarray(observations), jax.random.key(3))
    np.testing.assert_allclose(policy.act(observations), expected, atol=2e-6)
    np.testing.assert_allclose(policy.act(jnp.asarray(observations), jnp), expected, atol=2e-6)
    assert np.abs(policy.act(observations)).max() <= 1.0 and policy.act(observations[0]).shape == (ACTIONS,)


def test_a_saved_policy_is_read_back(policy, tmp_path: Path):
    save_policy(tmp_path / "policy.npz", policy)
    found = load_policy(tmp_path / "policy.npz")
    observation = np.linspace(-1, 1, OBSERVED, dtype=np.float32)
    np.testing.assert_array_equal(found.act(observation), policy.act(observation))
    assert found.interface.period == 0.02 and isinstance(found.interface.period, float)
    np.testing.assert_array_equal(found.interface.chain, policy.interface.chain)


def test_a_network_of_other_sizes_is_refused(parameters, interface):
    with pytest.raises(ValueError, match=r"a network of \(23, 32, 32, 18\) .* got \(23, 64, 64, 18\)"):
        policy_of(*parameters, layer_sizes((32, 32)), interface)


def rewritten(path: Path, change) -> None:
    with np.load(path) as file:
        found = {name: file[name] for name in file.files}
    change(found)
    np.savez(path, **found)


HEAD = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000,), }"
BOMB = b"\x93NUMPY\1\0" + len(HEAD).to_bytes(2, "little") + HEAD  # an array of 8 GB that is not there


def damaged(path: Path, name: str, content: bytes) -> None:
    """A policy's file with other bytes in one member."""
    with zipfile.ZipFile(path) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, old in members.items():
            archive.writestr(member, content if member == name else old)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda path: path.unlink(), "there is no such file"),
        (lambda path: path.write_bytes(path.read_bytes()[:200]), "cannot be read"),
        (lambda path: np.savez(path, format="something else"), "is no policy"),
        (lambda path: rewritten(path, lambda found: found.pop("bias_1")), "lacks bias_1"),
        (lambda path: rewritten(path, lambda found: found.pop("layout")), "lacks layout"),
        (lambda path: np.savez(path, format=FORMAT), "lacks layout, mean, std, .*weight_0"),
        (lambda path: rewritten(path, lambda found: found["std"].put(3, 0.0)), "std must be above zero, got 0"),
        (
            lambda path: rewritten(path, lambda found: found["period"].fill(-0.02)),
            "period must be above zero, got -0.02",
        ),
        (lambda path: damaged(path, "mean.npy", b"no array"), "cannot be read: the magic string"),
        (lambda path: damaged(path, "mean.npy", BOMB), "cannot be read: 'mean' declares float64"),
        (lambda path: damaged(path, "mean.npy", bytes(65 * 2**20)), "cannot be read: it declares \\d+ arrays of 68"),
        (lambda path: np.savez(path, format=np.array([{}])), "cannot be read: 'format' declares object"),
        (lambda path: rewritten(path, lambda found: found.update(std=np.array("x"))), "std hold NaN"),
        (lambda path: (path.unlink(), path.mkdir()), "cannot be read: it is no regular file"),
        (
            lambda path: rewritten(path, lambda found: found["mean"].fill(np.nan)),
            "mean hold NaN, infinite values or text",
        ),
    ],
)
def test_invalid_files_are_refused(policy, tmp_path: Path, spoil, expected: str):
    path = tmp_path / "policy.npz"
    save_policy(path, policy)
    spoil(path)
    with pytest.raises(ValueError, match=expected):
        load_policy(path)


def test_another_layout_of_observations_is_refused(policy, tmp_path: Path):
    path = tmp_path / "policy.npz"
    save_policy(path, policy)
    other = np.array([*LAYOUT[:-1], "temperature of the knob, K"])
    rewritten(path, lambda found: found.update(layout=other))
    with pytest.raises(ValueError, match="trained on another observation: temperature of the knob, K"):
        load_policy(path)


@pytest.mark.parametrize("other", [[LAYOUT], ["y" * 100_000], [f"\x1b{LAYOUT[0]}", *LAYOUT[1:]]])
def test_the_message_about_an_invalid_layout_is_short(policy, tmp_path: Path, other):
    path = tmp_path / "policy.npz"
    save_policy(path, policy)
    rewritten(path, lambda found: found.update(layout=np.array(other)))
    with pytest.raises(ValueError, match="trained on another observation") as refused:
        load_policy(path)
    assert str(refused.value).isprintable() and len(str(refused.value)) < 500
