"""One recording without repeats: contiguous blocks of time take the place of the repeats.

A block is longer than the noise stays correlated, so that under "nothing is missing" its score is about as likely
as its opposite, whatever the other blocks' are.  Four things differ from repeats:

* U is the mean square of the residual, noise included: nothing tells noise from what every repeat would share.
* A block's score depends on what moves in it, so scores of a present effect differ from block to block and
  Student's t stops growing with the effect.  The statistic is the share of the residual that an effect takes.
* The base fit has taken its part out of all blocks together.  Flipped scores lose more of themselves to it than
  the unflipped ones, so each statistic is divided by what is left of its mark after flipping and projecting.
  Without that, 17 of 100 Panda logs with nothing missing fell below p = 0.05 (linear replays; scaled: 7).
* Base parameters whose truth is off their prior's mean leave a residual that every block shares.  With few blocks and
  many nuisances that counts: marks are projected with loose priors (below p = 0.2: 8 of 40 Panda logs, not 19).

Sources: Hemerik, Goeman, Finos, JRSS B 2020 (flipping score contributions); De Santis, Goeman, Hemerik,
Davenport, Finos, JASA 2025 (the scaling).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.cost.noise import correlation_time
from droid_jax.discrepancy.residual_set import ResidualSet, only_comparison, residual_locations
from droid_jax.discrepancy.sign_flips import FEWEST_REPEATS, one_sided_p, sign_flips

LENGTH = 1.5  # correlation times of the residual, its columns' median: a block at least
SHORTEST = 0.5  # s; the low-pass alone reaches 0.2 s to either side
OUTSIDE = -1
TIE = 1.5  # U holds the noise: a rival that leaves this much more leaves far more beyond the noise
SLACK = 30.0  # prior deviations that a base parameter may move when marks are projected
CHUNK = 256  # flips at once


@dataclass(frozen=True, eq=False)
class BlockResidualSet(ResidualSet):
    """Blocks of one recording of one repeat; rows of residuals are blocks.

    deviations: [1, M] zeros.  block: [M] of each residual, OUTSIDE for what belongs to another part.
    """

    block: np.ndarray

    @property
    def units(self) -> int:
        """B."""
        return int(self.block.max()) + 1

    @property
    def repeated(self) -> bool:
        """They are not."""
        return False

    @property
    def instants(self) -> np.ndarray:
        """Those of the blocks."""
        return self.block[self.column == 0] != OUTSIDE

    @property
    def size(self) -> int:
        """Those of the blocks."""
        return int((self.block != OUTSIDE).sum())

    @property
    def equivalence_factor(self) -> float:
        """Closer to one than with repeats, whose U holds no noise."""
        return TIE

    @property
    def prior_slack(self) -> float:
        """Priors are loosened: what they hold back is in every block's residual alike and would look like an effect."""
        return SLACK

    @property
    def _inside(self) -> np.ndarray:
        """[B, M] which residuals a block holds."""
        return self.block == np.arange(self.units)[:, None]

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[B, M] B times each block's residuals, zero elsewhere: their mean is the whole residual."""
        return self.units * self._inside * common

    def discrepancy(self, residuals: np.ndarray) -> float:
        """Mean square of the residual, noise included, over the blocks' instants."""
        return float(np.mean(residuals.mean(axis=0)[self.block != OUTSIDE] ** 2))

    def discrepancies(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] mean square in each cell; cells: [K, M] bool."""
        inside = cells & (self.block != OUTSIDE)
        return inside @ residuals.mean(axis=0) ** 2 / np.maximum(inside.sum(axis=1), 1)

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Ones: squares do not change sign, so no flip tells a cell's gap from its noise."""
        return np.ones(len(cells))

    def gain_p_value(self, gains: np.ndarray) -> float:
        """p-value of gains [B]: blocks follow in time, and what moves more towards one end says nothing of noise."""
        return one_sided_p(gains)

    def losses(self, commons: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """[R, K] squared residual of K models in resamples of the blocks; draws [R, B]."""
        return self.units * draws @ (self._inside @ commons.T**2)

    def largest_score(
        self, scores: np.ndarray, marks: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """[K] standardised scores of K questions, and the p-value of the largest under flips of blocks.

        scores: [K, B] of projected marks [K, M].  base: [M, D] columns they were projected on, with prior
        deviations [D].  With H the base's (ridge) projection, a flip F of noise has the score z (1 - H) F (1 - H) e,
        whose variance is |(1 - H) F z|^2.
        """
        flips = sign_flips(self.units, seed)
        left = self._left(marks, base, prior, flips)
        standardised = flips @ scores.T / self.units / np.sqrt(np.maximum(left, 1e-30))
        largest = np.max(np.abs(standardised), axis=1)
        return standardised[0], float(np.mean(largest >= largest[0] * (1 - 1e-12)))

    def _left(self, marks: np.ndarray, base: np.ndarray, prior: np.ndarray, flips: np.ndarray) -> np.ndarray:
        """[F, K] squared size of each flipped mark after projection, |(1 - H) F z|^2."""
        inverse = np.linalg.inv(base.T @ base + np.diag(prior**-2))
        taken = np.linalg.cholesky(inverse + inverse @ np.diag(prior**-2) @ inverse)  # of 2 H - H^2
        shares = np.stack([(marks * inside) @ base @ taken for inside in self._inside])  # [B, K, D]
        size = np.einsum("km,km->k", marks, marks)
        chunks = np.split(flips, np.arange(CHUNK, len(flips), CHUNK))
        lost = np.concatenate([np.sum(np.tensordot(some, shares, 1) ** 2, axis=-1) for some in chunks])
        return np.maximum(size - lost, 1e-9 * size)


def block_residual_set(cost: Cost, block: np.ndarray) -> BlockResidualSet:
    """The residual_set of a cost over one recording of one repeat; block: [K] of each instant of the coarse clock.

    Raises ValueError for repeats, which need no blocks, and for fewer blocks than flips can use.
    """
    comparison = only_comparison(cost)
    if comparison.repeats > 1:
        raise ValueError(f"recording {comparison.name!r} has {comparison.repeats} repeats: flip these, not blocks")
    if block.max() + 1 < FEWEST_REPEATS:
        raise ValueError(
            f"recording {comparison.name!r}: {block.max() + 1} blocks, at least {FEWEST_REPEATS} are needed"
        )
    column, time = residual_locations(comparison)
    whole = np.tile(block, int(column.max()) + 1)
    return BlockResidualSet(cost, np.zeros((1, len(time))), column, time, whole)


def block_length(residuals: np.ndarray) -> float:
    """s, for residuals [K, C] on the coarse clock: LENGTH correlation times, the median over the columns.

    Of a model that lacks something the residual holds that too, and is correlated for longer than its noise.
    """
    return max(SHORTEST, LENGTH * float(np.median(correlation_time(residuals))))


def interleaved(
    clock: np.ndarray, first: float, end: float, length: float, parts: int = 1, share: float = 1.0
) -> np.ndarray:
    """[parts, K] block of each instant, from `first` to `end`, for parts that take turns.

    Blocks are at least `length` s long.  share: of the log that `first` to `end` is.  Raises ValueError where a part
    would get fewer than FEWEST blocks; it says how long the log should be.
    """
    each = int((end - first) / length) // parts
    if each < FEWEST_REPEATS:
        needed = parts * FEWEST_REPEATS * length / share
        raise ValueError(
            f"{end - first:.3g} s hold {each} blocks of {length:.3g} s for each of {parts} parts; "
            f"{FEWEST_REPEATS} are needed to tell an effect from noise: record for {np.ceil(needed):g} s or longer"
        )
    at = np.floor((clock - first) / (end - first) * parts * each).astype(int)
    inside = (clock >= first) & (clock < end)
    return np.stack([np.where(inside & (at % parts == p), at // parts, OUTSIDE) for p in range(parts)])
