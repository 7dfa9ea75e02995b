"""Fits that begin at the prior: the base model's, and an extended one's where the base fit's basin suits no effect.

What is missing bends the base fit, and may leave it in another basin than the truth's: a door whose catch the model
lacks was fitted by fingers that slip.  A refit goes on from there, and the right effect then explains the fitted
motion and not the other one.  From the prior on, with the effect in the model from the first replay, it explains both.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from droid_jax.discrepancy.candidates import Candidate
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.refit import FittedModel, refit
from droid_jax.identify.pipeline import Progress, grip_hypotheses, search_cost, starts
from droid_jax.identify.search import cma_search as search


def base_fit(case: Case, progress: Progress, start: np.ndarray | None = None) -> FittedModel:
    """Everything but the effects, fitted to the first demonstration.

    start: [F] values of the base parameters out of an earlier fit; without it they are searched for.
    """
    if start is None:
        return fitted_from_prior(case, (), progress)
    base = case.base
    return _refined(case, (), case.full_space.embed(base, np.clip(start, base.low, base.high)[None]), progress)


def fitted_from_prior(case: Case, parts: Sequence[Candidate], progress: Progress) -> FittedModel:
    """Base parameters and the effects `parts`, searched for from the prior on and refined like the base fit.

    The search moves amplitudes and holds shapes at the candidates' values; the refinement frees both.
    Raises NotReplayed where the replay of every start blows up.
    """
    base, whole = case.base, case.full_space
    at = whole.values({name: value for part in parts for name, value in part.shape_parameters.items()})
    amplitudes = [a for part in parts for a in part.coefficients]
    main = whole.select([*(p.name for p in base.parameters if not p.nuisance), *amplitudes])
    found = search(
        search_cost(case.train.cost, case.config.compare, whole, main, at),
        main,
        case.config.search,
        progress=lambda p: progress("search", p),
    )
    space = whole.select([*base.names, *amplitudes])
    return _refined(case, parts, whole.embed(space, starts(space, main, found), at), progress)


def _refined(case: Case, parts: Sequence[Candidate], begin: np.ndarray, progress: Progress) -> FittedModel:
    """begin: [S, D] over the whole space."""
    return refit(
        case.train,
        case.base,
        parts,
        begin,
        case.config.refine,
        hypotheses=grip_hypotheses(case.base),
        progress=lambda p: progress("refine", p),
    )
