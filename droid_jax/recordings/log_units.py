"""Converts numbers of a log to the units of a recording, from the units that the map or the log states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from droid_jax.errors import named
from droid_jax.recordings.column_map import ChannelMap, ColumnMap, as_list
from droid_jax.recordings.log_columns import LogColumns
from droid_jax.recordings.units import COUNTS, CURRENTS, HINGES, KINDS, NORMALISED, SLIDES, unit_factor


def in_si(
    numbers: np.ndarray, entry: ChannelMap, key: str, joints: Sequence[str], columns: ColumnMap, log: LogColumns
) -> np.ndarray:
    """Numbers [T, C] of a log in the units of a recording.

    Args:
        numbers: [T, C] as the log has them.
        entry: the map's entry of the channel.
        key: name of the channel.
        joints: C names.
        columns: the whole map.
        log: the log, which may state units itself.

    Raises:
        ValueError: a unit is unknown or not stated, or a number that its conversion needs is missing.
    """
    where = f"{log.where}, {key}"
    units = _unit_of_each(entry, key, joints, columns, log)
    pairs = zip(units, joints, strict=True)
    factors = np.array([unit_factor(KINDS[key], unit, joint in columns.slides, where) for unit, joint in pairs])
    for named_units, field in ((COUNTS, "counts_per_turn"), (CURRENTS, "torque_constant")):
        asked = [unit in named_units for unit in units]
        given = getattr(entry, field)
        if any(asked) and given is None:
            raise ValueError(f"{where}: {field} is needed for the unit {units[asked.index(True)]!r}")
        if not any(asked) and given is not None:
            raise ValueError(f"{where}: {field} is for the units {' and '.join(map(repr, named_units))}")
        if given is not None:
            constant = _each(given, len(joints), f"{where}: {field}")
            if not np.all(constant) or not np.isfinite(constant).all():
                raise ValueError(f"{where}: {field} must not be 0, got {given}")
            factors = np.where(asked, factors / constant if field == "counts_per_turn" else factors * constant, factors)
    scale = _each(entry.scale, len(joints), f"{where}: scale")
    zero = _each(entry.zero, len(joints), f"{where}: zero")
    if not np.all(scale):
        raise ValueError(f"{where}: scale must not be 0")
    if not (normal := [unit in NORMALISED for unit in units]) or not any(normal):
        if entry.range is not None:
            raise ValueError(f"{where}: range is for the units {' and '.join(map(repr, NORMALISED))}")
        trivial = np.all(factors * scale == 1.0) and not np.any(zero)
        return numbers if trivial else (numbers - zero) * (factors * scale)
    if np.any(zero[np.array(normal)]):
        raise ValueError(f"{where}: range states where normalised positions are; zero is for other units")
    low, high = _range(entry, len(joints), where)
    ends = np.array([NORMALISED.get(unit, (0.0, 1.0)) for unit in units])
    share = (numbers - ends[:, 0]) / (ends[:, 1] - ends[:, 0])
    return np.where(normal, (low + share * (high - low)) * scale, (numbers - zero) * (factors * scale))


def _unit_of_each(entry: ChannelMap, key: str, joints: Sequence[str], columns: ColumnMap, log: LogColumns) -> list[str]:
    """The unit of each column: that of the map's entry, else that of the whole map, else that which the log states."""
    if isinstance(entry.unit, list):
        if len(entry.unit) != len(joints):
            raise ValueError(f"{log.where}, {key}: {len(entry.unit)} units for {len(joints)} joints")
        return list(entry.unit)
    kind = KINDS[key]
    stated, hint = log.stated(entry.columns, log.units), log.stated(entry.columns, log.hints)
    out = []
    for joint in joints:
        slides = joint in columns.slides
        base = (columns.units.length if slides else columns.units.angle) if kind != "torque" else None
        of_all = {
            "position": base,
            "velocity": f"{base}/s" if base is not None and base not in NORMALISED else None,
            "torque": columns.units.force if slides else columns.units.torque,
        }[kind]
        unit = entry.unit or of_all or stated
        if unit is None:
            known = named((SLIDES if slides else HINGES)[kind])
            why = f" ({hint})" if hint else ""
            raise ValueError(
                f"{log.where}, {key}: the unit of joint {joint!r} is not stated{why}: give --units, one of {known}"
            )
        out.append(unit)
    return out


def _each(value: float | list[float], count: int, where: str) -> np.ndarray:
    numbers = np.asarray(as_list(value), np.float64)
    if len(numbers) not in (1, count):
        raise ValueError(f"{where}: expected 1 or {count} numbers, got {len(numbers)}")
    return np.broadcast_to(numbers, (count,))


def _range(entry: ChannelMap, count: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest position, each [C], of joints that are logged as shares of their travel."""
    if not entry.range:
        raise ValueError(
            f"{where}: range is needed for a normalised position: the calibrated [lowest, highest] of each "
            "joint in rad (m)"
        )
    ends = np.array([entry.range] if not isinstance(entry.range[0], list) else entry.range, np.float64, ndmin=2)
    if ends.ndim != 2 or ends.shape[1] != 2 or len(ends) not in (1, count) or not np.all(ends[:, 0] < ends[:, 1]):
        raise ValueError(f"{where}: range must be [lowest, highest], for each of the {count} joints or for all")
    ends = np.broadcast_to(ends, (count, 2))
    return ends[:, 0], ends[:, 1]
