"""The model to hand on: once its effects are chosen, it is fitted to both motions that chose them.

Effects are chosen on a motion that the fit did not see.  What is then simulated and trained with need not be of one
motion alone, and is better not: of a door whose catch has another form than the library's, the first motion by itself
was fitted best by pads that had changed places (torsional friction 2.5 and 1.2, where the truth is 0.79 and 2.29), both
together by 0.88 and 2.31.  Verdict, sizes and gaps stay those of the search; the test motion stays out of every fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.identify.multistart import refine
from droid_jax.identify.pipeline import Progress


@dataclass(frozen=True, eq=False)
class FinalModel:
    """A model, and the residual_set that it is fitted to.

    not_made: why it is the search's own although a fit to both motions was due, empty where none was or it was made.
    """

    model: FittedModel
    fitted_to: tuple[ResidualSet, ...]
    not_made: str = ""


def due(case: Case, model: FittedModel) -> bool:
    """Whether a model is to be fitted to both motions once it is chosen."""
    return bool(model.parts) and case.train.repeated


def final_model(case: Case, model: FittedModel, progress: Progress = lambda stage, value: None) -> FinalModel:
    """The model that a search ended with, gone on with on both motions with the care of a base fit.

    Without an effect it stays as it is, since `identify` fits a base model to any number of recordings.  So does that
    of a log in blocks, whose blocks are of one motion, and one whose fit to both does not converge.
    """
    if not due(case, model):
        return FinalModel(model, (case.train,))
    fit, validation, whole, space = case.train, case.validation, case.full_space, model.space

    def residuals(rows: np.ndarray) -> np.ndarray:
        values = whole.embed(space, rows, model.values)
        # The validation recording's own nuisances are at their best: they are no part of the model.
        return np.concatenate([-e.common(values) * e.repeats**0.5 for e in (fit, validation)], axis=1)

    begin = model.values[whole.columns(space)]
    progress("both", None)
    refined = refine(residuals, space, begin, case.config.refine, progress=lambda now: progress("both", now))
    if not refined.converged:
        return FinalModel(model, (case.train,), "the fit to both motions did not converge")
    values = whole.embed(space, refined.best[None], model.values)[0]
    left = fit.residuals(fit.common(values)[0])
    return FinalModel(FittedModel(model.parts, values, space, refined, left, fit.discrepancy(left)), (fit, validation))
