"""What is added to a verdict once it is known: candidate experiments for a tie, and the final refit.

Both take minutes, and neither changes the verdict.  So a caller writes the verdict first and each addition when it is
made; one that fails is said in the result, and nothing else is lost.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from droid_jax.discrepancy.candidate_experiments import separating
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.extended import extended
from droid_jax.discrepancy.final_refit import FinalModel, due, final_model
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.errors import reason
from droid_jax.files import NOT_MADE, TO_BE_MADE
from droid_jax.identify.pipeline import Progress
from droid_jax.recordings.recording import Recording

EXPERIMENTS, REFIT = "experiments", "final_refit"  # names of the amendments in gap.json
MADE, NOT_NEEDED = "made", "not needed"


@dataclass(frozen=True, eq=False)
class Amended:
    """A verdict with what has been added to it so far.

    final: the model to hand on, the search's own until the final refit is made.  states: amendment -> MADE,
    NOT_NEEDED, TO_BE_MADE, or "not made: " and the reason.
    """

    verdict: Verdict
    final: FinalModel
    states: dict[str, str] = field(default_factory=dict)


def amended(
    case: Case, verdict: Verdict, recording: Recording, progress: Progress = lambda stage, value: None
) -> Iterator[Amended]:
    """The verdict as it is, then again after each amendment; the last one is whole.

    recording: what the case was fitted to.  An amendment that raises is left out and its state says why.
    """
    states = {
        EXPERIMENTS: TO_BE_MADE if verdict.indistinguishable_models else NOT_NEEDED,
        REFIT: TO_BE_MADE if due(case, verdict.model) else NOT_NEEDED,
    }
    now = Amended(verdict, FinalModel(verdict.model, (case.train,)), states)
    yield now
    if states[EXPERIMENTS] == TO_BE_MADE:
        now = _with_experiments(now, case, recording)
        yield now
    if states[REFIT] == TO_BE_MADE:
        now = _refitted(now, case, progress)
        yield now


def _with_experiments(now: Amended, case: Case, recording: Recording) -> Amended:
    verdict = now.verdict
    try:
        experiments = separating(case, (verdict.model, *verdict.indistinguishable_models), recording)
    except Exception as error:  # whatever it is: the verdict stands
        return _state(now, EXPERIMENTS, f"{NOT_MADE}: {reason(error)}")
    return _state(replace(now, verdict=replace(verdict, experiments=experiments)), EXPERIMENTS, MADE)


def _refitted(now: Amended, case: Case, progress: Progress) -> Amended:
    try:
        handed = final_model(case, now.verdict.model, progress)
        extended(case, handed)  # what is written of it can be made
    except Exception as error:  # as above; the search's own model is handed on
        handed = replace(now.final, not_made=reason(error))
    state = f"{NOT_MADE}: {handed.not_made}" if handed.not_made else MADE
    return _state(replace(now, final=handed), REFIT, state)


def _state(now: Amended, name: str, state: str) -> Amended:
    return replace(now, states={**now.states, name: state})
