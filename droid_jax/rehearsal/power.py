"""Which size of an effect the search's own tests find, in a linear model.

The score test and the validation test of the search are made on drawn noise, with its own sign flips, thresholds and
block structure.  Only the replays are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.fitting import WORST
from droid_jax.discrepancy.statistics import Blocks, Repeats, detrended, sign_flips, t_values
from droid_jax.rehearsal.linear import LinearModel, RehearsalConfig, unhindered

LEAST, MOST = 0.2, 80.0  # noncentralities between which the smallest size is looked for
HALVINGS = 8
CHUNK = 4e6  # numbers of a batch of flips


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
    size = np.linalg.norm(scores.projected, axis=1)
    units = model.repeats**0.5 if model.repeated else 1.0
    out = []
    for k in wanted:
        strength = float(size[k]) * units  # noncentrality of a unit
        if strength < 1e-12:
            out.append(Smallest(np.inf, {}, "no signal", np.nan))
            continue
        spread = max(float(scipy.stats.norm.ppf(config.share)), 0.0) / strength  # of the fitted size
        drawn = {
            "score test": scores.crossings(k, selection.significance) / strength,
            "validation": gains.crossings(k, selection),
            "time step": discrepancy_crossings(model, k, strength, gains, config),
        }
        fixed = {
            "minimum effect size": float(model.minimum[k]) + spread,
            "weak imitation": unhindered(model, k, config.share),
        }
        limits = {name: float(np.quantile(a, config.share, method="higher")) for name, a in drawn.items()} | fixed
        each = np.maximum(np.max(list(drawn.values()), axis=0), max(fixed.values()))
        found = config.margin * float(np.quantile(each, config.share, method="higher"))
        limit = max(limits, key=limits.__getitem__)
        if found > model.room[k]:
            found, limit = np.inf, "beyond its bounds"
        out.append(Smallest(found, limits, limit, found * strength))
    return out


def discrepancy_crossings(
    model: LinearModel, k: int, strength: float, gains: GainDraws, config: RehearsalConfig
) -> np.ndarray:
    """[R] size of direction k from which U is above what the time step leaves, on both parts.

    U is estimated: with noncentrality l, N M U is (l + g)^2 and the products of M residuals of noise, whose deviation
    is sqrt(2 M).  Blocks have no such threshold: their U holds the noise.
    """
    if not model.repeated:
        return np.zeros(config.draws)
    rng, count, step_error = np.random.default_rng([config.seed, 3, k]), model.repeats, model.step_error
    sizes = (strength, float(np.linalg.norm(gains.added[k])) * count**0.5)
    out = np.zeros(config.draws)
    for part, factor, unit in zip((model.train, model.validation), (WORST, 1.0), sizes, strict=True):
        residuals = float(part.rows.counted.sum())
        along, beside = rng.normal(size=(2, config.draws))
        least = count * residuals * factor * step_error - np.sqrt(2 * residuals) * beside
        needed = np.sqrt(np.maximum(along**2 + least, 0.0)) - along
        out = np.maximum(out, np.maximum(needed, 0.0) / max(unit, 1e-30))
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
    flips = sign_flips(count, config.seed)[: config.flips].astype(np.float32)
    own, flipped = scipy.stats.t(max(count - 2, 1)), scipy.stats.t(count - 1)

    def p_values(scores: np.ndarray, of: np.ndarray) -> np.ndarray:
        """[R] as `statistics.largest_detrended_t` has them, of scores [R, S, N]."""
        straight = np.moveaxis(detrended(np.moveaxis(scores, 2, 0)), 0, 2).astype(np.float32)
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
    drawn = model.train.noise(config.draws, rng)

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
        drawn = self.model.validation.noise(self.config.draws, rng) * added
        noise = np.stack([drawn[:, rows.block == b].sum(axis=1) for b in range(count)], axis=1)
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
