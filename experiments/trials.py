"""A trial of an effect as plain data, as the experiments keep it."""

from __future__ import annotations

from typing import Any

from droid_jax.discrepancy.select import ValidationTest
from droid_jax.storage import finite


def trial_json(trial: ValidationTest) -> dict[str, Any]:
    """Name, figures and what spoke against it; discrepancy_validation is None where the model blew up there."""
    return {
        "name": trial.name,
        "passed": trial.passed,
        "p": trial.p,
        "discrepancy_train": trial.discrepancy_train,
        "discrepancy_validation": finite(trial.discrepancy_validation),
        "chosen": trial.chosen,
        "rivals": list(trial.indistinguishable),
        "reasons": list(trial.reasons),
    }
