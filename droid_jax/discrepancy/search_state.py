"""What all rounds of a search share: the case, its time, and the fits that they make."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from droid_jax.discrepancy.candidates import Candidate, joined_names
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.rank import Proposal
from droid_jax.discrepancy.refit import FittedModel, one_step_fit, refit
from droid_jax.discrepancy.restart import fitted_from_prior
from droid_jax.discrepancy.screen import ScoreTest
from droid_jax.discrepancy.select import LESS, MORE
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed

T = TypeVar("T")
Starter = tuple[Sequence[Candidate], np.ndarray]  # effects, and values [D] to start from


class Budget:
    """Minutes for refits: says when to stop, and afterwards what was left out."""

    def __init__(self, minutes: float | None) -> None:
        self._end = None if minutes is None else time.monotonic() + 60 * minutes
        self._cut: list[str] = []

    def within(self, what: str, items: Sequence[T]) -> Iterator[T]:
        """The items for as long as there is time, at least one."""
        for number, item in enumerate(items):
            if number and self.spent:
                self._cut.append(f"{len(items) - number} of {len(items)} {what}")
                return
            yield item

    @property
    def spent(self) -> bool:
        """No time left."""
        return self._end is not None and time.monotonic() > self._end

    def skip(self, what: str) -> None:
        """Note something left out."""
        self._cut.append(what)

    @property
    def cut(self) -> str:
        """In words; empty for nothing."""
        return "; ".join(self._cut)


@dataclass(frozen=True, eq=False)
class SearchState:
    """What every round is given: the case, U of its base model on the validation demonstration, the floor.

    failed: names of the models whose replay blew up where their refit was to begin; rounds add to it.
    """

    case: Case
    base_discrepancy: float
    discretisation_error: float
    budget: Budget
    progress: Progress
    failed: list[str] = field(default_factory=list)

    def one_step_fit(self, model: FittedModel, proposal: Proposal, found: ScoreTest) -> tuple[np.ndarray, float]:
        """A first look at one more effect: values [D] and objective (see `refit.look`)."""
        (part,), proposed = proposal.parts, proposal.start(self.case.full_space, model.values)
        self.progress("look", joined_names((*model.parts, part)))
        rows = {q.coefficient: k for k, q in enumerate(found.directions) if q.candidate.key == part.key}
        return one_step_fit(self.case.train, model, part, {a: found.raw[k] for a, k in rows.items()}, proposed)

    def refit(self, parts: Sequence[Candidate], start: np.ndarray, config: RefineConfig, note: str = "") -> FittedModel:
        """Base parameters and parts from a start [D] over the whole space."""
        self.progress("refit", (joined_names(parts) or "base") + note)
        return refit(self.case.train, self.case.base, parts, start[None], config)

    def refit_from_prior(self, model: FittedModel) -> FittedModel:
        """The model as it is or fitted from the prior on, whichever ends lower."""
        try:
            fresh = fitted_from_prior(self.case, model.parts, lambda stage, value: self.progress("anew", value))
        except NotReplayed:
            return model
        return min(model, fresh, key=lambda m: m.refined.objective)

    def staged_refit(self, starters: Iterable[Starter], aim: float, note: str = "") -> list[FittedModel]:
        """Refits one after the other; one that will not reach `aim`, or the best so far, is given up early."""
        models = list[FittedModel]()
        for parts, start in starters:
            aim = min([aim, *(m.refined.objective for m in models)])
            try:
                models.append(self.refit(parts, start, replace(self.case.config.refit, target_objective=aim), note))
            except NotReplayed:
                self.failed.append(joined_names(parts))
        return models

    def target_objective(self, model: FittedModel) -> float:
        """Objective [log likelihood] of a fit that would take half of what a further effect has to."""
        least = 0.5 * (MORE if model.parts else LESS)
        return model.refined.objective - 0.5 * least * model.discrepancy * self.case.train.size

    def discrepancy(self, model: FittedModel) -> float:
        """U on the validation demonstration."""
        return self.case.validation.discrepancy_at(model.values)

    def polished(self, model: FittedModel, config: RefineConfig, note: str) -> FittedModel:
        """`model` gone on with from where it is; as it is where that cannot be replayed on the validation motion."""
        found = self.refit(model.parts, model.values, config, note)
        if np.isfinite(self.case.validation.common(found.values)).all():
            return found
        self.failed.append(joined_names(model.parts) + note)
        return model
