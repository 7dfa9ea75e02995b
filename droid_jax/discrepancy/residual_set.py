"""One recording against a model: whitened residuals of every repeat, and the gap U that noise does not bias.

`A residual set` is of a recording with repeats, which are what the tests flip.  A recording without repeats is cut
into blocks of time instead: `droid_jax.discrepancy.blocks.Blocks`, which answers the same questions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.cost.residuals import Comparison
from droid_jax.discrepancy.sign_flips import detrended, detrended_discrepancy_p_values, largest_detrended_t, one_sided_p
from droid_jax.identify.search import NotReplayed

# A parameter off its prior's mean is held back by that prior, and what is left of it all repeats share: with the
# priors as they are, 6 of 200 recordings of a lone hinge with nothing missing fell below p = 0.01.  Within three
# deviations a nuisance is no effect (`case.BEYOND`), so its mark may as well be taken away up to there.
SLACK = 3.0
AT_REST = 2  # steps of Gauss and Newton for a recording's own nuisances where joints are at rest along its motion
TIE = 3.0  # times what the best model leaves above the floor: a rival that leaves no more is equivalent


@dataclass(frozen=True, eq=False)
class ResidualSet:
    """A recording's cost and its repeats, in units of one repeat's noise.

    cost: of this recording alone.  deviations: [N, M] of the repeats from their mean, data minus mean.
    column, time: [M] compared column and instant [s] of each residual.
    nuisances: names of nuisances that this recording has for itself; nuisance_columns: [M, len(own)] what one prior
    deviation of each adds to the common residual.  See `with_nuisances`.
    """

    cost: Cost
    deviations: np.ndarray
    column: np.ndarray
    time: np.ndarray
    nuisances: tuple[str, ...] = field(default=(), kw_only=True)
    nuisance_columns: np.ndarray | None = field(default=None, kw_only=True)

    @property
    def repeats(self) -> int:
        """N."""
        return len(self.deviations)

    @property
    def units(self) -> int:
        """How many rows the residuals have: what is flipped and resampled."""
        return self.repeats

    @property
    def repeated(self) -> bool:
        """Whether rows are repeats, which tell noise from what they share; blocks of one motion do not."""
        return True

    @property
    def instants(self) -> np.ndarray:
        """[K] bool of the coarse clock, those that count."""
        return np.ones(int(np.sum(self.column == 0)), bool)

    @property
    def size(self) -> int:
        """How many residuals the log likelihood holds: U of one is half of this."""
        return self.deviations.size

    @property
    def equivalence_factor(self) -> float:
        """Times what the best model leaves, up to which a rival's U is as good."""
        return TIE

    @property
    def prior_slack(self) -> float:
        """Times its prior that a base parameter may move when marks are projected."""
        return SLACK

    def common(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, M] mean of the repeats minus simulation, the recording's own nuisances at their best.

        NaN throughout where a replay blew up.
        """
        return self._nuisances_fitted(values)[1]

    def at_best_nuisances(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, D] with the recording's own nuisances where `common` has them."""
        return self._nuisances_fitted(values)[0]

    def _nuisances_fitted(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [P, D] with own nuisances at their best, and their residuals [P, M]."""
        rows = np.array(np.atleast_2d(values), dtype=np.float64)
        space, own = self.cost.space, [self.cost.space.index(name) for name in self.nuisances]
        rows[:, own] = space.mean[own]
        common = self._common(rows)
        if self.nuisance_columns is None:
            return rows, common
        moves = _moves(self.cost)
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
        return -self.cost.whitened(rows).astype(np.float64) / np.sqrt(self.repeats)

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

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[N, M] of every repeat, from the common part [M], which is their mean."""
        return common + self.deviations

    def discrepancy_at(self, values: np.ndarray) -> float:
        """U of the model at `values` [D]; NotReplayed where its replay blows up."""
        common = self.common(values)[0]
        if not np.isfinite(common).all():
            name = only_comparison(self.cost).name
            raise NotReplayed(
                f"the simulation of {name!r} blows up with parameters that were fitted to another recording"
            )
        return self.discrepancy(self.residuals(common))

    def discrepancy(self, residuals: np.ndarray) -> float:
        """U of residuals [N, M], without what grows or fades steadily over the repeats."""
        return discrepancy(detrended(residuals))

    def discrepancies(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] U of each cell; cells: [K, M] bool."""
        return discrepancies(detrended(residuals), cells)

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] p-value of each cell's U being above zero."""
        return detrended_discrepancy_p_values(residuals, cells)

    def gain_p_value(self, gains: np.ndarray) -> float:
        """p-value of gains [N], one of each repeat, being above zero; what grows or fades steadily is no noise."""
        return one_sided_p(detrended(gains))

    def largest_score(
        self, scores: np.ndarray, marks: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """[K] t of K questions, and the p-value of the largest |t| under flips of whole repeats.

        scores: [K, N] of projected marks [K, M], of which what grows or fades steadily over the repeats is left out.
        base: [M, D] columns they were projected on, with prior deviations [D]; repeats need neither.
        """
        return largest_detrended_t(scores, seed)

    def losses(self, commons: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """[R, K] squared mean residual of K models in resamples of the repeats, up to what all models share.

        commons: [K, M] common part of each model's residuals; draws: [R, N] weights, each row summing to one.  What
        grows or fades steadily over the repeats is no scatter.
        """
        return np.sum(commons**2, axis=1) + 2 * draws @ (detrended(self.deviations) @ commons.T)


def _moves(cost: Cost) -> np.ndarray:
    """[M] bool, residuals at which their joint moves; all of them where motions are not prescribed."""
    return np.concatenate([channel.moves.T.ravel() for channel in only_comparison(cost).channels])


def residual_set(cost: Cost) -> ResidualSet:
    """The data of a cost over one recording.

    Raises ValueError for several recordings at once, and for single repeats: whole repeats are what
    the tests flip.
    """
    comparison = only_comparison(cost)
    if comparison.repeats < 2:
        raise ValueError(f"recording {comparison.name!r} has one repeat; a gap is told from noise by repeats")
    deviations = comparison.deviations() / np.sqrt(comparison.repeats)
    return ResidualSet(cost, deviations, *residual_locations(comparison))


def only_comparison(cost: Cost) -> Comparison:
    """The comparison of a cost over one recording; ValueError for several."""
    if len(cost.comparisons) != 1:
        raise ValueError(f"data is of one recording, got {len(cost.comparisons)}")
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


def discrepancy(residuals: np.ndarray) -> float:
    """U of residuals [N, M]: mean product of different repeats' residuals, per residual.

    Noise of the repeats has no part in it; it is the mean square of what all repeats share.
    """
    count, size = residuals.shape
    total = residuals.sum(axis=0)
    return float((total @ total - np.sum(residuals**2)) / (count * (count - 1) * size))


def discrepancies(residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """[K] U of each cell; cells: [K, M] bool."""
    return np.array([discrepancy(residuals[:, cell]) if cell.any() else 0.0 for cell in cells])
