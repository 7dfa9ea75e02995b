"""One round of the search: refit what looks promising, put it on trial, choose."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.discrepancy.candidates import Candidate, joined
from droid_jax.discrepancy.case import SETTLED
from droid_jax.discrepancy.choose import winning, without_idle
from droid_jax.discrepancy.rank import Proposal, collinear, proposals
from droid_jax.discrepancy.refit import Model
from droid_jax.discrepancy.screen import Screen
from droid_jax.discrepancy.search_state import Hunt
from droid_jax.discrepancy.select import LESS, OF_ALL, Trial, judge, much_more
from droid_jax.discrepancy.transfer import remainder
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.search import NotReplayed

POLISH = RefineConfig(iterations=12, hops=0)
PAIRS = 4  # pairs refitted


@dataclass(frozen=True, eq=False)
class Round:
    """What was asked, what was tried, and what won.

    screen: of the model that stood; stood: names of its effects.  ranked: what could be added, the best first.
    tried, trials: the refitted models; winner, chosen: the one that does best and its trial, or None.
    """

    screen: Screen
    stood: tuple[str, ...] = ()
    ranked: tuple[Proposal, ...] = ()
    tried: tuple[Model, ...] = ()
    trials: tuple[Trial, ...] = ()
    winner: Model | None = None
    chosen: Trial | None = None

    @property
    def rivals(self) -> tuple[Model, ...]:
        """Models that cannot be told from the winner and lost, if at all, for their size or significance alone."""
        if self.chosen is None:
            return ()
        both = zip(self.tried, self.trials, strict=True)
        return tuple(m for m, t in both if (t.passed or t.weak) and t.name in self.chosen.rivals)


def forward(hunt: Hunt, model: Model, found: Screen) -> Round:
    """Add the effect that does best on the confirming demonstration, if one passes its trial."""
    case, config = hunt.case, hunt.case.config
    ranked = proposals(found, model.residuals, case.whole)
    begun = Round(found, tuple(c.name for c in model.parts), tuple(ranked))
    looks = [
        (hunt.look(model, p, found), p) for p in hunt.budget.within("candidates not looked at", ranked[: config.looked])
    ]
    best = sorted(looks, key=lambda look: look[0][1])[: config.refitted]
    left = hunt.budget.within("candidates not refitted", best)
    tried = hunt.race((((*model.parts, *p.parts), values) for (values, _), p in left), hunt.aim(model))
    done = _decided(hunt, model, begun, tried)
    twins = _twins(done)
    if not twins:
        return done
    left = hunt.budget.within("candidates that look like the best not refitted", twins)
    starters = (((*model.parts, *p.parts), p.start(case.whole, model.values)) for p in left)
    tried += hunt.race(starters, min(m.refined.objective for m in tried), " (looks like the best)")
    return _decided(hunt, model, begun, tried)


def anew(hunt: Hunt, base: Model, done: Round) -> Round:
    """A first round without a winner: its best model fitted from the prior on, since the basin may be at fault.

    Where what is missing bent the base fit into a wrong basin, the right effect explains the fitted demonstration from
    there and not the other one.  If it wins from the prior on, its rivals are fitted in that basin too, and so is the
    base model: what that takes away by itself is no effect's.  A log of one repeat is replayed by inverse dynamics,
    which is smooth and has one basin.
    """
    if done.winner is not None or not done.tried or not hunt.case.fit.repeated:
        return done
    best = min(done.tried, key=lambda m: m.gap)
    if best.gap > (1 - LESS) * base.gap:
        return done
    if hunt.budget.spent:
        hunt.budget.skip("the fit from the prior on")
        return done
    fresh = hunt.anew(best)
    again = _decided(hunt, base, done, [fresh if m is best else m for m in done.tried])
    return done if again.winner is None else _beside(hunt, base, again, again.winner)


def _beside(hunt: Hunt, base: Model, done: Round, won: Model) -> Round:
    """The round with what lost to a winner from the prior on, and what looks like it, fitted from where that ended.

    The base model is the one that does better on the confirming demonstration, from there or as it was.
    """
    whole, basin = hunt.case.whole, _neutral(hunt, won, won.amplitudes)
    tried = {m.name for m in done.tried if m is not won}
    lost = [p for p in done.ranked if joined(p.parts) in tried]
    left = hunt.budget.within("rivals not refitted where the best one ended", [*lost, *_twins(done)])
    note = " (from where the best one ended)"
    beside = hunt.race(((p.parts, p.start(whole, basin)) for p in left), won.refined.objective, note)
    try:
        before = min(base, hunt.refit((), basin, hunt.case.config.refit, note), key=hunt.gap)
    except NotReplayed:
        before = base
    best = {m.name: m for m in sorted([*done.tried, *beside], key=lambda m: m.refined.objective, reverse=True)}
    return _decided(hunt, before, done, list(best.values()))


def _neutral(hunt: Hunt, model: Model, amplitudes: Sequence[str]) -> np.ndarray:
    """[D] values of a model with some amplitudes at neutral."""
    values, at = model.values.copy(), [hunt.case.whole.index(a) for a in amplitudes]
    values[at] = hunt.case.whole.mean[at]
    return values


def _twins(done: Round) -> list[Proposal]:
    """Candidates that were not refitted though their marks are nearly the winner's: they may do as well."""
    if done.winner is None:
        return []
    new = [c.name for c in done.winner.parts if c.name not in done.stood]
    tried = {c.name for m in done.tried for c in m.parts}
    near = collinear(done.screen, set(new))
    return [p for p in done.ranked if p.names[0] in near - tried]


def pairs(hunt: Hunt, base: Model, model: Model, first: Round) -> Round:
    """Two effects at once, from the best of the first round: one that mimics both may have stood in their way."""
    case = hunt.case
    best = sorted(first.trials, key=lambda t: t.gap_confirm)[: case.config.refitted]
    ranked = proposals(first.screen, base.residuals, case.whole, number=2, among={t.name for t in best})
    known = {c.name for c in model.parts}
    ranked = [p for p in ranked if set(p.names) != known][:PAIRS]
    left = hunt.budget.within("pairs not tried", ranked)
    starters = ((p.parts, p.start(case.whole, base.values)) for p in left)
    tried = hunt.race(starters, hunt.aim(min(first.tried, key=lambda m: m.refined.objective)))
    alone, trial = min(zip(first.tried, first.trials, strict=True), key=lambda both: both[1].gap_confirm)
    done = _decided(hunt, base, first, [*tried, model] if len(model.parts) > 1 else tried)
    if done.winner is None or done.chosen is None:
        return done
    beside, beyond = (functools.partial(remainder, case.fit, case.confirm, m) for m in (alone, done.winner))
    if much_more(trial.gap_confirm, done.chosen.gap_confirm, beside, beyond, hunt.whole_gap):
        return done
    return replace(done, winner=None, chosen=None)


def pruned(hunt: Hunt, model: Model) -> Model:
    """The model without what no longer pays for itself on the confirming demonstration."""
    for part in model.parts if len(model.parts) > 1 else ():
        start = _neutral(hunt, model, part.amplitudes)
        try:
            less = hunt.refit(without(part, model.parts), start, hunt.case.config.refit, f" without {part.name}")
            pays = hunt.gap(less) - hunt.gap(model) >= OF_ALL * hunt.whole_gap
        except NotReplayed:  # it cannot do without the part
            continue
        if not pays:
            return pruned(hunt, less)
    return model


def without(part: Candidate, parts: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """The other parts; where one of them shares the part's shapes (a speed, a period), it has them from now on."""
    rest = [c for c in parts if c is not part]
    heir = next((c for c in rest if c.effect == part.effect and part.shapes and not c.shapes), None)
    return tuple(replace(c, shapes=part.shapes) if c is heir else c for c in rest)


def settled(hunt: Hunt, model: Model) -> Model:
    """The model gone on with until it stands still: what it has yet to take would be credited to the next effect."""
    if model.refined.converged:
        return model
    return hunt.gone_on_with(model, replace(hunt.case.config.refit, iterations=SETTLED), " gone on with")


def polished(hunt: Hunt, model: Model) -> Model:
    """The same model with slopes over the width of its posterior: its intervals are reported."""
    if not model.parts:
        return model
    return hunt.gone_on_with(model, POLISH, " polished")


def _decided(hunt: Hunt, before: Model, begun: Round, tried: Sequence[Model]) -> Round:
    """A round with these models on trial, and none before; before: the model that stood."""
    case, done = hunt.case, replace(begun, tried=tuple(tried), trials=(), winner=None, chosen=None)
    if not tried:
        return done
    trials = judge(
        case.fit,
        case.confirm,
        before,
        tried,
        case.smallest,
        hunt.whole_gap,
        floor=hunt.floor,
        seed=case.config.seed,
        ends=case.ends,
    )
    judged = list(zip(tried, trials, strict=True))
    won = winning(judged, hunt.floor, hunt.whole_gap)
    if won is None:
        return replace(done, trials=tuple(trials))
    trials = without_idle(judged, won, case.effects, hunt.floor)
    winner, chosen = won
    return replace(done, trials=tuple(trials), winner=winner, chosen=chosen)
