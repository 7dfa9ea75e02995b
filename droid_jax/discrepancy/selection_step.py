"""One round of the search: refit what looks promising, put it on trial, choose."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.discrepancy.candidates import Candidate, joined_names
from droid_jax.discrepancy.case import SETTLED
from droid_jax.discrepancy.choose import selected, without_dominated
from droid_jax.discrepancy.rank import Proposal, collinear, proposals
from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.screen import ScoreTest
from droid_jax.discrepancy.search_state import SearchState
from droid_jax.discrepancy.select import LESS, OF_ALL, ValidationTest, much_more, validation_tests
from droid_jax.discrepancy.transfer import remaining_discrepancy
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.search import NotReplayed

POLISH = RefineConfig(iterations=12, basin_hops=0)
PAIRS = 4  # pairs refitted


@dataclass(frozen=True, eq=False)
class SelectionStep:
    """What was asked, what was tried, and what won.

    screen: of the model that stood before; before: names of its effects.  ranked: what could be added, the best first.
    tried, tests: the refitted models; selected, chosen: the one that does best and its trial, or None.
    """

    screen: ScoreTest
    before: tuple[str, ...] = ()
    ranked: tuple[Proposal, ...] = ()
    tried: tuple[FittedModel, ...] = ()
    tests: tuple[ValidationTest, ...] = ()
    selected: FittedModel | None = None
    chosen: ValidationTest | None = None

    @property
    def indistinguishable(self) -> tuple[FittedModel, ...]:
        """Models that cannot be told from the winner and lost, if at all, for their size or significance alone."""
        if self.chosen is None:
            return ()
        both = zip(self.tried, self.tests, strict=True)
        return tuple(m for m, t in both if (t.passed or t.weak) and t.name in self.chosen.indistinguishable)


def forward_step(state: SearchState, model: FittedModel, found: ScoreTest) -> SelectionStep:
    """Add the effect that does best on the validation demonstration, if one passes its trial."""
    case, config = state.case, state.case.config
    ranked = proposals(found, model.residuals, case.full_space)
    begun = SelectionStep(found, tuple(c.name for c in model.parts), tuple(ranked))
    looks = [
        (state.one_step_fit(model, p, found), p)
        for p in state.budget.within("candidates not looked at", ranked[: config.one_step_fits])
    ]
    best = sorted(looks, key=lambda look: look[0][1])[: config.full_refits]
    left = state.budget.within("candidates not refitted", best)
    tried = state.staged_refit(
        (((*model.parts, *p.parts), values) for (values, _), p in left), state.target_objective(model)
    )
    done = _decided(state, model, begun, tried)
    twins = _collinear_candidates(done)
    if not twins:
        return done
    left = state.budget.within("candidates that look like the best not refitted", twins)
    starters = (((*model.parts, *p.parts), p.start(case.full_space, model.values)) for p in left)
    tried += state.staged_refit(starters, min(m.refined.objective for m in tried), " (looks like the best)")
    return _decided(state, model, begun, tried)


def restart_from_prior(state: SearchState, base: FittedModel, done: SelectionStep) -> SelectionStep:
    """A first round without a winner: its best model fitted from the prior on, since the basin may be at fault.

    Where what is missing bent the base fit into a wrong basin, the right effect explains the fitted demonstration from
    there and not the other one.  If it wins from the prior on, its rivals are fitted in that basin too, and so is the
    base model: what that takes away by itself is no effect's.  A log of one repeat is replayed by inverse dynamics,
    which is smooth and has one basin.
    """
    if done.selected is not None or not done.tried or not state.case.train.repeated:
        return done
    best = min(done.tried, key=lambda m: m.discrepancy)
    if best.discrepancy > (1 - LESS) * base.discrepancy:
        return done
    if state.budget.spent:
        state.budget.skip("the fit from the prior on")
        return done
    fresh = state.refit_from_prior(best)
    again = _decided(state, base, done, [fresh if m is best else m for m in done.tried])
    return done if again.selected is None else _beside(state, base, again, again.selected)


def _beside(state: SearchState, base: FittedModel, done: SelectionStep, won: FittedModel) -> SelectionStep:
    """The round with what lost to a winner from the prior on, and what looks like it, fitted from where that ended.

    The base model is the one that does better on the validation demonstration, from there or as it was.
    """
    whole, basin = state.case.full_space, _neutral(state, won, won.coefficients)
    tried = {m.name for m in done.tried if m is not won}
    lost = [p for p in done.ranked if joined_names(p.parts) in tried]
    left = state.budget.within("rivals not refitted where the best one ended", [*lost, *_collinear_candidates(done)])
    note = " (from where the best one ended)"
    beside = state.staged_refit(((p.parts, p.start(whole, basin)) for p in left), won.refined.objective, note)
    try:
        before = min(base, state.refit((), basin, state.case.config.refit, note), key=state.discrepancy)
    except NotReplayed:
        before = base
    best = {m.name: m for m in sorted([*done.tried, *beside], key=lambda m: m.refined.objective, reverse=True)}
    return _decided(state, before, done, list(best.values()))


def _neutral(state: SearchState, model: FittedModel, amplitudes: Sequence[str]) -> np.ndarray:
    """[D] values of a model with some amplitudes at neutral."""
    values, at = model.values.copy(), [state.case.full_space.index(a) for a in amplitudes]
    values[at] = state.case.full_space.mean[at]
    return values


def _collinear_candidates(done: SelectionStep) -> list[Proposal]:
    """Candidates that were not refitted though their marks are nearly the winner's: they may do as well."""
    if done.selected is None:
        return []
    new = [c.name for c in done.selected.parts if c.name not in done.before]
    tried = {c.name for m in done.tried for c in m.parts}
    near = collinear(done.screen, set(new))
    return [p for p in done.ranked if p.names[0] in near - tried]


def pair_step(state: SearchState, base: FittedModel, model: FittedModel, first: SelectionStep) -> SelectionStep:
    """Two effects at once, from the best of the first round: one that mimics both may have stood in their way."""
    case = state.case
    best = sorted(first.tests, key=lambda t: t.discrepancy_validation)[: case.config.full_refits]
    ranked = proposals(first.screen, base.residuals, case.full_space, number=2, among={t.name for t in best})
    known = {c.name for c in model.parts}
    ranked = [p for p in ranked if set(p.names) != known][:PAIRS]
    left = state.budget.within("pairs not tried", ranked)
    starters = ((p.parts, p.start(case.full_space, base.values)) for p in left)
    tried = state.staged_refit(starters, state.target_objective(min(first.tried, key=lambda m: m.refined.objective)))
    alone, trial = min(zip(first.tried, first.tests, strict=True), key=lambda both: both[1].discrepancy_validation)
    done = _decided(state, base, first, [*tried, model] if len(model.parts) > 1 else tried)
    if done.selected is None or done.chosen is None:
        return done
    beside, beyond = (
        functools.partial(remaining_discrepancy, case.train, case.validation, m) for m in (alone, done.selected)
    )
    if much_more(
        trial.discrepancy_validation, done.chosen.discrepancy_validation, beside, beyond, state.base_discrepancy
    ):
        return done
    return replace(done, selected=None, chosen=None)


def pruned(state: SearchState, model: FittedModel) -> FittedModel:
    """The model without what no longer pays for itself on the validation demonstration."""
    for part in model.parts if len(model.parts) > 1 else ():
        start = _neutral(state, model, part.coefficients)
        try:
            less = state.refit(without(part, model.parts), start, state.case.config.refit, f" without {part.name}")
            pays = state.discrepancy(less) - state.discrepancy(model) >= OF_ALL * state.base_discrepancy
        except NotReplayed:  # it cannot do without the part
            continue
        if not pays:
            return pruned(state, less)
    return model


def without(part: Candidate, parts: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """The other parts; where one of them shares the part's shapes (a speed, a period), it has them from now on."""
    rest = [c for c in parts if c is not part]
    heir = next((c for c in rest if c.effect == part.effect and part.shape_parameters and not c.shape_parameters), None)
    return tuple(replace(c, shape_parameters=part.shape_parameters) if c is heir else c for c in rest)


def converged_model(state: SearchState, model: FittedModel) -> FittedModel:
    """The model gone on with until it stands still: what it has yet to take would be credited to the next effect."""
    if model.refined.converged:
        return model
    return state.polished(model, replace(state.case.config.refit, iterations=SETTLED), " gone on with")


def polished(state: SearchState, model: FittedModel) -> FittedModel:
    """The same model with slopes over the width of its posterior: its intervals are reported."""
    if not model.parts:
        return model
    return state.polished(model, POLISH, " polished")


def _decided(
    state: SearchState, before: FittedModel, begun: SelectionStep, tried: Sequence[FittedModel]
) -> SelectionStep:
    """A round with these models on trial, and none before; before: the model that stood."""
    case, done = state.case, replace(begun, tried=tuple(tried), tests=(), selected=None, chosen=None)
    if not tried:
        return done
    trials = validation_tests(
        case.train,
        case.validation,
        before,
        tried,
        case.minimum_sizes,
        state.base_discrepancy,
        floor=state.discretisation_error,
        seed=case.config.seed,
        ends=case.natural_bounds,
    )
    judged = list(zip(tried, trials, strict=True))
    won = selected(judged, state.discretisation_error, state.base_discrepancy)
    if won is None:
        return replace(done, tests=tuple(trials))
    trials = without_dominated(judged, won, case.effects, state.discretisation_error)
    winner, chosen = won
    return replace(done, tests=tuple(trials), selected=winner, chosen=chosen)
