"""Which candidates imitate an effect, and from which size of the effect on the search distinguishes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats
from scipy.optimize import lsq_linear

from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.model.effects.candidate import EffectKey
from droid_jax.rehearsal.linear import LinearModel, unabsorbed


def explained_shares(model: LinearModel, residual: np.ndarray, free: np.ndarray) -> dict[EffectKey, float]:
    """Return the share of the square of a training residual [M] that each candidate explains, with its best shape.

    free: [D] bool, base parameters that absorb.
    """
    columns, products = model.projected_with(free)
    along = columns @ residual
    total, out = max(float(residual @ residual), 1e-30), dict[EffectKey, float]()
    for rows in model.shaped:
        key = model.directions[rows[0]].candidate.key
        low, high = np.where(model.low[rows] < 0, -np.inf, 0.0), np.where(model.high[rows] > 0, np.inf, 0.0)
        gram = products[np.ix_(rows, rows)]
        coefficients = _bounded_fit(gram, along[rows], low, high)
        share = float(coefficients @ (2 * along[rows] - gram @ coefficients)) / total
        out[key] = max(share, out.get(key, 0.0))
    return out


@dataclass(frozen=True)
class Alternative:
    """A candidate that the search may name instead of an effect.

    key: of the candidate.  share: share of the effect's squared sensitivity that it explains, within its bounds.
    distinguishable_from: size of the effect from which the search distinguishes them; inf if it never does.
    """

    key: EffectKey
    share: float
    distinguishable_from: float


def alternatives_of(
    model: LinearModel, k: int, size: float, config: DiscrepancyConfig, share: float
) -> list[Alternative]:
    """Return the candidates that the search would not distinguish from direction k at a size, the most similar first.

    The search distinguishes two models if the worse one is worse in nearly all resamples of the validation recording,
    and if its U is larger by a factor.

    Args:
        model: the linear model.
        k: the direction.
        size: of the effect; the bounds of the candidates apply at this size.
        config: of the search.
        share: share of rehearsals in which they must be distinguished.
    """
    if not np.isfinite(size):
        return []
    needed = distinguishable(model, config, share)
    out = []
    for imitation in imitations(model, k, size):
        unexplained = max(1.0 - imitation.share, 0.0)
        strength = unexplained * imitation.strength
        threshold = float(np.sqrt(needed / strength)) if unexplained > 1e-9 else np.inf
        if threshold > size:
            limit = threshold if threshold <= model.largest[k] else np.inf
            out.append(Alternative(imitation.key, imitation.share, limit))
    return sorted(out, key=lambda r: -r.share)


@dataclass(frozen=True)
class Imitation:
    """How well another candidate explains an effect on the validation part.

    key: of the candidate.  share: of the effect's square that it explains.
    strength: squared noncentrality of a unit of the effect on the validation part.
    above_minimum: size of the effect from which the imitation is above its own minimum effect size.
    """

    key: EffectKey
    share: float
    strength: float
    above_minimum: float


def imitations(model: LinearModel, k: int, size: float | None = None) -> list[Imitation]:
    """Return how well every other candidate explains direction k, with its best shape.

    size: of the effect, at which the candidates' bounds apply; None: only their signs apply.
    """
    own, times = model.directions[k].candidate.key, size or 1.0
    unbounded = times * model.sign[k] * model.added[k]
    targets = [unbounded] if size is None or model.base_low is None else [unbounded, unabsorbed(model, k).at(size)[1]]
    products = [model.added @ target for target in targets]
    if min(float(target @ target) for target in targets) <= 0:
        return []
    best: dict[EffectKey, Imitation] = {}
    for rows in model.shaped:
        key = model.directions[rows[0]].candidate.key
        if key == own:
            continue
        low, high = model.low[rows], model.high[rows]
        if size is None:
            low, high = np.where(low < 0, -np.inf, 0.0), np.where(high > 0, np.inf, 0.0)
        gram = model.gram[np.ix_(rows, rows)]
        for target, along in zip(targets, products, strict=True):
            coefficients, total = _bounded_fit(gram, along[rows], low, high), float(target @ target)
            change = times * model.sign[k] * model.absorbed[:, k] - model.absorbed[:, rows] @ coefficients
            if size is None or model.inside(change):
                break  # with this candidate the base parameters stay within their bounds
        share = float(coefficients @ (2 * along[rows] - gram @ coefficients)) / total
        if key not in best or share > best[key].share:
            above_minimum = model.minimum[rows] / np.maximum(np.abs(coefficients) / times, 1e-30)
            strength = total / times**2 * model.judging_repeats
            best[key] = Imitation(key, share, strength, float(above_minimum.min()))
    return list(best.values())


def weak_imitation_limit(model: LinearModel, k: int, share: float) -> float:
    """Return the size of direction k above which no imitation below its minimum effect size prevents a name.

    The search names nothing if such an imitation matches the validation recording better.  Up to a distance of two
    deviations of the noise this happens by chance in more than 1 - share of the rehearsals.
    """
    distance = 2 * max(float(scipy.stats.norm.ppf(share)), 0.0)
    return max(
        (
            min(i.above_minimum, distance / np.sqrt(max((1 - i.share) * i.strength, 1e-30)))
            for i in imitations(model, k)
        ),
        default=0.0,
    )


def _bounded_fit(gram: np.ndarray, toward: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[C] coefficients within bounds that explain most of the square of a target.

    gram: [C, C] scalar products of their columns.  toward: [C] scalar products of the columns and the target.
    """
    nonzero, coefficients = np.diag(gram) > 1e-24, np.zeros(len(toward))
    count = int(nonzero.sum())
    if not count:
        return coefficients
    gram, toward, low, high = gram[np.ix_(nonzero, nonzero)], toward[nonzero], low[nonzero], high[nonzero]
    scale = 1.0 / np.sqrt(np.diag(gram))
    gram = scale[:, None] * gram * scale + 1e-12 * np.eye(count)
    solution = scale * (np.linalg.solve(gram, scale * toward) if count > 1 else scale * toward)
    if count == 1:
        solution = np.clip(solution, low, high)
    elif np.any((solution < low) | (solution > high)):
        factor = np.linalg.cholesky(gram)
        bounds = ((low - 1e-12) / scale, (high + 1e-12) / scale)
        solution = scale * lsq_linear(factor.T, np.linalg.solve(factor, scale * toward), bounds=bounds).x
    coefficients[nonzero] = solution
    return coefficients


def distinguishable(model: LinearModel, config: DiscrepancyConfig, share: float) -> float:
    """Return the squared noncentrality between two models above which the search distinguishes them.

    share: share of rehearsals in which it must.
    """
    selection = config.selection
    quantile = abs(float(scipy.stats.norm.isf(share)))
    by_resamples = (2 * (float(scipy.stats.norm.isf(selection.equivalence_doubt)) + quantile)) ** 2
    counted = float(model.validation.rows.counted.sum())
    if model.repeated:  # U of the better one is noise about zero, of deviation sqrt(2 M) in these units
        return max(by_resamples, (selection.equivalence_factor - 1) * quantile * (2 * counted) ** 0.5)
    return max(by_resamples, (config.blocks.equivalence_factor - 1) * model.validation.level * counted)
