"""Reads recordings from logs of any column names with a `ColumnMap`: one log, or one part of it, for each repeat."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from droid_jax.arguments import shown
from droid_jax.recordings.alignment import common_clock, one_command, start_positions, warn_of_rate
from droid_jax.recordings.checks import UNITS, accept
from droid_jax.recordings.clocks import SLACK, check_clock, in_gap, interpolate, resample
from droid_jax.recordings.column_map import CHANNELS, ChannelMap, ColumnMap, TimeMap, as_list
from droid_jax.recordings.log_columns import LogColumns
from droid_jax.recordings.log_units import in_si
from droid_jax.recordings.recording import (
    Channel,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
    TorqueSide,
)
from droid_jax.recordings.units import TIMES

Opened = Callable[[str | None], LogColumns]  # name of a file in the log's folder, None: the log itself


@dataclass(frozen=True, eq=False)
class _Series:
    """One channel of one repeat: time [M] s, values [M, C]."""

    time: np.ndarray
    values: np.ndarray


def read_logs(
    logs: Sequence[Opened],
    columns: ColumnMap,
    *,
    name: str,
    command_tolerance: float = 5e-3,
    phases: Sequence[Phase] = (),
    allow_jitter: bool = False,
) -> Recording:
    """Logs, one per repeat, as a valid recording.

    Every log begins at its first command, or without commands at its first measurement.  Channels keep their own
    clocks; with a rate and a column of time in the map, all are interpolated onto one.

    Args:
        logs: for each repeat, the function that opens its files.
        columns: their column map.
        name: of the recording.
        command_tolerance: rad or m by which the commands of repeats may differ.
        phases: named parts of the motion, s from its beginning.
        allow_jitter: accept clocks of an irregular rate.

    Raises:
        ValueError: a column is missing or does not fit the map, a unit is not stated, time is not finite, does not
            increase or has no clear unit, or the repeats have different commands.
    """
    repeats = [_read(opened, columns, allow_jitter) for opened in logs]
    places = [_first(opened, columns).where for opened in logs]
    if columns.rate is not None and stamped(columns):
        warn_of_rate(_measured(repeats[0]).time, columns.rate, places[0])
        repeats = _on_one_clock(repeats, columns.rate, places)
    keys = [key for key in CHANNELS if key in repeats[0]]
    commands = [repeat["command"] for repeat in repeats] if "command" in keys else []
    time, command, command_names = np.zeros(0), np.zeros((0, 0)), ()
    if commands:
        time, command_names = commands[0].time, tuple(_joints(columns, "command"))
        values = [c.values if _same(c.time, time) else interpolate(time, c.time, c.values) for c in commands]
        command = one_command(values, time, command_names, command_tolerance, places)
    channels = {key: _channel(key, [r[key] for r in repeats], columns) for key in keys if key != "command"}
    side = TorqueSide(columns.side or "motor")
    damping = np.array(columns.damping) if columns.damping else None
    recording = Recording(
        name=name,
        time=time,
        command=command,
        command_names=command_names,
        channels=channels,
        torque=TorqueConvention(side, True if columns.gravity is None else columns.gravity),
        gains=ServoGains(np.array(columns.stiffness), damping) if columns.stiffness else None,
        phases=tuple(phases),
        meta=_meta(places, _first(logs[0], columns), columns),
    )
    # The replay starts at the first command.  Measurements may begin long before it, or after it; in the latter case
    # the initial position is unknown.
    first, begun = start_positions(channels), recording.measured_start()
    known = begun if commands else {**first, **begun}
    qpos0 = {joint: known[joint] for joint in first if joint in known}
    return accept(replace(recording, qpos0=qpos0), ", ".join(places), allow_jitter)


def fits(opened: Opened, columns: ColumnMap) -> bool:
    """Whether a log has every column that a map names."""
    try:
        for key in CHANNELS:
            if (entry := columns.channel(key)) is not None:
                log = opened(entry.file)
                stamps = _stamps(columns, entry)
                if not log.has(entry.columns, _joints(columns, key)):
                    return False
                if stamps is not None and not log.has(stamps.columns, ()):
                    return False
    except (OSError, ValueError):
        return False
    return True


def _read(opened: Opened, columns: ColumnMap, allow_jitter: bool) -> dict[str, _Series]:
    """Channel -> its numbers in the units of a recording, on clocks that begin where the motion does."""
    found: dict[str, _Series] = {}
    clocks: dict[tuple[str | None, str | None], np.ndarray] = {}
    for key in CHANNELS:  # the command first: the motion begins with it
        if (entry := columns.channel(key)) is None:
            continue
        log, joints = opened(entry.file), _joints(columns, key)
        if not joints:
            raise ValueError(f"{log.where}: the map names no joints for its {key}: give joints, as the MJCF calls them")
        values = in_si(log.pick(entry.columns, joints, key), entry, key, joints, columns, log)
        if not len(values):
            raise ValueError(f"{log.where}, {key}: has no rows")
        place = (entry.file, entry.time)
        if place not in clocks:
            clocks[place] = _clock(log, _stamps(columns, entry), columns.rate, len(values), allow_jitter)
        time = clocks[place]
        if len(time) != len(values):
            raise ValueError(f"{log.where}, {key}: {len(values)} rows where its time has {len(time)}")
        if key == "command" and (bad := np.argwhere(~np.isfinite(values))).size:
            row, column = map(int, bad[0])
            raise ValueError(
                f"{log.where}, command, row {row}, joint {joints[column]!r}: expected a finite number, got "
                f"{values[row, column]}; a row without a command has to be filled or cut off"
            )
        found[key] = _Series(time, values)
    if columns.powered is not None:
        found = _powered(opened, columns, found)
    begin = found["command"].time[0] if "command" in found else min(series.time[0] for series in found.values())
    return {key: _Series(series.time - begin, series.values) for key, series in found.items()}


def _powered(opened: Opened, columns: ColumnMap, found: dict[str, _Series]) -> dict[str, _Series]:
    """The part of all channels in the longest interval with motors on; a warning states the interval."""
    key = "command" if "command" in found else next(iter(found))
    entry, clock = columns.channel(key), found[key].time
    assert entry is not None and columns.powered is not None
    log = opened(entry.file)
    on = log.numbers(columns.powered)
    if on.shape != clock.shape:
        raise ValueError(f"{log.where}, powered: {shown(columns.powered)} must hold one number for each row of {key}")
    if not (on := np.nan_to_num(on.astype(float)) != 0).any():
        raise ValueError(f"{log.where}, powered: {shown(columns.powered)} is 0 throughout: the motors are never on")
    if on.all():
        return found
    changes = np.flatnonzero(np.diff(np.r_[False, on, False].astype(int))).reshape(-1, 2)
    first, end = max(changes.tolist(), key=lambda ends: ends[1] - ends[0])
    low, high = clock[first], clock[end - 1]
    warnings.warn(
        f"{log.where}: the motors are off in {np.mean(~on):.0%} of the rows ({shown(columns.powered)}); read is "
        f"{low - clock[0]:.3g} to {high - clock[0]:.3g} s, the longest interval in which they are on",
        stacklevel=4,
    )
    powered = dict[str, _Series]()
    for name, series in found.items():
        inside = (series.time >= low - SLACK) & (series.time <= high + SLACK)
        if not inside.any():
            raise ValueError(f"{log.where}, {name}: has no rows while the motors are on")
        powered[name] = _Series(series.time[inside], series.values[inside])
    return powered


def _joints(columns: ColumnMap, key: str) -> list[str]:
    entry = columns.channel(key)
    return list(columns.joints if entry is None or entry.joints is None else entry.joints)


def _first(opened: Opened, columns: ColumnMap) -> LogColumns:
    """The log, or the first of its files."""
    return opened(next(e.file for key in CHANNELS if (e := columns.channel(key)) is not None))


# Time -----------------------------------------------------------------------------------------


def _stamps(columns: ColumnMap, entry: ChannelMap) -> TimeMap | None:
    stamps = columns.stamps
    return stamps if entry.time is None else TimeMap(entry.time, columns.units.time if stamps is None else stamps.unit)


def stamped(columns: ColumnMap) -> bool:
    """Whether a channel of the map has a column of time."""
    entries = [entry for key in CHANNELS if (entry := columns.channel(key)) is not None]
    return any(_stamps(columns, entry) is not None for entry in entries)


def _clock(log: LogColumns, stamps: TimeMap | None, rate: float | None, rows: int, allow_jitter: bool) -> np.ndarray:
    """Instants [T] s of one file's rows, since the file's epoch; without stamps, by the rate of the rows."""
    if stamps is None:
        rate = rate or log.rate
        if rate is None:
            raise ValueError(f"{log.where}: no column of time is named, nor the rate of its rows: give time, or rate")
        return np.arange(rows) / rate
    names = as_list(stamps.columns)
    units = as_list(stamps.unit) if stamps.unit is not None else [log.units.get(n) for n in names]
    if len(units) != len(names):
        raise ValueError(f"{log.where}, time: {len(names)} columns and {len(units)} units; give one for each")
    parts = []
    for name, unit in zip(names, units, strict=True):
        numbers = log.numbers(name)
        if numbers.ndim != 1:
            raise ValueError(f"{log.where}, time: column {shown(name)} has {numbers.shape[1]} numbers in a row")
        if (bad := np.flatnonzero(~np.isfinite(numbers))).size:
            raise ValueError(f"{log.where}, time, row {bad[0]}: expected a number, got {numbers[bad[0]]}")
        # Integers are subtracted before they become float64, which cannot hold nanoseconds since 1970.  Unsigned
        # integers would wrap.
        if numbers.dtype.kind == "u":
            numbers = numbers.astype(np.int64)
        parts.append((numbers, TIMES[unit or _usual_unit(numbers, f"{log.where}, time {shown(name)}")]))
    time = np.sum([(n - n[0]) * scale for n, scale in parts], axis=0)
    regular = allow_jitter or rate is not None
    remedy = "where the rows have one rate, a map with that rate (--rate) and without time reads them by their number"
    check_clock(time, f"{log.where}, time", allow_jitter=regular, remedy=remedy)
    # Several files of one log share an epoch, so the first stamp is added again, to the precision of a float64.
    return time + sum(float(n[0]) * scale for n, scale in parts)


def _usual_unit(numbers: np.ndarray, where: str) -> str:
    """The unit "s" where the steps are plausible in seconds; ValueError lists the units that are plausible instead."""
    if len(numbers) < 2:
        return "s"
    step = abs(float(np.median(np.diff(numbers.astype(np.float64)))))
    possible = [unit for unit, scale in TIMES.items() if 2e-5 <= step * scale <= 0.2]
    if possible == ["s"] or not possible or step == 0:
        return "s"  # `check_clock` reports what else may be wrong
    said = " or ".join(f'"{unit}" ({1 / (step * TIMES[unit]):.4g} Hz)' for unit in possible)
    if "s" in possible and float(np.ptp(numbers.astype(np.float64))) >= 1.0:
        return "s"
    raise ValueError(f"{where}: its steps are {step:.6g}, and the map does not say of what: give its unit, {said}")


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return len(one) == len(other) and bool(np.abs(one - other).max(initial=0.0) <= SLACK)


def _measured(repeat: Mapping[str, _Series]) -> _Series:
    """The first channel of a repeat that is no command."""
    return next(series for key, series in repeat.items() if key != "command")


def _on_one_clock(repeats: list[dict[str, _Series]], rate: float, places: Sequence[str]) -> list[dict[str, _Series]]:
    """All channels of all repeats, interpolated onto one uniform clock over the part that all repeats cover."""
    clock = common_clock([_measured(repeat).time for repeat in repeats], rate, places)
    out = []
    for repeat in repeats:
        series = {}
        for key, one in repeat.items():
            values = interpolate(clock, one.time, one.values)
            if key != "command":
                outside = (clock < one.time[0] - SLACK) | (clock > one.time[-1] + SLACK)
                values = np.where((outside | in_gap(clock, one.time))[:, None], np.nan, values)
            series[key] = _Series(clock, values)
        out.append(series)
    return out


def _channel(key: str, repeats: Sequence[_Series], columns: ColumnMap) -> Channel:
    joints = tuple(_joints(columns, key))
    if all(_same(one.time, repeats[0].time) for one in repeats):
        clock, values = repeats[0].time, np.stack([one.values for one in repeats])
    else:
        clock, values = resample([one.time for one in repeats], [one.values for one in repeats])
    hinge, slide = UNITS[key]
    unit = " or ".join(dict.fromkeys(slide if joint in columns.slides else hinge for joint in joints))
    return Channel(key, unit, joints, clock, values, np.isfinite(values))


def _meta(places: Sequence[str], log: LogColumns, columns: ColumnMap) -> Mapping[str, str]:
    meta = {"logs": ", ".join(Path(place).name for place in places)[:1000], **log.notes}
    if columns.rate is not None and not stamped(columns):
        meta["rows"] = f"{columns.rate:g} Hz, by their number: the log was read without stamps"
        own = f" (the log itself states {log.rate:g} Hz)" if log.rate not in (None, columns.rate) else ""
        warnings.warn(
            f"{places[0]}: read without stamps, at the stated {columns.rate:g} Hz{own}; a rate that is off by 1 % "
            "looks like a delay that grows",
            stacklevel=3,
        )
    return meta
