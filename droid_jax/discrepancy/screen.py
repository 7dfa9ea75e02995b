"""Is anything missing, and what looks like it: each candidate's mark, without what the base model can absorb.

A candidate is simulated once with a small amplitude.  The whitened difference, less its projection on
the base parameters' columns (their priors included), is its mark; the product of mark and residual,
repeat by repeat, its score.  Source of the projection: Plumlee, Bayesian calibration of inexact
computer models, JASA 2017.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from droid_jax.discrepancy.candidates import Candidate
from droid_jax.discrepancy.residual_set import ResidualSet

Test = Callable[[np.ndarray], tuple[np.ndarray, float]]
SMALL = 0.3  # prior deviations of an amplitude: large against solver noise, small enough to be linear


@dataclass(frozen=True, eq=False)
class ScoreDirection:
    """One amplitude of one candidate (a tilted frame has two)."""

    candidate: Candidate
    coefficient: str


@dataclass(frozen=True, eq=False)
class ScoreTest:
    """What the screening found.

    directions: K of them.  raw: [K, M] what a unit of each amplitude adds; sensitivities: [K, M] the same, projected.
    t: [K]; explained: [K] share of the gap that the best amplitude would take away, linearly; size: [K] that
    amplitude.  p: of the largest |t|.  failed: names of candidates that made the replay blow up; their marks
    are zero.
    """

    directions: tuple[ScoreDirection, ...]
    raw: np.ndarray
    sensitivities: np.ndarray
    t: np.ndarray
    explained: np.ndarray
    size: np.ndarray
    p: float
    failed: tuple[str, ...] = ()

    def best(self) -> list[int]:
        """Questions by what they explain, the best first."""
        return np.argsort(-self.explained).tolist()


def sensitivities(residual_set: ResidualSet, values: np.ndarray, questions: Sequence[ScoreDirection]) -> np.ndarray:
    """[K, M] what each amplitude adds to the simulation, per unit of it, in units of one repeat's noise.

    values: [D] the fitted model.  One batch for all.  NaN where the replay blew up.
    """
    space = residual_set.cost.space
    rows, sizes = [values], []
    for q in questions:
        row = values.copy()
        for name, value in q.candidate.shape_parameters.items():
            row[space.index(name)] = value
        p = space[q.coefficient]
        room = p.high - p.mean or p.low - p.mean  # downwards where neutral is the upper bound
        size = math.copysign(min(SMALL * p.std, 0.5 * abs(room)), room)
        row[space.index(q.coefficient)] = p.mean + size
        rows.append(row)
        sizes.append(size)
    simulated = -residual_set.common(np.stack(rows))
    found = (simulated[1:] - simulated[0]) / np.array(sizes)[:, None]
    return np.where(np.isfinite(found).all(axis=1, keepdims=True), found, np.nan)


def directions_of(candidates: Sequence[Candidate]) -> tuple[ScoreDirection, ...]:
    """One question for each amplitude of each candidate."""
    return tuple(ScoreDirection(c, a) for c in candidates for a in c.coefficients)


def project(columns: np.ndarray, base: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Columns [K, M] without what base columns [M, D] with prior deviations [D] would absorb of them."""
    normal = base.T @ base + np.diag(prior**-2)
    return columns - np.linalg.solve(normal, base.T @ columns.T).T @ base.T


def score_test(
    residuals: np.ndarray,
    questions: Sequence[ScoreDirection],
    raw: np.ndarray,
    projected: np.ndarray,
    test: Test,
) -> ScoreTest:
    """Score projected marks [K, M] against residuals [N, M] of the base fit.

    raw: [K, M] the marks before projection.  test: scores [K, N] -> statistic [K] and the p-value of the
    largest (see `ResidualSet.largest_score`).
    """
    norm = np.einsum("km,km->k", projected, projected)
    scores = projected @ residuals.T  # [K, N]
    t, p = test(scores)
    size = scores.mean(axis=1) / np.maximum(norm, 1e-30)
    shared = residuals.mean(axis=0)
    explained = size * scores.mean(axis=1) / max(float(shared @ shared), 1e-30)
    return ScoreTest(tuple(questions), raw, projected, t, explained, size, p)
