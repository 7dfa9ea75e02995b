"""What a search returns, `Fit` with the history of every restart, and what it tells on its way, `Progress`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from droid_jax.identify.gaussian import Gaussian
from droid_jax.model.parameters import Parameter, Space

BOUND_SHARE = 0.01  # a best value this close to a bound, as a share of the range in x, counts as on it


@dataclass(frozen=True, eq=False)
class History:
    """One restart, generation by generation (G of them, P rows each); search state is after the update.

    mean:        [G, D] physical units.
    std:         [G, D] marginal deviations, search coordinates.
    sigma:       [G] step size.
    best_cost:   [G] lowest cost found so far.
    mean_cost, median_cost: [G] over the rows of the generation that did not fail; inf if all did.
    costs:       [G, P] cost of every row, inf where it failed.
    seconds:     [G] wall time of the generation, cost included (the first one compiles).
    """

    mean: np.ndarray
    std: np.ndarray
    sigma: np.ndarray
    best_cost: np.ndarray
    mean_cost: np.ndarray
    median_cost: np.ndarray
    costs: np.ndarray
    seconds: np.ndarray


@dataclass(frozen=True, eq=False)
class Restart:
    """One of the independent searches: its seed, where it ended, why it stopped and its history.

    best, mean: [D] physical units; cov: [D, D] sigma^2 C in search coordinates.
    """

    seed: int
    best: np.ndarray
    best_cost: float
    mean: np.ndarray
    cov: np.ndarray
    stop: str
    history: History


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a search: the restart with the lowest cost, and all of them in `restarts`.

    best:     [D] physical values with the lowest cost, best_cost.
    mean:     [D] physical values of the final Gaussian's centre.
    cov:      [D, D] of the final Gaussian in search coordinates, sigma^2 C.
    evaluations: rows given to the cost; failed: those that came back NaN or infinite.
    stop:     "generations", "tol_cost", "tol_sigma" or "max_seconds".
    on_bound: names of parameters whose best value lies within 1 % of the range of a bound.
    """

    space: Space
    best: np.ndarray
    best_cost: float
    mean: np.ndarray
    cov: np.ndarray
    history: History
    evaluations: int
    failed: int
    stop: str
    on_bound: tuple[str, ...]
    restarts: tuple[Restart, ...]

    def gaussian(self) -> Gaussian:
        """The search distribution.  Its width depends on when the search stopped: it is no posterior."""
        return Gaussian(self.space, self.space.to_search(self.mean), self.cov, rule="cma-es covariance")


@dataclass(frozen=True)
class SearchProgress:
    """What a progress display needs after each generation; costs over all running restarts.

    seconds: wall time so far; seconds_left: at most, at the pace of the latest generations.
    """

    generation: int
    generations: int
    best_cost: float
    median_cost: float
    sigma: float
    seconds: float
    seconds_left: float


def on_bound(space: Space, best: np.ndarray) -> tuple[str, ...]:
    """Names of the parameters whose value lies within BOUND_SHARE of the range, in x, of a bound."""
    return tuple(p.name for p, value in zip(space.parameters, best, strict=True) if bound_of(p, float(value)))


def bound_of(parameter: Parameter, value: float) -> Literal["lower", "upper", ""]:
    """On which bound a value sits, within BOUND_SHARE of the range in x; empty for none."""
    low, x, high = (float(parameter.to_search(v)) for v in (parameter.low, value, parameter.high))
    reach = BOUND_SHARE * (high - low)
    if min(x - low, high - x) > reach:
        return ""
    return "lower" if x - low <= high - x else "upper"
