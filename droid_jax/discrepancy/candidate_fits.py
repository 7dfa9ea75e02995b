"""The fits of a search: one-step fits of candidates, full refits, and the convergence of the selected model."""

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
from droid_jax.model.effects.candidate import Candidate, Keys, keys_of, names_of

ONE_STEP_BATCH = 6  # candidates whose one-step fits share batches: few of them do not fill a block of a CPU
Start = tuple[Sequence[Candidate], np.ndarray]  # effects, and values [D] to start from


@dataclass(frozen=True, eq=False)
class Problem:
    """The constants of a search.

    case: the recordings.
    base: the base model.
    base_discrepancy: its U on the validation recording.
    discretisation_error: U0.
    directions: all score-test directions.
    deadline: time (`time.monotonic`) after which no further candidate is refitted, None for no limit.
    progress: called with a stage's name and value.
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
        """Whether the deadline has passed."""
        return self.deadline is not None and agreed(time.monotonic() > self.deadline)

    def discrepancy(self, model: FittedModel) -> float:
        """U of a model on the validation recording."""
        return self.case.validation.discrepancy_at(model.values)


@dataclass(frozen=True)
class Notes:
    """Incidents of a search.

    failed: names of models whose replay blew up.
    not_tried: candidates or fits that were skipped for lack of time, in words.
    ruled_out: effects of models that were not refitted, since after one step they were too far from the best ones.
    """

    failed: tuple[str, ...] = ()
    not_tried: tuple[str, ...] = ()
    ruled_out: tuple[Keys, ...] = ()

    def __add__(self, other: Notes) -> Notes:
        return Notes(*(getattr(self, name) + getattr(other, name) for name in Notes.__dataclass_fields__))


def proposals_after_one_step(
    problem: Problem, model: FittedModel, ranked: Sequence[Proposal], found: ScoreTest
) -> tuple[list[tuple[np.ndarray, float, Proposal]], Notes]:
    """Values [D] and objective of each proposal after one step (see `fitting.one_step_fits`), in batches."""
    out, config = list[tuple[np.ndarray, float, Proposal]](), problem.case.config
    for first in range(0, len(ranked), ONE_STEP_BATCH):
        if first and problem.late:
            return out, _skipped(len(ranked) - first, len(ranked), "candidates without a one-step fit")
        asked, batch = [], ranked[first : first + ONE_STEP_BATCH]
        for proposal in batch:
            (part,), start = proposal.parts, proposal.start(problem.case.full_space, model.values)
            problem.progress("one_step_fit", names_of((*model.keys, part.key)))
            raw = {found.directions[k].coefficient: found.raw[k] for k in rows_of(found, proposal.parts)}
            asked.append((part, raw, start))
        ends = one_step_fits(problem.case.train, model, asked, config)
        out += [(*end, proposal) for end, proposal in zip(ends, batch, strict=True)]
    return out, Notes()


def _skipped(number: int, total: int, what: str) -> Notes:
    return Notes(not_tried=(f"{number} of {total} {what}",))


def search_refit(
    problem: Problem, parts: Sequence[Candidate], start: np.ndarray, config: RefineConfig, note: str = ""
) -> FittedModel:
    """The model with the effects `parts`, fitted to the training recording from a start [D] over the full space."""
    problem.progress("refit", (names_of(p.key for p in parts) or "base") + note)
    return refit(problem.case.train, problem.case.base, parts, start[None], config)


def staged_refit(
    problem: Problem,
    starts: Sequence[Start],
    target: float,
    what: str,
    note: str = "",
    one_step: tuple[float, Sequence[float]] | None = None,
) -> tuple[list[FittedModel], Notes]:
    """Refit models one after the other.  A fit that cannot reach the target objective stops early or is not begun.

    Args:
        problem: constants of the search.
        starts: effects and values [D] of each model.
        target: objective to reach; the best one of the models replaces it when it is lower.
        what: name of the models that are skipped when time runs out, for the notes.
        note: addition to the models' names, for the progress.
        one_step: objective without the effects, and that of each model after one step.  A model whose step is hopeless
            by the rule that gives up a refit (`RefineConfig.give_up`) is not refitted, unless it is the first.  None:
            all are refitted.
    """
    models, config = list[FittedModel](), problem.case.config.refit
    failed, ruled_out = list[str](), list[Keys]()
    for number, (parts, start) in enumerate(starts):
        if number and problem.late:
            late = _skipped(len(starts) - number, len(starts), what)
            return models, Notes(tuple(failed), ruled_out=tuple(ruled_out)) + late
        target = min([target, *(m.refined.objective for m in models)])
        if one_step is not None and models:
            before, reached = one_step[0], one_step[1][number]
            if config.give_up * (before - reached) < reached - target:
                ruled_out.append(keys_of(parts))
                continue
        try:
            models.append(search_refit(problem, parts, start, replace(config, target_objective=target), note))
        except NotReplayed:
            failed.append(names_of(p.key for p in parts))
    return models, Notes(tuple(failed), ruled_out=tuple(ruled_out))


def target_objective(problem: Problem, model: FittedModel) -> float:
    """Objective [log likelihood] of a fit that reduces U by half of the share that a further effect must reach."""
    config = problem.case.config.selection
    least = 0.5 * (config.least_further_gain if model.parts else config.least_gain)
    return model.refined.objective - 0.5 * least * model.discrepancy * problem.case.train.resampling.size


def pruned(problem: Problem, model: FittedModel) -> FittedModel:
    """The model without effects that reduce U on the validation recording by less than `least_share`."""
    config = problem.case.config
    least = config.selection.least_share * problem.base_discrepancy
    for part in model.parts if len(model.parts) > 1 else ():
        start = at_neutral(problem, model, part.coefficients)
        try:
            less = search_refit(problem, without(part, model.parts), start, config.refit, f" without {part.key}")
            needed = problem.discrepancy(less) - problem.discrepancy(model) >= least
        except NotReplayed:  # without the part it cannot be simulated
            continue
        if not needed:
            return pruned(problem, less)
    return model


def without(part: Candidate, parts: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """The parts without one of them.

    Locations of one effect share its shape parameters, which belong to the first part.  If that one is removed, the
    next part of the same effect gets them.
    """
    rest = [c for c in parts if c is not part]
    heir = next((c for c in rest if c.effect == part.effect and part.shape_parameters and not c.shape_parameters), None)
    return tuple(replace(c, shape_parameters=part.shape_parameters) if c is heir else c for c in rest)


def converged_model(problem: Problem, model: FittedModel) -> tuple[FittedModel, Notes]:
    """The model fitted until it converges.  Otherwise the next effect would get the credit for the remaining gain."""
    if model.refined.converged:
        return model, Notes()
    config = replace(problem.case.config.refit, iterations=CONVERGE_ITERATIONS)
    return _continued(problem, model, config, " continued")


def polished(problem: Problem, model: FittedModel) -> tuple[FittedModel, Notes]:
    """The model refined with slopes over the width of its posterior, if that fit converges; for its intervals."""
    if not model.parts:
        return model, Notes()
    return _continued(problem, model, problem.case.config.polish, " polished")


def _continued(problem: Problem, model: FittedModel, config: RefineConfig, note: str) -> tuple[FittedModel, Notes]:
    """The model fitted further.

    It is returned unchanged, with a note, if the replay of the validation motion blows up after the fit, or if the fit
    of a converged model does not converge.
    """
    continued = search_refit(problem, model.parts, model.values, config, note)
    if not np.isfinite(problem.case.validation.common(continued.values)).all():
        return model, Notes(failed=(model.name + note,))
    if model.refined.converged and not continued.refined.converged:
        return model, Notes(not_tried=(f"{model.name}{note} to the end",))
    return continued, Notes()


def at_neutral(problem: Problem, model: FittedModel, coefficients: Sequence[str]) -> np.ndarray:
    """[D] values of a model with the named coefficients at neutral."""
    space = problem.case.full_space
    values, at = model.values.copy(), [space.index(a) for a in coefficients]
    values[at] = space.mean[at]
    return values
