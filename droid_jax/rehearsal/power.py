"""Which size of an effect the search's own tests find, in a linear model.

The score test and the validation test of the search are made on drawn noise, with its own sign flips, thresholds and
block structure.  Only the replays are left out.
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
from droid_jax.rehearsal.linear import Leftover, LinearModel, RehearsalConfig, leftover, unhindered

LEAST, MOST = 0.2, 80.0  # noncentralities between which the smallest size is looked for
HALVINGS = 8
USUAL = 7.0  # noncentrality that a score test over many directions asks for, more or less
BESIDE = 0.05  # cosine below which a direction's score is taken not to see another one


@dataclass(frozen=True)
class Smallest:
    """The smallest size of one coefficient that is found often enough.

    size: in the coefficient's unit, with the margin; inf where none within its bounds is.  limits: what each condition
    alone asks for, without it.
    limit: the one that decides.  noncentrality: of `size` in the score test.
    """

    size: float
    limits: Mapping[str, float]
    limit: str
    noncentrality: float


def smallest_sizes(
    model: LinearModel, wanted: Sequence[int], config: RehearsalConfig, search: DiscrepancyConfig | None = None
) -> list[Smallest]:
    """The smallest size of each wanted direction that the score test and the validation test find.

    Args:
        model: the linear model.
        wanted: indices of directions.
        config: of the rehearsal.
        search: the search's thresholds.
    """
    search = search or DiscrepancyConfig()
    units = model.repeats**0.5 if model.repeated else 1.0
    gate = "train" if model.repeated else "both"  # blocks that train and validate are tested together
    left = [leftover(model, k) for k in wanted]
    about = np.array([_about(of, units) for of in left])
    rows = [of.at(size) for of, size in zip(left, about, strict=True)]
    asked = [train if model.repeated else train + validation for train, validation in rows]
    scores = score_draws(model, config, np.array(asked).reshape(len(rows), -1))
    spread, out = fit_deviations(model, config), list[Smallest]()
    for i, (k, of) in enumerate(zip(wanted, left, strict=True)):
        if not np.isfinite(spread[k]) or of.norms[1][-1] < 1e-12:
            out.append(Smallest(np.inf, {}, "no signal", np.nan))
            continue
        often = max(float(scipy.stats.norm.ppf(config.share)), 0.0)
        surely = float(scipy.stats.norm.ppf(0.5 * (1 + search.selection.interval_level)))
        drawn = {
            "score test": of.size_of(scores.crossings(i, search.selection.significance) / units, gate),
            "validation": of.size_of(gain_crossings(model, i, rows[i][1], config, search), "validation"),
            "time step": discrepancy_crossings(model, k, of, config),
        }
        fixed = {
            "minimum effect size": float(model.minimum[k]) + often * spread[k],
            "interval": (surely + often) * spread[k],
            "weak imitation": unhindered(model, k, config.share),
        }
        limits = {name: float(np.quantile(a, config.share, method="higher")) for name, a in drawn.items()} | fixed
        each = np.maximum(np.max(list(drawn.values()), axis=0), max(fixed.values()))
        found = config.margin * float(np.quantile(each, config.share, method="higher"))
        limit = max(limits, key=limits.__getitem__)
        if not found <= model.largest[k]:
            found, limit = np.inf, "beyond its bounds"
        noncentrality = units * float(np.interp(found, *of.norms[:2])) if np.isfinite(found) else np.inf
        out.append(Smallest(found, limits, limit, noncentrality))
    return out


def fit_deviations(model: LinearModel, config: RehearsalConfig) -> np.ndarray:
    """[K] by how much noise moves the fitted size of each coefficient, beside all base parameters; inf without signal.

    That of blocks is not white: it is drawn.
    """
    sensitivities = model.loosest
    size = np.linalg.norm(sensitivities, axis=1)
    noise = np.full(len(size), model.repeats**-0.5)
    if not model.repeated:
        drawn = model.train.noise(config.draws, np.random.default_rng([config.seed, 4]))
        noise = np.std(drawn @ _units(sensitivities).T, axis=0)
    return np.where(size * model.repeats**0.5 > 1e-12, noise / np.maximum(size, 1e-30), np.inf)


def _about(of: Leftover, units: float) -> float:
    """The size at which a direction has the noncentrality that a score test asks for, more or less."""
    size = float(of.size_of(np.array(USUAL / units)))
    return size if np.isfinite(size) else float(of.norms[0][-1])


def discrepancy_crossings(model: LinearModel, k: int, of: Leftover, config: RehearsalConfig) -> np.ndarray:
    """[R] size of direction k from which U is above what the time step leaves, on both parts.

    U is estimated: with noncentrality l, N M U is (l + g)^2 and the products of M residuals of noise, whose deviation
    is sqrt(2 M).  Blocks have no such threshold: their U holds the noise.
    """
    if not model.repeated:
        return np.zeros(config.draws)
    rng, step_error, out = np.random.default_rng([config.seed, 3, k]), model.step_error, np.zeros(config.draws)
    parts: tuple[tuple[Literal["train", "validation"], float, float], ...] = (
        ("train", FIRST_ORDER_RATIO, model.repeats),
        ("validation", 1.0, model.judging_repeats),
    )
    for part, factor, count in parts:
        residuals = float((model.train if part == "train" else model.validation).rows.counted.sum())
        along, beside = rng.normal(size=(2, config.draws))
        least = count * residuals * factor * step_error - np.sqrt(2 * residuals) * beside
        needed = np.sqrt(np.maximum(along**2 + least, 0.0)) - along
        out = np.maximum(out, of.size_of(np.maximum(needed, 0.0) / count**0.5, part))
    return out


Rejects = Callable[[np.ndarray], np.ndarray]  # noncentralities [R] -> [R] bool, whether each draw's test rejects


@dataclass(frozen=True, eq=False)
class ScoreDraws:
    """Scores of drawn noise, and the score test on them.

    tests: number of an asked direction and a significance -> the test, as its noncentrality grows.  draws: R.
    """

    tests: Callable[[int, float], Rejects]
    draws: int

    def crossings(self, k: int, significance: float) -> np.ndarray:
        """[R] noncentrality of asked direction k from which each draw's score test rejects; inf where none does."""
        return _crossings(self.tests(k, significance), self.draws)


def _crossings(passes: Rejects, draws: int) -> np.ndarray:
    """[R] noncentrality from which each draw's test passes, by halving between LEAST and MOST; inf where none does."""
    low, high = np.full(draws, LEAST), np.full(draws, MOST)
    ends = passes(high)
    for _ in range(HALVINGS):
        middle = np.sqrt(low * high)
        yes = passes(middle)
        low, high = np.where(yes, low, middle), np.where(yes, middle, high)
    return np.where(ends, high, np.inf)


def representatives(unit: np.ndarray, close: float) -> np.ndarray:
    """Indices of unit vectors [K, M] of which each other one is close to one, by absolute cosine."""
    cosines, kept = np.abs(unit @ unit.T), list[int]()
    for k in np.flatnonzero(np.diag(cosines) > 0.5).tolist():
        if not kept or cosines[k, kept].max() < close:
            kept.append(k)
    return np.array(kept, int)


def score_draws(model: LinearModel, config: RehearsalConfig, asked: np.ndarray) -> ScoreDraws:
    """Noise of the score test of a linear model, drawn `config.draws` times; asked: [A, M] what effects leave."""
    rows, unit = model.tested.rows, _units(np.concatenate([model.projected(), asked]))
    shown, rng = representatives(unit[: -len(asked)], config.close), np.random.default_rng([config.seed, 1])
    if isinstance(rows, Repeats):
        return _of_repeats(model, unit, len(asked), shown, rng, config)
    assert isinstance(rows, Blocks)
    return _of_blocks(model, rows, unit, len(asked), shown, rng, config)


def _units(vectors: np.ndarray) -> np.ndarray:
    """Rows of length one, or zero."""
    size = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
    return np.where(size > 1e-12, vectors / size, 0.0)


def scatter(rows: Repeats, unit: np.ndarray, pooling: float) -> np.ndarray:
    """[K] deviation of one repeat's score of unit directions [K, M], as the repeats scatter; one where noise is white.

    Few repeats say little of one direction, so each is drawn towards all of them.
    """
    if rows.units < 3:
        return np.ones(len(unit))
    scores = detrended((unit @ rows.deviations.T).T)
    own = scores.var(axis=0, ddof=1)
    present = own > 0
    if not present.any():
        return np.ones(len(unit))
    freedom = rows.units - 2
    pooled = float(np.median(own[present]))
    return np.sqrt((freedom * own + pooling * pooled) / (freedom + pooling))


def _some_flips(count: int, config: RehearsalConfig) -> np.ndarray:
    """The search's sign flips of so many units, or some of them.

    All of few units stand in order: the first of them would never turn the last units.
    """
    flips = sign_flips(count, config.seed)
    some = np.random.default_rng([config.seed, 5]).permutation(len(flips) - 1)[: config.flips - 1]
    return flips[np.r_[0, 1 + np.sort(some)]]


def _of_repeats(
    model: LinearModel,
    unit: np.ndarray,
    asked: int,
    shown: np.ndarray,
    rng: np.random.Generator,
    config: RehearsalConfig,
) -> ScoreDraws:
    """As `statistics.largest_detrended_t`, whose t grows with the share of its mean in a row's mean square.

    An effect adds a constant to a row, so a flipped mean is linear in it, and is worked out once for all sizes.
    """
    count, rows = model.repeats, model.train.rows
    assert isinstance(rows, Repeats)
    deviation = scatter(rows, unit, config.pooling)
    gram = unit @ unit.T
    value, vector = np.linalg.eigh(gram)
    kept = value > 1e-9 * max(value.max(initial=0.0), 1e-30)
    root = deviation[:, None] * vector[:, kept] * np.sqrt(value[kept])  # [K, r]
    drawn = rng.normal(size=(config.draws, int(kept.sum()), count))
    flips = _some_flips(count, config)
    balance = flips.mean(axis=1)[:, None, None].astype(np.float32)
    own, flipped = scipy.stats.t(max(count - 2, 1)), scipy.stats.t(count - 1)

    def of_noise(directions: np.ndarray) -> tuple[np.ndarray, ...]:
        """[F, R, S] flipped means of the noise of S directions, [R, S] its means and mean squares."""
        noise = np.einsum("sr,drn->dsn", root[directions], drawn, optimize=True)
        straight = np.moveaxis(detrended(np.moveaxis(noise, 2, 0)), 0, 2)
        means = np.tensordot(flips, straight, (1, 2)) / count
        return tuple(a.astype(np.float32) for a in (means, straight.mean(axis=2), np.mean(straight**2, axis=2)))

    def shares(means: np.ndarray, mean: np.ndarray, square: np.ndarray, added: np.ndarray) -> np.ndarray:
        return (means + balance * added) ** 2 / np.maximum(square + 2 * added * mean + added**2, 1e-30)

    means, mean, square = of_noise(shown)
    quiet = shares(means, mean, square, np.zeros_like(mean))

    def tests(number: int, significance: float) -> Rejects:
        k = len(unit) - asked + number
        near = np.abs(gram[shown, k]) > BESIDE
        others = quiet[:, :, ~near].max(axis=2, initial=0.0)
        mine = of_noise(np.array([k]))
        both = zip((means, mean, square), mine, strict=True)
        flipped_means, own_mean, own_square = (np.concatenate([a[..., near], b], axis=-1) for a, b in both)
        unit_added = (gram[np.r_[shown[near], k], k] / np.sqrt(count)).astype(np.float32)

        def rejects(strength: np.ndarray) -> np.ndarray:
            added = strength[:, None].astype(np.float32) * unit_added
            largest = np.maximum(others, shares(flipped_means, own_mean, own_square, added).max(axis=2))
            t = np.sqrt((count - 1) * largest[0] / np.maximum(1.0 - largest[0], 1e-30))
            limit = flipped.isf(own.sf(t)) ** 2
            return np.mean(largest >= limit / (count - 1 + limit) * (1 - 1e-12), axis=0) < significance

        return rejects

    return ScoreDraws(tests, config.draws)


def _of_blocks(
    model: LinearModel,
    rows: Blocks,
    unit: np.ndarray,
    asked: int,
    shown: np.ndarray,
    rng: np.random.Generator,
    config: RehearsalConfig,
) -> ScoreDraws:
    count, held = rows.units, model.prior * model.slack
    flips = _some_flips(count, config)
    left = rows.flipped_sizes(unit, model.tested.base, held, flips)  # [F, K]
    inside = [np.flatnonzero(rows.block == b) for b in range(count)]
    drawn = model.tested.noise(config.draws, rng)

    def of_rows(vectors: np.ndarray, other: np.ndarray) -> np.ndarray:
        """[A, B, N] products of rows of two sets of vectors, block by block, as `Blocks.residuals` scales them."""
        return count * np.stack([vectors[:, i] @ other[:, i].T for i in inside], axis=2)

    def standardised(directions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """[F, A, S] flipped scores of S directions with A vectors."""
        scale = 1.0 / np.sqrt(np.maximum(left[:, directions], 1e-30)) / count  # [F, S]
        return np.tensordot(flips, of_rows(vectors, unit[directions]), (1, 2)) * scale[:, None]

    noise = standardised(shown, drawn)

    def tests(number: int, significance: float) -> Rejects:
        k = len(unit) - asked + number
        added = standardised(shown, unit[[k]])
        near = np.abs(added).max(axis=(0, 1)) > BESIDE
        others = np.abs(noise[:, :, ~near]).max(axis=2, initial=0.0)
        mine = np.array([k])
        beside = np.concatenate([noise[:, :, near], standardised(mine, drawn)], axis=2)
        grows = np.concatenate([added[:, :, near], standardised(mine, unit[[k]])], axis=2)

        def rejects(strength: np.ndarray) -> np.ndarray:
            largest = np.maximum(others, np.abs(beside + strength[:, None] * grows).max(axis=2))
            return np.mean(largest >= largest[0] * (1 - 1e-12), axis=0) < significance

        return rejects

    return ScoreDraws(tests, config.draws)


def gain_crossings(
    model: LinearModel, number: int, added: np.ndarray, config: RehearsalConfig, search: DiscrepancyConfig
) -> np.ndarray:
    """[R] how much an effect must add to the validation part for the gain to be no chance and to take its share of U.

    added: [M] what it adds there, of any size.
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
    """Gains a m.e + a^2 m.m / 2 of each repeat are above zero by Student's t of their detrended scatter."""
    count = max(2, round(model.judging_repeats))
    noise = scatter(rows, unit[None], config.pooling)[0] * rng.normal(size=(config.draws, count))
    straight = detrended(noise.T).T
    least = scipy.stats.t(max(count - 2, 1)).isf(search.selection.confirmation)
    return np.maximum(2 * (least * straight.std(axis=1, ddof=1) / count**0.5 - straight.mean(axis=1)), 0.0)


def _blocks_gain(
    model: LinearModel,
    rows: Blocks,
    unit: np.ndarray,
    config: RehearsalConfig,
    search: DiscrepancyConfig,
    rng: np.random.Generator,
) -> np.ndarray:
    """The same by sign flips of blocks; and U, which holds the noise, must fall by its share.

    An effect that is hidden alone leaves nothing to find, so the smaller of the search's two shares is asked for.
    """
    count, share = rows.units, search.blocks.least_gain
    squares = np.array([np.sum(unit[rows.block == b] ** 2) for b in range(count)])
    level = model.validation.level * rows.counted.sum()
    least = np.sqrt(share / (1 - share) * level)
    drawn = model.validation.noise(config.draws, rng) * unit
    noise = np.stack([drawn[:, rows.block == b].sum(axis=1) for b in range(count)], axis=1)
    flips = sign_flips(count, config.seed, one_sided=True)
    flips = np.r_[flips[:1], rng.permutation(flips[1:])[: config.flips]]

    def passes(size: np.ndarray) -> np.ndarray:
        gains = 0.5 * size[:, None] ** 2 * squares + size[:, None] * noise
        t = t_values(gains, flips)
        return np.mean(t >= t[0] - 1e-12, axis=0) < search.selection.confirmation

    return np.maximum(_crossings(passes, len(noise)), least)
