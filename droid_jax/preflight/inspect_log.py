"""All that is to be said of a recording before a fit: its findings, with a scene or without, and what it holds."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene
from droid_jax.preflight.check_log import check_alone, check_log
from droid_jax.preflight.clocks import GAP
from droid_jax.preflight.findings import Finding, Kind
from droid_jax.preflight.preflight import check_range, command_notes, warn_if_moving
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.inverse_dynamics import prescribed
from droid_jax.simulate.measured_motion import CUTOFF, measured_motion
from droid_jax.simulate.replay import make_drive

ORDER = ("certain", "likely", "note")


def inspect_log(recording: Recording, scene: Scene | None = None, motion_cutoff: float = CUTOFF) -> tuple[Finding, ...]:
    """What of a recording can hardly be right, and what has to be known of it, the gravest first.

    Args:
        recording: a valid one.
        scene: that it is meant for; without one only what is in the recording itself is judged.
        motion_cutoff: Hz, of the filter of a log's positions (`CompareConfig.motion_cutoff`).

    Returns:
        The findings. Nothing is refused: what a replay would refuse is a finding that is certain.
    """
    if scene is None:
        return _sorted(check_alone(recording))
    try:
        scene = variant_scene(scene, recording.variant)
    except ValueError as error:
        return _sorted([*check_alone(recording), Finding("scene", "", 0.0, 0.0, "certain", str(error))])
    found: list[Finding] = []
    found += _said("range", lambda: check_range(scene, recording))
    found += check_log(scene, recording)
    if not any(f.kind == "range" and f.severity == "certain" for f in found):
        found += _said("scene", lambda: _replayable(scene, recording, motion_cutoff))
    if recording.command.size:
        found += _said("start", lambda: warn_if_moving(recording))
        found += [Finding("scene", "", 0.0, 0.0, "note", text) for text in _notes(scene, recording)]
    return _sorted(found)


def _replayable(scene: Scene, recording: Recording, motion_cutoff: float) -> None:
    """Raise ValueError where no replay can follow the recording; that it lacks commands `_notes` says."""
    if not recording.command.size:
        measured_motion(recording, prescribed(scene, recording, motion_cutoff), cutoff=motion_cutoff)
    elif set(scene.needs_command) <= set(recording.command_names):
        make_drive(scene, recording, weigh="torque" in recording.channels)


def _notes(scene: Scene, recording: Recording) -> list[str]:
    """Of the commands; none where the recording lacks some that the scene needs, which a replay says."""
    missing = [joint for joint in scene.needs_command if joint not in recording.command_names]
    if missing:
        return [
            f"recording {recording.name!r} has no commands for {', '.join(missing)}, and scene {scene.name!r} drives "
            "them: a replay is refused; check the joints' names"
        ]
    return command_notes(scene, recording)


def _said(kind: Kind, check: Callable[[], None]) -> list[Finding]:
    """What a check refuses or warns of, as findings."""
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
    return tuple(sorted(found, key=lambda finding: ORDER.index(finding.severity)))


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
