"""Base parameters and effects together, by full re-simulation.

Residual regression alone is biased by the servo loop, contact and stiction: what a candidate adds is
measured only after everything else has been allowed to move.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from droid_jax.gap.candidates import Candidate
from droid_jax.gap.evidence import Evidence, gap
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.refine import RefineConfig, Refined, RefineProgress, refine
from droid_jax.identify.uncertainty import calibrated, time_blocks
from droid_jax.model.parameters import Space

REFIT = RefineConfig(iterations=8, hops=0)
LEVEL = 0.9  # of the amplitudes' intervals


@dataclass(frozen=True, eq=False)
class Model:
    """A fitted model: the base parameters and the effects that are in it.

    parts: candidates, none for the base model.  values: [D] over the whole space, absent effects at
    neutral.  space: what was free.  refined: how the fit ended, over `space`.  residuals: [N, M] of
    the fitted recording's repeats.  gap: their U.
    """

    parts: tuple[Candidate, ...]
    values: np.ndarray
    space: Space
    refined: Refined
    residuals: np.ndarray
    gap: float

    @property
    def name(self) -> str:
        """ "base", "latch at door_hinge", "latch at door_hinge + drag at door_hinge"."""
        return " + ".join(c.name for c in self.parts) or "base"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names of the free amplitudes."""
        return tuple(a for c in self.parts for a in c.amplitudes)


def embed(whole: Space, part: Space, values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """[P, D] the vector `values` [D] over `whole` with the entries of `part` replaced by rows [P, F]."""
    out = np.tile(values, (len(rows), 1))
    out[:, [whole.index(n) for n in part.names]] = rows
    return out


def refit(
    evidence: Evidence,
    base: Space,
    parts: Sequence[Candidate],
    starts: np.ndarray,
    config: RefineConfig = REFIT,
    progress: Callable[[RefineProgress], None] | None = None,
) -> Model:
    """Fit base parameters and the effects `parts` to one recording, from starts [S, D] over the whole space."""
    whole = evidence.cost.space
    free = [name for c in parts for name in c.free]
    space = whole.select([*base.names, *dict.fromkeys(free)])
    columns = [whole.index(n) for n in space.names]

    def residuals(rows: np.ndarray) -> np.ndarray:
        return evidence.cost.whitened(embed(whole, space, starts[0], rows))

    refined = refine(residuals, space, starts[:, columns], config, progress=progress)
    values = embed(whole, space, starts[0], refined.best[None])[0]
    left = evidence.residuals(-refined.residual / np.sqrt(evidence.repeats))
    return Model(tuple(parts), values, space, refined, left, gap(left))


def gaussian(evidence: Evidence, model: Model) -> Gaussian:
    """The calibrated Gaussian over what was free in a model (the rule of identify/uncertainty.py)."""
    comparison = evidence.cost.comparisons[0]
    shapes = [(len(c.columns), c.noise.mean.shape[0]) for c in comparison.channels]
    durations = [c.span[1] - c.span[0] for c in comparison.channels]
    return calibrated(model.refined, [comparison.deviations()], time_blocks(shapes, durations))


def intervals(evidence: Evidence, model: Model) -> dict[str, tuple[float, float]]:
    """Interval of every free amplitude, in its own unit."""
    low, high = gaussian(evidence, model).interval(LEVEL)
    return {a: (float(low[model.space.index(a)]), float(high[model.space.index(a)])) for a in model.amplitudes}
