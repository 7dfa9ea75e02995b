"""The search for a missing effect, top to bottom: fit, ask, name, confirm, decide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from droid_jax.gap.candidates import Candidate, candidates
from droid_jax.gap.case import Case
from droid_jax.gap.localise import localise
from droid_jax.gap.refit import Model, refit
from droid_jax.gap.screen import Question, Screen, marks, project, questions_of, screen
from droid_jax.gap.select import SIGNIFICANT, Trial, judge, resampled, tied
from droid_jax.gap.verdict import Kind, Verdict
from droid_jax.identify.pipeline import grip_hypotheses, starts
from droid_jax.identify.search import search

Progress = Callable[[str, Any], None]
COLLINEAR = 0.9  # absolute cosine from which two marks count as one
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


def ask(case: Case, model: Model, asked: Sequence[Question]) -> Screen:
    """Screen questions against a model's residuals on the first demonstration."""
    count = case.fit.repeats
    raw = marks(case.fit, model.values, asked)
    base = model.refined.jacobian / np.sqrt(count)
    projected = project(raw, -base, model.refined.prior * np.sqrt(count))
    return screen(model.residuals, asked, projected, case.config.seed)


def find(case: Case, base: Model, floor: float, progress: Progress = lambda stage, value: None) -> Verdict:
    """From a converged base fit to a verdict.  floor: U0, see `numerical_floor`."""
    before = case.confirm.gap_at(base.values)
    asked = questions_of(candidates(case.effects))
    grounds = Grounds([], [], [])
    model, again = base, base.refined.converged
    while again and len(model.parts) < case.config.most:
        progress("screen", model.name)
        left = [q for q in asked if not set(q.candidate.amplitudes) & set(model.amplitudes)]
        found = ask(case, model, left)
        grounds.screens.append(found)
        if found.p >= SIGNIFICANT or model.gap <= floor:
            break
        extended = _next(case, model, found, before, grounds, progress)
        again, model = extended is not None, extended or model
    return _verdict(case, base, model, floor, grounds)


@dataclass(frozen=True, eq=False)
class Grounds:
    """What is gathered on the way: every screening, every trial, and the rivals of each effect chosen."""

    screens: list[Screen]
    trials: list[Trial]
    rivals: list[tuple[str, ...]]


def _next(
    case: Case, model: Model, found: Screen, whole_gap: float, grounds: Grounds, progress: Progress
) -> Model | None:
    """The model with the effect that does best on the confirming demonstration, if one passes its trial."""
    chosen = resampled(found, model.residuals, case.config.seed)
    tried: list[tuple[Model, Trial]] = []
    for candidate, start in _promising(case, model, found):
        progress("refit", candidate.name)
        extended = refit(case.fit, case.base, (*model.parts, candidate), start[None], case.config.refit)
        share = sum(chosen[n] for n in _alike(candidate, found))
        trial = judge(case.fit, case.confirm, model, extended, whole_gap, share, case.smallest)
        tried.append((extended, trial))
    grounds.trials.extend(t for _, t in tried)
    passed = [(m, t) for m, t in tried if t.passed]
    if not passed:
        return None
    winner, best = min(passed, key=lambda mt: mt[1].gap_confirm)
    rivals = tied([t for _, t in passed], best, case.confirm.gap_at(model.values))
    grounds.rivals.append(tuple(t.name.split(" + ")[-1] for t in rivals))
    return winner


def _promising(case: Case, model: Model, found: Screen) -> list[tuple[Candidate, np.ndarray]]:
    """The best shape of the best candidates, with a start [D] at what the linear score says."""
    seen: dict[str, tuple[Candidate, np.ndarray]] = {}
    for k in found.best():
        candidate = found.questions[k].candidate
        if candidate.name in seen:
            continue
        start = model.values.copy()
        for name, value in candidate.shapes.items():
            start[case.whole.index(name)] = value
        p = case.whole[found.questions[k].amplitude]
        start[case.whole.index(p.name)] = np.clip(found.size[k], p.low, p.high)
        seen[candidate.name] = (candidate, start)
        if len(seen) == case.config.refitted:
            break
    return list(seen.values())


def _alike(candidate: Candidate, found: Screen) -> set[str]:
    """Names of the candidates whose marks are nearly this one's: a resample may pick any of them."""
    rows = np.array([q.candidate.name == candidate.name for q in found.questions])
    unit = found.marks / np.maximum(np.linalg.norm(found.marks, axis=1, keepdims=True), 1e-30)
    near = np.max(np.abs(unit @ unit[rows].T), axis=1) > COLLINEAR
    return {candidate.name} | {found.questions[k].candidate.name for k in np.flatnonzero(near)}


def _verdict(case: Case, base: Model, model: Model, floor: float, grounds: Grounds) -> Verdict:
    gaps = {role: (e.gap_at(base.values), e.gap_at(model.values)) for role, e in case.judged.items()}
    before, after = gaps["confirm"]
    open_share = (after - floor) / max(before - floor, 1e-12)
    missing = grounds.screens and grounds.screens[0].p < SIGNIFICANT and base.gap > floor
    kind = Kind.NONE if not missing else Kind.UNEXPLAINED
    if not base.refined.converged:
        kind = Kind.UNCONVERGED
    elif model.parts:
        kind = Kind.PARTLY if open_share > OPEN else Kind.TIE if any(grounds.rivals) else Kind.NAMED
    return Verdict(
        kind=kind,
        effects=tuple(c.name for c in model.parts),
        tied=tuple(grounds.rivals),
        base=base,
        model=model,
        floor=floor,
        gaps=gaps,
        screens=tuple(grounds.screens),
        trials=tuple(grounds.trials),
        before=localise(case.fit, base.values, base.residuals),
        after=localise(case.fit, model.values, model.residuals),
    )
