"""Policies, and what a run keeps to go on from: checkpoints and replays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from kinds import Kind

from droid_jax.cost.replay_cache import cached
from droid_jax.files import POLICY
from droid_jax.identify.checkpoints import Checkpoints
from droid_jax.policy.control import ACTIONS, FORMAT, LAYOUT, OBSERVED, SHAPES, load_policy
from droid_jax.storage import write_npz


def make_policy(folder: Path) -> None:
    rng = np.random.default_rng(0)
    layers = {
        "weight_0": rng.normal(size=(OBSERVED, 4)), "weight_1": rng.normal(size=(4, 2 * ACTIONS)),
        "bias_0": np.zeros(4), "bias_1": np.zeros(2 * ACTIONS),
    }  # fmt: skip
    own = {"format": FORMAT, "layout": np.array(LAYOUT), "mean": np.zeros(OBSERVED), "std": np.ones(OBSERVED)}
    write_npz(folder / POLICY, {**own, **layers, **{name: np.ones(shape) for name, shape in SHAPES.items()}})


def use_policy(folder: Path) -> None:
    action = load_policy(folder / POLICY).act(np.zeros(OBSERVED))
    if np.shape(action) != (ACTIONS,):
        raise RuntimeError(f"an action has shape {np.shape(action)}")


_TREE = {"state": {"mean": np.arange(6.0).reshape(2, 3), "key": np.arange(4, dtype=np.uint32)}, "best": np.ones(3)}
_FINGERPRINT = {"config": "a text", "data": "another"}


def make_checkpoints(folder: Path) -> None:
    with Checkpoints(folder, fingerprint=_FINGERPRINT) as checkpoints:
        for step in (3, 6):
            checkpoints.save(step, {**_TREE, "best": np.full(3, float(step))})


def use_checkpoints(folder: Path) -> None:
    """What is restored is one of the states that were saved, with the step it was saved at."""
    with Checkpoints(folder, fingerprint=_FINGERPRINT) as checkpoints:
        found = checkpoints.restore()
    if found is None:
        return
    step, tree = found
    if step not in (3, 6) or not np.array_equal(tree["best"], np.full(3, float(step))):
        raise RuntimeError(f"step {step} holds another state")


def _replayed(values: Any) -> np.ndarray:
    """Replays that are known."""
    return np.arange(8.0).reshape(2, 4) * float(np.sum(values))


_ROWS = np.array([[1.0, 2.0], [3.0, 4.0]])


def make_replays(folder: Path) -> None:
    cached(_replayed, folder, "whitened")(_ROWS)


def use_replays(folder: Path) -> None:
    """A damaged file is computed again; what comes back is what was computed."""
    found = cached(_replayed, folder, "whitened")(_ROWS)
    if not np.array_equal(found, _replayed(_ROWS)) or found.dtype.kind != "f":
        raise RuntimeError(f"replays of shape {found.shape}, {found.dtype}")


KINDS = (
    Kind("policy.npz", POLICY, make_policy, use_policy, 4),
    Kind("checkpoints", "**/*", make_checkpoints, use_checkpoints, 1.5),
    Kind("kept replays", "*.npz", make_replays, use_replays, 2),
)
