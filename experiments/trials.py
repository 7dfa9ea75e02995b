"""A trial of an effect as plain data, as the experiments keep it."""

from __future__ import annotations

from typing import Any

from droid_jax.discrepancy.select import Trial
from droid_jax.storage import finite


def trial_json(trial: Trial) -> dict[str, Any]:
    """Name, figures and what spoke against it; gap_confirm is None where the model blew up there."""
    return {
        "name": trial.name,
        "passed": trial.passed,
        "p": trial.p,
        "gap_fit": trial.gap_fit,
        "gap_confirm": finite(trial.gap_confirm),
        "chosen": trial.chosen,
        "rivals": list(trial.rivals),
        "reasons": list(trial.reasons),
    }
