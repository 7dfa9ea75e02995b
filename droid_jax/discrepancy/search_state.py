"""What all rounds of a search share: the case, its time, and the fits that they make."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from droid_jax.discrepancy.candidates import Candidate, joined
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.rank import Proposal
from droid_jax.discrepancy.refit import Model, look, refit
from droid_jax.discrepancy.restart import fitted_anew
from droid_jax.discrepancy.screen import Screen
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
class Hunt:
    """What every round is given: the case, U of its base model on the confirming demonstration, the floor.

    failed: names of the models whose replay blew up where their refit was to begin; rounds add to it.
    """

    case: Case
    whole_gap: float
    floor: float
    budget: Budget
    progress: Progress
    failed: list[str] = field(default_factory=list)

    def look(self, model: Model, proposal: Proposal, found: Screen) -> tuple[np.ndarray, float]:
        """A first look at one more effect: values [D] and objective (see `refit.look`)."""
        (part,), proposed = proposal.parts, proposal.start(self.case.whole, model.values)
        self.progress("look", joined((*model.parts, part)))
        rows = {q.amplitude: k for k, q in enumerate(found.questions) if q.candidate.key == part.key}
        return look(self.case.fit, model, part, {a: found.raw[k] for a, k in rows.items()}, proposed)

    def refit(self, parts: Sequence[Candidate], start: np.ndarray, config: RefineConfig, note: str = "") -> Model:
        """Base parameters and parts from a start [D] over the whole space."""
        self.progress("refit", (joined(parts) or "base") + note)
        return refit(self.case.fit, self.case.base, parts, start[None], config)

    def anew(self, model: Model) -> Model:
        """The model as it is or fitted from the prior on, whichever ends lower."""
        try:
            fresh = fitted_anew(self.case, model.parts, lambda stage, value: self.progress("anew", value))
        except NotReplayed:
            return model
        return min(model, fresh, key=lambda m: m.refined.objective)

    def race(self, starters: Iterable[Starter], aim: float, note: str = "") -> list[Model]:
        """Refits one after the other; one that will not reach `aim`, or the best so far, is given up early."""
        models = list[Model]()
        for parts, start in starters:
            aim = min([aim, *(m.refined.objective for m in models)])
            try:
                models.append(self.refit(parts, start, replace(self.case.config.refit, aim=aim), note))
            except NotReplayed:
                self.failed.append(joined(parts))
        return models

    def aim(self, model: Model) -> float:
        """Objective [log likelihood] of a fit that would take half of what a further effect has to."""
        least = 0.5 * (MORE if model.parts else LESS)
        return model.refined.objective - 0.5 * least * model.gap * self.case.fit.size

    def gap(self, model: Model) -> float:
        """U on the confirming demonstration."""
        return self.case.confirm.gap_at(model.values)

    def gone_on_with(self, model: Model, config: RefineConfig, note: str) -> Model:
        """`model` gone on with from where it is; as it is where that cannot be replayed on the confirming motion."""
        found = self.refit(model.parts, model.values, config, note)
        if np.isfinite(self.case.confirm.common(found.values)).all():
            return found
        self.failed.append(joined(model.parts) + note)
        return model
