"""What is added to a verdict: one amendment after the other, and one that fails takes nothing along."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from small_gap import Small, record, small

from droid_jax.discrepancy import missing
from droid_jax.discrepancy.fitting import FinalModel
from droid_jax.discrepancy.missing import EXPERIMENTS, MADE, NOT_NEEDED, REFIT, amended
from droid_jax.discrepancy.verdict import Experiment, Verdict
from droid_jax.files import NOT_MADE, TO_BE_MADE

FASTER = (Experiment("twice as fast", 8.5),)


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def with_an_alternative(found: Small) -> Verdict:
    """The verdict as if the base model were indistinguishable from its own."""
    return replace(found.verdict, indistinguishable_models=(found.base,))


def another_model(found: Small) -> FinalModel:
    """A final model that is not the search's own."""
    return FinalModel(found.base, (found.case.train,))


def failing(error: BaseException) -> Callable[..., Any]:
    def fail(*arguments: Any) -> Any:
        raise error

    return fail


def test_the_verdict_comes_first_and_then_each_amendment(found: Small, monkeypatch: pytest.MonkeyPatch):
    open_verdict, refitted = with_an_alternative(found), another_model(found)
    monkeypatch.setattr(missing, "separating_experiments", lambda case, models, recording: FASTER)
    monkeypatch.setattr(missing, "final_refit", lambda *arguments: refitted)
    first, second, third = amended(found.case, open_verdict, record("train"))
    assert first.states == {EXPERIMENTS: TO_BE_MADE, REFIT: TO_BE_MADE}
    assert (
        first.verdict is open_verdict
        and first.final.model is open_verdict.model
        and first.final.fitted_to == (found.case.train,)
    )
    assert second.verdict.experiments == FASTER and second.states == {EXPERIMENTS: MADE, REFIT: TO_BE_MADE}
    assert third.final is refitted and third.states == {EXPERIMENTS: MADE, REFIT: MADE}


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("the channel has a stretch that no repeat measured"), "the channel has a stretch that no repeat "),
        (MemoryError(), "MemoryError"),
        (RuntimeError("XLA gave up\nat length"), "RuntimeError: XLA gave up"),
    ],
)
def test_what_fails_is_said_and_what_comes_after_it_is_made(
    found: Small, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
):
    open_verdict, refitted = with_an_alternative(found), another_model(found)
    monkeypatch.setattr(missing, "separating_experiments", failing(error))
    monkeypatch.setattr(missing, "final_refit", lambda *arguments: refitted)
    *_, last = amended(found.case, open_verdict, record("train"))
    assert last.states[EXPERIMENTS].startswith(f"{NOT_MADE}: {said}") and "\n" not in last.states[EXPERIMENTS]
    assert last.states[REFIT] == MADE and last.final is refitted and last.verdict.experiments == ()
    monkeypatch.setattr(missing, "final_refit", failing(error))
    *_, last = amended(found.case, open_verdict, record("train"))
    assert last.states[REFIT].startswith(f"{NOT_MADE}: {said}")
    assert last.final.model is open_verdict.model and last.final.fitted_to == (found.case.train,)


def test_a_refit_that_cannot_be_written_is_no_final_model(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(missing, "final_refit", lambda *arguments: another_model(found))
    monkeypatch.setattr(missing, "extended", failing(ValueError("its covariance is singular")))
    *_, last = amended(found.case, found.verdict, record("train"))
    assert last.states[REFIT] == f"{NOT_MADE}: its covariance is singular" and last.final.model is found.verdict.model


def test_a_refit_that_does_not_converge_is_said(found: Small, monkeypatch: pytest.MonkeyPatch):
    short = replace(
        found.case, config=replace(found.case.config, refine=replace(found.case.config.refine, iterations=1))
    )
    *_, last = amended(short, found.verdict, record("train"))
    assert last.states == {
        EXPERIMENTS: NOT_NEEDED, REFIT: f"{NOT_MADE}: the fit to both motions did not converge"
    }  # fmt: skip


def test_nothing_is_added_where_nothing_is_due(found: Small):
    (only,) = amended(found.case, replace(found.verdict, model=found.base), record("train"))
    assert only.states == {EXPERIMENTS: NOT_NEEDED, REFIT: NOT_NEEDED}


def test_a_stop_is_no_failure(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(missing, "final_refit", failing(KeyboardInterrupt()))
    steps = amended(found.case, found.verdict, record("train"))
    assert next(steps).states[REFIT] == TO_BE_MADE
    with pytest.raises(KeyboardInterrupt):
        next(steps)
