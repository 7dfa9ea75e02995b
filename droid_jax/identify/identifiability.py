"""From a refined fit to a calibrated Gaussian, and what the demonstration tells about each parameter.

Rule of the width.  Gauss-Newton around the best gives the covariance H^-1 with nuisances
marginalised.  It believes that the residuals are noise which is independent from joint to joint and
stationary in time.  Two sandwiches H^-1 S H^-1 (Huber 1967) ask the data what the scores J^T r really do:

* between repeats: every repeat has its own errors of pose and grasp, which stay for a whole opening and
  pull at all joints together.  S is the scatter of the repeats' scores.  Ten repeats say little about one
  parameter, so each parameter's ratio to H^-1 is drawn towards the ratio over all of them;
* within the residual: what the model leaves over is more than noise, and correlated.  S is the
  scatter of the scores of contiguous blocks of time (Kuensch 1989), per column.

Each deviation becomes the largest of the three; correlations stay those of H^-1.  So the data's information and
the prior's are widened alike.  But what a poor model leaves over makes its data less certain, and not what was stated
before them; and the refinement may have used a wider prior, so as not to be pulled by it.  The Gaussian that is
handed on holds the data's information as it was widened, and the stated prior as it was stated.

None of this sees the simulation's own time step, which moves every fit the same way.  What it does to the fitted values
is measured by a finer replay and added as one direction (`moved_by_step`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from droid_jax.arguments import check_fields, number
from droid_jax.cost.residuals import Comparison
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.levenberg_marquardt import curvature
from droid_jax.identify.multistart import Refined

STATED = 1.0  # search units: the deviation of a parameter's stated prior


@dataclass(frozen=True)
class IdentifiabilityConfig:
    """What decides the calibrated width, and when a parameter counts as identifiable.

    identifiable: posterior deviation over prior deviation, below which the data constrain a parameter.
    pooling: degrees of freedom with which the widening over all parameters counts in each one's own; ten repeats alone
      say little about one parameter.
    block: s, length of the contiguous blocks of time over which the residual's scores are summed (Kuensch 1989).
    partner: absolute correlation from which two parameters are called partners.
    """

    identifiable: float = 0.25
    pooling: float = 12
    block: float = 1.0
    partner: float = 0.7

    def __post_init__(self) -> None:
        check_fields(
            self,
            identifiable=partial(number, above=0),
            pooling=partial(number, above=0),
            block=partial(number, above=0),
            partner=partial(number, least=0, most=1),
        )


DEFAULT_IDENTIFIABILITY = IdentifiabilityConfig()


@dataclass(frozen=True)
class Identifiability:
    """What the data tell about one parameter: identifiable or not, why, and who it trades with.

    moved: deviations of its stated prior by which the fit moved it, search units; NaN where that was not judged.
    """

    name: str
    identifiable: bool
    shrinkage: float
    partners: tuple[tuple[str, float], ...]
    reason: str
    moved: float = math.nan


def posterior(
    refined: Refined, comparisons: Sequence[Comparison], config: IdentifiabilityConfig = DEFAULT_IDENTIFIABILITY
) -> Gaussian:
    """The Gaussian to hand on, in search coordinates over the refined space: `posterior_of` with the stated prior."""
    return with_stated_prior(posterior_of(refined, comparisons, config), refined)


def posterior_of(
    refined: Refined,
    comparisons: Sequence[Comparison],
    config: IdentifiabilityConfig = DEFAULT_IDENTIFIABILITY,
    *,
    misfit: bool = True,
) -> Gaussian:
    """What the recordings that were refined on tell by themselves, but for the refinement's wide prior.

    For questions to the data alone, as whether a coefficient may be zero.
    misfit: whether what the model leaves over beyond noise widens it too; without it the model is taken to be right.
    """
    channels = [c for comparison in comparisons for c in comparison.channels]
    shapes = [(len(c.columns), c.noise.mean.shape[0]) for c in channels]
    durations = [c.span[1] - c.span[0] for c in channels]
    blocks = time_blocks(shapes, durations, config.block) if misfit else None
    return calibrated(refined, [c.deviations() for c in comparisons], blocks, config.pooling)


def with_stated_prior(gaussian: Gaussian, refined: Refined) -> Gaussian:
    """A calibrated Gaussian with the stated prior in place of the refinement's, which was widened with the data.

    With D the widening of every deviation, C = D H^-1 D and H = J^T J + P: C^-1 - D^-1 P D^-1 + P_stated.
    Its mean stays, lest a value that is far from the prior and well told be pulled: between told and untold (a
    deviation of about one prior) the width is up to a third too small for that.
    """
    widened = np.diag(gaussian.cov) / np.diag(np.linalg.inv(refined.hessian))  # variances
    stated = np.minimum(refined.prior, STATED) ** -2.0
    precision = np.linalg.inv(gaussian.cov) - np.diag(refined.prior**-2.0 / widened) + np.diag(stated)
    cov = np.linalg.inv(precision)
    return replace(gaussian, cov=0.5 * (cov + cov.T))


def step_shift(refined: Refined, off: np.ndarray) -> np.ndarray:
    """[D] how far a difference `off` [M] of the simulation would move the fit, search units; zero at a bound.

    off: in the refinement's own units, of its first M residuals.
    """
    jacobian = refined.jacobian[: len(off)]
    shift = np.linalg.solve(curvature(jacobian, refined.prior), jacobian.T @ off)
    return np.where(refined.free, -shift, 0.0)


def moved_by_step(gaussian: Gaussian, shift: np.ndarray) -> Gaussian:
    """A Gaussian that is as uncertain as its time step makes it; shift: [D] of `step_shift`.

    An arm of three joints that was fitted at 5 ms has its dampings 1 % too low, three to four of its own deviations.
    """
    if not shift.any():
        return gaussian
    largest = np.abs(shift / np.sqrt(np.diag(gaussian.cov))).max()
    rule = f"{gaussian.rule}; and by what the time step moves it (up to {largest:.1f} deviations)"
    return replace(gaussian, cov=gaussian.cov + np.outer(shift, shift), rule=rule)


def calibrated(
    refined: Refined,
    deviations: Sequence[np.ndarray],
    block_ids: np.ndarray | None,
    pooling: float = DEFAULT_IDENTIFIABILITY.pooling,
) -> Gaussian:
    """The rule of the width on plain arrays.

    deviations: per recording [N, M_i] whitened deviations of its repeats from their mean (see
      `Comparison.deviations`); block_ids: [M] integer block of each residual (see `time_blocks`), or None: what the
      model leaves over widens nothing; pooling: see `IdentifiabilityConfig`.
    """
    plain = np.linalg.inv(refined.hessian)
    variance = np.diag(plain)
    repeats = variance * np.maximum(1.0, _repeat_ratio(refined, plain, deviations, pooling))
    blocks = variance if block_ids is None else np.diag(_sandwich(refined, plain, block_ids))
    factor = np.sqrt(np.maximum(repeats, blocks) / variance)
    cov = plain * np.outer(factor, factor)
    main = ~refined.space.nuisance
    left = "" if block_ids is None else " and to the block scores of the residuals"
    rule = (
        "Gauss-Newton around the best, nuisances marginalised, deviations widened to the scatter between repeats"
        f"{left} (x{np.median(factor[main]):.2f} in the median)"
    )
    return Gaussian(refined.space, refined.x, 0.5 * (cov + cov.T), rule, "search")


def _repeat_ratio(
    refined: Refined, inverse: np.ndarray, deviations: Sequence[np.ndarray], pooling: float
) -> np.ndarray:
    """[D] variance that the repeats' scatter gives each parameter, over the one that whitened noise would give.

    Both hold the prior's share, so that what the data do not see stays at ratio 1.
    """
    prior = np.diag(refined.prior**-2)
    scatter, freedom, start = np.zeros_like(inverse), 0, 0
    for deviation in deviations:
        count, size = deviation.shape
        part = refined.jacobian[start : start + size]
        start += size
        if count < 2:  # one repeat says nothing about scatter
            scatter += part.T @ part
            continue
        scores = deviation @ part
        scatter += scores.T @ scores / (count * (count - 1))
        freedom += count - 1
    seen = refined.jacobian.T @ refined.jacobian
    pooled = np.trace(inverse @ scatter) / max(np.trace(inverse @ seen), 1e-12)
    shared = freedom * scatter + pooling * pooled * seen
    return np.diag(inverse @ (shared / (freedom + pooling) + prior) @ inverse) / np.diag(inverse)


def _sandwich(refined: Refined, inverse: np.ndarray, block_ids: np.ndarray) -> np.ndarray:
    scores = np.zeros((int(block_ids.max()) + 1, refined.jacobian.shape[1]))
    np.add.at(scores, block_ids, refined.jacobian * refined.residual[:, None])
    prior = np.diag(refined.prior**-2)
    return inverse @ (scores.T @ scores + prior) @ inverse


def time_blocks(
    shapes: Sequence[tuple[int, int]], seconds: Sequence[float], block: float = DEFAULT_IDENTIFIABILITY.block
) -> np.ndarray:
    """[M] block of each whitened residual: per recording and column, contiguous stretches of `block` s.

    shapes: (columns C, coarse samples K) of each compared channel, in the order of the residuals
    (column by column); seconds: its duration.
    """
    ids: list[np.ndarray] = []
    start = 0
    for (columns, samples), duration in zip(shapes, seconds, strict=True):
        per_column = max(1, round(duration / block))
        within = np.minimum((np.arange(samples) * per_column) // samples, per_column - 1)
        for _ in range(columns):
            ids.append(start + within)
            start += per_column
    return np.concatenate(ids)


def not_judged(gaussian: Gaussian) -> tuple[Identifiability, ...]:
    """For a search's own covariance, which is no posterior: nothing is called identifiable from it."""
    reason = "not judged: the search's covariance depends on when it stopped"
    return tuple(Identifiability(name, False, 1.0, (), reason) for name in gaussian.space.names)


def identifiability(
    gaussian: Gaussian, prior: np.ndarray, config: IdentifiabilityConfig = DEFAULT_IDENTIFIABILITY
) -> tuple[Identifiability, ...]:
    """What the demonstration tells about each parameter of a calibrated Gaussian.

    It is judged against the stated prior, or the refinement's where that is narrower.
    prior: [D] deviations of the refinement's prior, search units.
    """
    deviation = np.sqrt(np.diag(gaussian.cov))
    correlation = gaussian.cov / np.outer(deviation, deviation)
    space = gaussian.space
    away = gaussian.mean if gaussian.coordinates == "search" else space.to_search(gaussian.mean)
    out: list[Identifiability] = []
    for i, name in enumerate(space.names):
        shrinkage = float(deviation[i] / min(prior[i], STATED))
        nearest: list[int] = np.argsort(-np.abs(correlation[i])).tolist()
        others = [(space.names[j], float(correlation[i, j])) for j in nearest if j != i]
        partners = tuple((n, c) for n, c in others if abs(c) > config.partner)[:3]
        known = shrinkage < config.identifiable
        out.append(Identifiability(name, known, shrinkage, partners, _reason(known, shrinkage), float(away[i])))
    return tuple(out)


def _reason(known: bool, shrinkage: float) -> str:
    if known:
        return f"the data narrow the prior to {shrinkage:.0%}"
    return f"the data leave {f'{shrinkage:.0%}' if shrinkage < 1 else 'all'} of the prior's width"
