"""Check for copied repeats, constant or rounded columns, and recordings without motion."""

from __future__ import annotations

import itertools

import numpy as np

from droid_jax.preflight.findings import Finding
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.simulate.repeat_starts import start_ranges

COPY_TOLERANCE = 1e-6  # of a channel's largest value: repeats that differ by less are copies (float32 rounds by less)
COARSE_VALUES = 8  # a column that moves and has at most so many different values is coarse
RESTING_SPAN = {
    "position": 0.02,
    "velocity": 0.1,
    "torque": 0.2,
}  # rad, rad/s, N m: a column that changes by less may be at rest
CONSTANT_COMMAND = 1e-4  # in the command's unit: a command that changes by less is constant
MOTIONLESS_SPAN = {
    "rad": 5e-3,
    "m": 5e-4,
}  # a position that changes by less is at rest; larger than encoder steps
FEWEST_ROWS = 40  # shorter recordings are not reported as motionless
OUTLIER_SHARE = 0.01  # share of the samples at both extremes that is ignored
NAMED_PAIRS = 3  # most pairs of copies that a sentence lists


def check_repeats(recording: Recording) -> list[Finding]:
    """Findings about repeats and sensors."""
    where = f"recording {recording.name!r}"
    sensors = [finding for channel in recording.channels.values() for finding in _sensors(channel, where)]
    found = _copies(recording, where) + sensors + _dead(recording, where) + _apart(recording, where)
    return found + _motionless(recording, where)


def _motionless(recording: Recording, where: str) -> list[Finding]:
    """Finding for a recording in which no command changes and no joint moves."""
    rows = max(len(recording.time), *(len(c.time) for c in recording.channels.values()))
    if rows < FEWEST_ROWS or (recording.command.size and np.ptp(recording.command, axis=0).max() > CONSTANT_COMMAND):
        return []
    most = 0.0
    for channel in (recording.channels[key] for key in ("position", "object_angle") if key in recording.channels):
        for c in range(len(channel.columns)):
            values = channel.values[..., c][channel.mask[..., c]]
            low, high = np.quantile(values, [OUTLIER_SHARE, 1 - OUTLIER_SHARE]) if values.size else (0.0, 0.0)
            if high - low > min(MOTIONLESS_SPAN.get(unit, 0.0) for unit in channel.unit.split(" or ")):
                return []
            most = max(most, float(high - low))
    if not recording.command.size and not {"position", "object_angle"} & {*recording.channels}:
        return []
    sentence = (
        f"{where}: nothing moves in it (by {most:.2g} at most): record a motion, so that parameters are identifiable"
    )
    return [Finding("motion", "", most, MOTIONLESS_SPAN["rad"], "certain", sentence)]


def _dead(recording: Recording, where: str) -> list[Finding]:
    """Findings for constant columns of joints whose other channels change.

    Positions of commanded joints are checked in `tracking`.
    """
    moving = {
        key: {j for c, j in enumerate(channel.columns) if _span(channel, c) > RESTING_SPAN[key]}
        for key, channel in recording.channels.items()
        if key in RESTING_SPAN
    }
    others = {"position": ("velocity", "torque"), "velocity": ("position",), "torque": ("position", "velocity")}
    found = []
    for key, channel in ((k, recording.channels[k]) for k in moving):
        for c, joint in enumerate(channel.columns):
            if not channel.mask[..., c].any():
                continue  # nothing was measured
            by = next((other for other in others[key] if joint in moving.get(other, ())), None)
            if _span(channel, c) == 0 and by is not None and not (key == "position" and recording.command.size):
                value = float(channel.values[..., c][channel.mask[..., c]][0])
                found.append(
                    Finding(
                        "sensor", joint, 0.0, 0.0, "likely" if by != "torque" else "note",
                        f"{where}: the {key} of {joint} does not move, it is {value:g} throughout while its {by} "
                        "changes: is the sensor broken, or the column not measured?",
                    )
                )  # fmt: skip
    return found


def _span(channel: Channel, column: int) -> float:
    """Largest minus smallest measured value of a column."""
    values = channel.values[..., column][channel.mask[..., column]]
    return float(np.ptp(values)) if values.size else 0.0


def _apart(recording: Recording, where: str) -> list[Finding]:
    """Note about repeats that start at visibly different positions."""
    apart = start_ranges(recording)
    if not apart:
        return []
    most = max(apart, key=lambda joint: apart[joint])
    return [
        Finding(
            "repeats", most, apart[most], 0.0, "note",
            f"{where}: its repeats start up to {apart[most]:.2g} rad or m apart, {most} most: each is compared with "
            "a replay from its own measured start",
        )
    ]  # fmt: skip


def _copies(recording: Recording, where: str) -> list[Finding]:
    pairs: dict[tuple[int, int], list[str]] = {}
    for key, channel in recording.channels.items():
        for pair in itertools.combinations(range(recording.repeats), 2):
            if _same(channel, *pair):
                pairs.setdefault(pair, []).append(key)
    if not pairs:
        return []
    named = ", ".join(f"{i} and {j}" for i, j in list(pairs)[:NAMED_PAIRS]) + (
        ", ..." if len(pairs) > NAMED_PAIRS else ""
    )
    whole = all(len(keys) == len(recording.channels) for keys in pairs.values())
    what = "" if whole else f" in channel {', '.join(sorted({k for keys in pairs.values() for k in keys}))}"
    first = next(iter(pairs))
    return [
        Finding(
            "repeats", f"{first[0]} and {first[1]}", float(len(pairs)), 0.0, "likely",
            f"{where}: repeats {named} are identical{what}: are they copies of one? Noise cannot be estimated from "
            "copies, so intervals, noise floor and p-values would be meaningless; give each measurement once",
        )
    ]  # fmt: skip


def _same(channel: Channel, first: int, second: int) -> bool:
    """Whether two repeats of a channel hold the same numbers."""
    one, other = channel.mask[first], channel.mask[second]
    if not np.array_equal(one, other):
        return False
    a, b = channel.values[first][one], channel.values[second][one]
    size = float(np.abs(a).max(initial=0.0))
    return size > 0 and np.ptp(a) > 0 and bool(np.abs(a - b).max() <= COPY_TOLERANCE * size)


def _sensors(channel: Channel, where: str) -> list[Finding]:
    """Findings for columns that change in steps as large as the motion."""
    found = []
    for c, column in enumerate(channel.columns):
        values = channel.values[:, :, c][channel.mask[:, :, c]]
        levels = np.unique(values[:: max(1, len(values) // 20000)])
        moves = channel.name in RESTING_SPAN and len(levels) > 1 and np.ptp(levels) > RESTING_SPAN[channel.name]
        if moves and len(levels) <= COARSE_VALUES and len(values) > 10 * COARSE_VALUES:
            found.append(
                Finding(
                    "sensor", column, float(len(levels)), float(COARSE_VALUES), "likely",
                    f"{where}: channel {channel.name!r}, column {column!r} has only {len(levels)} different values, "
                    f"{np.diff(levels).min():.3g} {channel.unit} apart: is it rounded?",
                )
            )  # fmt: skip
    return found
