"""The cost that a search minimises, its state, its result `Fit`, and the starts of the refinement after it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from droid_jax.identify.gaussian import Gaussian
from droid_jax.model.parameters import Parameter, Role, Space

if TYPE_CHECKING:
    from droid_jax.identify.checkpoints import Tree

BOUND_SHARE = 0.01  # of a parameter's range in x; a value closer to a bound counts as on it


@dataclass(frozen=True, eq=False)
class History:
    """One restart over G generations of P rows; the search state is that after each update.

    mean: [G, D] physical units.
    std: [G, D] marginal deviations, search coordinates.
    sigma: [G] step size.
    best_cost: [G] lowest cost so far.
    mean_cost, median_cost: [G] over the rows of the generation that did not fail; inf if all failed.
    costs: [G, P] cost of every row, inf where it failed.
    seconds: [G] wall time of the generation, cost included (the first one compiles).
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
class Fit:
    """Result of a search, of the restart with the lowest cost.

    best: [D] physical values with the lowest cost, best_cost.
    mean: [D] physical values of the final Gaussian's centre.
    cov: [D, D] of the final Gaussian in search coordinates, sigma^2 C.
    history: of the restart.
    evaluations: rows that were evaluated, of all restarts.  failed: those with a NaN or infinite cost.
    stop: "generations", "tol_cost", "tol_sigma" or "max_seconds".
    on_bound: names of parameters whose best value is on a bound (`on_bound`).
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

    def gaussian(self) -> Gaussian:
        """Return the search distribution.  It is no posterior: its width depends on when the search stopped."""
        return Gaussian(self.space, self.space.to_search(self.mean), self.cov, rule="cma-es covariance")


@dataclass(frozen=True)
class SearchProgress:
    """Numbers for a progress display after each generation; costs are over all running restarts.

    seconds: wall time so far.  seconds_left: upper limit, at the pace of the latest generations.
    """

    generation: int
    generations: int
    best_cost: float
    median_cost: float
    sigma: float
    seconds: float
    seconds_left: float


def search_cost(
    cost: Callable[[np.ndarray], Any], penalty: float, full: Space, space: Space, at: np.ndarray | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the cost of rows [P, d] over `space`, [P], as a function; a replay that blew up costs infinity.

    Args:
        cost: [P, D] physical values over `full` -> [P].
        penalty: cost of a replay that blew up (`Comparison.penalty`).
        full: space of the cost.
        space: of the d parameters that are searched.
        at: [D] values of the other parameters; None for their means.
    """

    def of_rows(rows: np.ndarray) -> np.ndarray:
        costs = np.asarray(cost(full.embed(space, rows, at)), np.float64)
        return np.where(costs == np.float32(penalty), np.inf, costs)

    return of_rows


def on_bound(space: Space, best: np.ndarray) -> tuple[str, ...]:
    """Return the names of the parameters whose value in `best` [D] is on a bound (`bound_of`)."""
    return tuple(p.name for p, value in zip(space.parameters, best, strict=True) if bound_of(p, float(value)))


def bound_of(parameter: Parameter, value: float) -> Literal["lower", "upper", ""]:
    """Return the bound that a value is within BOUND_SHARE of the parameter's range in x of; empty for none."""
    low, x, high = (float(parameter.to_search(v)) for v in (parameter.low, value, parameter.high))
    tolerance = BOUND_SHARE * (high - low)
    if min(x - low, high - x) > tolerance:
        return ""
    return "lower" if x - low <= high - x else "upper"


STOP_REASONS = ("", "tol_cost", "tol_sigma")  # why a restart stopped, by its code in checkpoints


@dataclass(eq=False)
class CmaState:
    """Everything that changes while a search runs; the content of a checkpoint."""

    state: Any  # evosax's, leading axis [R]
    generation: int
    best: np.ndarray  # [R, D] physical
    best_cost: np.ndarray  # [R]
    stopped: np.ndarray  # [R] index into STOP_REASONS
    ended: np.ndarray  # [R] generations the restart ran
    failed: int
    records: dict[str, list[np.ndarray]] = field(default_factory=dict)  # per generation [R, ...]

    @staticmethod
    def fresh(state: Any, restarts: int, dims: int) -> CmaState:
        """Return the state of a search that has not begun."""
        zeros = np.zeros(restarts, np.int64)
        return CmaState(state, 0, np.full((restarts, dims), np.nan), np.full(restarts, np.inf), zeros, zeros.copy(), 0)

    @property
    def cov(self) -> np.ndarray:
        """[R, D, D] sigma^2 C, search coordinates."""
        c = np.asarray(self.state.C, np.float64)
        sigma = np.asarray(self.state.std, np.float64)
        return sigma[:, None, None] ** 2 * (c + c.swapaxes(1, 2)) / 2

    @property
    def seconds(self) -> float:
        """Wall time of all generations so far."""
        return float(sum(float(s[0]) for s in self.records.get("seconds", [])))

    def tree(self) -> Tree:
        """Return the state as nested dictionaries of arrays."""
        return {
            "state": {name: np.asarray(getattr(self.state, name)) for name in self.state.__dataclass_fields__},
            "records": {name: np.stack(rows) for name, rows in self.records.items()},
            "best": self.best,
            "best_cost": self.best_cost,
            "stopped": self.stopped,
            "ended": self.ended,
            "failed": np.array(self.failed),
        }

    @staticmethod
    def of_tree(generation: int, tree: Tree, state: Any) -> CmaState:
        """Invert `tree`; state: evosax's, already on its device."""
        records = {name: list(rows) for name, rows in tree["records"].items()}
        best, best_cost, stopped, ended = (np.array(tree[k]) for k in ("best", "best_cost", "stopped", "ended"))
        return CmaState(state, generation, best, best_cost, stopped, ended, int(tree["failed"]), records)

    def update_best(self, values: np.ndarray, costs: np.ndarray, running: np.ndarray, *, ties: bool = False) -> None:
        """Update the best row of every running restart [R]; with `ties` also by a row of the same cost.

        values: [R, P, D].  costs: [R, P].
        """
        for r in np.flatnonzero(running):
            i = int(np.argmin(costs[r]))
            if costs[r, i] < self.best_cost[r] or (ties and costs[r, i] == self.best_cost[r]):
                self.best[r], self.best_cost[r] = values[r, i], costs[r, i]

    def record(self, costs: np.ndarray, mean: np.ndarray) -> None:
        """Append this generation to the records; costs [R, P], mean [R, D] physical."""
        finite = [row[np.isfinite(row)] for row in costs]
        entries = {
            "mean": mean,
            "std": np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2)),
            "sigma": np.asarray(self.state.std, np.float64),
            "best_cost": self.best_cost.copy(),
            "mean_cost": np.array([f.mean() if f.size else np.inf for f in finite]),
            "median_cost": np.array([np.median(f) if f.size else np.inf for f in finite]),
            "costs": costs,
        }
        for name, entry in entries.items():
            self.records.setdefault(name, []).append(entry)
        self.records.setdefault("seconds", [])


def starts(
    full: Space, space: Space, found: Fit, coefficients: Sequence[str] = (), *, firm_grip: float = 4.0
) -> np.ndarray:
    """Return the starts [S, F] of the refinement.

    They are the search's best values and the initial means.  If the space has the friction of a grip, the means with
    higher friction are added: a grip that slips and one that does not are different basins of the objective.  The
    search's best with neutral effects made active is added too (`with_acting`).

    Args:
        full: space of the refinement, F parameters.
        space: of the search, part of `full`.
        found: result of the search.
        coefficients: names of effects' coefficients in `full`.
        firm_grip: factor on the initial means of the friction of pads that do not slip.
    """
    best = full.embed(space, found.best[None])[0]
    pads = space.of_role(Role.SLIDING_FRICTION, Role.TORSIONAL_FRICTION)
    firm = {p.name: min(p.high, firm_grip * p.mean) for p in pads}
    return np.stack([best, full.mean, *([full.values(firm)] if firm else []), *with_acting(full, best, coefficients)])


def with_acting(space: Space, values: np.ndarray, coefficients: Sequence[str]) -> list[np.ndarray]:
    """Return `values` [F] with effects that are neutral on a bound moved off it by a prior deviation; one row or none.

    An effect that acts and one that does not may be different basins.  The derivative by a limit that is never reached
    is zero, for example.

    coefficients: names of effects' coefficients in the space.
    """
    acting = values.copy()
    for p in map(space.__getitem__, coefficients):
        at, sign = space.index(p.name), (p.mean == p.low) - (p.mean == p.high)
        if sign and bound_of(p, float(values[at])) == ("lower" if sign > 0 else "upper"):
            acting[at] = np.clip(p.mean + sign * p.std, p.low, p.high)
    return [] if np.array_equal(acting, values) else [acting]


def grip_hypotheses(space: Space) -> list[dict[str, float]]:
    """Return assignments {name: value} in which fingers slip: each sliding friction, and all of them, at its mean.

    A slipping finger is a basin of its own, which the derivatives at a sticking finger do not show.
    """
    sliding = {p.name: p.mean for p in space.of_role(Role.SLIDING_FRICTION)}
    single = [{name: mean} for name, mean in sliding.items()]
    return [*single, sliding] if len(sliding) > 1 else single
