"""From a base fit to a verdict: forward selection steps, then pairs of effects, then pruning.

A step scores all candidates, refits the most promising ones, tests them on the validation recording and selects one.
`selection_step` is a function from a state to the next one; states are immutable.
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
from droid_jax.discrepancy.posterior import remaining_discrepancy
from droid_jax.discrepancy.selection import (
    WEAK,
    Reason,
    SelectionStep,
    ValidationTest,
    reduced_enough,
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
    """State of a search.

    model: the model with the effects selected so far.
    steps: all selection steps so far.
    finished: whether there is no further step.
    exhausted: whether the last score test found nothing more.
    notes: incidents so far.
    """

    model: FittedModel
    steps: tuple[SelectionStep, ...] = ()
    finished: bool = False
    exhausted: bool = False
    notes: Notes = field(default_factory=Notes)


def search_effects(
    case: Case, base: FittedModel, discretisation_error: float, progress: Progress = lambda stage, value: None
) -> Verdict:
    """Search for missing effects, from a base fit to a verdict.

    Args:
        case: the recordings.
        base: the base model, fitted to the training recording.
        discretisation_error: U0, see `step_error.discretisation_error`.
        progress: called with a stage's name and value.

    Raises:
        ValueError: the case's effects have no location to test.
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
    last_scored = state.model if state.steps and state.steps[-1].selected is None else None
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
        exhausted=state.exhausted
        if last_scored is not None and last_scored.keys == model.keys
        else _explained(problem, model),
        failed=notes.failed,
        ruled_out=notes.ruled_out,
        not_tried=notes.not_tried,
    )


def _explained(problem: Problem, model: FittedModel) -> bool:
    """Whether a score test of the final model finds nothing more.

    Asked if the search made no such test: pairs of effects were added last, or `max_effects` was reached.
    """
    case, asked = problem.case, open_directions(problem.directions, model)
    if not asked:
        return True
    problem.progress("score_test", model.name)
    return _nothing_more(problem, model, case_score_test(case, model, asked))


def _nothing_more(problem: Problem, model: FittedModel, found: ScoreTest) -> bool:
    """Whether a score test is not significant, or shows no more than the error of the time step."""
    if found.p >= problem.case.config.selection.significance:
        return True
    return not more_than_step_error(problem.case, model, found, problem.discretisation_error)


def selection_step(state: SearchState, problem: Problem) -> tuple[SearchState, SelectionStep | None]:
    """One selection step.

    Returns:
        The next state, and the step's tests and fits; None if the model has `max_effects` or all effects.
    """
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
    after = replace(state, steps=(*state.steps, info), exhausted=exhausted, notes=state.notes + notes)
    if info.selected is None:
        return replace(after, finished=True), info
    model, notes = converged_model(problem, info.selected)
    return replace(after, model=model, notes=after.notes + notes), info


def open_directions(asked: Sequence[ScoreDirection], model: FittedModel) -> tuple[ScoreDirection, ...]:
    """Directions of effects that are not in a model.

    All locations of an effect share its shape parameters.  If the model has the effect at one location, directions at
    other locations take the shape parameters from the model.
    """
    present = {c.effect for c in model.parts}
    remaining = dict[tuple[EffectKey, str], ScoreDirection]()
    for d in asked:
        if set(d.candidate.coefficients) & set(model.coefficients):
            continue
        part = replace(d.candidate, shape_parameters={}) if d.candidate.effect in present else d.candidate
        remaining.setdefault((part.shaped_key, d.coefficient), replace(d, candidate=part))
    return tuple(remaining.values())


def _forward(problem: Problem, model: FittedModel, found: ScoreTest) -> tuple[SelectionStep, Notes]:
    """Refit and test the best candidates of a score test, and then those collinear with the selected one."""
    case, config = problem.case, problem.case.config
    ranked = proposals(found, model.residuals, case.full_space)
    fits, notes = proposals_after_one_step(problem, model, ranked[: config.one_step_fits], found)
    sure, others = fits[: config.sure_refits], fits[config.sure_refits :]
    others = sorted(others, key=lambda fit: fit[1])[: max(config.full_refits - len(sure), 0)]
    best = sorted([*sure, *others], key=lambda fit: fit[1])[: config.full_refits]
    begun = SelectionStep(found, model.keys, tuple(ranked), nearest=tuple(p for _, _, p in best))
    starts = [((*model.parts, *p.parts), values) for values, _, p in best]
    certain = {p.keys for _, _, p in sure}
    reached = [-np.inf if p.keys in certain else objective for _, objective, p in best]
    target, before = target_objective(problem, model), model.refined.objective
    tried, more = staged_refit(problem, starts, target, "candidates not refitted", one_step=(before, reached))
    notes += more
    done = _decided(problem, model, begun, tried)
    near = _collinear_candidates(done, config.selection.collinear)
    if not near:
        return done, notes
    starts = [((*model.parts, *p.parts), p.start(case.full_space, model.values)) for p in near]
    target = min(m.refined.objective for m in tried)
    what = "candidates collinear with the best not refitted"
    alternatives, more = staged_refit(problem, starts, target, what, " (collinear with the best)")
    return _decided(problem, model, begun, [*tried, *alternatives]), notes + more


def restart_from_prior(problem: Problem, done: SelectionStep) -> tuple[SelectionStep, Notes]:
    """A first step that selected nothing, repeated with its best model fitted from the prior.

    A missing effect may have biased the base fit into a wrong basin.  The right effect then explains the training
    recording but not the validation recording.  If it is selected after a fit from the prior, the other models and the
    base model are fitted in that basin too.  A gain of the base model there does not count for an effect.  The step is
    not repeated for logs: inverse dynamics is smooth in the parameters, and windows nearly are.
    """
    case, base = problem.case, problem.base
    if done.selected is not None or not done.tried or not case.train.resampling.repeated:
        return done, Notes()
    best = min(done.tried, key=lambda m: m.discrepancy)
    if best.discrepancy > (1 - case.config.selection.least_gain) * base.discrepancy:
        return done, Notes()
    if problem.late:
        return done, Notes(not_tried=("the fit from the prior",))
    restarted = _better_from_prior(problem, best)
    again = _decided(problem, base, done, [restarted if m is best else m for m in done.tried])
    return (done, Notes()) if again.selected is None else _alternatives_in_basin(problem, again, again.selected)


def _better_from_prior(problem: Problem, model: FittedModel) -> FittedModel:
    """The model unchanged or fitted from the prior, whichever has the lower objective."""
    case = problem.case

    def progress(stage: str, value: object) -> None:
        problem.progress("restart", value)

    try:
        restarted = fitted_from_prior(case.train, case.base, model.parts, case.config, progress)
    except NotReplayed:
        return model
    return min(model, restarted, key=lambda m: m.refined.objective)


def _alternatives_in_basin(problem: Problem, done: SelectionStep, winner: FittedModel) -> tuple[SelectionStep, Notes]:
    """The step with the other models, and candidates collinear with the winner, refitted from the winner's values.

    The base model is refitted from there too; the better one of both on the validation recording is taken.
    """
    case, config = problem.case, problem.case.config
    basin = at_neutral(problem, winner, winner.coefficients)
    # In the other basin some were not refitted, as their one step was hopeless there.
    best = ({m.keys for m in done.tried} | {p.keys for p in done.nearest}) - {winner.keys}
    others = [p for p in done.ranked if p.keys in best]
    near = [*others, *_collinear_candidates(done, config.selection.collinear)]
    starts = [(p.parts, p.start(case.full_space, basin)) for p in near]
    note, what = " (from the best model's values)", "alternatives not refitted from the best model's values"
    alternatives, notes = staged_refit(problem, starts, winner.refined.objective, what, note)
    try:
        before = min(problem.base, search_refit(problem, (), basin, config.refit, note), key=problem.discrepancy)
    except NotReplayed:
        before = problem.base
    lowest = {m.keys: m for m in sorted([*done.tried, *alternatives], key=lambda m: m.refined.objective, reverse=True)}
    return _decided(problem, before, done, list(lowest.values())), notes


def _collinear_candidates(done: SelectionStep, cosine: float) -> list[Proposal]:
    """Candidates whose sensitivities are collinear with the selected model's and that were not refitted."""
    if done.selected is None:
        return []
    new = [key for key in done.selected.keys if key not in done.before]
    tried = {key for m in done.tried for key in m.keys}
    near = collinear(done.score_test, set(new), cosine)
    present = {*done.selected.coefficients}  # a candidate with these alone is a part of the selected model
    return [p for p in done.ranked if p.keys[0] in near - tried and not present.issuperset(p.parts[0].coefficients)]


def pair_step(state: SearchState, problem: Problem) -> SearchState:
    """The state after a step that adds two effects at once, among the best of the first step.

    A single effect that imitates two missing ones may have been selected in their place.  The step is skipped if one
    effect is selected and explains the discrepancy.
    """
    if problem.case.config.max_effects < 2 or state.exhausted or not state.steps or not state.steps[0].tried:
        return state
    if len(state.model.parts) == 1 and not _partly_open(problem, state.model):
        return state
    if problem.late:
        return replace(state, notes=state.notes + Notes(not_tried=("pairs of effects not tried",)))
    info, notes = _pairs(problem, state.model, state.steps[0])
    model, more = converged_model(problem, info.selected or state.model)
    return replace(state, model=model, steps=(*state.steps, info), notes=state.notes + notes + more)


def _partly_open(problem: Problem, model: FittedModel) -> bool:
    """Whether more than `SelectionConfig.open_share` of the base model's U remains on the validation recording."""
    case = problem.case
    remaining = remaining_discrepancy(case.train, case.validation, model)
    share = open_share(remaining, problem.base_discrepancy, problem.discretisation_error)
    return share > case.config.selection.open_share


def _pairs(problem: Problem, model: FittedModel, first: SelectionStep) -> tuple[SelectionStep, Notes]:
    """Refit and test the best pairs of candidates of the first step, and the model that stands if it has several."""
    case, config = problem.case, problem.case.config
    best = sorted(first.tests, key=lambda t: t.discrepancy_validation)[: config.full_refits]
    keys = dict.fromkeys([key for one in (*best, *first.nearest) for key in one.keys])
    among = {*list(keys)[: config.full_refits]}
    ranked = proposals(first.score_test, problem.base.residuals, case.full_space, number=2, among=among)
    ranked = [p for p in ranked if set(p.keys) != set(model.keys)][: config.pair_refits]
    starts = [(p.parts, p.start(case.full_space, problem.base.values)) for p in ranked]
    target = target_objective(problem, min(first.tried, key=lambda m: m.refined.objective))
    tried, notes = staged_refit(problem, starts, target, "pairs not tried")
    single, test = min(zip(first.tried, first.tests, strict=True), key=lambda both: both[1].discrepancy_validation)
    done = _decided(problem, problem.base, first, [*tried, model] if len(model.parts) > 1 else tried)
    if done.selected is None or done.chosen is None:
        return done, notes
    remaining_before, remaining_after = (
        functools.partial(remaining_discrepancy, case.train, case.validation, m) for m in (single, done.selected)
    )
    before, after = test.discrepancy_validation, done.chosen.discrepancy_validation
    if reduced_enough(before, after, remaining_before, remaining_after, problem.base_discrepancy, config.selection):
        return done, notes
    return replace(done, selected=None, chosen=None), notes


def _decided(
    problem: Problem, before: FittedModel, begun: SelectionStep, tried: Sequence[FittedModel]
) -> SelectionStep:
    """The step with validation tests of the models `tried` and the selected one.

    Args:
        problem: constants of the search.
        before: the model that they extend.
        begun: the step; its earlier tests are dropped.
        tried: refitted models.
    """
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
    winner = selected(tested, u0, problem.base_discrepancy, config)
    if winner is None:
        return replace(done, tests=tuple(tests))
    tests = without_dominated(tested, winner, case.effects, u0, config)
    return replace(done, tests=tuple(tests), selected=winner[0], chosen=winner[1])


def without_small_gains(
    problem: Problem, before: FittedModel, tried: Sequence[FittedModel], tests: Sequence[ValidationTest]
) -> list[ValidationTest]:
    """The validation tests of a log, without the reason SMALL_GAIN where the score test finds nothing beside a model.

    U of blocks includes the noise.  If noise is most of it, no effect explains a large share, however significant it
    is.  A significant score test beside the model is the criterion there instead.  Models with a weak reason besides
    are tested too: if one of them is better than all models that pass, nothing is selected (`selected`).
    """
    out, case = list(tests), problem.case
    if before.parts or case.train.resampling.repeated:
        return out
    needed = case.config.blocks.least_gain * problem.base_discrepancy
    for k in np.argsort([t.discrepancy_validation for t in tests]).tolist():
        gain = problem.base_discrepancy - tests[k].discrepancy_validation
        if {r.reason for r in tests[k].reasons} - WEAK != {Reason.SMALL_GAIN} or gain < needed or problem.late:
            continue
        problem.progress("score_test", tried[k].name)
        if asked := open_directions(problem.directions, tried[k]):
            found = case_score_test(case, tried[k], asked)
            if found.p < case.config.selection.significance:
                break  # models with a smaller gain leave more to find
        out[k] = replace(tests[k], reasons=tuple(r for r in tests[k].reasons if r.reason is not Reason.SMALL_GAIN))
    return out
