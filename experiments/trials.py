"""Names and validation tests of a verdict as plain data, for the experiments' result files."""

from __future__ import annotations

from typing import Any

from droid_jax.discrepancy.selection import ValidationTest
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.model.effects.candidate import names_of
from droid_jax.storage import finite


def answer_json(verdict: Verdict) -> dict[str, Any]:
    """The named effects as text, "latch at door_hinge", and the alternatives of each."""
    return {
        "verdict": verdict.conclusion.value,
        "effects": list(map(str, verdict.effects)),
        "indistinguishable": [list(map(names_of, alternatives)) for alternatives in verdict.indistinguishable],
    }


def validation_json(trial: ValidationTest) -> dict[str, Any]:
    """Name, numbers and reasons of rejection; discrepancy_validation is None where the model blew up there."""
    return {
        "name": names_of(trial.keys),
        "passed": trial.passed,
        "p": trial.p,
        "discrepancy_train": trial.discrepancy_train,
        "discrepancy_validation": finite(trial.discrepancy_validation),
        "chosen": trial.chosen,
        "indistinguishable": list(map(names_of, trial.indistinguishable)),
        "reasons": [r.text for r in trial.reasons],
    }
