"""What simpler methods make of the same base fit: names by BIC, and a black box that closes the gap and names nothing.

Plain stepwise BIC over the candidates' linear marks is what one would try first; a small network from the state of
the motion to the torque that is left over is what one would try without caring for a name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from droid_jax.cost.noise import lowpass, smooth
from droid_jax.discrepancy.candidates import ScoreTest, project
from droid_jax.discrepancy.case import Case, ResidualSet
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.recordings.recording import Recording
from experiments.blind.answers import beside, matched
from experiments.blind.marks import torques, whitened

MOST = 5  # effects that BIC may name
WIDTH, LEARNING, DECAY = 32, 3e-3, 1e-3
ROUNDS, STEPS = 30, 100  # the network of the round that does best on blocks left aside is kept
BLOCK = 0.5  # s, every fifth such block is left aside
FOLDS = 5


def baselines(
    case: Case, model: FittedModel, screen: ScoreTest | None, recordings: Mapping[str, Recording]
) -> dict[str, Any]:
    """Both, from a fitted base model; screen: its first screening, if it came that far."""
    return {
        "bic": [] if screen is None else stepwise_bic(screen, model.residuals.mean(axis=0)),
        "black_box": black_box(case, model, recordings),
    }


def stepwise_bic(screen: ScoreTest, common: np.ndarray) -> list[str]:
    """Names in the order in which adding them lowers n log(RSS / n) + k log(n) most, until none does.

    common: [M] the mean residual.  A candidate counts its amplitudes, and its shapes too.
    """
    groups: dict[Any, list[int]] = {}
    for k, question in enumerate(screen.directions):
        groups.setdefault(question.candidate.shaped_key, []).append(k)
    names = {key: screen.directions[rows[0]].candidate for key, rows in groups.items()}
    size, chosen, named, cost = len(common), list[int](), list[str](), 0
    best = size * np.log(max(float(common @ common), 1e-30) / size)
    while len(named) < MOST:
        tried = {}
        for key, rows in groups.items():
            if str(names[key].key) not in named:
                columns = screen.sensitivities[[*chosen, *rows]].T
                rest = common - columns @ np.linalg.lstsq(columns, common, rcond=1e-8)[0]
                parameters = cost + len(rows) + len(names[key].shape_parameters)
                tried[key] = size * np.log(max(float(rest @ rest), 1e-30) / size) + parameters * np.log(size)
        winner = min(tried, key=lambda key: tried[key]) if tried else None
        if winner is None or tried[winner] >= best:
            break
        best = tried[winner]
        chosen += groups[winner]
        cost += len(groups[winner]) + len(names[winner].shape_parameters)
        named.append(str(names[winner].key))
    return named


def black_box(case: Case, model: FittedModel, recordings: Mapping[str, Recording]) -> dict[str, list[float]]:
    """Role -> U before and after a network, trained on the fitted recording, has added its torque.

    A recording on which the base model blows up is left out.
    """
    inputs = {role: features(e, recordings[role]) for role, e in case.residual_sets.items()}
    left = _shaped(case.train, torques(case.train, case.train.common(model.values)))
    centre, scale = inputs["train"].mean(axis=0), inputs["train"].std(axis=0) + 1e-9
    size = left.std(axis=0) + 1e-9
    time = case.train.time[: len(left)]
    aside = (np.floor((time - time[0]) / BLOCK) % FOLDS) == FOLDS - 1
    weights = train((inputs["train"] - centre) / scale, left / size, aside)
    out = {}
    for role, e in case.residual_sets.items():
        common = e.common(model.values)[0]
        torque = np.asarray(_Network(left.shape[1]).apply(weights, (inputs[role] - centre) / scale)) * size
        added = whitened(e, torque.T.reshape(1, -1))[0]
        if e.nuisance_columns is not None:  # the recording's own offsets are fitted again
            added = project(added[None], e.nuisance_columns, np.full(len(e.nuisances), np.sqrt(e.repeats)))[0]
        gaps = [e.resampling.discrepancy(e.resampling.residuals(c)) for c in (common, common - added)]
        if np.all(np.isfinite(gaps)):
            out[role] = gaps
    return out


def features(evidence: ResidualSet, recording: Recording) -> np.ndarray:
    """[K, F] mean position and velocity of the joints, angle and speed of the object, on the coarse clock."""
    clock = evidence.time[: np.sum(evidence.column == 0)]
    columns = []
    for name in ("position", "object_angle"):
        if name in recording.channels:
            channel = recording.channels[name]
            inside = np.clip(clock, channel.time[0], channel.time[-1])
            mean = smooth(channel.values, channel.mask, lowpass(channel.time, inside)).mean(axis=0)
            columns += [mean, np.gradient(mean, clock, axis=0)]
    return np.concatenate(columns, axis=1)


def train(inputs: np.ndarray, targets: np.ndarray, aside: np.ndarray) -> Any:
    """Weights of the network with the least error on rows left aside ([K] bool), out of `ROUNDS`."""
    network = _Network(targets.shape[1])
    weights = network.init(jax.random.key(0), inputs[:1])
    x, y = jnp.asarray(inputs, jnp.float32), jnp.asarray(targets, jnp.float32)
    kept, history = weights, []
    state = _OPTIMISER.init(weights)
    for _ in range(ROUNDS):
        weights, state, error = _round(network, weights, state, x, y, jnp.asarray(aside))
        history.append(float(error))
        if history[-1] <= min(history):
            kept = weights
    return kept


class _Network(nn.Module):
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(2):
            x = nn.tanh(nn.Dense(WIDTH)(x))
        return nn.Dense(self.outputs)(x)


_OPTIMISER = optax.adamw(LEARNING, weight_decay=DECAY)


@jax.jit(static_argnums=0)
def _round(network: _Network, weights: Any, state: Any, x: jax.Array, y: jax.Array, aside: jax.Array) -> Any:
    """`STEPS` steps of all rows but those aside, and the error of the latter."""

    def error(weights: Any, rows: jax.Array) -> jax.Array:
        predicted: Any = network.apply(weights, x)
        square = jnp.mean((predicted - y) ** 2, axis=1)
        return jnp.sum(square * rows) / jnp.maximum(jnp.sum(rows), 1)

    def step(carry: Any, _: None) -> Any:
        weights, state = carry
        slopes = jax.grad(error)(weights, ~aside)
        change, state = _OPTIMISER.update(slopes, state, weights)
        return (optax.apply_updates(weights, change), state), None

    (weights, state), _ = jax.lax.scan(step, (weights, state), length=STEPS)
    return weights, state, error(weights, aside)


def _shaped(evidence: ResidualSet, rows: np.ndarray) -> np.ndarray:
    """[1, M] -> [K, C]."""
    columns = int(evidence.column.max()) + 1
    return rows.reshape(columns, -1).T


def bic_outcome(
    named: Sequence[str], right: Sequence[Sequence[str]], parts_of: Sequence[Sequence[str]]
) -> dict[str, bool]:
    """Whether BIC named everything hidden, and anything that is neither that nor a part of what it named rightly."""
    met = matched([{n} for n in named], right)
    allowed = [*right, *beside(parts_of, met)]
    return {
        "all": any(right) and all(found for found, names in zip(met, right, strict=True) if names),
        "false": any(not any(n in names for names in allowed) for n in named),
    }
