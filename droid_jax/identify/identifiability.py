"""The calibrated Gaussian of a refined fit, and which parameters the data constrain.

Rule of the width.  Gauss-Newton around the best values gives the covariance H^-1, with nuisances marginalised.  It
assumes that the residuals are noise, independent between joints and stationary in time.  Two sandwich estimates
H^-1 S H^-1 (Huber 1967) measure the covariance S of the scores J^T r instead:

* between repeats: each repeat has its own errors of pose and grasp, which last for the whole motion and act on all
  joints.  S is the scatter of the repeats' scores.  Ten repeats say little about one parameter, so the ratio of each
  parameter's variance to H^-1 is shrunk towards the ratio over all parameters;
* within the residual: the model's error is larger than the noise, and correlated.  S is the scatter of the scores of
  contiguous blocks of time (Kuensch 1989), of each column.

Each deviation becomes the largest of the three; the correlations are those of H^-1.  This widens the prior's part as
well as the data's.  But a poor model only makes the data less informative, not the prior; and the refinement may have
used a wider prior than the stated one.  So the result combines the widened information of the data with the stated
prior (`with_stated_prior`).

The error of the time step, which moves all fits in the same direction, is not included in these estimates.  It is
measured with a finer replay and added as a covariance of rank one (`moved_by_step`).
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

STATED_PRIOR = 1.0  # deviation of a parameter's stated prior, search units


@dataclass(frozen=True)
class IdentifiabilityConfig:
    """Settings of the calibrated width, and of when a parameter counts as identifiable.

    identifiable: posterior deviation over prior deviation, below which a parameter is identifiable.
    pooling: degrees of freedom of the widening over all parameters, which each parameter's own widening is shrunk
      towards; ten repeats alone say little about one parameter.
    block: s, length of the contiguous blocks of time over which the residual's scores are summed (Kuensch 1989).
    partner: absolute correlation above which two parameters are listed as partners.
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
    """Whether the data constrain one parameter, and how it is correlated with others.

    name: of the parameter.  identifiable: whether `shrinkage` is below the threshold.
    shrinkage: posterior over prior deviation.  partners: names of strongly correlated parameters, and the correlations.
    reason: a clause for reports.  moved: search units, distance of the fit from the prior mean; NaN if not known.
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
    """Return the result of an identification: `posterior_of` with the stated prior, in search coordinates.

    Args:
        refined: the fit.
        comparisons: of the recordings that were refined on.
        config: settings of the width.
    """
    return with_stated_prior(posterior_of(refined, comparisons, config), refined)


def posterior_of(
    refined: Refined,
    comparisons: Sequence[Comparison],
    config: IdentifiabilityConfig = DEFAULT_IDENTIFIABILITY,
    *,
    misfit: bool = True,
) -> Gaussian:
    """Return the posterior of the fitted recordings with the refinement's wide prior, in search coordinates.

    It serves tests that should use the data only, such as whether a coefficient may be zero.

    Args:
        refined: the fit.
        comparisons: of the recordings that were refined on.
        config: settings of the width.
        misfit: whether the model's error widens it too.  If not, the model is taken to be right.
    """
    channels = [c for comparison in comparisons for c in comparison.channels]
    shapes = [(len(c.columns), c.noise.mean.shape[0]) for c in channels]
    durations = [c.span[1] - c.span[0] for c in channels]
    blocks = time_blocks(shapes, durations, config.block) if misfit else None
    return calibrated(refined, [c.deviations() for c in comparisons], blocks, config.pooling)


def with_stated_prior(gaussian: Gaussian, refined: Refined) -> Gaussian:
    """Return a calibrated Gaussian with the stated prior instead of the refinement's prior.

    With D the widening of the deviations, C = D H^-1 D and H = J^T J + P, the precision is
    C^-1 - D^-1 P D^-1 + P_stated.  The mean is not changed, so that a value that is far from its prior mean and well
    constrained does not move.  For posterior deviations of about one prior deviation the width is therefore up to a
    third too small.
    """
    widened = np.diag(gaussian.cov) / np.diag(np.linalg.inv(refined.hessian))  # variances
    stated = np.minimum(refined.prior, STATED_PRIOR) ** -2.0
    precision = np.linalg.inv(gaussian.cov) - np.diag(refined.prior**-2.0 / widened) + np.diag(stated)
    cov = np.linalg.inv(precision)
    return replace(gaussian, cov=0.5 * (cov + cov.T))


def step_shift(refined: Refined, change: np.ndarray) -> np.ndarray:
    """Return the shift [D] of the fit, search units, if the simulation changes by `change`; zero at a bound.

    change: [M] of the refinement's first M residuals, in noise units.
    """
    jacobian = refined.jacobian[: len(change)]
    shift = np.linalg.solve(curvature(jacobian, refined.prior), jacobian.T @ change)
    return np.where(refined.free, -shift, 0.0)


def moved_by_step(gaussian: Gaussian, shift: np.ndarray) -> Gaussian:
    """Return a Gaussian whose covariance includes the error of the time step, shift shift^T.

    An arm of three joints that was fitted at 5 ms has its dampings 1 % too low, three to four of their deviations.

    shift: [D] from `step_shift`.
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
    """Return the calibrated Gaussian, by the rule in the module's docstring, with the refinement's prior.

    Args:
        refined: the fit.
        deviations: for each recording, whitened deviations [N, M_i] of its repeats (`Comparison.deviations`).
        block_ids: [M] number of the block of each residual (`time_blocks`); None leaves out the scatter of blocks.
        pooling: see `IdentifiabilityConfig`.
    """
    inverse = np.linalg.inv(refined.hessian)
    variance = np.diag(inverse)
    repeats = variance * np.maximum(1.0, _repeat_ratio(refined, inverse, deviations, pooling))
    blocks = variance if block_ids is None else np.diag(_sandwich(refined, inverse, block_ids))
    factor = np.sqrt(np.maximum(repeats, blocks) / variance)
    cov = inverse * np.outer(factor, factor)
    main = ~refined.space.nuisance
    by_blocks = "" if block_ids is None else " and to the block scores of the residuals"
    rule = (
        "Gauss-Newton around the best, nuisances marginalised, deviations widened to the scatter between repeats"
        f"{by_blocks} (x{np.median(factor[main]):.2f} in the median)"
    )
    return Gaussian(refined.space, refined.x, 0.5 * (cov + cov.T), rule, "search")


def _repeat_ratio(
    refined: Refined, inverse: np.ndarray, deviations: Sequence[np.ndarray], pooling: float
) -> np.ndarray:
    """[D] variance of each parameter by the scatter of the repeats' scores, over that of whitened noise.

    Both include the prior's part, so that the ratio of an unconstrained parameter is 1.
    """
    prior = np.diag(refined.prior**-2)
    scatter, degrees_of_freedom, start = np.zeros_like(inverse), 0, 0
    for deviation in deviations:
        count, size = deviation.shape
        part = refined.jacobian[start : start + size]
        start += size
        if count < 2:  # one repeat has no scatter
            scatter += part.T @ part
            continue
        scores = deviation @ part
        scatter += scores.T @ scores / (count * (count - 1))
        degrees_of_freedom += count - 1
    information = refined.jacobian.T @ refined.jacobian
    pooled = np.trace(inverse @ scatter) / max(np.trace(inverse @ information), 1e-12)
    shrunk = (degrees_of_freedom * scatter + pooling * pooled * information) / (degrees_of_freedom + pooling)
    return np.diag(inverse @ (shrunk + prior) @ inverse) / np.diag(inverse)


def _sandwich(refined: Refined, inverse: np.ndarray, block_ids: np.ndarray) -> np.ndarray:
    """[D, D] covariance from the scatter of the scores of blocks, with the prior's part."""
    scores = np.zeros((int(block_ids.max()) + 1, refined.jacobian.shape[1]))
    np.add.at(scores, block_ids, refined.jacobian * refined.residual[:, None])
    prior = np.diag(refined.prior**-2)
    return inverse @ (scores.T @ scores + prior) @ inverse


def time_blocks(
    shapes: Sequence[tuple[int, int]], seconds: Sequence[float], block: float = DEFAULT_IDENTIFIABILITY.block
) -> np.ndarray:
    """Return the number [M] of the block of each whitened residual, contiguous stretches of about `block` s.

    Args:
        shapes: (columns C, coarse samples K) of each compared channel, in the order of the residuals, which is column
            by column.
        seconds: duration of each channel.
        block: s, length of a block.
    """
    ids: list[np.ndarray] = []
    start = 0
    for (columns, samples), duration in zip(shapes, seconds, strict=True):
        per_column = max(1, round(duration / block))
        numbers = np.minimum((np.arange(samples) * per_column) // samples, per_column - 1)
        for _ in range(columns):
            ids.append(start + numbers)
            start += per_column
    return np.concatenate(ids)


def not_judged(gaussian: Gaussian) -> tuple[Identifiability, ...]:
    """Return verdicts for the covariance of a search, which is no posterior: no parameter is called identifiable."""
    reason = "not judged: the search's covariance depends on when it stopped"
    return tuple(Identifiability(name, False, 1.0, (), reason) for name in gaussian.space.names)


def identifiability(
    gaussian: Gaussian, prior: np.ndarray, config: IdentifiabilityConfig = DEFAULT_IDENTIFIABILITY
) -> tuple[Identifiability, ...]:
    """Return for each parameter of a calibrated Gaussian whether the data constrain it.

    The posterior deviation is compared with the stated prior, or with the refinement's prior if that is narrower.

    Args:
        gaussian: calibrated, over D parameters.
        prior: [D] deviations of the refinement's prior, search units.
        config: thresholds.
    """
    deviation = np.sqrt(np.diag(gaussian.cov))
    correlation = gaussian.cov / np.outer(deviation, deviation)
    space = gaussian.space
    moved = gaussian.mean if gaussian.coordinates == "search" else space.to_search(gaussian.mean)
    out: list[Identifiability] = []
    for i, name in enumerate(space.names):
        shrinkage = float(deviation[i] / min(prior[i], STATED_PRIOR))
        strongest: list[int] = np.argsort(-np.abs(correlation[i])).tolist()
        others = [(space.names[j], float(correlation[i, j])) for j in strongest if j != i]
        partners = tuple((n, c) for n, c in others if abs(c) > config.partner)[:3]
        is_identifiable = shrinkage < config.identifiable
        reason = _reason(is_identifiable, shrinkage)
        out.append(Identifiability(name, is_identifiable, shrinkage, partners, reason, float(moved[i])))
    return tuple(out)


def _reason(is_identifiable: bool, shrinkage: float) -> str:
    if is_identifiable:
        return f"the data narrow the prior to {shrinkage:.0%}"
    return f"the data narrow the prior only to {shrinkage:.0%}" if shrinkage < 1 else "the data do not narrow the prior"
