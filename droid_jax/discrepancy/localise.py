"""Where simulation and measurement disagree: U by joint and phase, over the state of the motion, along the hinge."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.sign_flips import benjamini_hochberg
from droid_jax.model.scene import Scene

FALSE_DISCOVERIES = 0.1
BINS = 6
STILL = 0.01  # rad/s or m/s
LEAST = 1e-3  # of its size, by which a variable must change to be divided
ALONG = "hinge_preload"  # the amplitude whose mark says how a torque of the hinge shows in the measured joints
POSITION, LOAD = "position of ", "load of "  # a joint
HELD = 0.2  # of that mark's size where it is large: with less the door is not held


@dataclass(frozen=True)
class Cell:
    """One place of the disagreement: over which variable, where, how large, and whether it is there at all.

    Of a recording without repeats nothing tells the last: p = 1, found False.
    """

    variable: str
    where: str
    discrepancy: float
    p: float
    found: bool


@dataclass(frozen=True, eq=False)
class Localisation:
    """U in every cell, variable by variable."""

    cells: tuple[Cell, ...]


def localise(residual_set: ResidualSet, values: np.ndarray, residuals: np.ndarray, motion: np.ndarray) -> Localisation:
    """Cells by joint and phase, door angle, sign and size of the door's speed, each joint's direction, angle and load.

    What the repeats' order changes is no cell: U is what the repeats share (`trend`).

    values: [D] of the model; residuals: [N, M] of its repeats or blocks.  motion: [D] of the model whose angles, speeds
    and loads divide them: one for all models that are compared, each has loads of its own.
    """
    names, masks = zip(*_cells(residual_set, motion), strict=True)
    cells = np.stack(masks)
    kept = cells.sum(axis=1) >= 5
    p = np.ones(len(cells))
    p[kept] = residual_set.cell_p_values(residuals, cells[kept])
    found = np.zeros(len(cells), bool)
    found[kept] = benjamini_hochberg(p[kept], FALSE_DISCOVERIES)
    size = residual_set.discrepancies(residuals, cells)
    cells = tuple(Cell(v, w, float(size[i]), float(p[i]), bool(found[i])) for i, (v, w) in enumerate(names))
    return Localisation((*cells, *_parts(residual_set, values, residuals)))


def _parts(residual_set: ResidualSet, values: np.ndarray, residuals: np.ndarray) -> tuple[Cell, ...]:
    """U of three parts: what a torque of the hinge would do, what it cannot do, and the door not held.

    The first is the hinge's; the second pose, contact or the arm's; the third the arm's, its tool's or a sensor's.
    Empty where nothing tells the first: no hinge, a sensor on the hinge itself, or blocks instead of repeats.
    """
    space, scene = residual_set.cost.space, residual_set.cost.scene
    if ALONG not in space.names or scene.object_joint in scene.joints or not residual_set.repeated:
        return ()
    pushed, at, step = values.copy(), space.index(ALONG), 0.5 * space[ALONG].std
    pushed[at] += step if values[at] + step <= space[ALONG].high else -step
    without, with_it = -residual_set.common(np.stack([values, pushed]))
    columns = int(residual_set.column.max()) + 1
    mark = (with_it - without).reshape(columns, -1)
    size = np.linalg.norm(mark, axis=0)
    held = size > HELD * np.quantile(size, 0.9)
    if columns < 2 or held.all() or not held.any():
        return ()
    unit = mark[:, held] / size[held]
    each = residuals.reshape(len(residuals), columns, -1)
    along = np.einsum("nck,ck->nk", each[..., held], unit)
    # Columns minus one directions are left, spread over all columns.
    across = (each[..., held] - along[:, None] * unit) * np.sqrt(columns / (columns - 1))
    free = each[..., ~held].reshape(len(residuals), -1)
    parts = (("along the hinge", along), ("door held, other directions", across), ("door not held", free))
    flat = [part.reshape(len(residuals), -1) for _, part in parts]
    p = [residual_set.cell_p_values(f, np.ones((1, f.shape[1]), bool))[0] for f in flat]
    found = benjamini_hochberg(np.array(p), FALSE_DISCOVERIES)
    return tuple(
        Cell("force", name, residual_set.discrepancy(f), float(p[i]), bool(found[i]))
        for i, ((name, _), f) in enumerate(zip(parts, flat, strict=True))
    )


def _cells(residual_set: ResidualSet, values: np.ndarray) -> list[tuple[tuple[str, str], np.ndarray]]:
    comparison, scene = residual_set.cost.comparisons[0], residual_set.cost.scene
    joints = [scene.joints[c] for c in comparison.channel("torque").columns]
    (rollout,) = residual_set.cost.rollouts(values[None])
    clock = residual_set.time
    out: list[tuple[tuple[str, str], np.ndarray]] = []
    spans = [(p.name, p.start, p.end) for p in comparison.phases] or [("all", clock.min(), clock.max() + 1e-9)]
    for j, joint in enumerate(joints):
        for name, first, last in spans:
            inside = (clock >= first) & (clock < last) & (residual_set.column == j)
            out.append((("joint x phase", f"{joint}, {name} {first:.1f} s"), inside))
    at = np.clip(np.searchsorted(comparison.clock, clock), 0, len(comparison.clock) - 1)
    angle = np.asarray(rollout.object_angle[0])
    speed = np.gradient(angle, comparison.clock)
    if np.ptp(angle) > 0:
        length = _length(scene, str(scene.object_joint))
        out += _bins("object angle", angle[at], length)
        w = speed[at]
        sides = {"opening": w > STILL, "closing": w < -STILL, "still": np.abs(w) <= STILL}
        out += [(("object direction", word), side) for word, side in sides.items()]
        out += _bins("object speed", np.abs(w), f"{length}/s")
    for j, joint in enumerate(joints):
        mine = residual_set.column == j
        column = comparison.channel("torque").columns[j]
        velocity = np.asarray(rollout.velocity[0])[at, column]
        for word, side in (("forward", velocity > 0.005), ("back", velocity < -0.005)):
            out.append(((f"direction of {joint}", word), mine & side))
        position, load = np.asarray(rollout.position[0])[at, column], np.asarray(rollout.torque[0])[at, column]
        out += _bins(f"{POSITION}{joint}", position, _length(scene, joint), mine)
        out += _bins(f"{LOAD}{joint}", load, scene.torque_unit([joint]), mine)
    return out


def _length(scene: Scene, joint: str) -> str:
    """Unit of a joint's position."""
    return scene.position_unit([joint])


def _bins(variable: str, x: np.ndarray, unit: str, mine: Any = True) -> list[tuple[tuple[str, str], np.ndarray]]:
    """Equal bins of x [M] over its range in the cell `mine`; none where it hardly changes (a rounded constant)."""
    least, most = np.min(x, where=mine, initial=np.inf), np.max(x, where=mine, initial=-np.inf)
    if not most - least > LEAST * max(abs(least), abs(most)):
        return []
    digits = max(2, math.ceil(1 - math.log10((most - least) / BINS)))
    return [
        ((variable, f"{low:.{digits}f} to {high:.{digits}f} {unit}"), mine & (x >= low) & (x < high))
        for low, high in itertools.pairwise(np.linspace(least, most + 1e-9, BINS + 1))
    ]
