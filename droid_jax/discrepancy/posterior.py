"""The uncertainty of a fitted model's parameters, and of its residuals on another recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import scipy

from droid_jax.discrepancy.candidates import project
from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.discrepancy.step_error import FINER
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.identifiability import moved_by_step, posterior_of, step_shift
from droid_jax.identify.levenberg_marquardt import principal_axes
from droid_jax.model.effects.candidate import Candidate

SHORTEST_STEP = 0.25  # of a step cut by bounds, as a share of the full one, that the slope is divided by at least
LONGEST_STEP = 1.0  # search units (prior deviations): longest step along an axis that the data do not constrain


def fit_posterior(residual_set: ResidualSet, model: FittedModel) -> Gaussian:
    """Posterior of a model's parameters, over its space, given the fitted recording (`posterior_of`).

    It includes the error of the time step, if computed (`with_step_difference`).
    """
    gaussian = posterior_of(model.refined, residual_set.cost.comparisons, residual_set.identifiability)
    return with_step_moves(residual_set, model, gaussian)


def with_step_moves(residual_set: ResidualSet, model: FittedModel, gaussian: Gaussian) -> Gaussian:
    """A model's Gaussian, widened by the error of the time step (`moved_by_step`).

    An error of first order is `FINER` / (`FINER` - 1) times the difference to a quarter of the step.
    """
    if residual_set.step_difference is None:
        return gaussian
    error = FINER / (FINER - 1) * np.sqrt(residual_set.repeats) * residual_set.step_difference
    return moved_by_step(gaussian, step_shift(model.refined, error))


def consistent_with_zero(residual_set: ResidualSet, model: FittedModel, part: Candidate) -> bool:
    """Whether zero (neutral) of all of a part's coefficients lies in their joint confidence region, bounds ignored.

    Correlated coefficients (a friction's slope and curve) may each be consistent with zero, but not both together.  For
    one coefficient this is the same as an interval (`intervals`) that holds zero.
    """
    at, space = [model.space.index(a) for a in part.coefficients], residual_set.cost.space
    distance = [(model.values[space.index(a)] - space[a].mean) / space[a].std for a in part.coefficients]
    cov = fit_posterior(residual_set, model).cov[np.ix_(at, at)]
    level = residual_set.config.interval_level
    return bool(distance @ np.linalg.solve(cov, distance) <= scipy.stats.chi2.ppf(level, len(at)))


def deviations(residual_set: ResidualSet, model: FittedModel) -> dict[str, float]:
    """Coefficient -> posterior deviation in its unit, bounds ignored, of every free coefficient."""
    std = np.sqrt(np.diag(fit_posterior(residual_set, model).cov))
    return {a: float(std[model.space.index(a)] * model.space[a].std) for a in model.coefficients}


def intervals(
    residual_set: ResidualSet, model: FittedModel, names: Iterable[str] | None = None
) -> dict[str, tuple[float, float]]:
    """Parameter -> interval in its unit.

    Intervals are around the model's values, so each holds the reported value.  If all coefficients of an effect may be
    zero together (`consistent_with_zero`), their intervals are extended to zero, so that both statements agree.

    Args:
        residual_set: of the recording that the model was fitted to.
        model: the fitted model.
        names: of free parameters; None: of every coefficient.
    """
    space = model.space
    values = model.values[residual_set.cost.space.columns(space)]
    about = replace(fit_posterior(residual_set, model), mean=space.to_search(values))
    low, high = about.interval(residual_set.config.interval_level)
    for part in model.parts:
        if part.coefficients and consistent_with_zero(residual_set, model, part):
            at = [space.index(a) for a in part.coefficients]
            low[at], high[at] = np.minimum(low[at], space.mean[at]), np.maximum(high[at], space.mean[at])
    asked = model.coefficients if names is None else names
    return {a: (float(low[space.index(a)]), float(high[space.index(a)])) for a in asked}


def remaining_residuals(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[N, M] residuals on another recording than the fitted one, less the part that the fit's uncertainty explains.

    The fitted motion constrains some directions in parameter space poorly, and another motion may depend on these.  The
    resulting part of U is not a missing effect.  (For a door with nothing hidden U was 0.025 and U0 0.0005; one
    posterior deviation along every axis gives 0.016.)

    The parameters are fitted linearly to the other recording, with the posterior of the fitted one (`posterior_of`) as
    their prior.  Per-recording nuisances of the other recording are fitted too.  Every repeat is projected and not only
    the mean, since U estimates the noise from the scatter of the repeats.  Blocks of one log have the same motion, so
    nothing is projected there.
    """
    residuals = other.residuals(model.values)
    if not fitted.resampling.repeated:
        return residuals
    slopes = transfer_spread(fitted, other, model)
    prior = np.full(len(slopes.T), other.repeats**0.5)  # one deviation, in noise units of the repeats' mean
    return project(residuals, slopes, prior)


def remaining_discrepancy(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> float:
    """U of `remaining_residuals`."""
    return other.resampling.discrepancy(remaining_residuals(fitted, other, model))


def transfer_spread(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[M, D] change of the other recording's common residual by one posterior deviation along each principal axis.

    If a bound cuts a step short, the slope is that of the shortened step.  It is zero along an axis on which a replay
    blows up.
    """
    space, whole, x = model.space, other.cost.space, model.refined.x
    covariance = posterior_of(model.refined, fitted.cost.comparisons, fitted.identifiability, misfit=False).cov
    steps = principal_axes(covariance, LONGEST_STEP).T
    ends = [np.clip(x + sign * steps, *map(space.to_search, (space.low, space.high))) for sign in (1.0, -1.0)]
    up, down = np.split(other.common(whole.embed(space, space.from_search(np.concatenate(ends)), model.values)), 2)
    share = np.sum((ends[0] - ends[1]) * steps, axis=1) / np.sum(2 * steps**2, axis=1)  # of the step inside bounds
    return np.nan_to_num(0.5 * (up - down) / np.maximum(share, SHORTEST_STEP)[:, None]).T
