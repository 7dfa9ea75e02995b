"""From a base fit to a verdict: one selection step after the other, then pairs, then pruning.

A step scores all candidates, refits the promising ones, tests them on the validation recording and selects.
`selection_step` is a function from a state to the next one; nothing in a state is ever changed.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from droid_jax.cost.cost import Cost
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import (
    Proposal,
    ScoreDirection,
    ScoreTest,
    collinear,
    directions_of,
    proposals,
    rows_of,
    score_test,
)
from droid_jax.discrepancy.case import Case, ResidualSet
from droid_jax.discrepancy.config import CONVERGE_ITERATIONS
from droid_jax.discrepancy.fitting import (
    FittedModel,
    at_values,
    fitted_from_prior,
    one_step_fits,
    refit,
    remaining_discrepancy,
    remaining_residuals,
    with_step_difference,
)
from droid_jax.discrepancy.selection import (
    WEAK,
    Reason,
    SelectionStep,
    ValidationTest,
    much_more,
    selected,
    significance_reasons,
    validation_tests,
    without_dominated,
)
from droid_jax.discrepancy.statistics import one_sided_p
from droid_jax.discrepancy.verdict import Verdict, conclude, more_than_step_error, open_share
from droid_jax.distributed import agreed
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import Candidate, EffectKey, candidates, names_of

TOGETHER = 12  # candidates whose first steps share batches: on a CPU a few of them fill no whole block
Starter = tuple[Sequence[Candidate], np.ndarray]  # effects, and values [D] to start from


@dataclass(frozen=True, eq=False)
class Problem:
    """What every step is given.

    case: the recordings; base: the base model; base_discrepancy: its U on the validation recording;
    discretisation_error: U0; directions: all that are tested; deadline: `time.monotonic` after which no further
    candidate is tried; progress: called with a stage's name and value.
    """

    case: Case
    base: FittedModel
    base_discrepancy: float
    discretisation_error: float
    directions: tuple[ScoreDirection, ...]
    deadline: float | None
    progress: Progress

    @property
    def late(self) -> bool:
        """No time left."""
        return self.deadline is not None and agreed(time.monotonic() > self.deadline)

    def discrepancy(self, model: FittedModel) -> float:
        """U on the validation recording."""
        return self.case.validation.discrepancy_at(model.values)


@dataclass(frozen=True)
class Notes:
    """What went wrong by the way: models whose replay blew up, and what the budget left out."""

    failed: tuple[str, ...] = ()
    not_tried: tuple[str, ...] = ()

    def __add__(self, other: Notes) -> Notes:
        return Notes(self.failed + other.failed, self.not_tried + other.not_tried)


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
    return _nothing_more(problem, model, tested(case, model, asked))


def with_step_differences(case: Case, model: FittedModel, fine: Cost | None) -> Case:
    """The case, its training recording and the blocks of both parts knowing what a quarter of the time step changes.

    fine: what `with_finer_step` made of the training recording.
    """
    both = case.both
    if both is not None:
        same = fine
        if isinstance(fine, WindowedLog) and isinstance(both.cost, WindowedLog):
            same = replace(fine, whitener=both.cost.whitener, instants=both.cost.instants)
        both = with_step_difference(both, model, same)
    return replace(case, train=with_step_difference(case.train, model, fine), both=both)


def tested(case: Case, model: FittedModel, asked: Sequence[ScoreDirection]) -> ScoreTest:
    """The score test of the training recording; its p-value is that of all blocks, where validation has the others.

    What is tried next goes by the training blocks alone, so that the validation blocks judge it.
    """
    found = score_test(case.train, model, asked, case.config.seed)
    if case.both is None:
        return found
    return replace(found, p=score_test(case.both, at_values(case.both, model), asked, case.config.seed).p)


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
    found = tested(case, model, asked)
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
    promising, notes = _one_step_fits(problem, model, ranked[: config.one_step_fits], found)
    sure, others = promising[: config.sure_refits], promising[config.sure_refits :]
    others = sorted(others, key=lambda look: look[1])[: max(config.full_refits - len(sure), 0)]
    best = sorted([*sure, *others], key=lambda look: look[1])[: config.full_refits]
    begun = SelectionStep(found, model.keys, tuple(ranked), tuple(p for _, _, p in best))
    starters = [((*model.parts, *p.parts), values) for values, _, p in best]
    certain = {id(p) for _, _, p in sure}
    reached = [-np.inf if id(p) in certain else objective for _, objective, p in best]
    aim, before = target_objective(problem, model), model.refined.objective
    tried, more = staged_refit(problem, starters, aim, "candidates not refitted", gains=(before, reached))
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


def _one_step_fits(
    problem: Problem, model: FittedModel, ranked: Sequence[Proposal], found: ScoreTest
) -> tuple[list[tuple[np.ndarray, float, Proposal]], Notes]:
    """Values [D] and objective of each proposal after one step (see `fitting.one_step_fits`), some at a time."""
    out, config = list[tuple[np.ndarray, float, Proposal]](), problem.case.config
    for first in range(0, len(ranked), TOGETHER):
        if first and problem.late:
            return out, _late(len(ranked) - first, len(ranked), "candidates not looked at")
        asked, some = [], ranked[first : first + TOGETHER]
        for proposal in some:
            (part,), start = proposal.parts, proposal.start(problem.case.full_space, model.values)
            problem.progress("one_step_fit", names_of((*model.keys, part.key)))
            raw = {found.directions[k].coefficient: found.raw[k] for k in rows_of(found, proposal.parts)}
            asked.append((part, raw, start))
        ended = one_step_fits(problem.case.train, model, asked, config.one_step)
        out += [(*end, proposal) for end, proposal in zip(ended, some, strict=True)]
    return out, Notes()


def _late(left: int, of: int, what: str) -> Notes:
    return Notes(not_tried=(f"{left} of {of} {what}",))


def _refit(
    problem: Problem, parts: Sequence[Candidate], start: np.ndarray, config: RefineConfig, note: str = ""
) -> FittedModel:
    """Base parameters and parts from a start [D] over the whole space."""
    problem.progress("refit", (names_of(p.key for p in parts) or "base") + note)
    return refit(problem.case.train, problem.case.base, parts, start[None], config)


def staged_refit(
    problem: Problem,
    starters: Sequence[Starter],
    aim: float,
    what: str,
    note: str = "",
    gains: tuple[float, Sequence[float]] | None = None,
) -> tuple[list[FittedModel], Notes]:
    """Refits one after the other; one that will not reach the objective `aim`, or the best so far, is given up early.

    what: says in words what is left out where time runs out.  gains: the objective before, and what each reached in one
    step; where that step is hopeless by the rule that gives up a refit (`RefineConfig.give_up`), none is begun.
    """
    models, failed, config = list[FittedModel](), list[str](), problem.case.config.refit
    for number, (parts, start) in enumerate(starters):
        if number and problem.late:
            return models, Notes(tuple(failed)) + _late(len(starters) - number, len(starters), what)
        aim = min([aim, *(m.refined.objective for m in models)])
        if gains is not None and config.give_up * (gains[0] - gains[1][number]) < gains[1][number] - aim:
            continue
        try:
            models.append(_refit(problem, parts, start, replace(config, target_objective=aim), note))
        except NotReplayed:
            failed.append(names_of(p.key for p in parts))
    return models, Notes(tuple(failed))


def target_objective(problem: Problem, model: FittedModel) -> float:
    """Objective [log likelihood] of a fit that would take half of what a further effect has to."""
    config = problem.case.config.selection
    least = 0.5 * (config.least_further_gain if model.parts else config.least_gain)
    return model.refined.objective - 0.5 * least * model.discrepancy * problem.case.train.resampling.size


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
    basin = _neutral(problem, won, won.coefficients)
    tried = {m.keys for m in done.tried if m is not won}
    lost = [p for p in done.ranked if p.keys in tried]
    near = [*lost, *_collinear_candidates(done, config.selection.collinear)]
    starters = [(p.parts, p.start(case.full_space, basin)) for p in near]
    note, what = " (from where the best one ended)", "alternatives not refitted where the best one ended"
    beside, notes = staged_refit(problem, starters, won.refined.objective, what, note)
    try:
        before = min(problem.base, _refit(problem, (), basin, config.refit, note), key=problem.discrepancy)
    except NotReplayed:
        before = problem.base
    best = {m.keys: m for m in sorted([*done.tried, *beside], key=lambda m: m.refined.objective, reverse=True)}
    return _decided(problem, before, done, list(best.values())), notes


def _neutral(problem: Problem, model: FittedModel, coefficients: Sequence[str]) -> np.ndarray:
    """[D] values of a model with some coefficients at neutral."""
    space = problem.case.full_space
    values, at = model.values.copy(), [space.index(a) for a in coefficients]
    values[at] = space.mean[at]
    return values


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
    known = dict.fromkeys([key for one in (*best, *first.nearest) for key in one.keys])
    among = {*list(known)[: config.full_refits]}
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


def pruned(problem: Problem, model: FittedModel) -> FittedModel:
    """The model without effects that no longer take their share of U on the validation recording."""
    config = problem.case.config
    least = config.selection.least_share * problem.base_discrepancy
    for part in model.parts if len(model.parts) > 1 else ():
        start = _neutral(problem, model, part.coefficients)
        try:
            less = _refit(problem, without(part, model.parts), start, config.refit, f" without {part.key}")
            needed = problem.discrepancy(less) - problem.discrepancy(model) >= least
        except NotReplayed:  # it cannot do without the part
            continue
        if not needed:
            return pruned(problem, less)
    return model


def without(part: Candidate, parts: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """The other parts; where one of them shares the part's shape parameters, it has them from now on."""
    rest = [c for c in parts if c is not part]
    heir = next((c for c in rest if c.effect == part.effect and part.shape_parameters and not c.shape_parameters), None)
    return tuple(replace(c, shape_parameters=part.shape_parameters) if c is heir else c for c in rest)


def converged_model(problem: Problem, model: FittedModel) -> tuple[FittedModel, Notes]:
    """The model fitted until it converges: what it has yet to take would be credited to the next effect."""
    if model.refined.converged:
        return model, Notes()
    config = replace(problem.case.config.refit, iterations=CONVERGE_ITERATIONS)
    return _continued(problem, model, config, " continued")


def polished(problem: Problem, model: FittedModel) -> tuple[FittedModel, Notes]:
    """The same model with slopes over the width of its posterior, whose intervals are reported, if that fit arrives."""
    if not model.parts:
        return model, Notes()
    return _continued(problem, model, problem.case.config.polish, " polished")


def _continued(problem: Problem, model: FittedModel, config: RefineConfig, note: str) -> tuple[FittedModel, Notes]:
    """`model` fitted further; unchanged, with a note, where the result cannot be replayed on the validation motion, or
    where `model` had converged and the further fit did not.
    """
    found = _refit(problem, model.parts, model.values, config, note)
    if not np.isfinite(problem.case.validation.common(found.values)).all():
        return model, Notes(failed=(model.name + note,))
    if model.refined.converged and not found.refined.converged:
        return model, Notes(not_tried=(f"{model.name}{note} to the end",))  # that its replay blew up would be false
    return found, Notes()


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
    tests = confirmed_in_turns(problem, before, tried, tests)
    tests = without_small_gains(problem, before, tried, tests)
    tested = list(zip(tried, tests, strict=True))
    won = selected(tested, u0, problem.base_discrepancy, config)
    if won is None:
        return replace(done, tests=tuple(tests))
    tests = without_dominated(tested, won, case.effects, u0, config)
    winner, chosen = won
    return replace(done, tests=tuple(tests), selected=winner, chosen=chosen)


def confirmed_in_turns(
    problem: Problem, before: FittedModel, tried: Sequence[FittedModel], tests: Sequence[ValidationTest]
) -> list[ValidationTest]:
    """The tests with both halves of a log for the best models that the validation blocks alone do not confirm.

    Fitted to the validation blocks, a model is judged on the training blocks: twice as many blocks tell its gain from
    chance (two-fold cross-validation).  Asked for where nothing else but its size is against a model.
    """
    out, case = list(tests), problem.case
    if case.both is None:
        return out
    for k in np.argsort([t.discrepancy_validation for t in tests]).tolist()[: case.config.blocks.cross_validated]:
        reasons = {r.reason for r in tests[k].reasons}
        if Reason.NOT_CONFIRMED not in reasons or reasons - WEAK - {Reason.SMALL_GAIN} or problem.late:
            continue
        problem.progress("refit", f"{tried[k].name}, halves of the log in turns")
        try:
            p = _p_in_turns(case, before, tried[k])
        except NotReplayed:
            continue
        kept = (r for r in tests[k].reasons if r.reason is not Reason.NOT_CONFIRMED)
        out[k] = replace(tests[k], p=p, reasons=(*significance_reasons(p, case.config.selection), *kept))
    return out


def _p_in_turns(case: Case, before: FittedModel, model: FittedModel) -> float:
    """p-value of a model's gain over the blocks of validation, fitted to training, and the other way round."""

    def gains(judged: ResidualSet, without: FittedModel, extended: FittedModel) -> np.ndarray:
        rows = judged.resampling
        commons = judged.common(np.stack([without.values, extended.values]))
        if not np.isfinite(commons).all():
            raise NotReplayed(f"the simulation of {judged.comparison.name!r} blows up")
        losses = [np.sum((rows.residuals(common) / rows.units) ** 2, axis=1) for common in commons]
        return 0.5 * (losses[0] - losses[1])

    other = [refit(case.validation, case.base, m.parts, m.values[None], case.config.refit) for m in (before, model)]
    return one_sided_p(np.concatenate([gains(case.validation, before, model), gains(case.train, *other)]))


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
            found = tested(case, tried[k], asked)
            if found.p < case.config.selection.significance:
                break  # what explains less leaves more
        out[k] = replace(tests[k], reasons=tuple(r for r in tests[k].reasons if r.reason is not Reason.SMALL_GAIN))
    return out
