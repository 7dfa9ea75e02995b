"""How well a recording constrains a fitted model's parameters, and what their uncertainty changes on another one."""

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

SHORTEST_STEP = 0.25  # share of a step that bounds must leave for a slope
LONGEST_STEP = 1.0  # search units: what the fit did not constrain at all is no further from it than that


def fit_posterior(residual_set: ResidualSet, model: FittedModel) -> Gaussian:
    """What the fitted recording says of a model's parameters, over its space (`posterior_of`), its time step's part
    among it where that was measured (`with_step_difference`)."""
    gaussian = posterior_of(model.refined, residual_set.cost.comparisons, residual_set.identifiability)
    return with_step_moves(residual_set, model, gaussian)


def with_step_moves(residual_set: ResidualSet, model: FittedModel, gaussian: Gaussian) -> Gaussian:
    """A model's Gaussian, as uncertain as the time step makes it (`moved_by_step`).

    An error of first order is `FINER` / (`FINER` - 1) times what a quarter of the step changes.
    """
    if residual_set.step_difference is None:
        return gaussian
    off = FINER / (FINER - 1) * np.sqrt(residual_set.repeats) * residual_set.step_difference
    return moved_by_step(gaussian, step_shift(model.refined, off))


def consistent_with_zero(residual_set: ResidualSet, model: FittedModel, part: Candidate) -> bool:
    """Whether all coefficients of a part may be zero together, by their posterior covariance, bounds or no bounds.

    Together, because two that trade with each other (a friction's slope and curve) may each be zero and not both.  Of
    one coefficient it is the same as its interval (`intervals`) holding zero.
    """
    at, space = [model.space.index(a) for a in part.coefficients], residual_set.cost.space
    away = [(model.values[space.index(a)] - space[a].mean) / space[a].std for a in part.coefficients]
    cov = fit_posterior(residual_set, model).cov[np.ix_(at, at)]
    level = residual_set.config.interval_level
    return bool(away @ np.linalg.solve(cov, away) <= scipy.stats.chi2.ppf(level, len(at)))


def deviations(residual_set: ResidualSet, model: FittedModel) -> dict[str, float]:
    """Posterior deviation of every free coefficient, in its own unit, bounds or no bounds."""
    std = np.sqrt(np.diag(fit_posterior(residual_set, model).cov))
    return {a: float(std[model.space.index(a)] * model.space[a].std) for a in model.coefficients}


def intervals(
    residual_set: ResidualSet, model: FittedModel, names: Iterable[str] | None = None
) -> dict[str, tuple[float, float]]:
    """Interval of free parameters, each in its own unit; of every coefficient unless named.

    Around the model's own values, so that each holds what is reported.  Coefficients that may all be zero together
    (`consistent_with_zero`) have intervals that reach zero: one statement, whichever is read.
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
    """[N, M] residuals of a model on another recording than the fitted one, less what the fit's uncertainty allows.

    The fitted motion tells some directions of the parameters poorly, and another motion may show just these.  What that
    adds to U there is no missing effect: on a door with nothing hidden it was 0.025 where U0 is 0.0005, and one
    deviation that the fit's noise leaves along every axis makes 0.016.

    The parameters move once more, along slopes, to where the other recording wants them; how far is held by what the
    fitted one tells of them (`posterior_of`), as if both had been fitted.  The other recording's own nuisances are at
    their best throughout.  Every repeat is projected and not their mean alone, whose noise U estimates from their
    scatter.  Blocks of one log are of one motion: nothing is allowed for there.
    """
    left = other.residuals(model.values)
    if not fitted.resampling.repeated:
        return left
    slopes = transfer_spread(fitted, other, model)
    held = np.full(len(slopes.T), other.repeats**0.5)  # the residual is that of the mean of so many repeats
    return project(left, slopes, held)


def remaining_discrepancy(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> float:
    """U of `remaining_residuals`."""
    return other.resampling.discrepancy(remaining_residuals(fitted, other, model))


def transfer_spread(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[M, D] by how much one deviation of the fit, along each of its principal axes, changes the common residual.

    Where a bound cuts a step short, what is left of it gives the slope.  Zero along an axis on which a replay blows up:
    nothing is allowed for there.
    """
    space, whole, x = model.space, other.cost.space, model.refined.x
    covariance = posterior_of(model.refined, fitted.cost.comparisons, fitted.identifiability, misfit=False).cov
    steps = principal_axes(covariance, LONGEST_STEP).T
    ends = [np.clip(x + sign * steps, *map(space.to_search, (space.low, space.high))) for sign in (1.0, -1.0)]
    up, down = np.split(other.common(whole.embed(space, space.from_search(np.concatenate(ends)), model.values)), 2)
    left = np.sum((ends[0] - ends[1]) * steps, axis=1) / np.sum(2 * steps**2, axis=1)
    return np.nan_to_num(0.5 * (up - down) / np.maximum(left, SHORTEST_STEP)[:, None]).T
