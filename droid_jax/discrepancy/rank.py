"""Which candidates a refit is worth: what the best amplitudes of each would take away, linearly."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from droid_jax.discrepancy.candidates import Candidate
from droid_jax.discrepancy.screen import ScoreTest
from droid_jax.model.parameters import Space

COLLINEAR = 0.9  # absolute cosine from which two marks count as one


@dataclass(frozen=True)
class Proposal:
    """One or several candidates together: the sizes of their amplitudes, and the share of the gap they would take."""

    parts: tuple[Candidate, ...]
    sizes: Mapping[str, float]
    explained: float

    @property
    def names(self) -> tuple[str, ...]:
        """Of the candidates."""
        return tuple(c.name for c in self.parts)

    def start(self, space: Space, values: np.ndarray) -> np.ndarray:
        """`values` [D] with the shapes and amplitudes proposed."""
        out = values.copy()
        for name, value in {**{k: v for c in self.parts for k, v in c.shape_parameters.items()}, **self.sizes}.items():
            out[space.index(name)] = value
        return out


def proposals(
    screen: ScoreTest, residuals: np.ndarray, space: Space, number: int = 1, among: Container[str] | None = None
) -> list[Proposal]:
    """Every candidate (number = 1), or every pair of candidates (2), best shapes only, the best first.

    residuals: [N, M] of the model that was screened.  among: names of the candidates to take, None for
    all.  Amplitudes stay inside their bounds: a friction that would have to be negative explains nothing.
    """
    mean = residuals.mean(axis=0)
    whole = max(float(mean @ mean), 1e-30)
    scores, gram = screen.sensitivities @ mean, screen.sensitivities @ screen.sensitivities.T
    groups: dict[Any, list[int]] = {}
    for k, question in enumerate(screen.directions):
        if among is None or question.candidate.name in among:
            groups.setdefault(question.candidate.key, []).append(k)
    best: dict[tuple[str, ...], Proposal] = {}
    for rows in _combinations(list(groups.values()), number, screen):
        proposal = _proposal(screen, rows, scores[rows], gram[np.ix_(rows, rows)], whole, space)
        known = best.get(proposal.names)
        if known is None or proposal.explained > known.explained:
            best[proposal.names] = proposal
    return sorted(best.values(), key=lambda p: -p.explained)


def _combinations(groups: Sequence[list[int]], number: int, screen: ScoreTest) -> list[list[int]]:
    if number == 1:
        return list(groups)

    def together(a: Candidate, b: Candidate) -> bool:
        """Not the same candidate; and an effect has one shape at all its places."""
        return a.name != b.name and (a.effect != b.effect or a.shape_parameters == b.shape_parameters)

    of = [screen.directions[rows[0]].candidate for rows in groups]
    both = ((i, k) for i in range(len(of)) for k in range(i + 1, len(of)) if together(of[i], of[k]))
    return [[*groups[i], *groups[k]] for i, k in both]


def _proposal(
    screen: ScoreTest, rows: Sequence[int], scores: np.ndarray, gram: np.ndarray, whole: float, space: Space
) -> Proposal:
    names = [screen.directions[k].coefficient for k in rows]
    low = np.array([space[n].low - space[n].mean for n in names])
    high = np.array([space[n].high - space[n].mean for n in names])
    ridge = gram + 1e-9 * max(np.trace(gram), 1e-30) * np.eye(len(gram))
    if len(rows) == 1:
        size = np.clip(scores / ridge[0], low, high)
    else:
        factor = np.linalg.cholesky(ridge)
        size = lsq_linear(factor.T, np.linalg.solve(factor, scores), bounds=(low, high)).x
    explained = float(2 * size @ scores - size @ gram @ size) / whole
    sizes = {n: float(space[n].mean + s) for n, s in zip(names, size, strict=True)}
    return Proposal(_parts(screen, rows), sizes, explained)


def _parts(screen: ScoreTest, rows: Sequence[int]) -> tuple[Candidate, ...]:
    """The candidates of some questions, once each."""
    found: dict[Any, Candidate] = {}
    for k in rows:
        candidate = screen.directions[k].candidate
        found.setdefault(candidate.key, candidate)
    return tuple(found.values())


def collinear(screen: ScoreTest, names: Container[str]) -> set[str]:
    """Names of the candidates with a mark that is nearly one of these candidates'."""
    rows = np.array([q.candidate.name in names for q in screen.directions])
    unit = screen.sensitivities / np.maximum(np.linalg.norm(screen.sensitivities, axis=1, keepdims=True), 1e-30)
    near = np.max(np.abs(unit @ unit[rows].T), axis=1) > COLLINEAR
    return {screen.directions[k].candidate.name for k in np.flatnonzero(near)}
