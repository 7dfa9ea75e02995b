"""Where simulation and measurement disagree: U by joint and phase, over the state of the motion, along the hinge."""

from __future__ import annotations

import enum
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.statistics import benjamini_hochberg
from droid_jax.model.parameters import Role
from droid_jax.model.scene import Scene

BINS = 6
STILL = 0.01  # rad/s or m/s
STILL_JOINT = 0.005  # rad/s or m/s
LEAST = 1e-3  # of its size, by which a variable must change to be divided
FEWEST = 5  # residuals of a cell that is tested
HELD = 0.2  # of the size, where it is large, of what a torque of the hinge does: with less the door is not held


class Axis(enum.Enum):
    """What a cell divides."""

    PHASE = "phase"  # of the motion, by joint
    OBJECT_ANGLE = "object_angle"
    OBJECT_DIRECTION = "object_direction"  # opening, closing, still
    OBJECT_SPEED = "object_speed"
    DIRECTION = "direction"  # of a joint: forward, back
    POSITION = "position"  # of a joint
    LOAD = "load"  # of a joint
    HINGE_FORCE = "hinge_force"  # along the hinge, other directions, door not held


@dataclass(frozen=True)
class CellKey:
    """Which part of a recording: of which axis, of which joint, which named part or which range.

    joint, label, low, high: None where the axis has none.  unit: of the range.
    """

    axis: Axis
    joint: str | None = None
    label: str | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class Cell:
    """One part of the disagreement: where, how large, and whether it is there at all.

    Of a recording without repeats nothing says the last: p = 1, found False.
    """

    key: CellKey
    discrepancy: float
    p: float
    found: bool


Localisation = tuple[Cell, ...]  # every cell, axis by axis


def localise(residual_set: ResidualSet, values: np.ndarray, residuals: np.ndarray, motion: np.ndarray) -> Localisation:
    """Cells by joint and phase, the object's angle, direction and speed, each joint's direction, angle and load.

    What changes over the repeats' order is no cell: U is what the repeats share (`candidates.trend`).

    Args:
        residual_set: of the recording.
        values: [D] of the model.
        residuals: [N, M] of its repeats or blocks.
        motion: [D] of the model whose angles, speeds and loads divide them: one for all models that are compared, since
            each has loads of its own.
    """
    keys, masks = zip(*_cells(residual_set, motion), strict=True)
    cells, rows = np.stack(masks), residual_set.resampling
    tested = cells.sum(axis=1) >= FEWEST
    p = np.ones(len(cells))
    p[tested] = rows.cell_p_values(residuals, cells[tested])
    found = np.zeros(len(cells), bool)
    found[tested] = benjamini_hochberg(p[tested], residual_set.config.false_discovery_rate)
    size = rows.discrepancies(residuals, cells)
    out = (Cell(key, float(size[i]), float(p[i]), bool(found[i])) for i, key in enumerate(keys))
    return (*out, *_hinge_parts(residual_set, values, residuals))


def _hinge_parts(residual_set: ResidualSet, values: np.ndarray, residuals: np.ndarray) -> Localisation:
    """U of three parts: what a torque of the hinge would do, what it cannot do, and the door not held.

    The first is the hinge's; the second pose, contact or the arm's; the third the arm's, its tool's or a sensor's.
    Empty where nothing tells the first: no hinge, a sensor on the hinge itself, or blocks instead of repeats.
    """
    space, scene, rows = residual_set.cost.space, residual_set.cost.scene, residual_set.resampling
    torques = space.of_role(Role.OBJECT_TORQUE)  # how they show in the measured joints
    if [c.name for c in residual_set.comparison.channels] != ["torque"]:
        return ()
    if not torques or scene.object_joint in scene.joints or not rows.repeated:
        return ()
    pushed, at, step = values.copy(), space.index(torques[0].name), 0.5 * torques[0].std
    pushed[at] += step if values[at] + step <= torques[0].high else -step
    without, with_it = -residual_set.common(np.stack([values, pushed]))
    columns = int(residual_set.column.max()) + 1
    sensitivity = (with_it - without).reshape(columns, -1)
    size = np.linalg.norm(sensitivity, axis=0)
    held = size > HELD * np.quantile(size, 0.9)
    if columns < 2 or held.all() or not held.any():
        return ()
    unit = sensitivity[:, held] / size[held]
    each = residuals.reshape(len(residuals), columns, -1)
    along = np.einsum("nck,ck->nk", each[..., held], unit)
    # Columns minus one directions are left, spread over all columns.
    across = (each[..., held] - along[:, None] * unit) * np.sqrt(columns / (columns - 1))
    free = each[..., ~held].reshape(len(residuals), -1)
    parts = {"along the hinge": along, "door held, other directions": across, "door not held": free}
    flat = [part.reshape(len(residuals), -1) for part in parts.values()]
    p = [rows.cell_p_values(f, np.ones((1, f.shape[1]), bool))[0] for f in flat]
    found = benjamini_hochberg(np.array(p), residual_set.config.false_discovery_rate)
    return tuple(
        Cell(CellKey(Axis.HINGE_FORCE, label=label), rows.discrepancy(f), float(p[i]), bool(found[i]))
        for i, (label, f) in enumerate(zip(parts, flat, strict=True))
    )


def _cells(residual_set: ResidualSet, values: np.ndarray) -> Iterator[tuple[CellKey, np.ndarray]]:
    """Every cell and its residuals, [M] bool."""
    comparison, scene, clock = residual_set.comparison, residual_set.cost.scene, residual_set.time
    columns = joint_columns(residual_set)
    (rollout,) = residual_set.cost.rollouts(values[None])
    spans = [(p.name, p.start, p.end) for p in comparison.phases] or [("all", clock.min(), clock.max() + 1e-9)]
    for joint, mine in columns.items():
        for name, first, last in spans:
            inside = (clock >= first) & (clock < last) & mine
            yield CellKey(Axis.PHASE, joint, name, float(first), float(last), "s"), inside
    at = np.clip(np.searchsorted(comparison.clock, clock), 0, len(comparison.clock) - 1)
    angle = np.asarray(rollout.object_angle[0])
    speed = np.gradient(angle, comparison.clock)
    if np.ptp(angle) > 0:
        length = _length(scene, str(scene.object_joint))
        yield from _bins(CellKey(Axis.OBJECT_ANGLE, unit=length), angle[at])
        w = speed[at]
        sides = {"opening": w > STILL, "closing": w < -STILL, "still": np.abs(w) <= STILL}
        for label, side in sides.items():
            yield CellKey(Axis.OBJECT_DIRECTION, label=label), side
        yield from _bins(CellKey(Axis.OBJECT_SPEED, unit=f"{length}/s"), np.abs(w))
    for joint, mine in columns.items():
        if joint not in scene.joints:
            continue
        column = scene.joints.index(joint)
        velocity = np.asarray(rollout.velocity[0])[at, column]
        for label, side in (("forward", velocity > STILL_JOINT), ("back", velocity < -STILL_JOINT)):
            yield CellKey(Axis.DIRECTION, joint, label), mine & side
        position, load = np.asarray(rollout.position[0])[at, column], np.asarray(rollout.torque[0])[at, column]
        yield from _bins(CellKey(Axis.POSITION, joint, unit=_length(scene, joint)), position, mine)
        yield from _bins(CellKey(Axis.LOAD, joint, unit=scene.torque_unit([joint])), load, mine)


def joint_columns(residual_set: ResidualSet) -> dict[str, np.ndarray]:
    """Joint -> residuals [M] bool of it, in whatever channel; the object's angle is its joint's."""
    scene, names = residual_set.cost.scene, list[str]()
    for channel in residual_set.comparison.channels:
        each = (
            [str(scene.object_joint)] if channel.name == "object_angle" else [scene.joints[c] for c in channel.columns]
        )
        names += each
    of = np.array(names)[residual_set.column]
    return {joint: of == joint for joint in dict.fromkeys(names)}


def _length(scene: Scene, joint: str) -> str:
    """Unit of a joint's position."""
    return scene.position_unit([joint])


def _bins(of: CellKey, x: np.ndarray, mine: np.ndarray | bool = True) -> Iterator[tuple[CellKey, np.ndarray]]:
    """Equal bins of x [M] over its range in the cell `mine`; none where it hardly changes (a rounded constant)."""
    least, most = np.min(x, where=mine, initial=np.inf), np.max(x, where=mine, initial=-np.inf)
    if not most - least > LEAST * max(abs(least), abs(most)):
        return
    for low, high in itertools.pairwise(np.linspace(least, most + 1e-9, BINS + 1).tolist()):
        yield CellKey(of.axis, of.joint, None, low, high, of.unit), mine & (x >= low) & (x < high)
