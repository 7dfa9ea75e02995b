"""A verdict's names and validation tests as plain data, as the experiments keep them."""

from __future__ import annotations

from typing import Any

from droid_jax.discrepancy.selection import ValidationTest
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.model.effects.candidate import names_of
from droid_jax.storage import finite


def answer_json(verdict: Verdict) -> dict[str, Any]:
    """What is named, in words: "latch at door_hinge", and the alternatives of each."""
    return {
        "verdict": verdict.conclusion.value,
        "effects": list(map(str, verdict.effects)),
        "indistinguishable": [list(map(names_of, alternatives)) for alternatives in verdict.indistinguishable],
    }


def validation_json(trial: ValidationTest) -> dict[str, Any]:
    """Name, figures and what spoke against it; discrepancy_validation is None where the model blew up there."""
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
