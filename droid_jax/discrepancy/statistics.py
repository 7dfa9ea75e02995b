"""The discrepancy U and its tests, by sign flips of whole repeats, or of blocks of time where there are no repeats.

Under "nothing is missing" the residuals of a repeat are as likely as their opposite.  A block is longer than the noise
stays correlated, so that its score too is about as likely as its opposite, whatever the other blocks' are.  Four things
differ from repeats:

* U is the mean square of the residual, noise included: nothing separates noise from what every repeat would share.
* A block's score depends on what moves in it, so scores of a present effect differ from block to block and
  Student's t stops growing with the effect.  The statistic is the share of the residual that an effect takes.
* The base fit has taken its part out of all blocks together.  Flipped scores lose more of themselves to it than
  the unflipped ones, so each statistic is divided by what is left of its sensitivity after flipping and projecting.
  Without that, 17 of 100 Panda logs with nothing missing fell below p = 0.05 (linear replays; scaled: 7).
* Base parameters whose truth is off their prior's mean leave a residual that every block shares.  With few blocks and
  many nuisances that counts, so sensitivities are projected with loose priors (`BlocksConfig.prior_slack`).

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

EXACT = 12  # up to this many repeats all flips are tried
DRAWS = 4096
OUTSIDE = -1  # the block of an instant that belongs to another part
CHUNK = 256  # flips at once


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


def detrended(x: np.ndarray) -> np.ndarray:
    """x [N, ...] of repeats without its trend over their order: the same mean, the scatter of N - 2 degrees of freedom.

    What grows or fades steadily over the repeats (a friction or a sensor that warms up) is no noise.
    """
    if len(x) < 3:
        return x
    mean = x.mean(axis=0)
    return mean + (detrend(x) - mean) * np.sqrt((len(x) - 1) / (len(x) - 2))


def sign_flips(repeats: int, seed: int = 0, *, one_sided: bool = False) -> np.ndarray:
    """[F, N] of +1 and -1; the first row is the data unflipped.

    Up to EXACT repeats all there are, of two opposite ones but one: for statistics that do not see the difference.
    one_sided: both, for those that do.
    """
    if repeats <= EXACT:
        bits = np.arange(2 ** (repeats if one_sided else repeats - 1))[:, None] >> np.arange(repeats) & 1
        return 1.0 - 2.0 * bits
    rng = np.random.default_rng(seed)
    drawn = rng.choice([-1.0, 1.0], size=(DRAWS, repeats))
    drawn[0] = 1.0
    return drawn


def t_values(scores: np.ndarray, flips: np.ndarray) -> np.ndarray:
    """[F, K] Student's t of scores [K, N] over the repeats, for every flip."""
    count = scores.shape[1]
    mean = flips @ scores.T / count
    variance = np.maximum(np.mean(scores**2, axis=1) - mean**2, 1e-30) * count / (count - 1)
    return mean / np.sqrt(variance / count)


def one_sided_p(gains: np.ndarray) -> float:
    """p-value of gains [N] being above zero on average."""
    t = t_values(gains[None], sign_flips(len(gains), one_sided=True))[:, 0]
    return float(np.mean(t >= t[0] - 1e-12))


def largest_detrended_t(scores: np.ndarray, seed: int = 0) -> tuple[np.ndarray, float]:
    """[K] t of each of K directions with scores [K, N], and the p-value of the largest |t| among them.

    Without what grows or fades steadily over the repeats (`detrended`).

    A line taken out costs a degree of freedom, but not where rows were flipped after it: the unflipped t is compared as
    the quantile of theirs that it is of its own.  Without that 1.6 % of noise alone fell below p = 0.01 (ten repeats,
    forty independent directions; `tests/discrepancy/test_statistics.py`).
    """
    count = scores.shape[1]
    t = t_values(detrended(scores.T).T, sign_flips(count, seed))
    own, flipped = scipy.stats.t(max(count - 2, 1)), scipy.stats.t(count - 1)
    found = flipped.isf(own.sf(np.max(np.abs(t[0]))))
    return t[0], float(np.mean(np.max(np.abs(t), axis=1) >= found * (1 - 1e-12)))


def detrended_discrepancy_p_values(residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """[K] p-value of each cell's U being above zero, without what grows or fades steadily over the repeats.

    residuals [N, M], cells [K, M] bool.  Where a line was taken out, the products of different repeats have a part of
    their own (`_taken_out`), which adds up to next to nothing unflipped and to something under most flips: it is put
    back.  Without that hardly anything is found below U = M^-1/2 (U = 0.02 of 1400 residuals, eight repeats, p < 0.01:
    1 in 50, and now 2 in 3; `tests/discrepancy/test_statistics.py`).
    """
    flips, rows, out = sign_flips(len(residuals)), detrended(residuals), []
    for cell in cells:
        gram = rows[:, cell] @ rows[:, cell].T
        gram -= _taken_out(gram)
        np.fill_diagonal(gram, 0.0)  # squares do not change sign
        products = np.einsum("fn,nm,fm->f", flips, gram, flips)
        out.append(float(np.mean(products >= products[0] - 1e-12 * abs(products[0]))))
    return np.array(out)


def _taken_out(gram: np.ndarray) -> np.ndarray:
    """[N, N] what taking the line out makes of the products [N, N] of repeats that share nothing.

    Each repeat has a noise of its own size, estimated from the repeats' deviations from their mean.
    """
    count = len(gram)
    made = detrended(np.eye(count))
    apart = made - 1.0 / count
    centred = np.eye(count) - 1.0 / count
    squares = np.diag(centred @ gram @ centred)
    return made @ np.diag(np.maximum(np.linalg.lstsq(apart**2, squares)[0], 0.0)) @ made.T


def benjamini_hochberg(p: np.ndarray, level: float) -> np.ndarray:
    """[K] bool, the hypotheses rejected at a false discovery rate.  Benjamini and Hochberg, JRSS B 1995."""
    return scipy.stats.false_discovery_control(p, method="bh") <= level


def resample_weights(count: int, draws: int, seed: int = 0) -> np.ndarray:
    """[R, N] weights of the repeats in R resamples, each row summing to one."""
    return np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=draws) / count


def largest_trend(scores: np.ndarray, seed: int = 0) -> tuple[int, float, float]:
    """Which of K scores [K, N] changes most steadily over the repeats' order.

    If the order says nothing, every other order is as likely (Fisher, section 21).

    Returns:
        Its index, its slope from one repeat to the next, and the p-value of a trend as strong in any of them.
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
    """How the rows of a residual set (one for each repeat or block) come about, and the tests on them."""

    @property
    def repeated(self) -> bool:
        """Whether rows are repeats, which separate noise from what they share; blocks of one motion do not."""
        ...

    @property
    def units(self) -> int:
        """Number of rows: what is flipped and resampled."""
        ...

    @property
    def size(self) -> int:
        """How many residuals the log likelihood holds: U of one is half of this."""
        ...

    @property
    def counted(self) -> np.ndarray:
        """[M] bool, residuals that count."""
        ...

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[N, M] of every row, from the common residual [M], which is their mean."""
        ...

    def discrepancy(self, residuals: np.ndarray) -> float:
        """U of residuals [N, M]."""
        ...

    def discrepancies(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] U of each cell; cells: [K, M] bool."""
        ...

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] p-value of each cell's U being above zero."""
        ...

    def gain_p_value(self, gains: np.ndarray) -> float:
        """p-value of gains [N], one for each row, being above zero."""
        ...

    def losses(self, commons: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """[R, K] squared residual of K models with common residuals [K, M] in resamples of the rows; draws [R, N]."""
        ...

    def largest_score(
        self, scores: np.ndarray, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """[K] statistic of K directions, and the p-value of the largest of them under flips of rows.

        Args:
            scores: [K, N] of each direction and row.
            sensitivities: [K, M] of the directions, projected.
            base: [M, D] columns they were projected on.
            prior: [D] prior deviations of these.
            seed: of the flips.
        """
        ...


@dataclass(frozen=True, eq=False)
class Repeats:
    """Rows are repeats.  deviations: [N, M] of the repeats from their mean, data minus mean.

    What grows or fades steadily over the repeats is taken out before every test (`statistics.detrended`).
    """

    deviations: np.ndarray

    @property
    def repeated(self) -> bool:
        """They are."""
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
        """All."""
        return np.ones(self.deviations.shape[1], bool)

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[N, M] common part and deviations."""
        return common + self.deviations

    def discrepancy(self, residuals: np.ndarray) -> float:
        """U of what the repeats share."""
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
        """[R, K] up to what all models share."""
        return np.sum(commons**2, axis=1) + 2 * draws @ (detrended(self.deviations) @ commons.T)

    def largest_score(
        self, scores: np.ndarray, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """Student's t over the repeats; neither the sensitivities nor the base are needed."""
        return largest_detrended_t(scores, seed)


def in_turns(parts: Sequence[np.ndarray]) -> np.ndarray:
    """[M] the blocks [M] of some parts as those of one, which take turns."""
    out = np.full(len(parts[0]), OUTSIDE)
    for number, block in enumerate(parts):
        out = np.where(block == OUTSIDE, out, len(parts) * block + number)
    kept, within = np.unique(out[out != OUTSIDE], return_inverse=True)
    assert len(kept)
    out[out != OUTSIDE] = within
    return out


@dataclass(frozen=True, eq=False)
class Blocks:
    """Rows are blocks of one recording of one repeat.  block: [M] of each residual, OUTSIDE for other parts."""

    block: np.ndarray

    @property
    def repeated(self) -> bool:
        """They are not."""
        return False

    @property
    def units(self) -> int:
        """B."""
        return int(self.block.max()) + 1

    @property
    def size(self) -> int:
        """Those of the blocks."""
        return int(self.counted.sum())

    @property
    def counted(self) -> np.ndarray:
        """Those of the blocks."""
        return self.block != OUTSIDE

    @property
    def _inside(self) -> np.ndarray:
        """[B, M] which residuals a block holds."""
        return self.block == np.arange(self.units)[:, None]

    def residuals(self, common: np.ndarray) -> np.ndarray:
        """[B, M] B times each block's residuals, zero elsewhere: their mean is the whole residual."""
        return self.units * self._inside * common

    def discrepancy(self, residuals: np.ndarray) -> float:
        """Mean square of the residual, noise included, over the blocks' instants."""
        return float(np.mean(residuals.mean(axis=0)[self.counted] ** 2))

    def discrepancies(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """[K] mean square in each cell."""
        inside = cells & self.counted
        return inside @ residuals.mean(axis=0) ** 2 / np.maximum(inside.sum(axis=1), 1)

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Ones: squares do not change sign, so no flip separates a cell's discrepancy from its noise."""
        return np.ones(len(cells))

    def gain_p_value(self, gains: np.ndarray) -> float:
        """By flips of blocks.  They follow in time, and what moves more towards one end says nothing of noise."""
        return one_sided_p(gains)

    def losses(self, commons: np.ndarray, draws: np.ndarray) -> np.ndarray:
        """[R, K] in resamples of the blocks."""
        return self.units * draws @ (self._inside @ commons.T**2)

    def largest_score(
        self, scores: np.ndarray, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, seed: int = 0
    ) -> tuple[np.ndarray, float]:
        """Standardised scores under flips of blocks.

        With H the base's (ridge) projection, a flip F of noise has the score z (1 - H) F (1 - H) e, whose variance
        is |(1 - H) F z|^2.
        """
        flips = sign_flips(self.units, seed)
        left = self.left_after_flips(sensitivities, base, prior, flips)
        standardised = flips @ scores.T / self.units / np.sqrt(np.maximum(left, 1e-30))
        largest = np.max(np.abs(standardised), axis=1)
        return standardised[0], float(np.mean(largest >= largest[0] * (1 - 1e-12)))

    def left_after_flips(
        self, sensitivities: np.ndarray, base: np.ndarray, prior: np.ndarray, flips: np.ndarray
    ) -> np.ndarray:
        """[F, K] squared size of each flipped sensitivity after projection, |(1 - H) F z|^2."""
        inverse = np.linalg.inv(base.T @ base + np.diag(prior**-2))
        taken = np.linalg.cholesky(inverse + inverse @ np.diag(prior**-2) @ inverse)  # of 2 H - H^2
        shares = np.stack([(sensitivities * inside) @ base @ taken for inside in self._inside])  # [B, K, D]
        size = np.einsum("km,km->k", sensitivities, sensitivities)
        chunks = np.split(flips, np.arange(CHUNK, len(flips), CHUNK))
        lost = np.concatenate([np.sum(np.tensordot(some, shares, 1) ** 2, axis=-1) for some in chunks])
        return np.maximum(size - lost, 1e-9 * size)


def block_length(residuals: np.ndarray, config: BlocksConfig, rate: float = DEFAULT_NOISE.rate) -> float:
    """s, for residuals [K, C] at `rate` Hz: some correlation times, the median over the columns.

    Of a model that lacks something the residual holds that too, and is correlated for longer than its noise.
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
    """[parts, K] block of each instant, from `first` to `end`, for parts that take turns.

    Args:
        clock: [K] s.
        first: s, where the first block begins.
        end: s, where the last one ends.
        length: s, of a block at least.
        parts: that take turns, e.g. training and validation.
        share: of the recording that `first` to `end` is.
        least: blocks that each part must have.

    Raises:
        ValueError: a part would get fewer; it says how long the recording should be.
    """
    each = int((end - first) / length) // parts
    if each < least:
        needed = parts * least * length / share
        raise ValueError(
            f"{end - first:.3g} s hold {each} blocks of {length:.3g} s for each of {parts} parts; "
            f"{least} are needed to tell an effect from noise: record for {np.ceil(needed):g} s or longer"
        )
    at = np.floor((clock - first) / (end - first) * parts * each).astype(int)
    inside = (clock >= first) & (clock < end)
    return np.stack([np.where(inside & (at % parts == p), at // parts, OUTSIDE) for p in range(parts)])


def fewest_blocks(clock: np.ndarray, first: float) -> np.ndarray:
    """[K] block of each instant from `first` on, for what is not tested: as few blocks as there may be."""
    end = clock[-1] + 1e-6
    return interleaved(clock, first, end, (end - first) / (FEWEST_REPEATS + 0.5))[0]
