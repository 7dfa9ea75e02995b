"""One recording against a model: its residuals in units of one repeat's noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.cost.observation import Measured
from droid_jax.cost.residuals import Comparison
from droid_jax.discrepancy.config import DiscrepancyConfig, SelectionConfig
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling
from droid_jax.identify.identifiability import IdentifiabilityConfig
from droid_jax.identify.search import NotReplayed
from droid_jax.recordings.split import FEWEST_REPEATS

AT_REST = 2  # steps of Gauss and Newton for a recording's own nuisances where joints are at rest along its motion


@dataclass(frozen=True, eq=False)
class ResidualSet:
    """A recording's cost, what is resampled and tested of it, and its own nuisances.

    cost: of this recording alone.
    whitened: [P, D] -> [P, M], distances: [P, D] -> [P, 1]: the cost's own, or ones that remember their replays.
    resampling: whole repeats, or blocks of time.
    column, time: [M] compared column and instant [s] of each residual.
    config, identifiability: thresholds of the search.
    equivalence_factor, prior_slack: those of the config that go with the resampling.
    nuisances: names of nuisances that this recording has for itself; nuisance_columns: [M, len(nuisances)] what one
    prior deviation of each adds to the common residual.  See `with_nuisances`.
    """

    cost: Cost
    whitened: Callable[[np.ndarray], np.ndarray]
    distances: Callable[[np.ndarray], np.ndarray]
    resampling: Resampling
    column: np.ndarray
    time: np.ndarray
    config: SelectionConfig
    identifiability: IdentifiabilityConfig
    equivalence_factor: float
    prior_slack: float
    nuisances: tuple[str, ...] = field(default=(), kw_only=True)
    nuisance_columns: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def comparison(self) -> Comparison:
        """Of the recording."""
        return only_comparison(self.cost)

    @property
    def repeats(self) -> int:
        """Of the recording."""
        return self.comparison.repeats

    def instants_of(self, channel: Measured) -> np.ndarray:
        """[K] bool of a channel's coarse clock, those that count."""
        names = [c.name for c in self.comparison.channels]
        before = self.comparison.channels[: names.index(channel.name)]
        return self.resampling.counted[self.column == sum(len(c.columns) for c in before)]

    def common(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, M] mean of the repeats minus simulation, the recording's own nuisances at their best.

        NaN throughout where a replay blew up.
        """
        return self._nuisances_fitted(values)[1]

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """[D] -> [N, M] of every repeat or block."""
        return self.resampling.residuals(self.common(values)[0])

    def at_best_nuisances(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, D] with the recording's own nuisances where `common` has them."""
        return self._nuisances_fitted(values)[0]

    def discrepancy_at(self, values: np.ndarray) -> float:
        """U of the model at `values` [D]; NotReplayed where its replay blows up."""
        common = self.common(values)[0]
        if not np.isfinite(common).all():
            raise NotReplayed(
                f"the simulation of {self.comparison.name!r} blows up with parameters that were fitted to another "
                "recording"
            )
        return self.resampling.discrepancy(self.resampling.residuals(common))

    def with_nuisances(self, names: Sequence[str]) -> ResidualSet:
        """The same, with nuisances `names` that are not the fitted recording's but fitted to this one.

        They must enter the residual linearly (torque offsets).  Each is fitted with its own prior.
        """
        if not names:
            return self
        space = self.cost.space
        rows = [space.mean, *(space.values({n: space[n].mean + space[n].std}) for n in names)]
        common = self._common(np.stack(rows))
        return replace(self, nuisances=tuple(names), nuisance_columns=(common[1:] - common[0]).T)

    def _nuisances_fitted(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [P, D] with own nuisances at their best, and their residuals [P, M]."""
        rows = np.array(np.atleast_2d(values), dtype=np.float64)
        space, own = self.cost.space, [self.cost.space.index(name) for name in self.nuisances]
        rows[:, own] = space.mean[own]
        common = self._common(rows)
        if self.nuisance_columns is None:
            return rows, common
        moves = self._moves()
        columns = self.nuisance_columns * moves[:, None]
        normal = columns.T @ columns + np.eye(len(self.nuisances)) / self.repeats
        best = np.zeros((len(rows), len(self.nuisances)))
        # Where a joint is at rest its friction takes up an offset as far as it can: there it is replayed again.
        for _ in range(1 if moves.all() else AT_REST):
            best -= np.linalg.solve(normal, (common @ columns + best / self.repeats).T).T
            rows[:, own] = space.mean[own] + space.std[own] * best
            common = common + best @ self.nuisance_columns.T if moves.all() else self._common(rows)
        return rows, common

    def _common(self, rows: np.ndarray) -> np.ndarray:
        return -self.whitened(rows).astype(np.float64) / np.sqrt(self.repeats)

    def _moves(self) -> np.ndarray:
        """[M] bool, residuals at which their joint moves; all of them where motions are not prescribed."""
        return np.concatenate([channel.moves.T.ravel() for channel in self.comparison.channels])


def residual_set(cost: Cost, config: DiscrepancyConfig | None = None) -> ResidualSet:
    """The residual set of a cost over one recording with repeats.

    Raises:
        ValueError: several recordings at once, or a single repeat: whole repeats are what the tests flip.
    """
    comparison, config = only_comparison(cost), config or DiscrepancyConfig()
    if comparison.repeats < 2:
        raise ValueError(f"recording {comparison.name!r} has one repeat; a discrepancy needs repeats, or blocks")
    rows = Repeats(comparison.deviations() / np.sqrt(comparison.repeats))
    selection = config.selection
    return _of(cost, rows, config, selection.equivalence_factor, selection.prior_slack)


def block_residual_set(
    cost: Cost, block: np.ndarray, config: DiscrepancyConfig | None = None, least: int = FEWEST_REPEATS
) -> ResidualSet:
    """The residual set of a cost over one recording of one repeat; block: [K] of each instant of the coarse clock.

    least: blocks that there must be.  Raises:
        ValueError: repeats, which need no blocks, or fewer blocks than flips can use.
    """
    config, comparison = config or DiscrepancyConfig(), only_comparison(cost)
    if comparison.repeats > 1:
        raise ValueError(f"recording {comparison.name!r} has {comparison.repeats} repeats: flip these, not blocks")
    if block.max() + 1 < least:
        raise ValueError(f"recording {comparison.name!r}: {block.max() + 1} blocks, at least {least} are needed")
    column, _ = residual_locations(comparison)
    rows, blocks = Blocks(np.tile(block, int(column.max()) + 1)), config.blocks
    return _of(cost, rows, config, blocks.equivalence_factor, blocks.prior_slack)


def _of(cost: Cost, rows: Resampling, config: DiscrepancyConfig, factor: float, slack: float) -> ResidualSet:
    return ResidualSet(
        cost,
        cost.whitened,
        cost.distances,
        rows,
        *residual_locations(only_comparison(cost)),
        config=config.selection,
        identifiability=config.identifiability,
        equivalence_factor=factor,
        prior_slack=slack,
    )


def only_comparison(cost: Cost) -> Comparison:
    """The comparison of a cost over one recording; ValueError for several."""
    if len(cost.comparisons) != 1:
        raise ValueError(f"a residual set is of one recording, got {len(cost.comparisons)}")
    return cost.comparisons[0]


def residual_locations(comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """Column and instant [s] of each residual, both [M]."""
    columns, times, start = [], [], 0
    for channel in comparison.channels:
        clock = channel.clock
        columns.append(np.repeat(start + np.arange(len(channel.columns)), len(clock)))
        times.append(np.tile(clock, len(channel.columns)))
        start += len(channel.columns)
    return np.concatenate(columns), np.concatenate(times)
