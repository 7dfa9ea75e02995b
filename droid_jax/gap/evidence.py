"""One recording against a model: whitened residuals of every repeat, and the gap U that noise does not bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from droid_jax.compare.cost import Cost
from droid_jax.measure.noise import coarse_clock


@dataclass(frozen=True, eq=False)
class Evidence:
    """A recording's cost and its repeats, in units of one repeat's noise.

    cost: of this recording alone.  deviations: [N, M] of the repeats from their mean, data minus mean.
    column, time: [M] compared column and instant [s] of each residual.
    """

    cost: Cost
    deviations: np.ndarray
    column: np.ndarray
    time: np.ndarray

    @property
    def repeats(self) -> int:
        """N."""
        return len(self.deviations)

    def common(self, values: np.ndarray) -> np.ndarray:
        """[P, D] -> [P, M] mean of the repeats minus simulation."""
        return -self.cost.whitened(np.atleast_2d(values)).astype(np.float64) / np.sqrt(self.repeats)

    def gap_at(self, values: np.ndarray) -> float:
        """U of the model at `values` [D]."""
        return gap(self.residuals(self.common(values)[0]))

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[N, M] of every repeat, from the common part [M]."""
        return common + self.deviations


def evidence(cost: Cost) -> Evidence:
    """The evidence of a cost over one recording.

    Raises ValueError for several recordings at once, and for single repeats: whole repeats are what
    the tests flip.
    """
    if len(cost.comparisons) != 1:
        raise ValueError(f"evidence is of one recording, got {len(cost.comparisons)}")
    (comparison,) = cost.comparisons
    if comparison.repeats < 2:
        raise ValueError(f"recording {comparison.name!r} has one repeat; a gap is told from noise by repeats")
    columns, times, start = [], [], 0
    for channel in comparison.channels:
        clock = coarse_clock(*channel.span)
        columns.append(np.repeat(start + np.arange(len(channel.columns)), len(clock)))
        times.append(np.tile(clock, len(channel.columns)))
        start += len(channel.columns)
    deviations = comparison.deviations() / np.sqrt(comparison.repeats)
    return Evidence(cost, deviations, np.concatenate(columns), np.concatenate(times))


def gap(residuals: np.ndarray) -> float:
    """U of residuals [N, M]: mean product of different repeats' residuals, per residual.

    Noise of the repeats has no part in it; it is the mean square of what all repeats share.
    """
    count, size = residuals.shape
    total = residuals.sum(axis=0)
    return float((total @ total - np.sum(residuals**2)) / (count * (count - 1) * size))


def gaps(residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """[K] U of each cell; cells: [K, M] bool."""
    return np.array([gap(residuals[:, cell]) if cell.any() else 0.0 for cell in cells])
