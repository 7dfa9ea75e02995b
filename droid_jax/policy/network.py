"""The policy as numbers: an actor with its observation's normalisation, run by numpy or jax, kept as npz."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.policy.task import ACTIONS, LAYOUT, OBSERVED
from droid_jax.storage import write_npz

FORMAT = "droid_jax policy 1"


@dataclass(frozen=True, eq=False)
class Policy:
    """mean, std: [23] of the observations seen in training.  weights, biases: of each layer, the last of twice
    nine numbers, of which the first nine are the action's mean before tanh."""

    mean: np.ndarray
    std: np.ndarray
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]

    def act(self, observation: Any, numbers: Any = np) -> Any:
        """[..., 9] in -1 .. 1, the most likely action at observations [..., 23]; numbers: numpy or jax.numpy."""
        x = (observation - self.mean) / self.std
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = numbers.tanh(x @ weight + bias)
        return numbers.tanh((x @ self.weights[-1] + self.biases[-1])[..., :ACTIONS])


def layer_sizes(hidden: tuple[int, ...]) -> tuple[int, ...]:
    """Numbers between the layers, from the observation to mean and width of each action."""
    return (OBSERVED, *hidden, 2 * ACTIONS)


def policy_of(normaliser: Any, actor: Any, sizes: tuple[int, ...]) -> Policy:
    """Out of brax's running statistics and its actor's parameters.  ValueError for a network of other sizes."""
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
    )


def save_policy(path: Path, policy: Policy) -> None:
    """One npz file: mean, std, weight_0, bias_0, ..., and the observation's layout in words."""
    layers = {f"weight_{k}": w for k, w in enumerate(policy.weights)}
    layers |= {f"bias_{k}": b for k, b in enumerate(policy.biases)}
    write_npz(path, {"format": FORMAT, "layout": np.array(LAYOUT), "mean": policy.mean, "std": policy.std, **layers})


def load_policy(path: Path) -> Policy:
    """ValueError names what is wrong with a file: missing, damaged, or of another layout of observations."""
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file; `train` and `export` write it") from None
    except Exception as error:  # what numpy and zipfile raise on damaged files is of many kinds
        raise ValueError(f"{path} cannot be read: {error}") from None
    if str(found.get("format")) != FORMAT:
        raise ValueError(f"{path} is no policy: expected format {FORMAT!r}, got {str(found.get('format'))!r}")
    if tuple(found["layout"].tolist()) != LAYOUT:
        other = [name for name in found["layout"].tolist() if name not in LAYOUT] or ["another order"]
        raise ValueError(f"{path} was trained on another observation: {', '.join(other[:3])}")
    count = sum(name.startswith("weight_") for name in found)
    layers = range(count)
    weights, biases = (tuple(found[f"{kind}_{k}"] for k in layers) for kind in ("weight", "bias"))
    return Policy(found["mean"], found["std"], weights, biases)
