"""Convert brax's networks to a policy, and write its file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.policy.control import ACTIONS, OBSERVED, Interface, Policy, arrays
from droid_jax.storage import write_npz


def layer_sizes(hidden: tuple[int, ...]) -> tuple[int, ...]:
    """Sizes between the layers, from the observation to mean and deviation of each action."""
    return (OBSERVED, *hidden, 2 * ACTIONS)


def policy_of(normaliser: Any, actor: Any, sizes: tuple[int, ...], interface: Interface) -> Policy:
    """The policy of brax's running statistics and actor parameters; ValueError for a network of other sizes."""
    layers = [actor["params"][f"hidden_{k}"] for k in range(len(sizes) - 1)]
    weights = tuple(np.asarray(layer["kernel"], np.float32) for layer in layers)
    found = (weights[0].shape[0], *(w.shape[1] for w in weights))
    if found != sizes or len(actor["params"]) != len(layers):
        raise ValueError(f"expected a network of {sizes} numbers between its layers, got {found}")
    return Policy(
        np.asarray(normaliser.mean, np.float32),
        np.asarray(normaliser.std, np.float32),
        weights,
        tuple(np.asarray(layer["bias"], np.float32) for layer in layers),
        interface,
    )


def save_policy(path: Path, policy: Policy) -> None:
    """Write the npz file that `control.load_policy` reads."""
    write_npz(path, arrays(policy))
