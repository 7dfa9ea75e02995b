"""What a fit leaves on another motion without anything missing: its parameters are uncertain, and it asks for others.

The fitted demonstration tells some directions of the parameters poorly, and another motion may show just these.  What
that adds to U there is no missing effect: on a door with nothing hidden it was 0.025 where U0 is 0.0005, and
one deviation that the fit's noise leaves along every axis makes 0.016.
"""

from __future__ import annotations

import numpy as np

from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.screen import project
from droid_jax.identify.identifiability import posterior_of
from droid_jax.identify.levenberg_marquardt import principal_axes

LEAST = 0.25  # share of a step that bounds must leave for a slope
LONGEST = 1.0  # search units: what the fit did not tell at all is no further from it than that


def remaining_residuals(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[N, M] `beyond_fit_uncertainty`; of blocks of one log, which are of one motion, what the model leaves as it
    is.
    """
    if fitted.repeated:
        return beyond_fit_uncertainty(fitted, other, model)
    return other.residuals(other.common(model.values)[0])


def remaining_discrepancy(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> float:
    """U of what a model leaves over on another recording than the fitted one."""
    return other.discrepancy(remaining_residuals(fitted, other, model))


def beyond_fit_uncertainty(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[N, M] residuals of a model on another recording than the fitted one, less what its uncertainty allows.

    The parameters move once more, along slopes, to where the other recording wants them; how far is held by what the
    fitted one tells of them (`posterior_of`), as if both had been fitted.  The other recording's own nuisances are at
    their best throughout.  Every repeat is projected and not their mean alone, whose noise U tells from their scatter.
    """
    slopes = transfer_spread(fitted, other, model)
    held = np.full(len(slopes.T), other.repeats**0.5)  # the residual is that of the mean of so many repeats
    return project(other.residuals(other.common(model.values)[0]), slopes, held)


def transfer_spread(fitted: ResidualSet, other: ResidualSet, model: FittedModel) -> np.ndarray:
    """[M, D] by how much one deviation of the fit, along each of its principal axes, changes the common residual.

    Where a bound cuts a step short, what is left of it tells the slope.  Zero along an axis on which a replay blows up:
    nothing is allowed for there.
    """
    space, whole, x = model.space, other.cost.space, model.refined.x
    steps = principal_axes(posterior_of(model.refined, fitted.cost.comparisons, misfit=False).cov, LONGEST).T
    ends = [np.clip(x + sign * steps, *map(space.to_search, (space.low, space.high))) for sign in (1.0, -1.0)]
    up, down = np.split(other.common(whole.embed(space, space.from_search(np.concatenate(ends)), model.values)), 2)
    left = np.sum((ends[0] - ends[1]) * steps, axis=1) / np.sum(2 * steps**2, axis=1)
    return np.nan_to_num(0.5 * (up - down) / np.maximum(left, LEAST)[:, None]).T
