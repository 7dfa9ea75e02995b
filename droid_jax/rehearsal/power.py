"""The smallest size of an effect that the search's tests find, in a linear model.

The score test and the validation test of the search are applied to drawn noise, with the search's sign flips,
thresholds and block structure.  Only the replays are replaced by the linear model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.stats

from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.statistics import Blocks, Repeats, detrended, sign_flips, t_values
from droid_jax.discrepancy.step_error import FIRST_ORDER_RATIO
from droid_jax.rehearsal.config import RehearsalConfig
from droid_jax.rehearsal.imitations import weak_imitation_limit
from droid_jax.rehearsal.linear import LinearModel, Unabsorbed, unabsorbed

HALVINGS = 8  # of the range of noncentralities, in logarithms


@dataclass(frozen=True)
class Smallest:
    """The smallest size of one coefficient that is found often enough.

    size: in the coefficient's unit, with the margin; inf if no size within the bounds is found.
    limits: size that each condition alone requires, without the margin.  limit: name of the largest of them.
    noncentrality: of `size` in the score test.
    """

    size: float
    limits: Mapping[str, float]
    limit: str
    noncentrality: float


def smallest_sizes(
    model: LinearModel, wanted: Sequence[int], config: RehearsalConfig, search: DiscrepancyConfig | None = None
) -> list[Smallest]:
    """Return the smallest size of each wanted direction that the score test and the validation test find.

    Args:
        model: the linear model.
        wanted: numbers of directions.
        config: of the rehearsal.
        search: the search's thresholds; None for the defaults.
    """
    search = search or DiscrepancyConfig()
    units = model.repeats**0.5 if model.repeated else 1.0
    tested = "train" if model.repeated else "both"  # blocks of both parts are tested together
    parts = [unabsorbed(model, k) for k in wanted]
    typical = np.array([_typical_size(part, units, config) for part in parts])
    rows = [part.at(size) for part, size in zip(parts, typical, strict=True)]
    effects = [train if model.repeated else train + validation for train, validation in rows]
    scores = score_draws(model, config, np.array(effects).reshape(len(rows), -1))
    deviation, out = fit_deviations(model, config), list[Smallest]()
    for i, (k, part) in enumerate(zip(wanted, parts, strict=True)):
        if not np.isfinite(deviation[k]) or part.norms[1][-1] < 1e-12:
            out.append(Smallest(np.inf, {}, "no signal", np.nan))
            continue
        often = max(float(scipy.stats.norm.ppf(config.share)), 0.0)
        surely = float(scipy.stats.norm.ppf(0.5 * (1 + search.selection.interval_level)))
        drawn = {
            "score test": part.size_of(scores.crossings(i, search.selection.significance) / units, tested),
            "validation": part.size_of(gain_crossings(model, i, rows[i][1], config, search), "validation"),
            "time step": discrepancy_crossings(model, k, part, config),
        }
        fixed = {
            "minimum effect size": float(model.minimum[k]) + often * deviation[k],
            "interval": (surely + often) * deviation[k],
            "weak imitation": weak_imitation_limit(model, k, config.share),
        }
        limits = {name: float(np.quantile(a, config.share, method="higher")) for name, a in drawn.items()} | fixed
        each = np.maximum(np.max(list(drawn.values()), axis=0), max(fixed.values()))
        smallest = config.margin * float(np.quantile(each, config.share, method="higher"))
        limit = max(limits, key=limits.__getitem__)
        if not smallest <= model.largest[k]:
            smallest, limit = np.inf, "beyond its bounds"
        noncentrality = units * float(np.interp(smallest, *part.norms[:2])) if np.isfinite(smallest) else np.inf
        out.append(Smallest(smallest, limits, limit, noncentrality))
    return out


def fit_deviations(model: LinearModel, config: RehearsalConfig) -> np.ndarray:
    """Return the standard deviation [K] of each coefficient fitted with all base parameters; inf without signal.

    The noise of blocks is not white, so its deviation is that of draws.
    """
    sensitivities = model.projected_by_prior
    size = np.linalg.norm(sensitivities, axis=1)
    noise = np.full(len(size), model.repeats**-0.5)
    if not model.repeated:
        drawn = model.train.noise(config.draws, np.random.default_rng([config.seed, 4]))
        noise = np.std(drawn @ _units(sensitivities).T, axis=0)
    return np.where(size * model.repeats**0.5 > 1e-12, noise / np.maximum(size, 1e-30), np.inf)


def _typical_size(part: Unabsorbed, units: float, config: RehearsalConfig) -> float:
    """The size at which a direction has about the noncentrality of a score test's threshold."""
    size = float(part.size_of(np.array(config.typical_noncentrality / units)))
    return size if np.isfinite(size) else float(part.norms[0][-1])


def discrepancy_crossings(model: LinearModel, k: int, part: Unabsorbed, config: RehearsalConfig) -> np.ndarray:
    """Return the size [R] of direction k above which U exceeds the time step's error, on both parts, of each draw.

    U is an estimate: with noncentrality l and g standard normal, N M U is (l + g)^2 plus products of M residuals of
    noise, whose deviation is sqrt(2 M).  There is no such threshold for blocks, whose U includes the noise.
    """
    if not model.repeated:
        return np.zeros(config.draws)
    rng, step_error, out = np.random.default_rng([config.seed, 3, k]), model.step_error, np.zeros(config.draws)
    recordings: tuple[tuple[Literal["train", "validation"], float, float], ...] = (
        ("train", FIRST_ORDER_RATIO, model.repeats),
        ("validation", 1.0, model.judging_repeats),
    )
    for name, factor, count in recordings:
        residuals = float((model.train if name == "train" else model.validation).rows.counted.sum())
        along, products = rng.normal(size=(2, config.draws))
        threshold = count * residuals * factor * step_error - np.sqrt(2 * residuals) * products
        needed = np.sqrt(np.maximum(along**2 + threshold, 0.0)) - along
        out = np.maximum(out, part.size_of(np.maximum(needed, 0.0) / count**0.5, name))
    return out


Rejects = Callable[[np.ndarray], np.ndarray]  # noncentralities [R] -> [R] bool, whether each draw's test rejects


@dataclass(frozen=True, eq=False)
class ScoreDraws:
    """Scores of drawn noise, and the score test on them.

    tests: (number of an effect, significance) -> whether the test rejects, as a function of the noncentrality.
    config: of the rehearsal.
    """

    tests: Callable[[int, float], Rejects]
    config: RehearsalConfig

    def crossings(self, k: int, significance: float) -> np.ndarray:
        """Return the noncentrality [R] of effect k above which each draw's score test rejects; inf if it never does."""
        return _crossings(self.tests(k, significance), self.config)


def _crossings(passes: Rejects, config: RehearsalConfig) -> np.ndarray:
    """[R] noncentrality above which each draw's test passes, by bisection; inf if it does not at the largest one."""
    low, high = np.full(config.draws, config.least_noncentrality), np.full(config.draws, config.most_noncentrality)
    at_largest = passes(high)
    for _ in range(HALVINGS):
        middle = np.sqrt(low * high)
        passed = passes(middle)
        low, high = np.where(passed, low, middle), np.where(passed, middle, high)
    return np.where(at_largest, high, np.inf)


def representatives(unit: np.ndarray, close: float) -> np.ndarray:
    """Return numbers of unit vectors [K, M] that every other vector is close to one of, by absolute cosine."""
    cosines, chosen = np.abs(unit @ unit.T), list[int]()
    for k in np.flatnonzero(np.diag(cosines) > 0.5).tolist():
        if not chosen or cosines[k, chosen].max() < close:
            chosen.append(k)
    return np.array(chosen, int)


def score_draws(model: LinearModel, config: RehearsalConfig, effects: np.ndarray) -> ScoreDraws:
    """Draw noise for the score test of a linear model; effects: [A, M] their unabsorbed residuals."""
    rows, unit = model.tested.rows, _units(np.concatenate([model.projected(), effects]))
    directions, rng = representatives(unit[: -len(effects)], config.close), np.random.default_rng([config.seed, 1])
    if isinstance(rows, Repeats):
        return _of_repeats(model, unit, len(effects), directions, rng, config)
    assert isinstance(rows, Blocks)
    return _of_blocks(model, rows, unit, len(effects), directions, rng, config)


def _units(vectors: np.ndarray) -> np.ndarray:
    """Rows scaled to norm one; zero rows stay zero."""
    size = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
    return np.where(size > 1e-12, vectors / size, 0.0)


def scatter(rows: Repeats, unit: np.ndarray, pooling: float) -> np.ndarray:
    """Return the deviation [K] of one repeat's score of unit directions [K, M]; 1 if the noise is white.

    Few repeats determine it poorly, so each is shrunk towards the median of all, with `pooling` degrees of freedom.
    """
    if rows.units < 3:
        return np.ones(len(unit))
    scores = detrended((unit @ rows.deviations.T).T)
    variance = scores.var(axis=0, ddof=1)
    nonzero = variance > 0
    if not nonzero.any():
        return np.ones(len(unit))
    degrees_of_freedom = rows.units - 2
    pooled = float(np.median(variance[nonzero]))
    return np.sqrt((degrees_of_freedom * variance + pooling * pooled) / (degrees_of_freedom + pooling))


def _some_flips(count: int, config: RehearsalConfig) -> np.ndarray:
    """The search's sign flips of so many units, or a random subset of them.

    If all flips of few units are enumerated, the first ones never flip the last units.
    """
    flips = sign_flips(count, config.seed)
    some = np.random.default_rng([config.seed, 5]).permutation(len(flips) - 1)[: config.flips - 1]
    return flips[np.r_[0, 1 + np.sort(some)]]


def _of_repeats(
    model: LinearModel,
    unit: np.ndarray,
    effects: int,
    directions: np.ndarray,
    rng: np.random.Generator,
    config: RehearsalConfig,
) -> ScoreDraws:
    """The same test as `statistics.largest_detrended_t`: t increases with mean^2 over the mean square of the scores.

    An effect adds a constant to all scores of a direction.  So the flipped means are linear in its size, and those of
    the noise are computed once for all sizes.

    unit: [K + A, M] directions and effects of norm one.  effects: A.  directions: numbers of those in the statistic.
    """
    count, rows = model.repeats, model.train.rows
    assert isinstance(rows, Repeats)
    deviation = scatter(rows, unit, config.pooling)
    gram = unit @ unit.T
    value, vector = np.linalg.eigh(gram)
    positive = value > 1e-9 * max(value.max(initial=0.0), 1e-30)
    root = deviation[:, None] * vector[:, positive] * np.sqrt(value[positive])  # [K, r]
    drawn = rng.normal(size=(config.draws, int(positive.sum()), count))
    flips = _some_flips(count, config)
    mean_flip = flips.mean(axis=1)[:, None, None].astype(np.float32)
    unflipped, flipped = scipy.stats.t(max(count - 2, 1)), scipy.stats.t(count - 1)

    def of_noise(numbers: np.ndarray) -> tuple[np.ndarray, ...]:
        """[F, R, S] flipped means of the noise of S directions, [R, S] its means and mean squares."""
        noise = np.einsum("sr,drn->dsn", root[numbers], drawn, optimize=True)
        scores = np.moveaxis(detrended(np.moveaxis(noise, 2, 0)), 0, 2)
        means = np.tensordot(flips, scores, (1, 2)) / count
        return tuple(a.astype(np.float32) for a in (means, scores.mean(axis=2), np.mean(scores**2, axis=2)))

    def shares(means: np.ndarray, mean: np.ndarray, square: np.ndarray, added: np.ndarray) -> np.ndarray:
        return (means + mean_flip * added) ** 2 / np.maximum(square + 2 * added * mean + added**2, 1e-30)

    means, mean, square = of_noise(directions)
    without_effect = shares(means, mean, square, np.zeros_like(mean))

    def tests(number: int, significance: float) -> Rejects:
        k = len(unit) - effects + number
        related = np.abs(gram[directions, k]) > config.unrelated
        unrelated = without_effect[:, :, ~related].max(axis=2, initial=0.0)
        of_effect = of_noise(np.array([k]))
        both = zip((means, mean, square), of_effect, strict=True)
        all_means, all_mean, all_square = (np.concatenate([a[..., related], b], axis=-1) for a, b in both)
        unit_added = (gram[np.r_[directions[related], k], k] / np.sqrt(count)).astype(np.float32)

        def rejects(strength: np.ndarray) -> np.ndarray:
            added = strength[:, None].astype(np.float32) * unit_added
            largest = np.maximum(unrelated, shares(all_means, all_mean, all_square, added).max(axis=2))
            t = np.sqrt((count - 1) * largest[0] / np.maximum(1.0 - largest[0], 1e-30))
            limit = flipped.isf(unflipped.sf(t)) ** 2
            return np.mean(largest >= limit / (count - 1 + limit) * (1 - 1e-12), axis=0) < significance

        return rejects

    return ScoreDraws(tests, config)


def _of_blocks(
    model: LinearModel,
    rows: Blocks,
    unit: np.ndarray,
    effects: int,
    directions: np.ndarray,
    rng: np.random.Generator,
    config: RehearsalConfig,
) -> ScoreDraws:
    """The score test of blocks, whose scores are linear in an effect's size; arguments as in `_of_repeats`."""
    count, prior = rows.units, model.prior * model.slack
    flips = _some_flips(count, config)
    squares = rows.flipped_sizes(unit, model.tested.base, prior, flips)  # [F, K]
    members = [np.flatnonzero(rows.block == b) for b in range(count)]
    drawn = model.tested.noise(config.draws, rng)

    def of_rows(vectors: np.ndarray, other: np.ndarray) -> np.ndarray:
        """[A, B, N] products of rows of two sets of vectors, block by block, scaled as in `Blocks.residuals`."""
        return count * np.stack([vectors[:, i] @ other[:, i].T for i in members], axis=2)

    def standardised(numbers: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """[F, A, S] flipped scores of S directions with A vectors."""
        scale = 1.0 / np.sqrt(np.maximum(squares[:, numbers], 1e-30)) / count  # [F, S]
        return np.tensordot(flips, of_rows(vectors, unit[numbers]), (1, 2)) * scale[:, None]

    noise = standardised(directions, drawn)

    def tests(number: int, significance: float) -> Rejects:
        k = len(unit) - effects + number
        added = standardised(directions, unit[[k]])
        related = np.abs(added).max(axis=(0, 1)) > config.unrelated
        unrelated = np.abs(noise[:, :, ~related]).max(axis=2, initial=0.0)
        effect = np.array([k])
        of_noise = np.concatenate([noise[:, :, related], standardised(effect, drawn)], axis=2)
        per_strength = np.concatenate([added[:, :, related], standardised(effect, unit[[k]])], axis=2)

        def rejects(strength: np.ndarray) -> np.ndarray:
            largest = np.maximum(unrelated, np.abs(of_noise + strength[:, None] * per_strength).max(axis=2))
            return np.mean(largest >= largest[0] * (1 - 1e-12), axis=0) < significance

        return rejects

    return ScoreDraws(tests, config)


def gain_crossings(
    model: LinearModel, number: int, added: np.ndarray, config: RehearsalConfig, search: DiscrepancyConfig
) -> np.ndarray:
    """Return the norm [R] that an effect must add to the validation residual, for each draw's test to confirm it.

    The gain must be significant, and for blocks U must fall by the search's share.

    Args:
        model: the linear model.
        number: of the effect, for the seed.
        added: [M] change of the validation residual by the effect, of any size.
        config: of the rehearsal.
        search: the search's thresholds.
    """
    rows, rng = model.validation.rows, np.random.default_rng([config.seed, 2, number])
    size = float(np.linalg.norm(added))
    if size < 1e-12:
        return np.full(config.draws, np.inf)
    if isinstance(rows, Repeats):
        return _repeats_gain(model, rows, added / size, config, search, rng)
    assert isinstance(rows, Blocks)
    return _blocks_gain(model, rows, added / size, config, search, rng)


def _repeats_gain(
    model: LinearModel,
    rows: Repeats,
    unit: np.ndarray,
    config: RehearsalConfig,
    search: DiscrepancyConfig,
    rng: np.random.Generator,
) -> np.ndarray:
    """The mean gain of the repeats must be above zero by Student's t of their detrended scatter.

    With the effect's residual a m, m of norm one, and noise e, the gain of a repeat is a m.e + a^2 / 2.
    """
    count = max(2, round(model.judging_repeats))
    noise = scatter(rows, unit[None], config.pooling)[0] * rng.normal(size=(config.draws, count))
    scores = detrended(noise.T).T
    threshold = scipy.stats.t(max(count - 2, 1)).isf(search.selection.confirmation)
    return np.maximum(2 * (threshold * scores.std(axis=1, ddof=1) / count**0.5 - scores.mean(axis=1)), 0.0)


def _blocks_gain(
    model: LinearModel,
    rows: Blocks,
    unit: np.ndarray,
    config: RehearsalConfig,
    search: DiscrepancyConfig,
    rng: np.random.Generator,
) -> np.ndarray:
    """The same by sign flips of blocks; and U, which includes the noise, must fall by `least_gain`.

    The search requires a smaller share if no further effect is found, as in the linear model, where only one is hidden.
    """
    count, share = rows.units, search.blocks.least_gain
    squares = np.array([np.sum(unit[rows.block == b] ** 2) for b in range(count)])
    level = model.validation.level * rows.counted.sum()
    by_share = np.sqrt(share / (1 - share) * level)
    drawn = model.validation.noise(config.draws, rng) * unit
    noise = np.stack([drawn[:, rows.block == b].sum(axis=1) for b in range(count)], axis=1)
    flips = sign_flips(count, config.seed, one_sided=True)
    flips = np.r_[flips[:1], rng.permutation(flips[1:])[: config.flips]]

    def passes(size: np.ndarray) -> np.ndarray:
        gains = 0.5 * size[:, None] ** 2 * squares + size[:, None] * noise
        t = t_values(gains, flips)
        return np.mean(t >= t[0] - 1e-12, axis=0) < search.selection.confirmation

    return np.maximum(_crossings(passes, config), by_share)
