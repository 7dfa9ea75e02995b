"""Which size of an effect the search's own tests find, in a model that is linear in parameters and effects.

The score test and the validation test of the search are made on drawn noise, with its own sign flips, thresholds and
block structure.  Only the replays are left out: an effect adds its sensitivity times its size to the residual, and the
base parameters absorb what they can of it.  Whitened noise has a deviation of one in each repeat.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy.stats
from scipy.optimize import lsq_linear

from droid_jax.arguments import check_fields, number, weights, whole
from droid_jax.discrepancy.candidates import ScoreDirection, project
from droid_jax.discrepancy.config import DiscrepancyConfig, SelectionConfig
from droid_jax.discrepancy.fitting import WORST
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling, detrended, sign_flips, t_values
from droid_jax.model.effects.candidate import EffectKey
from droid_jax.recordings.split import FEWEST_REPEATS

LEAST, MOST = 1.5, 80.0  # noncentralities between which the smallest size is looked for
HALVINGS = 8
CHUNK = 4e6  # numbers of a batch of flips


def _assumed() -> dict[str, float]:
    return {"torque": 0.05, "position": 1e-4, "velocity": 0.01, "object_angle": 0.0035}


@dataclass(frozen=True)
class RehearsalConfig:
    """What counts as found, and what is assumed where nothing was measured.

    share: of rehearsals in which an effect must be found.
    draws: of noise, over which that share is taken.
    flips: sign flips of a score test at most; the search itself makes up to 4096.
    close: absolute cosine of two sensitivities from which one stands for both in the largest statistic.
    recovered: posterior deviation over prior deviation up to which a parameter counts as recovered; None: that of
      `IdentifiabilityConfig`.
    pooling: degrees of freedom with which the scatter of all directions counts in each one's own.
    noise: channel -> deviation of one sample, in its unit, where it was neither measured nor stated; torque,
      position and camera are those of a Panda.
    faster: how many times as fast the other motion is.
    seed: of the draws.
    """

    share: float = 0.9
    draws: int = 48
    flips: int = 512
    close: float = 0.97
    recovered: float | None = None
    pooling: float = 12.0
    noise: dict[str, float] = field(default_factory=_assumed)
    faster: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(
            self,
            share=partial(number, above=0, below=1),
            draws=partial(whole, least=8),
            flips=partial(whole, least=100),
            close=partial(number, above=0, most=1),
            pooling=partial(number, above=0),
            noise=weights,
            faster=partial(number, above=0),
            seed=partial(whole, least=0),
        )


@dataclass(frozen=True, eq=False)
class LinearPart:
    """One part of the recordings (training or validation) in a linear model.

    raw: [K, M] what a unit of each coefficient adds, in noise units of one repeat.  base: [M, D] what a search unit of
    each base parameter adds.  rows: what is resampled.  channel: [M] name of the channel of each residual.
    level: mean square of the residual where nothing is missing, of rows that are blocks.
    """

    raw: np.ndarray
    base: np.ndarray
    rows: Resampling
    channel: np.ndarray
    level: float = 0.0

    def of(self, channels: Sequence[str]) -> LinearPart:
        """The same of some channels."""
        kept = np.isin(self.channel, channels)
        rows = (
            Repeats(self.rows.deviations[:, kept]) if isinstance(self.rows, Repeats) else Blocks(self.rows.block[kept])  # type: ignore[attr-defined]
        )
        return replace(self, raw=self.raw[:, kept], base=self.base[kept], rows=rows, channel=self.channel[kept])


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A linear model of a search.

    directions: K coefficients.  train, validation: parts.  prior: [D] deviations of the base parameters' priors in a
    fit, search units.  slack: times these that the score test lets parameters move.  repeats: N that are rehearsed; of
    blocks how many times the recording's own length, times its blocks.
    step_error: U0.  minimum: [K] minimum effect size.  low, high: [K] bounds of each coefficient, from neutral on.
    """

    directions: tuple[ScoreDirection, ...]
    train: LinearPart
    validation: LinearPart
    prior: np.ndarray
    slack: float
    repeats: int
    step_error: float
    minimum: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def room(self) -> np.ndarray:
        """[K] largest size of each coefficient: upwards, or downwards where neutral is the upper bound."""
        return np.where(self.high > 0, self.high, -self.low)

    @property
    def sign(self) -> np.ndarray:
        """[K] direction that a size counts in."""
        return np.where(self.high > 0, 1.0, -1.0)

    @property
    def repeated(self) -> bool:
        """Whether rows are repeats."""
        return self.train.rows.repeated

    def of(self, channels: Sequence[str]) -> LinearModel:
        """The same with some channels compared."""
        return replace(self, train=self.train.of(channels), validation=self.validation.of(channels))

    def projected(self) -> np.ndarray:
        """[K, M] sensitivities of the training part, as the score test has them."""
        return project(self.train.raw, self.train.base, self._held(self.slack))

    def unabsorbed(self) -> np.ndarray:
        """[K, M] what a unit adds to the validation part once the base is fitted to the training part."""
        base, held = self.train.base, self._held(1.0)
        normal = base.T @ base + np.diag(held**-2)
        absorbed = np.linalg.solve(normal, base.T @ self.train.raw.T)  # [D, K]
        return self.validation.raw - (self.validation.base @ absorbed).T

    def _held(self, slack: float) -> np.ndarray:
        """[D] prior deviations beside the residual of one repeat, or of the whole log."""
        return self.prior * slack * (self.repeats**0.5 if self.repeated else 1.0)


@dataclass(frozen=True)
class Smallest:
    """The smallest size of one coefficient that is found often enough.

    size: in the coefficient's unit; inf where none within its bounds is.  score, gain, minimum, step: what each
    condition alone asks for; noncentrality: of `size` in the score test.  limit: which of them decides.
    """

    size: float
    score: float
    gain: float
    minimum: float
    step: float
    noncentrality: float
    limit: str


def smallest_sizes(
    model: LinearModel, wanted: Sequence[int], config: RehearsalConfig, selection: SelectionConfig | None = None
) -> list[Smallest]:
    """The smallest size of each wanted direction that the score test and the validation test find.

    Args:
        model: the linear model.
        wanted: indices of directions.
        config: of the rehearsal.
        selection: the search's thresholds.
    """
    selection = selection or SelectionConfig()
    scores, gains = score_draws(model, config), gain_draws(model, config)
    projected, size = scores.projected, np.linalg.norm(scores.projected, axis=1)
    units = model.repeats**0.5 if model.repeated else 1.0
    share = float(model.train.rows.counted.sum()) * WORST * model.step_error
    out = []
    for k in wanted:
        strength = float(size[k]) * units  # noncentrality of a unit
        if strength < 1e-12 or not np.isfinite(projected[k]).all():
            out.append(Smallest(np.inf, np.inf, np.inf, float(model.minimum[k]), np.inf, np.nan, "no signal"))
            continue
        by_score = scores.crossings(k, selection.significance) / strength
        by_gain = gains.crossings(k, selection)
        spread = max(float(scipy.stats.norm.ppf(config.share)), 0.0) / strength  # of the fitted size
        least, step = float(model.minimum[k]) + spread, float(np.sqrt(share) / size[k])
        each = np.maximum(np.maximum(by_score, by_gain), max(least, step))
        found = float(np.quantile(each, config.share, method="higher"))
        alone = {name: float(np.quantile(a, config.share, method="higher")) for name, a in
                 (("score test", by_score), ("validation", by_gain))}  # fmt: skip
        limits = {**alone, "minimum effect size": least, "time step": step}
        limit = max(limits, key=lambda name: limits[name])
        if found > model.room[k]:
            found, limit = np.inf, "beyond its bounds" if np.isfinite(found) else limit
        out.append(Smallest(found, alone["score test"], alone["validation"], least, step, found * strength, limit))
    return out


@dataclass(frozen=True, eq=False)
class ScoreDraws:
    """Scores of drawn noise, and the score test on them.

    projected: [K, M] sensitivities.  shown: representatives of the K directions.
    own: direction -> [R, S, N] noise of the scores of the representatives and of itself, and what a unit of its
    noncentrality adds to them.  p_values: such scores and the S directions -> [R] p of the largest.
    """

    projected: np.ndarray
    shown: np.ndarray
    own: Callable[[int], tuple[np.ndarray, np.ndarray]]
    p_values: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def crossings(self, k: int, significance: float) -> np.ndarray:
        """[R] noncentrality of direction k from which each draw's score test rejects; inf where none does."""
        noise, added = self.own(k)

        def rejects(strength: np.ndarray) -> np.ndarray:
            return self.p_values(noise + strength[:, None, None] * added, np.r_[self.shown, k]) < significance

        low, high = np.full(len(noise), np.log(LEAST)), np.full(len(noise), np.log(MOST))
        ends = rejects(np.exp(high))
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            yes = rejects(np.exp(middle))
            low, high = np.where(yes, low, middle), np.where(yes, middle, high)
        return np.where(ends, np.exp(high), np.inf)


def representatives(unit: np.ndarray, close: float) -> np.ndarray:
    """Indices of unit vectors [K, M] of which each other one is close to one, by absolute cosine."""
    cosines, kept = np.abs(unit @ unit.T), list[int]()
    for k in np.flatnonzero(np.diag(cosines) > 0.5).tolist():
        if not kept or cosines[k, kept].max() < close:
            kept.append(k)
    return np.array(kept, int)


def score_draws(model: LinearModel, config: RehearsalConfig) -> ScoreDraws:
    """Noise of the score test of a linear model, drawn `config.draws` times."""
    rows, projected = model.train.rows, np.nan_to_num(model.projected())
    size = np.maximum(np.linalg.norm(projected, axis=1), 1e-30)
    unit = np.where(size[:, None] > 1e-12, projected / size[:, None], 0.0)
    shown, rng = representatives(unit, config.close), np.random.default_rng([config.seed, 1])
    if isinstance(rows, Repeats):
        return _of_repeats(model, unit, projected, shown, rng, config)
    assert isinstance(rows, Blocks)
    return _of_blocks(model, rows, unit, projected, shown, rng, config)


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


def _of_repeats(
    model: LinearModel,
    unit: np.ndarray,
    projected: np.ndarray,
    shown: np.ndarray,
    rng: np.random.Generator,
    config: RehearsalConfig,
) -> ScoreDraws:
    count, rows = model.repeats, model.train.rows
    assert isinstance(rows, Repeats)
    deviation = scatter(rows, unit, config.pooling)
    gram = unit @ unit.T
    value, vector = np.linalg.eigh(gram)
    kept = value > 1e-9 * max(value.max(initial=0.0), 1e-30)
    root = deviation[:, None] * vector[:, kept] * np.sqrt(value[kept])  # [K, r]
    drawn = rng.normal(size=(config.draws, int(kept.sum()), count))
    flips = sign_flips(count, config.seed)[: config.flips]
    own, flipped = scipy.stats.t(max(count - 2, 1)), scipy.stats.t(count - 1)

    def p_values(scores: np.ndarray, of: np.ndarray) -> np.ndarray:
        """[R] as `statistics.largest_detrended_t` has them, of scores [R, S, N]."""
        straight = np.moveaxis(detrended(np.moveaxis(scores, 2, 0)), 0, 2)
        out = []
        for part in np.array_split(straight, max(1, int(straight.size * len(flips) / count / CHUNK))):
            t = np.abs(t_values(part.reshape(-1, count), flips)).reshape(len(flips), len(part), -1).max(axis=2)
            found = flipped.isf(own.sf(t[0]))
            out.append(np.mean(t >= found * (1 - 1e-12), axis=0))
        return np.concatenate(out)

    def own_scores(k: int) -> tuple[np.ndarray, np.ndarray]:
        of = np.r_[shown, k]
        noise = np.einsum("sr,drn->dsn", root[of], drawn, optimize=True)
        added = gram[of, k] / np.sqrt(count)
        return noise, np.broadcast_to(added[None, :, None], (1, len(of), count))

    return ScoreDraws(projected, shown, own_scores, p_values)


def _of_blocks(
    model: LinearModel,
    rows: Blocks,
    unit: np.ndarray,
    projected: np.ndarray,
    shown: np.ndarray,
    rng: np.random.Generator,
    config: RehearsalConfig,
) -> ScoreDraws:
    count, held = rows.units, model.prior * model.slack
    flips = sign_flips(count, config.seed)[: config.flips]
    left = rows.left_after_flips(unit, model.train.base, held, flips)  # [F, K]
    inside = [np.flatnonzero(rows.block == b) for b in range(count)]
    drawn = rng.normal(size=(config.draws, unit.shape[1])) * rows.counted

    def of_rows(vectors: np.ndarray, other: np.ndarray) -> np.ndarray:
        """[A, B, N] products of rows of two sets of vectors, block by block, as `Blocks.residuals` scales them."""
        return count * np.stack([vectors[:, i] @ other[:, i].T for i in inside], axis=2)

    base_noise = np.swapaxes(of_rows(unit[shown], drawn), 0, 1)  # [R, S, N]

    def p_values(scores: np.ndarray, of: np.ndarray) -> np.ndarray:
        scale = 1.0 / np.sqrt(np.maximum(left[:, of], 1e-30)) / count  # [F, S]
        out = []
        for part in np.array_split(scores, max(1, int(scores.size * len(flips) / count / CHUNK))):
            largest = np.abs(np.einsum("fn,rsn->frs", flips, part, optimize=True) * scale[:, None]).max(axis=2)
            out.append(np.mean(largest >= largest[0] * (1 - 1e-12), axis=0))
        return np.concatenate(out)

    def own_scores(k: int) -> tuple[np.ndarray, np.ndarray]:
        of = np.r_[shown, k]
        noise = np.concatenate([base_noise, np.swapaxes(of_rows(unit[[k]], drawn), 0, 1)], axis=1)
        return noise, of_rows(unit[of], unit[[k]])[:, 0][None]

    return ScoreDraws(projected, shown, own_scores, p_values)


@dataclass(frozen=True, eq=False)
class GainDraws:
    """What the validation test of the search makes of drawn noise.

    added: [K, M] what a unit of each coefficient adds to the validation part.  score: [R, N] drawn, deviation one.
    """

    model: LinearModel
    added: np.ndarray
    config: RehearsalConfig

    def crossings(self, k: int, selection: SelectionConfig) -> np.ndarray:
        """[R] size of direction k from which the gain is no chance and takes its share of U."""
        rows, rng = self.model.validation.rows, np.random.default_rng([self.config.seed, 2, k])
        if isinstance(rows, Repeats):
            return self._of_repeats(rows, k, selection, rng)
        assert isinstance(rows, Blocks)
        return self._of_blocks(rows, k, selection, rng)

    def _of_repeats(self, rows: Repeats, k: int, selection: SelectionConfig, rng: np.random.Generator) -> np.ndarray:
        """Gains a m.e + a^2 m.m / 2 of each repeat are above zero by Student's t of their detrended scatter."""
        size, count = float(np.linalg.norm(self.added[k])), self.model.repeats
        if size < 1e-12:
            return np.full(self.config.draws, np.inf)
        deviation = scatter(rows, self.added[[k]] / size, self.config.pooling)[0]
        noise = deviation * rng.normal(size=(self.config.draws, count))
        straight = detrended(noise.T).T
        least = scipy.stats.t(max(count - 2, 1)).isf(selection.confirmation)
        needed = 2 * (least * straight.std(axis=1, ddof=1) / count**0.5 - straight.mean(axis=1))
        return np.maximum(needed, 0.0) / size

    def _of_blocks(self, rows: Blocks, k: int, selection: SelectionConfig, rng: np.random.Generator) -> np.ndarray:
        """The same by sign flips of blocks; and U, which holds the noise, must fall by its share."""
        added, count = self.added[k], rows.units
        squares = np.array([np.sum(added[rows.block == b] ** 2) for b in range(count)])
        total = float(squares.sum())
        if total < 1e-24:
            return np.full(self.config.draws, np.inf)
        level = self.model.validation.level * rows.counted.sum()
        share = selection.least_gain
        least = np.sqrt(share / (1 - share) * level / total)
        noise = rng.normal(size=(self.config.draws, count)) * np.sqrt(squares)
        flips = sign_flips(count, self.config.seed, one_sided=True)
        flips = np.r_[flips[:1], rng.permutation(flips[1:])[: self.config.flips]]

        def passes(size: np.ndarray) -> np.ndarray:
            gains = 0.5 * size[:, None] ** 2 * squares + size[:, None] * noise
            t = t_values(gains, flips)
            return np.mean(t >= t[0] - 1e-12, axis=0) < selection.confirmation

        low, high = np.full(len(noise), LEAST / total**0.5), np.full(len(noise), MOST / total**0.5)
        ends = passes(high)
        for _ in range(HALVINGS):
            middle = np.sqrt(low * high)
            yes = passes(middle)
            low, high = np.where(yes, low, middle), np.where(yes, middle, high)
        return np.maximum(np.where(ends, high, np.inf), least)


def gain_draws(model: LinearModel, config: RehearsalConfig) -> GainDraws:
    """Noise of the validation test."""
    return GainDraws(model, np.nan_to_num(model.unabsorbed()), config)


@dataclass(frozen=True)
class Rival:
    """A candidate that an effect may be taken for.

    key: of it.  share: of the effect's squared sensitivity that it takes too, within its bounds.  apart: size of the
    effect from which the search distinguishes them; inf where it never does.
    """

    key: EffectKey
    share: float
    apart: float


def rivals_of(model: LinearModel, k: int, size: float, config: DiscrepancyConfig, share: float) -> list[Rival]:
    """The candidates that the search would not distinguish from direction k at some size, the nearest first.

    By the search's own criterion: the worse of two models is worse in nearly all resamples of the validation
    recording, and leaves so many times the U that the better one leaves.

    Args:
        model: the linear model.
        k: the direction.
        size: of the effect, where its rivals' bounds are looked at.
        config: of the search.
        share: of rehearsals in which they must be distinguished.
    """
    added = np.nan_to_num(model.unabsorbed())
    target = model.sign[k] * added[k]
    whole = float(target @ target)
    if whole <= 0 or not np.isfinite(size):
        return []
    groups: dict[EffectKey, list[int]] = {}
    for i, direction in enumerate(model.directions):
        if direction.candidate.key != model.directions[k].candidate.key:
            groups.setdefault(direction.candidate.shaped_key, []).append(i)
    best: dict[EffectKey, float] = {}
    for rows in groups.values():
        taken = _taken(added[rows], size * target, model.low[rows], model.high[rows]) / (size**2 * whole)
        key = model.directions[rows[0]].candidate.key
        best[key] = max(best.get(key, 0.0), taken)
    needed = _needed(model, config, share)
    strength = whole * (model.repeats if model.repeated else 1)
    out = []
    for key, taken in best.items():
        left = max(1.0 - taken, 0.0)
        apart = float(np.sqrt(needed / (left * strength))) if left > 1e-9 else np.inf
        if apart > size:
            out.append(Rival(key, taken, apart if apart <= model.room[k] else np.inf))
    return sorted(out, key=lambda r: -r.share)


def _taken(columns: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """What coefficients with columns [C, M] within their bounds take of the square of a target [M]."""
    seen = np.linalg.norm(columns, axis=1) > 1e-12
    if not seen.any():
        return 0.0
    q, triangle = np.linalg.qr(columns[seen].T)
    found = lsq_linear(triangle, q.T @ target, bounds=(low[seen] - 1e-12, high[seen] + 1e-12)).x
    left = target - columns[seen].T @ found
    return float(target @ target - left @ left)


def _needed(model: LinearModel, config: DiscrepancyConfig, share: float) -> float:
    """Squared noncentrality that must stand between two models for the search to distinguish them."""
    selection = config.selection
    aside = float(scipy.stats.norm.isf(selection.equivalence_doubt) + abs(scipy.stats.norm.isf(share)))
    by_resamples = (2 * aside) ** 2
    counted = float(model.validation.rows.counted.sum())
    if model.repeated:  # U of the better one is noise about zero, of deviation sqrt(2 M) in these units
        often = abs(float(scipy.stats.norm.isf(share)))
        return max(by_resamples, (selection.equivalence_factor - 1) * often * (2 * counted) ** 0.5)
    return max(by_resamples, (config.blocks.equivalence_factor - 1) * model.validation.level * counted)


def longest_enough(model: LinearModel) -> bool:
    """Whether there are rows enough for any effect to be told from chance."""
    return (model.repeats if model.repeated else model.train.rows.units) >= FEWEST_REPEATS
