"""What a search is given, `search_cost`; a search under way, `CmaState`; what it returns: `Fit`, with the history of
every restart; and where the refinement begins from there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from droid_jax.identify.gaussian import Gaussian
from droid_jax.model.parameters import Parameter, Role, Space

if TYPE_CHECKING:
    from droid_jax.identify.checkpoints import Tree

FIRM = 4.0  # times its initial mean: the friction of a pad that does not slip
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


def search_cost(
    cost: Callable[[np.ndarray], Any], penalty: float, full: Space, space: Space, at: np.ndarray | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """[P, d] rows over `space` -> [P] costs of them in the full one: a replay that blew up is no parent.

    penalty: what such a replay costs (`Comparison.penalty`).
    at: [D] where the other parameters stand; default: their means.
    """

    def searched(rows: np.ndarray) -> np.ndarray:
        found = np.asarray(cost(full.embed(space, rows, at)), np.float64)
        return np.where(found == np.float32(penalty), np.inf, found)

    return searched


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


REASONS = ("", "tol_cost", "tol_sigma")  # why a restart stopped, by the code kept in checkpoints


@dataclass(eq=False)
class CmaState:
    """Everything that changes while a search runs; what a checkpoint holds."""

    state: Any  # evosax's, leading axis [R]
    generation: int
    best: np.ndarray  # [R, D] physical
    best_cost: np.ndarray  # [R]
    stopped: np.ndarray  # [R] index into REASONS
    ended: np.ndarray  # [R] generations the restart ran
    failed: int
    records: dict[str, list[np.ndarray]] = field(default_factory=dict)  # per generation [R, ...]

    @staticmethod
    def fresh(state: Any, restarts: int, dims: int) -> CmaState:
        """Of a search that has not begun."""
        none = np.zeros(restarts, np.int64)
        return CmaState(state, 0, np.full((restarts, dims), np.nan), np.full(restarts, np.inf), none, none.copy(), 0)

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
        """As nested dictionaries of arrays."""
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
        """Inverse of tree(), with the state already on its device."""
        records = {name: list(rows) for name, rows in tree["records"].items()}
        best, best_cost, stopped, ended = (np.array(tree[k]) for k in ("best", "best_cost", "stopped", "ended"))
        return CmaState(state, generation, best, best_cost, stopped, ended, int(tree["failed"]), records)

    def keep_best(self, values: np.ndarray, costs: np.ndarray, running: np.ndarray, *, ties: bool = False) -> None:
        """Bring every running restart's best row up to date, with `ties` also by a row that costs the same."""
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


def starts(full: Space, space: Space, found: Fit, coefficients: Sequence[str] = ()) -> np.ndarray:
    """[S, F] where the refinement begins: the search's best, the initial means, these with a firm grip where the space
    has the friction of one, and the search's best with effects that do not act in it (`with_acting`).

    A grip that slips and one that never does are different basins, and neither start finds the other's.
    """
    searched = full.embed(space, found.best[None])[0]
    pads = space.of_role(Role.SLIDING_FRICTION, Role.TORSIONAL_FRICTION)
    firm = {p.name: min(p.high, FIRM * p.mean) for p in pads}
    return np.stack(
        [searched, full.mean, *([full.values(firm)] if firm else []), *with_acting(full, searched, coefficients)]
    )


def with_acting(space: Space, values: np.ndarray, coefficients: Sequence[str]) -> list[np.ndarray]:
    """`values` [F] with the effects that stand neutral on a bound a prior deviation off it; nothing where none does.

    A limit that acts and one that does not are different basins: where it is out of reach, no slope tells of it.

    coefficients: of effects that the space holds, by name.
    """
    acting = values.copy()
    for p in map(space.__getitem__, coefficients):
        at, way = space.index(p.name), (p.mean == p.low) - (p.mean == p.high)
        if way and bound_of(p, float(values[at])) == ("lower" if way > 0 else "upper"):
            acting[at] = np.clip(p.mean + way * p.std, p.low, p.high)
    return [] if np.array_equal(acting, values) else [acting]


def grip_hypotheses(space: Space) -> list[dict[str, float]]:
    """Which fingers slip: each sliding friction alone, and all, at its initial mean.

    Slip is a basin of its own: from a sticking finger no derivative sees it.
    """
    sliding = {p.name: p.mean for p in space.of_role(Role.SLIDING_FRICTION)}
    alone = [{name: mean} for name, mean in sliding.items()]
    return [*alone, sliding] if len(sliding) > 1 else alone
