"""Tests that use both halves of a log: the training blocks and the validation blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from droid_jax.discrepancy.candidate_fits import Problem
from droid_jax.discrepancy.candidates import ScoreDirection, ScoreTest, score_test
from droid_jax.discrepancy.case import Case, ResidualSet
from droid_jax.discrepancy.fitting import FittedModel, at_values, refit
from droid_jax.discrepancy.selection import WEAK, Reason, ValidationTest, significance_reasons
from droid_jax.discrepancy.statistics import one_sided_p
from droid_jax.identify.search import NotReplayed


def case_score_test(case: Case, model: FittedModel, asked: Sequence[ScoreDirection]) -> ScoreTest:
    """The score test of a case: on the training recording, for a log with the p-value of all blocks.

    Candidates are ranked on the training blocks alone, since the validation blocks judge them afterwards.
    """
    found = score_test(case.train, model, asked, case.config.seed)
    if case.both is None:
        return found
    return replace(found, p=score_test(case.both, at_values(case.both, model), asked, case.config.seed).p)


def cross_validated(
    problem: Problem, before: FittedModel, tried: Sequence[FittedModel], tests: Sequence[ValidationTest]
) -> list[ValidationTest]:
    """The validation tests, with two-fold cross-validation of the best models that validation blocks do not confirm.

    The model is also fitted to the validation blocks and judged on the training blocks.  Its gain is then tested with
    twice as many blocks.  Models are cross-validated only if there is no other reason against them than significance
    and size.
    """
    out, case = list(tests), problem.case
    if case.both is None:
        return out
    for k in np.argsort([t.discrepancy_validation for t in tests]).tolist()[: case.config.blocks.cross_validated]:
        reasons = {r.reason for r in tests[k].reasons}
        if Reason.NOT_CONFIRMED not in reasons or reasons - WEAK - {Reason.SMALL_GAIN} or problem.late:
            continue
        problem.progress("refit", f"{tried[k].name}, cross-validation")
        try:
            p = _cross_validated_p(case, before, tried[k])
        except NotReplayed:
            continue
        others = (r for r in tests[k].reasons if r.reason is not Reason.NOT_CONFIRMED)
        out[k] = replace(tests[k], p=p, reasons=(*significance_reasons(p, case.config.selection), *others))
    return out


def _cross_validated_p(case: Case, before: FittedModel, model: FittedModel) -> float:
    """p-value of a model's gain on the validation blocks and, fitted to these, on the training blocks."""

    def gains(judged: ResidualSet, without: FittedModel, extended: FittedModel) -> np.ndarray:
        rows = judged.resampling
        commons = judged.common(np.stack([without.values, extended.values]))
        if not np.isfinite(commons).all():
            raise NotReplayed(f"the simulation of {judged.comparison.name!r} blows up")
        losses = [np.sum((rows.residuals(common) / rows.units) ** 2, axis=1) for common in commons]
        return 0.5 * (losses[0] - losses[1])

    other = [refit(case.validation, case.base, m.parts, m.values[None], case.config.refit) for m in (before, model)]
    return one_sided_p(np.concatenate([gains(case.validation, before, model), gains(case.train, *other)]))
