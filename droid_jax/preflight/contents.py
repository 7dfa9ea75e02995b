"""What a recording holds, as rows of a table: clocks with their rates and gaps, channels with their ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from droid_jax.recordings.recording import Recording

GAP = 5.0  # usual steps: a longer one is a gap


@dataclass(frozen=True)
class Column:
    """One column of a channel, or of the command.

    unit: of its numbers.  low, high: smallest and largest measured value.  measured: share of the samples that are.
    """

    name: str
    unit: str
    low: float
    high: float
    measured: float


@dataclass(frozen=True)
class Signal:
    """The command, or a channel, over time.

    rows: samples of a repeat.  rate: Hz, usual.  jitter: largest deviation of a step from the usual one, as a share of
    it.  longest: s, of the steps.  gaps: steps longer than GAP usual ones.  columns: of it.
    """

    name: str
    rows: int
    rate: float
    jitter: float
    longest: float
    gaps: int
    columns: tuple[Column, ...]


def contents(recording: Recording) -> tuple[Signal, ...]:
    """The command, where there is one, and the channels of a valid recording."""
    tracks = []
    if recording.command.size:
        values = recording.command[None]
        tracks.append(
            _track("command", recording.time, "", recording.command_names, values, np.ones(values.shape, bool))
        )
    for key, channel in recording.channels.items():
        tracks.append(_track(key, channel.time, channel.unit, channel.columns, channel.values, channel.mask))
    return tuple(tracks)


def _track(
    name: str, time: np.ndarray, unit: str, names: tuple[str, ...], values: np.ndarray, mask: np.ndarray
) -> Signal:
    columns = []
    for c, column in enumerate(names):
        seen = values[..., c][mask[..., c]]
        low, high = (float(seen.min()), float(seen.max())) if seen.size else (float("nan"), float("nan"))
        columns.append(Column(column, unit, low, high, float(mask[..., c].mean())))
    steps = np.diff(time)
    if not len(steps):
        return Signal(name, len(time), 0.0, 0.0, 0.0, 0, tuple(columns))
    usual = float(np.median(steps))
    jitter = float(np.abs(steps - usual).max() / usual)
    return Signal(
        name, len(time), 1.0 / usual, jitter, float(steps.max()), int(np.sum(steps > GAP * usual)), tuple(columns)
    )
