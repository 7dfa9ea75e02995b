"""All findings about a recording before a fit, with or without a scene, and its content as a table."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.preflight.check_log import check_alone, check_log
from droid_jax.preflight.clocks import GAP_STEPS
from droid_jax.preflight.findings import Finding, Kind
from droid_jax.preflight.preflight import check_range, command_notes, warn_if_moving
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.inverse_dynamics import prescribed_joints
from droid_jax.simulate.measured_motion import CUTOFF, measured_motion
from droid_jax.simulate.replay import make_drive

SEVERITIES = ("certain", "likely", "note")


def inspect_log(recording: Recording, scene: Scene | None = None, motion_cutoff: float = CUTOFF) -> tuple[Finding, ...]:
    """Probable errors in a recording and notes about it, the most severe first.

    Args:
        recording: a valid one.
        scene: the scene that it was recorded for; without it only the recording itself is checked.
        motion_cutoff: Hz, low-pass of a log's positions (`CompareConfig.motion_cutoff`).

    Returns:
        The findings. An error that a replay would raise is a finding of severity "certain".
    """
    if scene is None:
        return _sorted(check_alone(recording))
    try:
        scene = variant_scene(scene, recording.variant, recording.name)
    except ValueError as error:
        return _sorted([*check_alone(recording), Finding("scene", "", 0.0, 0.0, "certain", str(error))])
    found: list[Finding] = []
    found += _said("range", lambda: check_range(scene, recording))
    found += check_log(scene, recording)
    if not any(f.kind == "range" and f.severity == "certain" for f in found):
        found += _said("scene", lambda: _replayable(scene, recording, motion_cutoff))
    if recording.command.size:
        found += _said("start", lambda: warn_if_moving(recording))
        notes = list[str]()
        errors = _said("scene", lambda: notes.extend(_notes(scene, recording)))
        found += [error for error in errors if error not in found]
        found += [Finding("scene", "", 0.0, 0.0, "note", text) for text in notes]
    return _sorted(found)


def _replayable(scene: Scene, recording: Recording, motion_cutoff: float) -> None:
    """Raise ValueError if the recording cannot be replayed; missing commands are reported by `_notes`."""
    if not recording.command.size:
        measured_motion(recording, prescribed_joints(scene, recording, motion_cutoff), cutoff=motion_cutoff)
    elif set(scene.needs_command) <= set(recording.command_names):
        make_drive(scene, recording, weigh="torque" in recording.channels)


def _notes(scene: Scene, recording: Recording) -> list[str]:
    """Notes about the commands; if the scene needs commands that the recording lacks, only that."""
    missing = [joint for joint in scene.needs_command if joint not in recording.command_names]
    if missing:
        return [
            f"recording {recording.name!r} has no commands for {', '.join(missing)}, and scene {scene.name!r} drives "
            "them: it cannot be replayed; check the joints' names"
        ]
    return command_notes(scene, recording)


def _said(kind: Kind, check: Callable[[], None]) -> list[Finding]:
    """Errors and warnings of a check as findings."""
    found = []
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            check()
        except ValueError as error:
            found.append(Finding(kind, "", 0.0, 0.0, "certain", str(error)))
    found += [Finding(kind, "", 0.0, 0.0, "likely", str(w.message)) for w in said]
    return found


def _sorted(found: list[Finding] | tuple[Finding, ...]) -> tuple[Finding, ...]:
    return tuple(sorted(found, key=lambda finding: SEVERITIES.index(finding.severity)))


@dataclass(frozen=True)
class Column:
    """One column of a channel, or of the command.

    unit: of its numbers.  low, high: smallest and largest measured value.  measured: share of measured samples.
    """

    name: str
    unit: str
    low: float
    high: float
    measured: float


@dataclass(frozen=True)
class Signal:
    """The command, or a channel, over time.

    rows: samples of a repeat.  rate: Hz, of the median step.  jitter: largest deviation from the median step, relative
    to it.  longest: s, longest step.  gaps: number of steps longer than GAP_STEPS median steps.  columns: its columns.
    """

    name: str
    rows: int
    rate: float
    jitter: float
    longest: float
    gaps: int
    columns: tuple[Column, ...]


def contents(recording: Recording) -> tuple[Signal, ...]:
    """The command, if there is one, and the channels of a valid recording."""
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
        name, len(time), 1.0 / usual, jitter, float(steps.max()), int(np.sum(steps > GAP_STEPS * usual)), tuple(columns)
    )
