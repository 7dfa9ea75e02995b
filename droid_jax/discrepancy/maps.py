"""Maps of the discrepancy: U by joint and phase, over the state of the motion, and along the hinge."""

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

BINS = 6  # of an angle, a speed or a load
STILL_OBJECT_SPEED = 0.01  # rad/s or m/s: the object moves above this speed
STILL_JOINT_SPEED = 0.005  # rad/s or m/s: a joint moves above this speed
LEAST_RANGE = 1e-3  # range of a variable, as a share of its largest absolute value, from which it is binned
FEWEST_RESIDUALS = 5  # of a cell that is tested
HELD_SHARE = 0.2  # of the 90 % quantile of the hinge torque's sensitivity, above which the hand holds the door


class Axis(enum.Enum):
    """Variable by which residuals are divided into cells."""

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
    """The part of a recording that a cell holds.

    axis: the variable that is divided.
    joint: name of the joint, None if the axis has none.
    label: name of the part, None for a range.
    low, high: range of the variable, None for a named part without one.
    unit: of the range.
    """

    axis: Axis
    joint: str | None = None
    label: str | None = None
    low: float | None = None
    high: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class Cell:
    """Discrepancy of one part of a recording.

    key: the part.
    discrepancy: U of its residuals.
    p: p-value of U = 0; 1 for a recording without repeats.
    found: whether it is significant at the false discovery rate of the search.
    """

    key: CellKey
    discrepancy: float
    p: float
    found: bool


Localisation = tuple[Cell, ...]  # every cell, axis by axis


def localise(residual_set: ResidualSet, values: np.ndarray, residuals: np.ndarray, motion: np.ndarray) -> Localisation:
    """U in cells by joint and phase, object angle, direction and speed, and each joint's direction, position and load.

    A trend over the repeats is not in the cells, since U is that of the common residual (see `candidates.trend`).

    Args:
        residual_set: of the recording.
        values: [D] of the model.
        residuals: [N, M] of its repeats or blocks.
        motion: [D] of the model whose simulated angles, speeds and loads define the cells.  Models that are compared
            need the same one, since their loads differ.
    """
    keys, masks = zip(*_cells(residual_set, motion), strict=True)
    cells, rows = np.stack(masks), residual_set.resampling
    tested = cells.sum(axis=1) >= FEWEST_RESIDUALS
    p = np.ones(len(cells))
    p[tested] = rows.cell_p_values(residuals, cells[tested])
    found = np.zeros(len(cells), bool)
    found[tested] = benjamini_hochberg(p[tested], residual_set.config.false_discovery_rate)
    size = rows.discrepancies(residuals, cells)
    out = (Cell(key, float(size[i]), float(p[i]), bool(found[i])) for i, key in enumerate(keys))
    return (*out, *_hinge_parts(residual_set, values, residuals))


def _hinge_parts(residual_set: ResidualSet, values: np.ndarray, residuals: np.ndarray) -> Localisation:
    """U of three parts: along the direction of a hinge torque, across it, and while the door is not held.

    The direction is that of the measured joint torques under a torque of the hinge.  The first part points to the
    hinge, the second to pose, contact or arm, the third to the arm, its tool or a sensor.  Empty without a hinge, with
    a sensor on the hinge itself, and for blocks.
    """
    space, scene, rows = residual_set.cost.space, residual_set.cost.scene, residual_set.resampling
    torques = space.of_role(Role.OBJECT_TORQUE)
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
    held = size > HELD_SHARE * np.quantile(size, 0.9)
    if columns < 2 or held.all() or not held.any():
        return ()
    unit = sensitivity[:, held] / size[held]
    each = residuals.reshape(len(residuals), columns, -1)
    along = np.einsum("nck,ck->nk", each[..., held], unit)
    # The residual across has one direction less than there are columns.
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
    """Each cell's key and its residuals, [M] bool."""
    comparison, scene, clock = residual_set.comparison, residual_set.cost.scene, residual_set.time
    columns = joint_columns(residual_set)
    (rollout,) = residual_set.cost.rollouts(values[None])
    phases = [(p.name, p.start, p.end) for p in comparison.phases] or [("all", clock.min(), clock.max() + 1e-9)]
    for joint, of_joint in columns.items():
        for name, first, last in phases:
            inside = (clock >= first) & (clock < last) & of_joint
            yield CellKey(Axis.PHASE, joint, name, float(first), float(last), "s"), inside
    at = np.clip(np.searchsorted(comparison.clock, clock), 0, len(comparison.clock) - 1)
    angle = np.asarray(rollout.object_angle[0])
    speed = np.gradient(angle, comparison.clock)
    if np.ptp(angle) > 0:
        length = _length(scene, str(scene.object_joint))
        yield from _bins(CellKey(Axis.OBJECT_ANGLE, unit=length), angle[at])
        w, still = speed[at], STILL_OBJECT_SPEED
        directions = {"opening": w > still, "closing": w < -still, "still": np.abs(w) <= still}
        for label, inside in directions.items():
            yield CellKey(Axis.OBJECT_DIRECTION, label=label), inside
        yield from _bins(CellKey(Axis.OBJECT_SPEED, unit=f"{length}/s"), np.abs(w))
    for joint, of_joint in columns.items():
        if joint not in scene.joints:
            continue
        column = scene.joints.index(joint)
        velocity = np.asarray(rollout.velocity[0])[at, column]
        for label, inside in (("forward", velocity > STILL_JOINT_SPEED), ("back", velocity < -STILL_JOINT_SPEED)):
            yield CellKey(Axis.DIRECTION, joint, label), of_joint & inside
        position, load = np.asarray(rollout.position[0])[at, column], np.asarray(rollout.torque[0])[at, column]
        yield from _bins(CellKey(Axis.POSITION, joint, unit=_length(scene, joint)), position, of_joint)
        yield from _bins(CellKey(Axis.LOAD, joint, unit=scene.torque_unit([joint])), load, of_joint)


def joint_columns(residual_set: ResidualSet) -> dict[str, np.ndarray]:
    """Joint -> [M] bool, its residuals in all channels; the object angle belongs to the object's joint."""
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


def _bins(of: CellKey, x: np.ndarray, among: np.ndarray | bool = True) -> Iterator[tuple[CellKey, np.ndarray]]:
    """Equal bins of x [M] over its range among some residuals [M] bool; none if x is nearly constant."""
    least, most = np.min(x, where=among, initial=np.inf), np.max(x, where=among, initial=-np.inf)
    if not most - least > LEAST_RANGE * max(abs(least), abs(most)):
        return
    for low, high in itertools.pairwise(np.linspace(least, most + 1e-9, BINS + 1).tolist()):
        yield CellKey(of.axis, of.joint, None, low, high, of.unit), among & (x >= low) & (x < high)
