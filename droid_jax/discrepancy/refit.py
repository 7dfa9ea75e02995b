"""Base parameters and effects together, by full re-simulation.

Residual regression alone is biased by the servo loop, contact and stiction: what a candidate adds is
measured only after everything else has been allowed to move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from droid_jax.discrepancy.candidates import Candidate, joined_names
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.identify.identifiability import posterior_of
from droid_jax.identify.multistart import Hypotheses, RefineConfig, Refined, RefineProgress, chord, refine
from droid_jax.model.parameters import Space

REFIT = RefineConfig(iterations=20, basin_hops=0, spreads=0)
LEVEL = 0.9  # of the amplitudes' intervals


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model: the base parameters and the effects that are in it.

    parts: candidates, none for the base model.  values: [D] over the whole space, absent effects at
    neutral.  space: what was free.  refined: how the fit ended, over `space`.  residuals: [N, M] of
    the fitted recording's repeats, or blocks.  discrepancy: their U.
    """

    parts: tuple[Candidate, ...]
    values: np.ndarray
    space: Space
    refined: Refined
    residuals: np.ndarray
    discrepancy: float

    @property
    def name(self) -> str:
        """ "base", "latch at door_hinge", "latch at door_hinge + drag at door_hinge"."""
        return joined_names(self.parts) or "base"

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the free amplitudes."""
        return tuple(a for c in self.parts for a in c.coefficients)


def refit(
    residual_set: ResidualSet,
    base: Space,
    parts: Sequence[Candidate],
    starts: np.ndarray,
    config: RefineConfig = REFIT,
    hypotheses: Hypotheses = (),
    progress: Callable[[RefineProgress], None] | None = None,
) -> FittedModel:
    """Fit base parameters and the effects `parts` to one recording, from starts [S, D] over the whole space.

    What is not free stays as in the first start.
    """
    whole = residual_set.cost.space
    free = [name for c in parts for name in c.free]
    space = whole.select([*base.names, *dict.fromkeys(free)])

    def residuals(rows: np.ndarray) -> np.ndarray:
        return residual_set.cost.whitened(whole.embed(space, rows, starts[0]))

    begin = starts[:, whole.columns(space)]
    refined = refine(residuals, space, begin, config, hypotheses=hypotheses, progress=progress)
    values = whole.embed(space, refined.best[None], starts[0])[0]
    left = residual_set.residuals(-refined.residual / np.sqrt(residual_set.repeats))
    return FittedModel(tuple(parts), values, space, refined, left, residual_set.discrepancy(left))


def one_step_fit(
    residual_set: ResidualSet,
    model: FittedModel,
    part: Candidate,
    marks: Mapping[str, np.ndarray],
    proposed: np.ndarray,
) -> tuple[np.ndarray, float]:
    """A first look at a model with one more effect, with slopes that are known already: values [D], objective.

    marks: amplitude -> [M] what a unit of it adds to the simulation at `model`, in one repeat's noise.
    proposed: [D] the model with the effect's amplitudes at their linear best.  It begins there and without the effect,
    and the better end counts: a step takes parameters two prior deviations at most, and a strong effect is many.
    """
    whole = residual_set.cost.space
    space = whole.select(dict.fromkeys((*model.space.names, *part.free)))
    jacobian = np.zeros((model.refined.jacobian.shape[0], len(space)))
    jacobian[:, space.columns(model.space)] = model.refined.jacobian
    for name in part.coefficients:
        jacobian[:, space.index(name)] = marks[name] * space[name].std * np.sqrt(residual_set.repeats)
    without, amplitudes = proposed.copy(), [whole.index(name) for name in part.coefficients]
    without[amplitudes] = model.values[amplitudes]

    def residuals(rows: np.ndarray) -> np.ndarray:
        return residual_set.cost.whitened(whole.embed(space, rows, without))

    starts = np.stack([without, proposed])[:, whole.columns(space)]
    values, objective = chord(residuals, space, starts, jacobian)
    return whole.embed(space, values[None], without)[0], objective


def consistent_with_zero(residual_set: ResidualSet, model: FittedModel, part: Candidate) -> bool:
    """Whether all amplitudes of a part may be zero together, by their posterior covariance, bounds or no bounds.

    Together, because two that trade with each other (a friction's slope and curve) may each be zero and not both.  Of
    one amplitude it is the same as its interval (`intervals`) holding zero.
    """
    at, space = [model.space.index(a) for a in part.coefficients], residual_set.cost.space
    away = [(model.values[space.index(a)] - space[a].mean) / space[a].std for a in part.coefficients]
    cov = posterior_of(model.refined, residual_set.cost.comparisons).cov[np.ix_(at, at)]
    return bool(away @ np.linalg.solve(cov, away) <= scipy.stats.chi2.ppf(LEVEL, len(at)))


def deviations(residual_set: ResidualSet, model: FittedModel) -> dict[str, float]:
    """Posterior deviation of every free amplitude, in its own unit, bounds or no bounds."""
    std = np.sqrt(np.diag(posterior_of(model.refined, residual_set.cost.comparisons).cov))
    return {a: float(std[model.space.index(a)] * model.space[a].std) for a in model.coefficients}


def intervals(
    residual_set: ResidualSet, model: FittedModel, names: Iterable[str] | None = None
) -> dict[str, tuple[float, float]]:
    """Interval of free parameters, each in its own unit; of every amplitude unless named.

    Around the model's own values, so that each holds what is reported.  Amplitudes that may all be zero together
    (`vanishing`) have intervals that reach zero: one statement, whichever is read.
    """
    space = model.space
    values = model.values[residual_set.cost.space.columns(space)]
    about = replace(posterior_of(model.refined, residual_set.cost.comparisons), mean=space.to_search(values))
    low, high = about.interval(LEVEL)
    for part in model.parts:
        if part.coefficients and consistent_with_zero(residual_set, model, part):
            at = [space.index(a) for a in part.coefficients]
            low[at], high[at] = np.minimum(low[at], space.mean[at]), np.maximum(high[at], space.mean[at])
    asked = model.coefficients if names is None else names
    return {a: (float(low[space.index(a)]), float(high[space.index(a)])) for a in asked}


def zero_warning(residual_set: ResidualSet, model: FittedModel, part: Candidate) -> str:
    """ "its amplitude may be zero (90 % interval 0 to 0.58 N m)" of a part of which that is so; empty else."""
    if not consistent_with_zero(residual_set, model, part):
        return ""
    spans = intervals(residual_set, model, part.coefficients)
    each = [f"{low:.3g} to {high:.3g} {model.space[a].unit}".removesuffix(" -") for a, (low, high) in spans.items()]
    what = "its amplitude may be zero" if len(each) == 1 else "its amplitudes may all be zero"
    return f"{what} ({LEVEL:.0%} interval {' and '.join(each)})".replace("%", " %")
