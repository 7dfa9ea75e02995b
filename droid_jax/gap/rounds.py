"""One round of the search: refit what looks promising, put it on trial, choose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from droid_jax.gap.case import Case
from droid_jax.gap.rank import Proposal, proposals
from droid_jax.gap.refit import Model, refit
from droid_jax.gap.screen import Screen
from droid_jax.gap.select import OF_ALL, Trial, judge
from droid_jax.identify.refine import RefineConfig

Progress = Callable[[str, Any], None]
LOOK = RefineConfig(iterations=2, hops=0, spreads=0)  # enough to tell what is worth a refit
PAIRS = 4  # pairs refitted


@dataclass(frozen=True, eq=False)
class Round:
    """What was asked, what was tried, and what won.

    screen: of the model that stood; stood: names of its effects.  trials: of the refitted models;
    winner, chosen: the model that does best and its trial, or None.
    """

    screen: Screen
    stood: tuple[str, ...] = ()
    trials: tuple[Trial, ...] = ()
    winner: Model | None = None
    chosen: Trial | None = None

    def passed(self, name: str) -> bool:
        """Whether a model stood its trial but for others that do as well."""
        return any(t.passed for t in self.trials if t.name == name)


def forward(case: Case, model: Model, found: Screen, whole_gap: float, floor: float, progress: Progress) -> Round:
    """Add the effect that does best on the confirming demonstration, if one passes its trial."""
    ranked = proposals(found, model.residuals, case.whole)[: case.config.looked]
    looks = [_refit(case, model.parts, p, p.start(case.whole, model.values)[None], LOOK, progress) for p in ranked]
    best = sorted(looks, key=lambda m: m.refined.objective)[: case.config.refitted]
    tried = [refit(case.fit, case.base, m.parts, m.values[None], case.config.refit) for m in best]
    return _decided(case, model, found, tried, whole_gap, floor)


def pairs(
    case: Case, base: Model, model: Model, first: Round, whole_gap: float, floor: float, progress: Progress
) -> Round:
    """Two effects at once, from the best of the first round: one that mimics both may have stood in their way."""
    best = sorted(first.trials, key=lambda t: t.gap_confirm)[: case.config.refitted]
    ranked = proposals(first.screen, base.residuals, case.whole, number=2, among={t.name for t in best})
    known = {frozenset(c.name for c in model.parts)}
    ranked = [p for p in ranked if frozenset(p.names) not in known][:PAIRS]
    tried = [_refit(case, (), p, p.start(case.whole, base.values)[None], case.config.refit, progress) for p in ranked]
    tried = [*tried, model] if len(model.parts) > 1 else tried
    return _decided(case, base, first.screen, tried, whole_gap, floor)


def pruned(case: Case, model: Model, whole_gap: float, floor: float, progress: Progress) -> Model:
    """The model without what no longer pays for itself on the confirming demonstration."""
    for part in model.parts if len(model.parts) > 1 else ():
        rest = tuple(c for c in model.parts if c is not part)
        start = model.values.copy()
        free = [case.whole.index(a) for a in part.amplitudes]
        start[free] = case.whole.mean[free]
        progress("refit", f"without {part.name}")
        less = refit(case.fit, case.base, rest, start[None], case.config.refit)
        if case.confirm.gap_at(less.values) - case.confirm.gap_at(model.values) < OF_ALL * whole_gap:
            return pruned(case, less, whole_gap, floor, progress)
    return model


def polished(case: Case, model: Model, progress: Progress) -> Model:
    """The same model settled, with slopes over the width of its posterior: its intervals are reported."""
    if not model.parts:
        return model
    progress("refit", model.name)
    return refit(case.fit, case.base, model.parts, model.values[None], RefineConfig(iterations=12, hops=0))


def _refit(
    case: Case, parts: Sequence[Any], proposal: Proposal, starts: np.ndarray, config: RefineConfig, progress: Progress
) -> Model:
    progress("refit", " + ".join(c.name for c in (*parts, *proposal.parts)))
    return refit(case.fit, case.base, (*parts, *proposal.parts), starts, config)


def _decided(case: Case, before: Model, found: Screen, tried: Sequence[Model], whole_gap: float, floor: float) -> Round:
    stood = tuple(c.name for c in before.parts)
    if not tried:
        return Round(found, stood)
    trials = judge(case.fit, case.confirm, before, tried, case.smallest, whole_gap, floor=floor, seed=case.config.seed)
    passed = [(m, t) for m, t in zip(tried, trials, strict=True) if t.passed]
    if not passed:
        return Round(found, stood, tuple(trials))
    winner, chosen = min(passed, key=lambda mt: mt[1].gap_confirm)
    return Round(found, stood, tuple(trials), winner, chosen)
