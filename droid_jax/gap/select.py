"""Which effects belong into the model: forward, judged on a demonstration that moves differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from droid_jax.gap.evidence import Evidence, gap
from droid_jax.gap.flips import sign_flips, t_values
from droid_jax.gap.refit import Model, intervals
from droid_jax.gap.screen import Screen

SIGNIFICANT = 0.01
LESS = 0.2  # share of U that an effect must take away on the confirming demonstration
OF_ALL = 0.05  # and share of the base model's U: what a wrong form of the first effect leaves is no effect of its own
TIE = 0.1  # of what the best takes away: a rival that leaves no more than this beyond it does as well
CHOSEN = 0.8  # share of the resamples in which an effect must win
RESAMPLES = 400
EDGE = 0.02  # share of a parameter's range that counts as its bound


@dataclass(frozen=True)
class Trial:
    """An effect's case: everything it had to pass, and the reason where it did not.

    gap_fit, gap_confirm: U with it on both demonstrations; p: of the improvement on the confirming one.
    interval: of each amplitude; chosen: share of resamples.  reasons: why it lost, empty where it passed.
    """

    name: str
    gap_fit: float
    gap_confirm: float
    p: float
    interval: dict[str, tuple[float, float]]
    chosen: float
    reasons: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """No reason against it."""
        return not self.reasons


def improvement(confirm: Evidence, before: np.ndarray, after: np.ndarray) -> tuple[float, float, np.ndarray]:
    """U before and after on the confirming demonstration, parameters frozen; and every repeat's gain [N].

    before, after: [D] values.  gain: half the fall of a repeat's squared residual.
    """
    common = confirm.common(np.stack([before, after]))
    old, new = (confirm.residuals(c) for c in common)
    return gap(old), gap(new), 0.5 * (np.sum(old**2, axis=1) - np.sum(new**2, axis=1))


def one_sided_p(gain: np.ndarray) -> float:
    """p-value of gains [N] being above zero on average, by sign flips."""
    t = t_values(gain[None], sign_flips(len(gain)))[:, 0]
    return float(np.mean(t >= t[0] - 1e-12))


def resampled(screen: Screen, residuals: np.ndarray, seed: int = 0) -> dict[str, float]:
    """Share of resamples of the repeats in which each candidate (any shape) explains most, linearly."""
    rng = np.random.default_rng(seed)
    count = len(residuals)
    scores = screen.marks @ residuals.T  # [K, N]
    gram = screen.marks @ screen.marks.T
    groups: dict[Any, list[int]] = {}
    for k, question in enumerate(screen.questions):
        groups.setdefault(question.candidate.key, []).append(k)
    draws = rng.multinomial(count, np.full(count, 1 / count), size=RESAMPLES) / count  # [R, N]
    mean = draws @ scores.T  # [R, K]
    explained = np.stack([_explained(mean[:, rows], gram[np.ix_(rows, rows)]) for rows in groups.values()], axis=1)
    names = [screen.questions[rows[0]].candidate.name for rows in groups.values()]
    winners = np.bincount(np.argmax(explained, axis=1), minlength=len(names)) / RESAMPLES
    out: dict[str, float] = {}
    for name, share in zip(names, winners, strict=True):
        out[name] = out.get(name, 0.0) + float(share)
    return out


def _explained(scores: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """[R] what the best combination of some amplitudes explains; scores [R, K] and gram [K, K] of their marks."""
    damped = gram + 1e-9 * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.einsum("rk,rk->r", scores, np.linalg.solve(damped, scores.T).T)


def judge(
    fit: Evidence,
    confirm: Evidence,
    base: Model,
    model: Model,
    whole_gap: float,
    chosen: float,
    smallest: dict[str, float],
) -> Trial:
    """Put an extended model on trial against the one without its last effect.

    whole_gap: U of the model without any effect on the confirming demonstration.  chosen: share of
    resamples in which the effect, or one that looks like it, wins.
    """
    before, after, gain = improvement(confirm, base.values, model.values)
    p = one_sided_p(gain)
    spans = intervals(fit, model)
    new = [a for a in model.amplitudes if a not in base.amplitudes]
    reasons = []
    if p >= SIGNIFICANT:
        reasons.append(f"not confirmed by the other demonstration (p = {p:.2g})")
    if after > (1 - LESS) * before:
        reasons.append(f"takes only {1 - after / before:.0%} of the gap away on the other demonstration")
    elif before - after < OF_ALL * whole_gap:
        reasons.append(f"takes only {(before - after) / whole_gap:.1%} of the first gap away")
    if all(low <= 0.0 <= high for low, high in (spans[a] for a in new)):
        reasons.append("its amplitude may be zero")
    if all(abs(model.values[fit.cost.space.index(a)]) < smallest[a] for a in new):
        reasons.append("too small to be worth a name")
    reasons += [f"{a} ran into its bound" for a in new if _on_bound(fit, model, a)]
    if chosen < CHOSEN:
        reasons.append(f"wins only {chosen:.0%} of the resamples")
    return Trial(model.name, model.gap, after, p, {a: spans[a] for a in new}, chosen, tuple(reasons))


def _on_bound(fit: Evidence, model: Model, amplitude: str) -> bool:
    """At a bound that is not neutral."""
    p = fit.cost.space[amplitude]
    value, reach = model.values[fit.cost.space.index(amplitude)], EDGE * (p.high - p.low)
    return value > p.high - reach or (p.low != p.mean and value < p.low + reach)


def tied(trials: Sequence[Trial], best: Trial, before: float) -> list[Trial]:
    """The rivals that passed and do as well as the best; before: U without any of them."""
    enough = best.gap_confirm + TIE * (before - best.gap_confirm)
    return [t for t in trials if t is not best and t.passed and t.gap_confirm <= enough]
