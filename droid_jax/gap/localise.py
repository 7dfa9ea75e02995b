"""Where simulation and measurement disagree: U by joint and phase, and over the state of the motion."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from droid_jax.gap.evidence import Evidence
from droid_jax.gap.flips import benjamini_hochberg

FALSE_DISCOVERIES = 0.1
BINS = 6
STILL = 0.01  # rad/s


@dataclass(frozen=True)
class Cell:
    """One place of the disagreement: over which variable, where, how large, and whether it is there at all.

    Of a recording without repeats nothing tells the last: p = 1, found False.
    """

    variable: str
    where: str
    gap: float
    p: float
    found: bool


@dataclass(frozen=True, eq=False)
class Localisation:
    """U in every cell, variable by variable."""

    cells: tuple[Cell, ...]


def localise(evidence: Evidence, values: np.ndarray, residuals: np.ndarray) -> Localisation:
    """Cells by joint and phase, door angle, sign and size of the door's speed, and each joint's position.

    values: [D] of the model; residuals: [N, M] of its repeats or blocks.
    """
    names, masks = zip(*_cells(evidence, values), strict=True)
    cells = np.stack(masks)
    kept = cells.sum(axis=1) >= 5
    p = np.ones(len(cells))
    p[kept] = evidence.cell_p_values(residuals, cells[kept])
    found = np.zeros(len(cells), bool)
    found[kept] = benjamini_hochberg(p[kept], FALSE_DISCOVERIES)
    size = evidence.gaps(residuals, cells)
    return Localisation(
        tuple(Cell(v, w, float(size[i]), float(p[i]), bool(found[i])) for i, (v, w) in enumerate(names))
    )


def _cells(evidence: Evidence, values: np.ndarray) -> list[tuple[tuple[str, str], np.ndarray]]:
    comparison = evidence.cost.comparisons[0]
    joints = [evidence.cost.scene.joints[c] for c in comparison.channel("torque").columns]
    (rollout,) = evidence.cost.rollouts(values[None])
    clock = evidence.time
    out: list[tuple[tuple[str, str], np.ndarray]] = []
    spans = [(p.name, p.start, p.end) for p in comparison.phases] or [("all", clock.min(), clock.max() + 1e-9)]
    for j, joint in enumerate(joints):
        for name, first, last in spans:
            inside = (clock >= first) & (clock < last) & (evidence.column == j)
            out.append((("joint x phase", f"{joint}, {name} {first:.1f} s"), inside))
    at = np.clip(np.searchsorted(comparison.clock, clock), 0, len(comparison.clock) - 1)
    angle = np.asarray(rollout.object_angle[0])
    speed = np.gradient(angle, comparison.clock)
    if np.ptp(angle) > 0:
        out += _bins("object angle", angle[at], "rad")
        w = speed[at]
        sides = {"opening": w > STILL, "closing": w < -STILL, "still": np.abs(w) <= STILL}
        out += [(("object direction", word), side) for word, side in sides.items()]
        out += _bins("object speed", np.abs(w), "rad/s")
    for j, joint in enumerate(joints):
        mine = evidence.column == j
        column = comparison.channel("torque").columns[j]
        velocity = np.asarray(rollout.velocity[0])[at, column]
        for word, side in (("forward", velocity > 0.005), ("back", velocity < -0.005)):
            out.append(((f"direction of {joint}", word), mine & side))
    return out


def _bins(variable: str, x: np.ndarray, unit: str) -> list[tuple[tuple[str, str], np.ndarray]]:
    edges = np.linspace(x.min(), x.max() + 1e-9, BINS + 1)
    return [
        ((variable, f"{low:.2f} to {high:.2f} {unit}"), (x >= low) & (x < high))
        for low, high in itertools.pairwise(edges)
    ]
