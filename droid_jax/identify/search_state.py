"""A search under way: what changes from one generation to the next, and what a checkpoint of it holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from droid_jax.identify.checkpoints import Tree

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
