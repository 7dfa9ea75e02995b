"""The search for a missing effect, top to bottom: fit, ask, name, confirm, decide."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from droid_jax.gap.candidates import candidates
from droid_jax.gap.case import Case
from droid_jax.gap.localise import localise
from droid_jax.gap.refit import Model, refit
from droid_jax.gap.rounds import Round, forward, pairs, polished, pruned
from droid_jax.gap.screen import Question, Screen, marks, project, questions_of, screen
from droid_jax.gap.select import SIGNIFICANT
from droid_jax.gap.verdict import Kind, Verdict
from droid_jax.identify.pipeline import grip_hypotheses, starts
from droid_jax.identify.search import search

Progress = Callable[[str, Any], None]
OPEN = 0.2  # share of the gap left open from which a model explains it only partly


def base_fit(case: Case, progress: Progress) -> Model:
    """Everything but the effects, fitted to the first demonstration."""
    cost, base = case.fit.cost, case.base
    main = base.select([p.name for p in base.parameters if not p.nuisance])
    found = search(
        lambda rows: cost(case.whole.embed(main, rows)),
        main,
        case.config.search,
        progress=lambda p: progress("search", p),
    )
    return refit(
        case.fit,
        base,
        (),
        case.whole.embed(base, starts(base, main, found)),
        case.config.refine,
        hypotheses=grip_hypotheses(base),
        progress=lambda p: progress("refine", p),
    )


def ask(case: Case, model: Model, asked: tuple[Question, ...]) -> Screen:
    """Screen questions against a model's residuals on the first demonstration."""
    root = case.fit.repeats**0.5
    base, prior = model.refined.jacobian / root, model.refined.prior * root
    projected = project(marks(case.fit, model.values, asked), base, prior)
    return screen(
        model.residuals, asked, projected, lambda s: case.fit.largest(s, projected, base, prior, case.config.seed)
    )


def find(case: Case, base: Model, floor: float, progress: Progress = lambda stage, value: None) -> Verdict:
    """From a base fit to a verdict.  floor: U0, see `numerical_floor`."""
    if not base.refined.converged:
        return _verdict(case, base, base, floor, [])
    whole_gap = case.confirm.gap_at(base.values)
    asked = questions_of(candidates(case.effects))
    model, rounds = base, list[Round]()
    while len(model.parts) < case.config.most:
        progress("screen", model.name)
        left = tuple(q for q in asked if not set(q.candidate.amplitudes) & set(model.amplitudes))
        found = ask(case, model, left)
        if found.p >= SIGNIFICANT or model.gap <= floor:
            rounds.append(Round(found))
            break
        done = forward(case, model, found, whole_gap, floor, progress)
        rounds.append(done)
        if done.winner is None:
            break
        model = done.winner
    if (len(rounds) > 1 and rounds[1].trials and len(model.parts) != 1) or (not model.parts and rounds[0].trials):
        paired = pairs(case, base, model, rounds[0], whole_gap, floor, progress)
        rounds.append(paired)
        model = paired.winner or model
    model = pruned(case, model, whole_gap, floor, progress)
    return _verdict(case, base, polished(case, model, progress), floor, rounds)


def _unsettled(case: Case, model: Model, whole_gap: float, floor: float) -> bool:
    """Nothing named yet, several effects, or much left over: one that mimics two may have stood in their way."""
    return len(model.parts) != 1 or _open(case.confirm.gap_at(model.values), whole_gap, floor) > OPEN


def _open(after: float, before: float, floor: float) -> float:
    """Share of a gap that is left."""
    return (after - floor) / max(before - floor, 1e-12)


def _verdict(case: Case, base: Model, model: Model, floor: float, rounds: list[Round]) -> Verdict:
    gaps = {role: (e.gap_at(base.values), e.gap_at(model.values)) for role, e in case.judged.items()}
    before, after = gaps["confirm"]
    missing = bool(rounds) and rounds[0].screen.p < SIGNIFICANT and base.gap > floor
    tied = tuple(_rivals(model, part.name, rounds) for part in model.parts)
    kind = Kind.NONE if not missing else Kind.UNEXPLAINED
    if not base.refined.converged:
        kind = Kind.UNCONVERGED
    elif model.parts:
        kind = Kind.PARTLY if _open(after, before, floor) > OPEN else Kind.TIE if any(tied) else Kind.NAMED
    return Verdict(
        kind=kind,
        effects=tuple(c.name for c in model.parts),
        tied=tied,
        base=base,
        model=model,
        floor=floor,
        gaps=gaps,
        screens=tuple(r.screen for r in rounds),
        trials=tuple(t for r in rounds for t in r.trials),
        before=localise(case.fit, base.values, base.residuals),
        after=localise(case.fit, model.values, model.residuals),
    )


def _rivals(model: Model, part: str, rounds: list[Round]) -> tuple[str, ...]:
    """What does as well as one effect of the model: members of passing rivals in the round that chose it."""
    for done in rounds:
        if done.winner is not None and done.chosen is not None and part in _last(done.chosen.name, done):
            names = {n for r in done.chosen.rivals for n in _last(r, done) if done.passed(r)}
            return tuple(sorted(names - {part}))
    return ()


def _last(name: str, done: Round) -> tuple[str, ...]:
    """The effects that a round added to what stood before."""
    return tuple(n for n in name.split(" + ") if n not in done.stood)
