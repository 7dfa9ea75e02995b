"""From a base fit to a verdict: one selection step after the other, then pairs, then pruning.

A step scores all candidates, refits the promising ones, tests them on the validation recording and selects.
`selection_step` is a function from a state to the next one; nothing in a state is ever changed.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from droid_jax.discrepancy.candidate_fits import (
    Notes,
    Problem,
    at_neutral,
    converged_model,
    polished,
    proposals_after_one_step,
    pruned,
    search_refit,
    staged_refit,
    target_objective,
)
from droid_jax.discrepancy.candidates import Proposal, ScoreDirection, ScoreTest, collinear, directions_of, proposals
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.cross_validation import case_score_test, cross_validated
from droid_jax.discrepancy.fitting import FittedModel, fitted_from_prior
from droid_jax.discrepancy.posterior import remaining_discrepancy, remaining_residuals
from droid_jax.discrepancy.selection import (
    WEAK,
    Reason,
    SelectionStep,
    ValidationTest,
    much_more,
    selected,
    validation_tests,
    without_dominated,
)
from droid_jax.discrepancy.step_error import more_than_step_error
from droid_jax.discrepancy.verdict import Verdict, conclude, open_share
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import EffectKey, candidates


@dataclass(frozen=True, eq=False)
class SearchState:
    """Where a search stands.

    model: with the effects selected so far.  steps: all that were made.  finished: no further step is to be made.
    exhausted: the last score test found nothing more.  notes: what went wrong.
    """

    model: FittedModel
    steps: tuple[SelectionStep, ...] = ()
    finished: bool = False
    exhausted: bool = False
    notes: Notes = field(default_factory=Notes)


def search_effects(
    case: Case, base: FittedModel, discretisation_error: float, progress: Progress = lambda stage, value: None
) -> Verdict:
    """From a base fit to a verdict.

    Args:
        case: the recordings.
        base: the base model, fitted to the training recording.
        discretisation_error: U0, see `fitting.discretisation_error`.
        progress: called with a stage's name and value.

    Raises:
        ValueError: the case's effects have no location that could be tested.
    """
    minutes, before = case.config.budget_minutes, case.validation.discrepancy_at(base.values)
    deadline = None if minutes is None else time.monotonic() + 60 * minutes
    if not base.refined.converged:
        return conclude(case, base, base, (), discretisation_error)
    asked = directions_of(candidates(case.effects))
    problem = Problem(case, base, before, discretisation_error, asked, deadline, progress)
    state = SearchState(base)
    while not state.finished:
        state, _ = selection_step(state, problem)
    tested = state.model if state.steps and state.steps[-1].selected is None else None  # what the last test was of
    state = pair_step(state, problem)
    model = pruned(problem, state.model)
    model, converging = converged_model(problem, model)
    model, polishing = polished(problem, model)
    notes = state.notes + converging + polishing
    return conclude(
        case,
        base,
        model,
        state.steps,
        discretisation_error,
        exhausted=state.exhausted if tested is not None and tested.keys == model.keys else _explained(problem, model),
        failed=notes.failed,
        not_tried=notes.not_tried,
    )


def _explained(problem: Problem, model: FittedModel) -> bool:
    """Whether a score test finds nothing beside a model of which none was made: its last effects came two at a time, or
    were as many as a search may take.
    """
    case, asked = problem.case, open_directions(problem.directions, model)
    if not asked:
        return True
    problem.progress("score_test", model.name)
    return _nothing_more(problem, model, case_score_test(case, model, asked))


def _nothing_more(problem: Problem, model: FittedModel, found: ScoreTest) -> bool:
    """Whether a score test of a model finds nothing, or no more than the time step leaves."""
    if found.p >= problem.case.config.selection.significance:
        return True
    return not more_than_step_error(problem.case, model, found, problem.discretisation_error)


def selection_step(state: SearchState, problem: Problem) -> tuple[SearchState, SelectionStep | None]:
    """One selection step: the next state, and what was asked and tried; None where nothing was left to ask."""
    model, case = state.model, problem.case
    if len(model.parts) >= case.config.max_effects:
        return replace(state, finished=True), None
    asked = open_directions(problem.directions, model)
    if not asked:
        return replace(state, finished=True, exhausted=True), None
    problem.progress("score_test", model.name)
    found = case_score_test(case, model, asked)
    thresholds = case.config.selection
    exhausted = _nothing_more(problem, model, found)
    info, notes = SelectionStep(found), Notes()
    enough = not model.parts or problem.discrepancy(model) > thresholds.least_share * problem.base_discrepancy
    if enough and not exhausted:
        info, notes = _forward(problem, model, found)
    if not model.parts:
        info, more = restart_from_prior(problem, info)
        notes += more
    known = replace(state, steps=(*state.steps, info), exhausted=exhausted, notes=state.notes + notes)
    if info.selected is None:
        return replace(known, finished=True), info
    model, notes = converged_model(problem, info.selected)
    return replace(known, model=model, notes=known.notes + notes), info


def open_directions(asked: Sequence[ScoreDirection], model: FittedModel) -> tuple[ScoreDirection, ...]:
    """Directions that a model leaves open.

    A shape belongs to an effect at all locations alike: where the effect is in the model at one location, it is asked
    about at the others with the shape that it has there.
    """
    known = {c.effect for c in model.parts}
    left = dict[tuple[EffectKey, str], ScoreDirection]()
    for d in asked:
        if set(d.candidate.coefficients) & set(model.coefficients):
            continue
        part = replace(d.candidate, shape_parameters={}) if d.candidate.effect in known else d.candidate
        left.setdefault((part.shaped_key, d.coefficient), replace(d, candidate=part))
    return tuple(left.values())


def _forward(problem: Problem, model: FittedModel, found: ScoreTest) -> tuple[SelectionStep, Notes]:
    """Add the effect that does best on the validation recording, if one passes its test."""
    case, config = problem.case, problem.case.config
    ranked = proposals(found, model.residuals, case.full_space)
    begun = SelectionStep(found, model.keys, tuple(ranked))
    promising, notes = proposals_after_one_step(problem, model, ranked[: config.one_step_fits], found)
    sure, others = promising[: config.sure_refits], promising[config.sure_refits :]
    others = sorted(others, key=lambda look: look[1])[: max(config.full_refits - len(sure), 0)]
    best = sorted([*sure, *others], key=lambda look: look[1])[: config.full_refits]
    starters = [((*model.parts, *p.parts), values) for values, _, p in best]
    tried, more = staged_refit(problem, starters, target_objective(problem, model), "candidates not refitted")
    notes += more
    done = _decided(problem, model, begun, tried)
    near = _collinear_candidates(done, config.selection.collinear)
    if not near:
        return done, notes
    starters = [((*model.parts, *p.parts), p.start(case.full_space, model.values)) for p in near]
    aim = min(m.refined.objective for m in tried)
    what = "candidates collinear with the best not refitted"
    beside, more = staged_refit(problem, starters, aim, what, " (collinear with the best)")
    return _decided(problem, model, begun, [*tried, *beside]), notes + more


def restart_from_prior(problem: Problem, done: SelectionStep) -> tuple[SelectionStep, Notes]:
    """A first step without a winner: its best model fitted from the prior on, since the basin may be at fault.

    Where what is missing bent the base fit into a wrong basin, the right effect explains the training recording from
    there and not the other one.  If it wins from the prior on, the others are fitted in that basin too, and so is the
    base model: what that takes away by itself is no effect's.  A log of one repeat is replayed by inverse dynamics,
    which is smooth and has one basin.
    """
    case, base = problem.case, problem.base
    if done.selected is not None or not done.tried or not case.train.resampling.repeated:
        return done, Notes()
    best = min(done.tried, key=lambda m: m.discrepancy)
    if best.discrepancy > (1 - case.config.selection.least_gain) * base.discrepancy:
        return done, Notes()
    if problem.late:
        return done, Notes(not_tried=("the fit from the prior on",))
    fresh = _better_from_prior(problem, best)
    again = _decided(problem, base, done, [fresh if m is best else m for m in done.tried])
    return (done, Notes()) if again.selected is None else _beside(problem, again, again.selected)


def _better_from_prior(problem: Problem, model: FittedModel) -> FittedModel:
    """The model unchanged or fitted from the prior on, whichever ends lower."""
    case = problem.case

    def progress(stage: str, value: object) -> None:
        problem.progress("restart", value)

    try:
        fresh = fitted_from_prior(case.train, case.base, model.parts, case.config, progress)
    except NotReplayed:
        return model
    return min(model, fresh, key=lambda m: m.refined.objective)


def _beside(problem: Problem, done: SelectionStep, won: FittedModel) -> tuple[SelectionStep, Notes]:
    """The step with what lost to a winner from the prior on, and what is collinear with it, fitted from its end.

    The base model is the one that does better on the validation recording, from there or unchanged.
    """
    case, config = problem.case, problem.case.config
    basin = at_neutral(problem, won, won.coefficients)
    tried = {m.keys for m in done.tried if m is not won}
    lost = [p for p in done.ranked if p.keys in tried]
    near = [*lost, *_collinear_candidates(done, config.selection.collinear)]
    starters = [(p.parts, p.start(case.full_space, basin)) for p in near]
    note, what = " (from where the best one ended)", "alternatives not refitted where the best one ended"
    beside, notes = staged_refit(problem, starters, won.refined.objective, what, note)
    try:
        before = min(problem.base, search_refit(problem, (), basin, config.refit, note), key=problem.discrepancy)
    except NotReplayed:
        before = problem.base
    best = {m.keys: m for m in sorted([*done.tried, *beside], key=lambda m: m.refined.objective, reverse=True)}
    return _decided(problem, before, done, list(best.values())), notes


def _collinear_candidates(done: SelectionStep, cosine: float) -> list[Proposal]:
    """Candidates that were not refitted though their sensitivities are nearly the winner's: they may do as well."""
    if done.selected is None:
        return []
    new = [key for key in done.selected.keys if key not in done.before]
    tried = {key for m in done.tried for key in m.keys}
    near = collinear(done.score_test, set(new), cosine)
    held = {*done.selected.coefficients}  # a part of the winner is no other model
    return [p for p in done.ranked if p.keys[0] in near - tried and not held.issuperset(p.parts[0].coefficients)]


def pair_step(state: SearchState, problem: Problem) -> SearchState:
    """Two effects at once, from the best of the first step: one that mimics both may have stood in their way.

    Tried where nothing is named yet, where several effects are, or where much is left over.
    """
    if problem.case.config.max_effects < 2 or state.exhausted or not state.steps or not state.steps[0].tried:
        return state
    if len(state.model.parts) == 1 and not _much_left(problem, state.model):
        return state
    if problem.late:
        return replace(state, notes=state.notes + Notes(not_tried=("pairs of effects not tried",)))
    info, notes = _pairs(problem, state.model, state.steps[0])
    model, more = converged_model(problem, info.selected or state.model)
    return replace(state, model=model, steps=(*state.steps, info), notes=state.notes + notes + more)


def _much_left(problem: Problem, model: FittedModel) -> bool:
    """Whether a model leaves much of the base model's U on the validation recording."""
    case = problem.case
    left = case.validation.resampling.discrepancy(remaining_residuals(case.train, case.validation, model))
    share = open_share(left, problem.base_discrepancy, problem.discretisation_error)
    return share > case.config.selection.open_share


def _pairs(problem: Problem, model: FittedModel, first: SelectionStep) -> tuple[SelectionStep, Notes]:
    case, config = problem.case, problem.case.config
    best = sorted(first.tests, key=lambda t: t.discrepancy_validation)[: config.full_refits]
    among = {key for t in best for key in t.keys}
    ranked = proposals(first.score_test, problem.base.residuals, case.full_space, number=2, among=among)
    ranked = [p for p in ranked if set(p.keys) != set(model.keys)][: config.pair_refits]
    starters = [(p.parts, p.start(case.full_space, problem.base.values)) for p in ranked]
    aim = target_objective(problem, min(first.tried, key=lambda m: m.refined.objective))
    tried, notes = staged_refit(problem, starters, aim, "pairs not tried")
    alone, test = min(zip(first.tried, first.tests, strict=True), key=lambda both: both[1].discrepancy_validation)
    done = _decided(problem, problem.base, first, [*tried, model] if len(model.parts) > 1 else tried)
    if done.selected is None or done.chosen is None:
        return done, notes
    beside, beyond = (
        functools.partial(remaining_discrepancy, case.train, case.validation, m) for m in (alone, done.selected)
    )
    before, after = test.discrepancy_validation, done.chosen.discrepancy_validation
    if much_more(before, after, beside, beyond, problem.base_discrepancy, config.selection):
        return done, notes
    return replace(done, selected=None, chosen=None), notes


def _decided(
    problem: Problem, before: FittedModel, begun: SelectionStep, tried: Sequence[FittedModel]
) -> SelectionStep:
    """A step with these models tested, and none before; before: the model that stood."""
    case, done = problem.case, replace(begun, tried=tuple(tried), tests=(), selected=None, chosen=None)
    if not tried:
        return done
    u0, config = problem.discretisation_error, case.config.selection
    tests = validation_tests(
        case.train,
        case.validation,
        before,
        tried,
        case.minimum_sizes,
        problem.base_discrepancy,
        discretisation_error=u0,
        seed=case.config.seed,
        natural_bounds=case.natural_bounds,
    )
    tests = cross_validated(problem, before, tried, tests)
    tests = without_small_gains(problem, before, tried, tests)
    tested = list(zip(tried, tests, strict=True))
    won = selected(tested, u0, problem.base_discrepancy, config)
    if won is None:
        return replace(done, tests=tuple(tests))
    tests = without_dominated(tested, won, case.effects, u0, config)
    winner, chosen = won
    return replace(done, tests=tuple(tests), selected=winner, chosen=chosen)


def without_small_gains(
    problem: Problem, before: FittedModel, tried: Sequence[FittedModel], tests: Sequence[ValidationTest]
) -> list[ValidationTest]:
    """The tests without a small gain as a reason where the model leaves nothing to find.

    U of blocks holds the noise.  Where noise is most of it no effect takes a large share, however sure it is; so what
    counts there is whether anything is left that chance would not leave.  A model that is weak besides is asked too:
    it may do better than one that passes, and nothing is named then.
    """
    out, case = list(tests), problem.case
    if before.parts or case.train.resampling.repeated:
        return out
    needed = case.config.blocks.least_gain * problem.base_discrepancy
    for k in np.argsort([t.discrepancy_validation for t in tests]).tolist():
        taken = problem.base_discrepancy - tests[k].discrepancy_validation
        if {r.reason for r in tests[k].reasons} - WEAK != {Reason.SMALL_GAIN} or taken < needed or problem.late:
            continue
        problem.progress("score_test", tried[k].name)
        if asked := open_directions(problem.directions, tried[k]):
            found = case_score_test(case, tried[k], asked)
            if found.p < case.config.selection.significance:
                break  # what explains less leaves more
        out[k] = replace(tests[k], reasons=tuple(r for r in tests[k].reasons if r.reason is not Reason.SMALL_GAIN))
    return out
