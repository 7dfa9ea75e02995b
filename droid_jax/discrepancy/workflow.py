"""The search for a missing effect, top to bottom: fit, ask, name, confirm, decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from droid_jax.discrepancy.candidates import candidates
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.discretisation_error import above
from droid_jax.discrepancy.doubts import doubts
from droid_jax.discrepancy.localise import localise
from droid_jax.discrepancy.refit import Model
from droid_jax.discrepancy.screen import Question, Screen, marks, project, questions_of, screen
from droid_jax.discrepancy.search_state import Budget, Hunt
from droid_jax.discrepancy.select import OF_ALL, SIGNIFICANT
from droid_jax.discrepancy.selection_step import Round, anew, forward, pairs, polished, pruned, settled
from droid_jax.discrepancy.transfer import left_over
from droid_jax.discrepancy.trend import trend
from droid_jax.discrepancy.verdict import LOST, Hint, Kind, Verdict, open_share
from droid_jax.identify.pipeline import Progress
from droid_jax.identify.search import NotReplayed

OPEN = 0.1  # share of the gap left open from which a model explains it only partly


def ask(case: Case, model: Model, asked: tuple[Question, ...]) -> Screen:
    """Screen questions against a model's residuals on the first demonstration.

    A base parameter at a bound absorbs nothing more: marks keep what it would have taken.
    """
    root, free = case.fit.repeats**0.5, model.refined.free
    base, prior = model.refined.jacobian[:, free] / root, model.refined.prior[free] * root * case.fit.slack
    raw = marks(case.fit, model.values, asked)
    blown_up = np.isnan(raw).any(axis=1)
    raw[blown_up] = 0.0
    projected = project(raw, base, prior)
    found = screen(
        model.residuals, asked, raw, projected, lambda s: case.fit.largest(s, projected, base, prior, case.config.seed)
    )
    names = (asked[k].candidate.name for k in np.flatnonzero(blown_up))
    return replace(found, failed=tuple(dict.fromkeys(names)))


def find(case: Case, base: Model, floor: float, progress: Progress = lambda stage, value: None) -> Verdict:
    """From a base fit to a verdict.  floor: U0, see `numerical_floor`.

    Raises ValueError where the case's effects have no place that could be asked about.
    """
    hunt = Hunt(case, case.confirm.gap_at(base.values), floor, Budget(case.config.budget), progress)
    if not base.refined.converged:
        return _verdict(hunt, base, base, [], quiet=False)
    asked = questions_of(candidates(case.effects))
    model, rounds, quiet = base, list[Round](), False
    while len(model.parts) < case.config.most:
        left = further(asked, model)
        quiet = not left
        if quiet:  # all that was asked about is in the model
            break
        progress("screen", model.name)
        found = ask(case, model, left)
        quiet = found.p >= SIGNIFICANT or not above(model.gap, floor)
        enough = not model.parts or hunt.gap(model) > OF_ALL * hunt.whole_gap
        done = forward(hunt, model, found) if enough and not quiet else Round(found)
        if not model.parts:
            done = anew(hunt, base, done)
        rounds.append(done)
        if done.winner is None:
            break
        model = settled(hunt, done.winner)
    if case.config.most > 1 and not quiet and rounds[0].tried and _unsettled(hunt, model):
        if hunt.budget.spent:
            hunt.budget.skip("pairs of effects not tried")
        else:
            rounds.append(pairs(hunt, base, model, rounds[0]))
            model = settled(hunt, rounds[-1].winner or model)
    return _verdict(hunt, base, polished(hunt, settled(hunt, pruned(hunt, model))), rounds, quiet)


def further(asked: Sequence[Question], model: Model) -> tuple[Question, ...]:
    """Questions that a model leaves open.

    A shape belongs to an effect at all places alike: where the effect is in the model at one place, it is asked about
    at the others with the shape that it has there.
    """
    known = {c.effect for c in model.parts}
    left = dict[Any, Question]()
    for q in asked:
        if set(q.candidate.amplitudes) & set(model.amplitudes):
            continue
        part = replace(q.candidate, shapes={}) if q.candidate.effect in known else q.candidate
        left.setdefault((part.key, q.amplitude), replace(q, candidate=part))
    return tuple(left.values())


def _unsettled(hunt: Hunt, model: Model) -> bool:
    """Nothing named yet, several effects, or much left over: one that mimics two may have stood in their way."""
    return len(model.parts) != 1 or _open(hunt, left_over(hunt.case.fit, hunt.case.confirm, model)) > OPEN


def _open(hunt: Hunt, residuals: np.ndarray) -> float:
    """Share of the gap on the confirming demonstration that these residuals still hold."""
    return open_share(hunt.case.confirm.gap(residuals), hunt.whole_gap, hunt.floor)


def _verdict(hunt: Hunt, base: Model, model: Model, rounds: list[Round], quiet: bool) -> Verdict:
    """quiet: the last screening found nothing more.  Of a fit that did not converge nothing is named."""
    case, floor = hunt.case, hunt.floor
    converged = base.refined.converged and model.refined.converged
    if not converged:
        model, rounds = base, [replace(r, winner=None, chosen=None) for r in rounds]
    gaps = _gaps(hunt, base, model)
    missing = bool(rounds) and rounds[0].screen.p < SIGNIFICANT and above(base.gap, floor)
    tied = tuple(_tied(part.name, model, rounds) for part in model.parts)
    left = left_over(case.fit, case.confirm, model) if converged else None
    kind = Kind.NONE if not missing else Kind.UNEXPLAINED
    if left is None:
        kind = Kind.UNCONVERGED
    elif model.parts:
        kind = Kind.PARTLY if _remains(hunt, left, quiet) else Kind.TIE if any(tied) else Kind.NAMED
    verdict = Verdict(
        kind=kind,
        effects=tuple(c.name for c in model.parts),
        tied=tied,
        base=base,
        model=model,
        floor=floor,
        gaps=gaps,
        remainder=None if left is None else case.confirm.gap(left),
        screens=tuple(dict.fromkeys(r.screen for r in rounds)),  # pairs are proposed from the first one
        trials=tuple(t for r in rounds for t in r.trials),
        before=localise(case.fit, base.values, base.residuals, model.values),
        after=localise(case.fit, model.values, model.residuals, model.values),
        failed=tuple(hunt.failed),
        rivals=next((r.rivals for r in reversed(rounds) if r.winner is not None), ()),
        cut=hunt.budget.cut,
        trend=trend(rounds[0].screen, base.residuals, case.config.seed) if rounds and case.fit.repeated else None,
        doubts=doubts(case.fit, model, case.ends),
    )
    return unnamed(case, verdict) if too_little(verdict, case.config.least_closed) else verdict


def too_little(verdict: Verdict, least: float) -> bool:
    """Whether effects beside a remainder close less than a share `least` on a held-out recording.

    What closes a third of a discrepancy and leaves the rest may only imitate what is missing.
    """
    closed = verdict.closed_held_out() if verdict.kind is Kind.PARTLY else {}
    return bool(closed) and min(closed.values()) < least


def unnamed(case: Case, verdict: Verdict) -> Verdict:
    """The verdict with its effects as hints, and the base model as the one that stands."""
    base = verdict.base
    where = localise(case.fit, base.values, base.residuals, base.values)
    return replace(
        verdict,
        kind=Kind.UNEXPLAINED,
        effects=(),
        tied=(),
        model=base,
        gaps={role: (before, before) for role, (before, _) in verdict.gaps.items()},
        remainder=case.confirm.gap(left_over(case.fit, case.confirm, base)),
        before=where,
        after=where,
        rivals=(),
        doubts=(),
        hints=(Hint(verdict.effects, verdict.tied, verdict.closed_held_out()),),
    )


def _gaps(hunt: Hunt, base: Model, model: Model) -> dict[str, tuple[float, float]]:
    """U before and after by role; without the sealed motion where one of them cannot be replayed there."""
    gaps = {}
    for role, judged in hunt.case.judged.items():
        try:
            gaps[role] = judged.gap_at(base.values), judged.gap_at(model.values)
        except NotReplayed:
            if role != "sealed":
                raise
            hunt.failed.append(LOST)
    return gaps


def _remains(hunt: Hunt, residuals: np.ndarray, quiet: bool) -> bool:
    """Whether residuals of the confirming demonstration hold much of its gap, and more than chance leaves.

    An effect that no candidate looks like is seen by no screening, but by every repeat.
    """
    if _open(hunt, residuals) <= OPEN:
        return False
    everywhere = np.ones((1, residuals.shape[1]), bool)
    return not quiet or float(hunt.case.confirm.cell_p_values(residuals, everywhere)[0]) < SIGNIFICANT


def _tied(part: str, model: Model, rounds: Sequence[Round]) -> tuple[str, ...]:
    """What does as well as one effect of the model: what rivals have in its place in the last round that chose it.

    A rival that does without several of the model's effects is named whole, beside each of them.
    """
    known = {c.name for c in model.parts}
    for done in reversed(rounds):
        added = {c.name for c in done.winner.parts} - set(done.stood) if done.winner is not None else set()
        if part in added:
            others = [{c.name for c in m.parts} - set(done.stood) for m in done.rivals]
            instead = [o - added for o in others if part not in o and not (o - added) & known]
            return tuple(sorted({" + ".join(sorted(names)) for names in instead if names}))
    return ()
