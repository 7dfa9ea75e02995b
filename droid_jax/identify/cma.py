"""The CMA-ES of evosax for several restarts at once, with other recombination weights.

evosax gives half of the population a positive weight whatever `elite_ratio` is, and gives rows with equal costs the
weight of their average rank.  So the weights are computed here; the rest of the algorithm is evosax's.  All randomness
comes from fold_in(key(seed), generation).
References "Tutorial" are to Hansen, The CMA Evolution Strategy: A Tutorial, arXiv 1604.00772.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax.identify.gaussian import redraw_box
from droid_jax.model.parameters import Space


class Recombination(NamedTuple):
    """Weights of the ranked rows, and the learning rates that depend on them (Tutorial, Table 1)."""

    weights: np.ndarray  # [P], best row first; the positive ones sum to 1
    mu_eff: float
    c_1: float
    c_mu: float
    c_std: float
    d_std: float
    c_c: float


def recombination(population: int, parents: int, dims: int, active: bool) -> Recombination:
    """Return weights log(parents + 1/2) - log(rank): exactly the `parents` best rows have a positive weight.

    Args:
        population: rows P.
        parents: rows with a positive weight.
        dims: parameters D.
        active: whether the other rows get negative weights (Tutorial, eqs. 50-53) instead of zero.
    """
    raw = math.log(parents + 0.5) - np.log(np.arange(1, population + 1))  # [P]
    mu_eff = raw[:parents].sum() ** 2 / (raw[:parents] ** 2).sum()
    mu_eff_minus = raw[parents:].sum() ** 2 / (raw[parents:] ** 2).sum()
    c_c = (4 + mu_eff / dims) / (dims + 4 + 2 * mu_eff / dims)
    c_1 = 2 / ((dims + 1.3) ** 2 + mu_eff)
    c_mu = min(1 - c_1 - 1e-8, 2 * (mu_eff - 2 + 1 / mu_eff) / ((dims + 2) ** 2 + mu_eff))
    c_std = (mu_eff + 2) / (dims + mu_eff + 5)
    d_std = 1 + 2 * max(0.0, math.sqrt((mu_eff - 1) / (dims + 1)) - 1) + c_std
    weights = np.zeros(population)
    weights[:parents] = raw[:parents] / raw[:parents].sum()
    if active and c_mu > 0:
        alpha = min(1 + c_1 / c_mu, 1 + 2 * mu_eff_minus / (mu_eff + 2), (1 - c_1 - c_mu) / (dims * c_mu))
        weights[parents:] = alpha * raw[parents:] / -raw[parents:].sum()
    return Recombination(weights, float(mu_eff), c_1, float(c_mu), float(c_std), float(d_std), float(c_c))


class Strategy:
    """The CMA-ES of evosax for all restarts at once, on one device; arrays have a leading axis [R] of restarts.

    The device is a CPU if there is one.  The matrices are small, and the draws are then the same on every machine.

    space: meaning of the D entries.
    weights: of the ranked rows.
    sigma: initial step in search coordinates.
    seeds: [R], one for each restart.
    redraws: draws per row, of which the first with all linearly scaled parameters inside their bounds is taken.  A row
      that is still outside is clipped.
    """

    def __init__(self, space: Space, weights: Recombination, *, sigma: float, seeds: Sequence[int], redraws: int):
        self.space, dims = space, len(space)
        self._device = _one_device()
        box = redraw_box(space)
        with jax.default_device(self._device):
            self._kernels = _kernels(len(weights.weights), dims, redraws if np.isfinite(box).any() else 1)
        params = self._kernels.params.replace(std_init=sigma, **weights._asdict())
        self._params = self._put(jax.tree.map(lambda a: np.asarray(a, np.float32), params))
        self._box = self._put(np.asarray(box, np.float32))
        self._bounds = self._put(np.asarray([space.to_search(space.low), space.to_search(space.high)], np.float32))
        self._seeds = self._put(np.asarray(seeds))

    def init(self, centre: np.ndarray) -> Any:
        """Return the state of every restart at its start [R, D], physical values."""
        x = self._put(np.asarray(self.space.to_search(centre), np.float32))
        return self._kernels.init(self._seeds, x, self._params)

    def ask(self, state: Any, generation: int) -> tuple[np.ndarray, Any]:
        """Return populations [R, P, D] in search coordinates, and the state with its principal axes updated."""
        number = self._put(np.int32(generation))
        x, state = self._kernels.ask(self._seeds, number, state, self._params, self._box)
        return np.asarray(x), state

    def tell(self, state: Any, x: np.ndarray, costs: np.ndarray, running: np.ndarray) -> Any:
        """Return the state updated with costs [R, P] of x [R, P, D]; unchanged for a restart not `running` [R]."""
        # Ranks instead of costs: float64 costs that are equal in float32 keep their order.
        ranks = np.argsort(np.argsort(costs, axis=1, kind="stable"), axis=1)
        fitness = np.where(np.isfinite(costs), ranks, np.inf).astype(np.float32)
        arrays = (self._put(a) for a in (x, fitness, running & np.isfinite(costs).any(axis=1)))
        return self._kernels.tell(state, *arrays, self._params, self._bounds)

    def put_state(self, state: Any, arrays: Mapping[str, np.ndarray]) -> Any:
        """Return a copy of a state with its arrays replaced."""
        return state.replace(**{name: self._put(a) for name, a in arrays.items()})

    def _put(self, tree: Any) -> Any:
        return jax.device_put(tree, self._device)


class _Kernels(NamedTuple):
    """Jitted functions over all restarts, and evosax's default parameters for them."""

    init: Callable[..., Any]
    ask: Callable[..., Any]
    tell: Callable[..., Any]
    params: Any


@cache  # a study runs many searches of one size: compile them once
def _kernels(population: int, dims: int, redraws: int) -> _Kernels:
    """The compiled algebra for P rows of D parameters, `redraws` draws per row."""
    from evosax.algorithms import CMA_ES  # only here: its import takes half a second

    evosax = CMA_ES(population, jnp.zeros(dims), fitness_shaping_fn=_ranked_weights)

    def init(seed: Any, x: Any, params: Any) -> Any:
        state = evosax.init(jax.random.key(seed), x, params)
        # The types that `tell` returns: with evosax's weak types everything would be compiled twice.
        return jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), state)

    def ask(seed: Any, generation: Any, state: Any, params: Any, box: Any) -> tuple[Any, Any]:
        """One restart's rows [P, D], each the first of its draws inside the box [2, D]."""
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), generation), redraws)
        draw = jax.vmap(lambda key: evosax.ask(key, state, params), out_axes=(0, None))
        draws, state = draw(keys)  # [K, P, D]
        inside = jnp.all((draws >= box[0]) & (draws <= box[1]), axis=-1)  # [K, P]
        first = jnp.argmax(inside, axis=0)  # 0 where none is inside: that one is clipped
        x = jnp.take_along_axis(draws, first[None, :, None], axis=0)[0]
        return jnp.clip(x, box[0], box[1]), state

    def tell(state: Any, x: Any, fitness: Any, running: Any, params: Any, bounds: Any) -> Any:
        """One restart's update, with its mean clipped to the bounds [2, D]."""
        new, _ = evosax.tell(jax.random.key(0), x, fitness, state, params)  # evosax does not use this key
        # Far beyond the bounds clipped draws all cost the same, and the mean would diverge.
        new = new.replace(mean=jnp.clip(new.mean, bounds[0], bounds[1]))
        return jax.tree.map(lambda a, b: jnp.where(running, a, b), new, state)

    return _Kernels(
        init=jax.jit(jax.vmap(init, in_axes=(0, 0, None))),
        ask=jax.jit(jax.vmap(ask, in_axes=(0, None, 0, None, None))),
        tell=jax.jit(jax.vmap(tell, in_axes=(0, 0, 0, 0, None, None))),
        # In one program: evosax computes them by some sixty small ones, each compiled on its own.
        params=jax.tree.map(np.asarray, jax.jit(lambda: evosax.default_params)()),
    )


def _ranked_weights(population: jax.Array, fitness: jax.Array, state: Any, params: Any) -> Any:
    """Weights [P] by rank; a failed row (inf) is no parent, and the other parents share its weight."""
    weights = params.weights[jnp.argsort(jnp.argsort(fitness))]
    positive = jnp.where(jnp.isinf(fitness), 0.0, jnp.maximum(weights, 0.0))
    return jnp.where(weights > 0, positive / jnp.sum(positive), weights)


def _one_device() -> Any:
    """A CPU device of this process, or its first device if jax does not use the CPU."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return jax.local_devices()[0]
