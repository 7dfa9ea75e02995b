"""The search for a missing effect, top to bottom: fit, ask, name, validation, decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from droid_jax.discrepancy.candidates import candidates
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.discretisation_error import above
from droid_jax.discrepancy.doubts import doubts
from droid_jax.discrepancy.localise import localise
from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.screen import ScoreDirection, ScoreTest, directions_of, project, score_test, sensitivities
from droid_jax.discrepancy.search_state import Budget, SearchState
from droid_jax.discrepancy.select import OF_ALL, SIGNIFICANT
from droid_jax.discrepancy.selection_step import (
    SelectionStep,
    converged_model,
    forward_step,
    pair_step,
    polished,
    pruned,
    restart_from_prior,
)
from droid_jax.discrepancy.transfer import remaining_residuals
from droid_jax.discrepancy.trend import trend
from droid_jax.discrepancy.verdict import LOST, Conclusion, Hint, Verdict, open_share
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed

OPEN = 0.1  # share of the gap left open from which a model explains it only partly


def score(case: Case, model: FittedModel, asked: tuple[ScoreDirection, ...]) -> ScoreTest:
    """Screen questions against a model's residuals on the first demonstration.

    A base parameter at a bound absorbs nothing more: marks keep what it would have taken.
    """
    root, free = case.train.repeats**0.5, model.refined.free
    base, prior = model.refined.jacobian[:, free] / root, model.refined.prior[free] * root * case.train.prior_slack
    raw = sensitivities(case.train, model.values, asked)
    blown_up = np.isnan(raw).any(axis=1)
    raw[blown_up] = 0.0
    projected = project(raw, base, prior)
    found = score_test(
        model.residuals,
        asked,
        raw,
        projected,
        lambda s: case.train.largest_score(s, projected, base, prior, case.config.seed),
    )
    names = (asked[k].candidate.name for k in np.flatnonzero(blown_up))
    return replace(found, failed=tuple(dict.fromkeys(names)))


def search_effects(
    case: Case, base: FittedModel, floor: float, progress: Progress = lambda stage, value: None
) -> Verdict:
    """From a base fit to a verdict.  floor: U0, see `discretisation_error`.

    Raises ValueError where the case's effects have no place that could be asked about.
    """
    state = SearchState(
        case, case.validation.discrepancy_at(base.values), floor, Budget(case.config.budget_minutes), progress
    )
    if not base.refined.converged:
        return _verdict(state, base, base, [], quiet=False)
    asked = directions_of(candidates(case.effects))
    model, rounds, quiet = base, list[SelectionStep](), False
    while len(model.parts) < case.config.max_effects:
        left = open_directions(asked, model)
        quiet = not left
        if quiet:  # all that was asked about is in the model
            break
        progress("screen", model.name)
        found = score(case, model, left)
        quiet = found.p >= SIGNIFICANT or not above(model.discrepancy, floor)
        enough = not model.parts or state.discrepancy(model) > OF_ALL * state.base_discrepancy
        done = forward_step(state, model, found) if enough and not quiet else SelectionStep(found)
        if not model.parts:
            done = restart_from_prior(state, base, done)
        rounds.append(done)
        if done.selected is None:
            break
        model = converged_model(state, done.selected)
    if case.config.max_effects > 1 and not quiet and rounds[0].tried and _unsettled(state, model):
        if state.budget.spent:
            state.budget.skip("pairs of effects not tried")
        else:
            rounds.append(pair_step(state, base, model, rounds[0]))
            model = converged_model(state, rounds[-1].selected or model)
    return _verdict(state, base, polished(state, converged_model(state, pruned(state, model))), rounds, quiet)


def open_directions(asked: Sequence[ScoreDirection], model: FittedModel) -> tuple[ScoreDirection, ...]:
    """Questions that a model leaves open.

    A shape belongs to an effect at all places alike: where the effect is in the model at one place, it is asked about
    at the others with the shape that it has there.
    """
    known = {c.effect for c in model.parts}
    left = dict[Any, ScoreDirection]()
    for q in asked:
        if set(q.candidate.coefficients) & set(model.coefficients):
            continue
        part = replace(q.candidate, shape_parameters={}) if q.candidate.effect in known else q.candidate
        left.setdefault((part.key, q.coefficient), replace(q, candidate=part))
    return tuple(left.values())


def _unsettled(state: SearchState, model: FittedModel) -> bool:
    """Nothing named yet, several effects, or much left over: one that mimics two may have stood in their way."""
    return (
        len(model.parts) != 1
        or _open(state, remaining_residuals(state.case.train, state.case.validation, model)) > OPEN
    )


def _open(state: SearchState, residuals: np.ndarray) -> float:
    """Share of the gap on the validation demonstration that these residuals still hold."""
    return open_share(state.case.validation.discrepancy(residuals), state.base_discrepancy, state.discretisation_error)


def _verdict(
    state: SearchState, base: FittedModel, model: FittedModel, rounds: list[SelectionStep], quiet: bool
) -> Verdict:
    """quiet: the last screening found nothing more.  Of a fit that did not converge nothing is named."""
    case, floor = state.case, state.discretisation_error
    converged = base.refined.converged and model.refined.converged
    if not converged:
        model, rounds = base, [replace(r, selected=None, chosen=None) for r in rounds]
    gaps = _gaps(state, base, model)
    missing = bool(rounds) and rounds[0].screen.p < SIGNIFICANT and above(base.discrepancy, floor)
    tied = tuple(_tied(part.name, model, rounds) for part in model.parts)
    left = remaining_residuals(case.train, case.validation, model) if converged else None
    kind = Conclusion.NONE if not missing else Conclusion.UNEXPLAINED
    if left is None:
        kind = Conclusion.UNCONVERGED
    elif model.parts:
        kind = (
            Conclusion.PARTLY
            if _remains(state, left, quiet)
            else Conclusion.INDISTINGUISHABLE
            if any(tied)
            else Conclusion.NAMED
        )
    verdict = Verdict(
        kind=kind,
        effects=tuple(c.name for c in model.parts),
        indistinguishable=tied,
        base=base,
        model=model,
        discretisation_error=floor,
        discrepancies=gaps,
        remainder=None if left is None else case.validation.discrepancy(left),
        score_tests=tuple(dict.fromkeys(r.screen for r in rounds)),  # pairs are proposed from the first one
        validation_tests=tuple(t for r in rounds for t in r.tests),
        before=localise(case.train, base.values, base.residuals, model.values),
        after=localise(case.train, model.values, model.residuals, model.values),
        failed=tuple(state.failed),
        indistinguishable_models=next((r.indistinguishable for r in reversed(rounds) if r.selected is not None), ()),
        not_tried=state.budget.cut,
        trend=trend(rounds[0].screen, base.residuals, case.config.seed) if rounds and case.train.repeated else None,
        doubts=doubts(case.train, model, case.natural_bounds),
    )
    return unnamed(case, verdict) if too_little(verdict, case.config.minimum_closed) else verdict


def too_little(verdict: Verdict, least: float) -> bool:
    """Whether effects beside a remainder close less than a share `least` on a held-out recording.

    What closes a third of a discrepancy and leaves the rest may only imitate what is missing.
    """
    closed = verdict.closed_held_out() if verdict.kind is Conclusion.PARTLY else {}
    return bool(closed) and min(closed.values()) < least


def unnamed(case: Case, verdict: Verdict) -> Verdict:
    """The verdict with its effects as hints, and the base model as the one that stands."""
    base = verdict.base
    where = localise(case.train, base.values, base.residuals, base.values)
    return replace(
        verdict,
        kind=Conclusion.UNEXPLAINED,
        effects=(),
        indistinguishable=(),
        model=base,
        discrepancies={role: (before, before) for role, (before, _) in verdict.discrepancies.items()},
        remainder=case.validation.discrepancy(remaining_residuals(case.train, case.validation, base)),
        before=where,
        after=where,
        indistinguishable_models=(),
        doubts=(),
        hints=(Hint(verdict.effects, verdict.indistinguishable, verdict.closed_held_out()),),
    )


def _gaps(state: SearchState, base: FittedModel, model: FittedModel) -> dict[str, tuple[float, float]]:
    """U before and after by role; without the test motion where one of them cannot be replayed there."""
    gaps = {}
    for role, judged in state.case.held_sets.items():
        try:
            gaps[role] = judged.discrepancy_at(base.values), judged.discrepancy_at(model.values)
        except NotReplayed:
            if role != "test":
                raise
            state.failed.append(LOST)
    return gaps


def _remains(state: SearchState, residuals: np.ndarray, quiet: bool) -> bool:
    """Whether residuals of the validation demonstration hold much of its gap, and more than chance leaves.

    An effect that no candidate looks like is seen by no screening, but by every repeat.
    """
    if _open(state, residuals) <= OPEN:
        return False
    everywhere = np.ones((1, residuals.shape[1]), bool)
    return not quiet or float(state.case.validation.cell_p_values(residuals, everywhere)[0]) < SIGNIFICANT


def _tied(part: str, model: FittedModel, rounds: Sequence[SelectionStep]) -> tuple[str, ...]:
    """What is equivalent as one effect of the model: what rivals have in its place in the last round that chose it.

    A rival that does without several of the model's effects is named whole, beside each of them.
    """
    known = {c.name for c in model.parts}
    for done in reversed(rounds):
        added = {c.name for c in done.selected.parts} - set(done.before) if done.selected is not None else set()
        if part in added:
            others = [{c.name for c in m.parts} - set(done.before) for m in done.indistinguishable]
            instead = [o - added for o in others if part not in o and not (o - added) & known]
            return tuple(sorted({" + ".join(sorted(names)) for names in instead if names}))
    return ()
