"""Repeats with different starts: the effect of each repeat's start is simulated and subtracted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene
from droid_jax.recordings.checks import validate
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.simulate.initial_state import DEFAULT_START, StartConfig
from droid_jax.simulate.replay import Drive, make_drive


def start_ranges(recording: Recording, config: StartConfig = DEFAULT_START) -> dict[str, float]:
    """Joint -> range of the repeats' measured starts, rad or m, of joints where it exceeds scatter and noise."""
    if "position" not in recording.channels or recording.repeats < 2 or not recording.command.size:
        return {}
    channel = recording.channels["position"]
    starts = _starts(recording)
    ranges = {}
    for c, joint in enumerate(channel.columns):
        measured = [start[joint] for start in starts if joint in start]
        width = float(np.ptp(measured)) if measured else 0.0
        if width > max(config.scatter, config.noise * _noise(channel, c, config.early)):
            ranges[joint] = width
    return ranges


def own_starts(recording: Recording, config: StartConfig = DEFAULT_START) -> Recording:
    """The recording without the stated starts (qpos0) of joints whose measured starts differ between repeats.

    One stated start cannot be right for all of them.  Returns the same object if there are none.
    Raises ValueError for an invalid recording.
    """
    validate(recording, allow_jitter=True)  # a recording made in Python was perhaps not validated yet
    different = start_ranges(recording, config)
    if not different.keys() & recording.qpos0.keys():
        return recording
    return replace(recording, qpos0={j: q for j, q in recording.qpos0.items() if j not in different})


def from_one_start(
    scene: Scene,
    recording: Recording,
    drive: Drive,
    replay: Callable[[Drive], Rollout],
    config: StartConfig = DEFAULT_START,
) -> Recording:
    """The recording as if all repeats had started where `drive` does.

    Each repeat is replayed from its own start.  The difference of that replay from the mean of these replays is
    subtracted from the repeat.

    Args:
        scene: the simulated one.
        recording: with commands.
        drive: from the mean start of these repeats.
        replay: of one drive, at nominal values; traces [T, J].
        config: thresholds.

    Returns:
        The recording with corrected values [N, Tc, C], exact to first order in the spread of the starts.  The same
        object if the repeats start at the same place, or if a replay diverges.
    """
    if not start_ranges(recording, config):
        return recording
    replays = [replay(_own_drive(scene, recording, n, drive, config)) for n in range(recording.repeats)]
    if not all(bool(np.all(np.asarray(r.finite))) for r in replays):
        return recording
    clock = float(recording.time[0]) + drive.time
    channels = dict(recording.channels)
    for name in ("torque", "position", "velocity"):
        if name in channels:
            traces = np.stack([np.asarray(getattr(r, name), float) for r in replays])
            channels[name] = _shifted(scene, channels[name], clock, traces - traces.mean(axis=0))
    return replace(recording, channels=channels)


def _own_drive(scene: Scene, recording: Recording, repeat: int, drive: Drive, config: StartConfig) -> Drive:
    """The drive of one repeat from its own measured start; joints that were not measured there start as in `drive`."""
    one = recording.repeats_subset([repeat])
    measured = one.measured_start()
    unmeasured = {j: float(drive.qpos0[scene.qpos(j)]) for j in start_ranges(recording, config) if j not in measured}
    return make_drive(scene, replace(one, qpos0={**one.qpos0, **unmeasured}), weigh=False, config=config)


def _shifted(scene: Scene, channel: Channel, clock: np.ndarray, difference: np.ndarray) -> Channel:
    """A channel minus each repeat's difference [N, T, J] at times [T] s."""
    values = channel.values.astype(float)
    for c, joint in enumerate(channel.columns):
        if joint in scene.joints:
            trace = difference[:, :, scene.joints.index(joint)]
            values[:, :, c] -= np.stack([np.interp(channel.time, clock, row) for row in trace])
    return replace(channel, values=values)


def _starts(recording: Recording) -> list[dict[str, float]]:
    """For each repeat: joint -> measured initial position, rad or m."""
    position = {"position": recording.channels["position"]}
    return [
        replace(recording, channels=position).repeats_subset([n]).measured_start() for n in range(recording.repeats)
    ]


def _noise(channel: Channel, column: int, seconds: float) -> float:
    """Standard deviation of a position's white noise, from its second differences in the first seconds."""
    early = channel.time <= channel.time[0] + seconds
    values = np.where(channel.mask, channel.values, np.nan)[:, early, column]
    second = np.abs(np.diff(values, n=2, axis=1))
    return float(np.nanmedian(second)) / (0.6745 * np.sqrt(6.0)) if np.isfinite(second).any() else 0.0
