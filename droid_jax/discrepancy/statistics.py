"""The discrepancy U and its tests by sign flips of whole repeats, or of blocks of time in logs without repeats.

Under the null hypothesis, that nothing is missing, a repeat's residuals and their negatives are equally likely.  A
block is longer than the noise's correlation time.  Its score and the score's negative are therefore about equally
likely, independently of the other blocks.  Blocks differ from repeats in four points:

* U is the mean square of the residual and includes the noise, which only repeats separate from a common residual.
* A block's score depends on the motion in it.  Scores of a present effect differ from block to block, and Student's t
  stops growing with the effect.  The statistic is therefore the share of the residual that an effect explains.
* The base fit was projected out of all blocks together.  Flipped scores lose a larger share to that projection than
  unflipped ones.  Each statistic is therefore divided by the size of its sensitivity after flipping and projection.
  Without it, 17 of 100 Panda logs with nothing missing had p < 0.05 (linear replays; with it: 7).
* Base parameters whose true values differ from their prior means leave a residual that all blocks share.  This matters
  with few blocks and many nuisances.  Sensitivities are therefore projected with wide priors
  (`BlocksConfig.prior_slack`).

Sources: R. A. Fisher, The Design of Experiments, 1935, section 21; Westfall and Young, Resampling-Based Multiple
Testing, 1993 (the largest statistic over many directions); Hemerik, Goeman, Finos, JRSS B 2020 (flipping score
contributions); De Santis, Goeman, Hemerik, Davenport, Finos, JASA 2025 (the scaling).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy

from droid_jax.cost.noise import DEFAULT_NOISE, correlation_time, detrend
from droid_jax.discrepancy.config import BlocksConfig
from droid_jax.recordings.split import FEWEST_REPEATS

EXACT = 12  # largest number of repeats or blocks of which all sign flips are computed
DRAWS = 4096  # random sign flips, or orders, of more than that
OUTSIDE = -1  # block number of an instant that belongs to another part
CHUNK = 256  # flips that are projected at once


def discrepancy(residuals: np.ndarray) -> float:
    """U of residuals [N, M]: the mean product of the residuals of two different repeats.

    It is an unbiased estimate of the mean square of the common residual: independent noise of the repeats averages out.
    """
    count, size = residuals.shape
    total = residuals.sum(axis=0)
    return float((total @ total - np.sum(residuals**2)) / (count * (count - 1) * size))


def discrepancies(residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """[K] U of each cell; cells: [K, M] bool."""
    return np.array([discrepancy(residuals[:, cell]) if cell.any() else 0.0 for cell in cells])


def detrended(x: np.ndarray) -> np.ndarray:
    """Remove the linear trend over the order of the repeats from x [N, ...].

    The mean is unchanged; deviations from it are scaled for N - 2 degrees of freedom.  A steady change over the repeats
    (a friction or a sensor that warms up) is not noise.
    """
    if len(x) < 3:
        return x
    mean = x.mean(axis=0)
    return mean + (detrend(x) - mean) * np.sqrt((len(x) - 1) / (len(x) - 2))


def sign_flips(repeats: int, seed: int = 0, *, one_sided: bool = False) -> np.ndarray:
    """[F, N] sign flips of N repeats or blocks; the first row leaves the data unflipped.

    All flips for up to `EXACT` repeats, otherwise `DRAWS` random ones.

    Args:
        repeats: N.
        seed: of the random flips.
        one_sided: include both of two opposite flips, for statistics whose sign matters.
    """
    if repeats <= EXACT:
        bits = np.arange(2 ** (repeats if one_sided else repeats - 1))[:, None] >> np.arange(repeats) & 1
        return 1.0 - 2.0 * bits
    rng = np.random.default_rng(seed)
    drawn = rng.choice([-1.0, 1.0], size=(DRAWS, repeats))
    drawn[0] = 1.0
    return drawn


def t_values(scores: np.ndarray, flips: np.ndarray) -> np.ndarray:
    """[F, K] Student's t over the repeats of scores [K, N], for every flip [F, N]."""
    count = scores.shape[1]
    mean = flips @ scores.T / count
    variance = np.maximum(np.mean(scores**2, axis=1) - mean**2, 1e-30) * count / (count - 1)
    return mean / np.sqrt(variance / count)


def one_sided_p(gains: np.ndarray) -> float:
    """One-sided p-value of the hypothesis that the mean of the gains [N] is zero, against a positive mean."""
    t = t_values(gains[None], sign_flips(len(gains), one_sided=True))[:, 0]
    return float(np.mean(t >= t[0] - 1e-12))


def largest_detrended_t(scores: np.ndarray, seed: int = 0) -> tuple[np.ndarray, float]:
    """[K] t of K directions with scores [K, N], and the p-value of the largest |t|, without the trend over the repeats.

    Removing the trend costs the unflipped scores a degree of freedom.  Scores that are flipped afterwards do not lose
    it.  The unflipped t is therefore converted to the flipped t of the same tail probability.  Without it 1.6 % of
    noise alone had p < 0.01 (ten repeats, forty independent directions; `tests/discrepancy/test_statistics.py`).
    """
    count = scores.shape[1]
    t = t_values(detrended(scores.T).T, sign_flips(count, seed))
    unflipped, flipped = scipy.stats.t(max(count - 2, 1)), scipy.stats.t(count - 1)
    largest = flipped.isf(unflipped.sf(np.max(np.abs(t[0]))))
    return t[0], float(np.mean(np.max(np.abs(t), axis=1) >= largest * (1 - 1e-12)))


def detrended_discrepancy_p_values(residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """[K] p-value of U = 0 in each cell, without the trend over the repeats.

    Args:
        residuals: [N, M] of the repeats.
        cells: [K, M] bool.

    Removing the trend correlates the residuals of different repeats (`_detrending_products`).  These products nearly
    cancel unflipped, but not under most flips.  They are therefore subtracted.  Without it a U below M^-1/2 is hardly
    ever significant (U = 0.02 of 1400 residuals, eight repeats, p < 0.01: 1 in 50, with it 2 in 3;
    `tests/discrepancy/test_statistics.py`).
    """
    flips, rows, out = sign_flips(len(residuals)), detrended(residuals), []
    for cell in cells:
        gram = rows[:, cell] @ rows[:, cell].T
        gram -= _detrending_products(gram)
        np.fill_diagonal(gram, 0.0)  # squares do not change sign
        products = np.einsum("fn,nm,fm->f", flips, gram, flips)
        out.append(float(np.mean(products >= products[0] - 1e-12 * abs(products[0]))))
    return np.array(out)


def _detrending_products(gram: np.ndarray) -> np.ndarray:
    """[N, N] expected products of detrended repeats that hold independent noise alone.

    The noise variance of each repeat is estimated from the products' [N, N] deviations from the repeats' mean.
    """
    count = len(gram)
    detrending = detrended(np.eye(count))
    deviations = detrending - 1.0 / count
    centred = np.eye(count) - 1.0 / count
    squares = np.diag(centred @ gram @ centred)
    return detrending @ np.diag(np.maximum(np.linalg.lstsq(deviations**2, squares)[0], 0.0)) @ detrending.T


def benjamini_hochberg(p: np.ndarray, level: float) -> np.ndarray:
    """[K] bool, hypotheses rejected at a false discovery rate `level`.  Benjamini and Hochberg, JRSS B 1995."""
    return scipy.stats.false_discovery_control(p, method="bh") <= level


def resample_weights(count: int, draws: int, seed: int = 0) -> np.ndarray:
    """[R, N] weights of N repeats in R bootstrap resamples; each row sums to one."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws) / count


def largest_trend(scores: np.ndarray, seed: int = 0) -> tuple[int, float, float]:
    """The strongest linear trend of K scores [K, N] over the order of the repeats.

    The p-value is that of a permutation test of the order (Fisher, section 21).

    Returns:
        The score's index, its slope per repeat, and the p-value of the largest trend among all scores.
    """
    count = scores.shape[1]
    order = np.arange(count) - 0.5 * (count - 1)
    order /= np.linalg.norm(order)
    others = np.random.default_rng(seed).permuted(np.tile(order, (DRAWS - 1, 1)), axis=1)
    slopes = np.abs(np.concatenate([order[None], others]) @ scores.T)  # [F, K]
    largest, best = slopes.max(axis=1), int(np.argmax(slopes[0]))
    slope = float(order @ scores[best]) * (order[1] - order[0])
    return best, slope, float(np.mean(largest >= largest[0] * (1 - 1e-12)))


class Resampling(Protocol):
    """The rows of a residual set, one for each repeat or block, and the tests on them."""

    @property
    def repeated(self) -> bool:
        """Whether rows are repeats, which separate noise from the common residual; blocks of one motion do not."""
        ...

    @property
    def units(self) -> int:
        """Number of rows N, which are flipped and resampled."""
        ...

    @property
    def size(self) -> int:
        """Number of residuals in the log likelihood; U = 1 adds half of it to the objective."""
        ...

    @property
    def counted(self) -> np.ndarray:
        """[M] bool, residuals that belong to the set."""
        ...

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[N, M] residuals of every row, from the common residual [M], which is their mean."""
        ...

    def discrepancy(self, residuals: np.ndarray) -> float:
        """U of residuals [N, M]."""
        ...

    def discrepancies(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] U of each cell; cells: [K, M] bool."""
        ...

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] p-value of U = 0 in each cell."""
        ...

    def gain_p_value(self, gains: np.ndarray) -> float:
        """One-sided p-value of a zero mean of gains [N], one for each row."""
        ...

    def losses(self, commons: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """[R, K] squared residual of K models in resamples of the rows.

        Args:
            commons: [K, M] common residual of each model.
            draws: [R, N] weights of the rows (`resample_weights`).
        """
        ...

    def largest_score(
        self, scores: np.ndarray, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """[K] statistic of K directions, and the p-value of the largest of them under flips of rows.

        Args:
            scores: [K, N] of each direction and row.
            sensitivities: [K, M] projected sensitivities of the directions.
            base: [M, D] columns of the base parameters, which were projected out.
            prior: [D] prior deviations of these.
            seed: of the flips.
        """
        ...


@dataclass(frozen=True, eq=False)
class Repeats:
    """Rows that are repeats.

    deviations: [N, M] of the repeats from their mean.  Their trend over the order of the repeats is removed before
    every test (`detrended`).
    """

    deviations: np.ndarray

    @property
    def repeated(self) -> bool:
        """True."""
        return True

    @property
    def units(self) -> int:
        """N."""
        return len(self.deviations)

    @property
    def size(self) -> int:
        """N M."""
        return self.deviations.size

    @property
    def counted(self) -> np.ndarray:
        """[M] all of them."""
        return np.ones(self.deviations.shape[1], bool)

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[N, M] common residual plus deviations."""
        return common + self.deviations

    def discrepancy(self, residuals: np.ndarray) -> float:
        """U of the common residual, without the noise."""
        return discrepancy(detrended(residuals))

    def discrepancies(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] U of each cell."""
        return discrepancies(detrended(residuals), cells)

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] by flips of whole repeats."""
        return detrended_discrepancy_p_values(residuals, cells)

    def gain_p_value(self, gains: np.ndarray) -> float:
        """By flips of whole repeats."""
        return one_sided_p(detrended(gains))

    def losses(self, commons: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """[R, K] up to a constant that is the same for all models."""
        return np.sum(commons**2, axis=1) + 2 * draws @ (detrended(self.deviations) @ commons.T)

    def largest_score(
        self, scores: np.ndarray, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """Student's t over the repeats; sensitivities and base are not used."""
        return largest_detrended_t(scores, seed)


def in_turns(parts: Sequence[np.ndarray]) -> np.ndarray:
    """[M] block numbers of several parts' blocks [M] together, in order of time if the parts alternate."""
    out = np.full(len(parts[0]), OUTSIDE)
    for number, block in enumerate(parts):
        out = np.where(block == OUTSIDE, out, len(parts) * block + number)
    numbers, renumbered = np.unique(out[out != OUTSIDE], return_inverse=True)
    assert len(numbers)
    out[out != OUTSIDE] = renumbered
    return out


@dataclass(frozen=True, eq=False)
class Blocks:
    """Rows that are blocks of time of one recording of one repeat.

    block: [M] block number of each residual, `OUTSIDE` for residuals of other parts.
    """

    block: np.ndarray

    @property
    def repeated(self) -> bool:
        """False."""
        return False

    @property
    def units(self) -> int:
        """B."""
        return int(self.block.max()) + 1

    @property
    def size(self) -> int:
        """Number of residuals inside the blocks."""
        return int(self.counted.sum())

    @property
    def counted(self) -> np.ndarray:
        """[M] bool, residuals inside the blocks."""
        return self.block != OUTSIDE

    @property
    def _inside(self) -> np.ndarray:
        """[B, M] bool, residuals of each block."""
        return self.block == np.arange(self.units)[:, None]

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[B, M] B times each block's residuals, zero elsewhere; their mean is the common residual."""
        return self.units * self._inside * common

    def discrepancy(self, residuals: np.ndarray) -> float:
        """Mean square of the residual inside the blocks, noise included."""
        return float(np.mean(residuals.mean(axis=0)[self.counted] ** 2))

    def discrepancies(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] mean square in each cell."""
        inside = cells & self.counted
        return inside @ residuals.mean(axis=0) ** 2 / np.maximum(inside.sum(axis=1), 1)

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Ones: squares do not change under sign flips, so noise and discrepancy of a cell cannot be separated."""
        return np.ones(len(cells))

    def gain_p_value(self, gains: np.ndarray) -> float:
        """By flips of blocks, without detrending: a trend over the blocks comes from the motion."""
        return one_sided_p(gains)

    def losses(self, commons: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """[R, K] squared residual in resamples of the blocks."""
        return self.units * draws @ (self._inside @ commons.T**2)

    def largest_score(
        self, scores: np.ndarray, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """Standardised scores under flips of blocks.

        Let H be the (ridge) projection on the base columns.  A flip F of noise e has the score z (1 - H) F (1 - H) e
        with the variance |(1 - H) F z|^2.
        """
        flips = sign_flips(self.units, seed)
        sizes = self.flipped_sizes(sensitivities, base, prior, flips)
        standardised = flips @ scores.T / self.units / np.sqrt(np.maximum(sizes, 1e-30))
        largest = np.max(np.abs(standardised), axis=1)
        return standardised[0], float(np.mean(largest >= largest[0] * (1 - 1e-12)))

    def flipped_sizes(
        self, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, flips: np.ndarray
    ) -> np.ndarray:
        """[F, K] squared norm of each sensitivity after flipping and projection, |(1 - H) F z|^2."""
        # 2 H - H^2 by singular values: normal equations of nearly dependent columns are no positive matrix in floats.
        _, values, rows = np.linalg.svd(base * prior, full_matrices=False)
        kept = 1.0 / (1.0 + values**2)
        factor = prior[:, None] * rows.T * np.sqrt(kept + kept**2)
        columns, numbers = base @ factor, (np.flatnonzero(inside) for inside in self._inside)
        shares = np.stack([sensitivities[:, some] @ columns[some] for some in numbers])  # [B, K, D]
        size = np.einsum("km,km->k", sensitivities, sensitivities)
        chunks = np.split(flips, np.arange(CHUNK, len(flips), CHUNK))
        absorbed = np.concatenate([np.sum(np.tensordot(some, shares, 1) ** 2, axis=-1) for some in chunks])
        return np.maximum(size - absorbed, 1e-9 * size)


def block_length(residuals: np.ndarray, config: BlocksConfig, rate: float = DEFAULT_NOISE.rate) -> float:
    """Length of a block [s] for residuals [K, C] at `rate` Hz (`BlocksConfig.correlation_times`).

    The residuals of a model that lacks an effect are correlated for longer than the noise.
    """
    return max(config.shortest, config.correlation_times * float(np.median(correlation_time(residuals, rate))))


def interleaved(
    clock: np.ndarray,
    first: float,
    end: float,
    length: float,
    parts: int = 1,
    share: float = 1.0,
    least: int = FEWEST_REPEATS,
) -> np.ndarray:
    """[parts, K] block number of each instant, for parts whose blocks alternate.

    Args:
        clock: [K] s.
        first: s, beginning of the first block.
        end: s, end of the last block.
        length: s, least length of a block.
        parts: number of parts, e.g. two for training and validation.
        share: share of the recording between `first` and `end`.
        least: least number of blocks in each part.

    Raises:
        ValueError: a part would get fewer; the message says how long the recording should be.
    """
    each = int((end - first) / length) // parts
    if each < least:
        needed = parts * least * length / share
        raise ValueError(
            f"{end - first:.3g} s hold {each} blocks of {length:.3g} s for each of {parts} parts; "
            f"{least} are needed to distinguish an effect from noise: record for {np.ceil(needed):g} s or longer"
        )
    at = np.floor((clock - first) / (end - first) * parts * each).astype(int)
    inside = (clock >= first) & (clock < end)
    return np.stack([np.where(inside & (at % parts == p), at // parts, OUTSIDE) for p in range(parts)])


def fewest_blocks(clock: np.ndarray, first: float) -> np.ndarray:
    """[K] block number of each instant from `first` on: as few blocks as allowed, for fits that are not tested."""
    end = clock[-1] + 1e-6
    return interleaved(clock, first, end, (end - first) / (FEWEST_REPEATS + 0.5))[0]
