"""The fits of a search: candidates after one step, refits in turn, and the selected model to its end."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.discrepancy.candidates import Proposal, ScoreDirection, ScoreTest, rows_of
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.config import CONVERGE_ITERATIONS
from droid_jax.discrepancy.fitting import FittedModel, one_step_fits, refit
from droid_jax.distributed import agreed
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import Candidate, names_of

TOGETHER = 4  # candidates whose first steps share batches: two starts of eight trials each fill two blocks of a CPU
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


def proposals_after_one_step(
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


def search_refit(
    problem: Problem, parts: Sequence[Candidate], start: np.ndarray, config: RefineConfig, note: str = ""
) -> FittedModel:
    """Base parameters and parts from a start [D] over the whole space."""
    problem.progress("refit", (names_of(p.key for p in parts) or "base") + note)
    return refit(problem.case.train, problem.case.base, parts, start[None], config)


def staged_refit(
    problem: Problem, starters: Sequence[Starter], aim: float, what: str, note: str = ""
) -> tuple[list[FittedModel], Notes]:
    """Refits one after the other; one that will not reach the objective `aim`, or the best so far, is given up early.

    what: says in words what is left out where time runs out.
    """
    models, failed = list[FittedModel](), list[str]()
    for number, (parts, start) in enumerate(starters):
        if number and problem.late:
            return models, Notes(tuple(failed)) + _late(len(starters) - number, len(starters), what)
        aim = min([aim, *(m.refined.objective for m in models)])
        try:
            models.append(
                search_refit(problem, parts, start, replace(problem.case.config.refit, target_objective=aim), note)
            )
        except NotReplayed:
            failed.append(names_of(p.key for p in parts))
    return models, Notes(tuple(failed))


def target_objective(problem: Problem, model: FittedModel) -> float:
    """Objective [log likelihood] of a fit that would take half of what a further effect has to."""
    config = problem.case.config.selection
    least = 0.5 * (config.least_further_gain if model.parts else config.least_gain)
    return model.refined.objective - 0.5 * least * model.discrepancy * problem.case.train.resampling.size


def pruned(problem: Problem, model: FittedModel) -> FittedModel:
    """The model without effects that no longer take their share of U on the validation recording."""
    config = problem.case.config
    least = config.selection.least_share * problem.base_discrepancy
    for part in model.parts if len(model.parts) > 1 else ():
        start = at_neutral(problem, model, part.coefficients)
        try:
            less = search_refit(problem, without(part, model.parts), start, config.refit, f" without {part.key}")
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
    found = search_refit(problem, model.parts, model.values, config, note)
    if not np.isfinite(problem.case.validation.common(found.values)).all():
        return model, Notes(failed=(model.name + note,))
    if model.refined.converged and not found.refined.converged:
        return model, Notes(not_tried=(f"{model.name}{note} to the end",))  # that its replay blew up would be false
    return found, Notes()


def at_neutral(problem: Problem, model: FittedModel, coefficients: Sequence[str]) -> np.ndarray:
    """[D] values of a model with some coefficients at neutral."""
    space = problem.case.full_space
    values, at = model.values.copy(), [space.index(a) for a in coefficients]
    values[at] = space.mean[at]
    return values
