"""Repeats that start apart: each is compared with a replay from where it starts itself."""

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


def spread(recording: Recording, config: StartConfig = DEFAULT_START) -> dict[str, float]:
    """Joint -> rad or m between the measured starts of the repeats that are furthest apart, where that is visible."""
    if "position" not in recording.channels or recording.repeats < 2 or not recording.command.size:
        return {}
    channel = recording.channels["position"]
    starts = _starts(recording)
    found = {}
    for c, joint in enumerate(channel.columns):
        own = [start[joint] for start in starts if joint in start]
        apart = float(np.ptp(own)) if own else 0.0
        if apart > max(config.scatter, config.noise * _noise(channel, c, config.early)):
            found[joint] = apart
    return found


def own_starts(recording: Recording, config: StartConfig = DEFAULT_START) -> Recording:
    """The recording without stated starts (qpos0) of joints whose repeats were measured to start apart.

    One statement cannot be right for all of them.  The same object where there is nothing to leave out.
    Raises ValueError for a recording that is not valid.
    """
    validate(recording, allow_jitter=True)  # one made in Python may not have been
    apart = spread(recording, config)
    if not apart.keys() & recording.qpos0.keys():
        return recording
    return replace(recording, qpos0={j: q for j, q in recording.qpos0.items() if j not in apart})


def from_one_start(
    scene: Scene,
    recording: Recording,
    drive: Drive,
    replay: Callable[[Drive], Rollout],
    config: StartConfig = DEFAULT_START,
) -> Recording:
    """The recording as if all repeats had started where `drive` does: less what their own starts change in a replay.

    Args:
        scene: the simulated one.
        recording: with commands; returned unchanged where its repeats start at one place.
        drive: the mean start of these repeats.
        replay: of one drive, at nominal values; traces [T, J].
        config: what decides where repeats start.

    Returns:
        The recording with values [N, Tc, C] less each repeat's difference from the repeats' mean.  Exact to first order
        in the starts' spread.
    """
    if not spread(recording, config):
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
    """The drive of one repeat from its own measured start; a joint that was not measured there starts as in `drive`."""
    alone = recording.repeats_subset([repeat])
    measured = alone.measured_start()
    rest = {j: float(drive.qpos0[scene.qpos(j)]) for j in spread(recording, config) if j not in measured}
    return make_drive(scene, replace(alone, qpos0={**alone.qpos0, **rest}), weigh=False, config=config)


def _shifted(scene: Scene, channel: Channel, clock: np.ndarray, apart: np.ndarray) -> Channel:
    """A channel less what repeats are apart [N, T, J] at times [T] s."""
    values = channel.values.astype(float)
    for c, joint in enumerate(channel.columns):
        if joint in scene.joints:
            trace = apart[:, :, scene.joints.index(joint)]
            values[:, :, c] -= np.stack([np.interp(channel.time, clock, row) for row in trace])
    return replace(channel, values=values)


def _starts(recording: Recording) -> list[dict[str, float]]:
    """Of each repeat joint -> measured position at the start, rad or m."""
    position = {"position": recording.channels["position"]}
    return [
        replace(recording, channels=position).repeats_subset([n]).measured_start() for n in range(recording.repeats)
    ]


def _noise(channel: Channel, column: int, seconds: float) -> float:
    """Deviation of the white noise of a position, from its steps in the first seconds."""
    early = channel.time <= channel.time[0] + seconds
    values = np.where(channel.mask, channel.values, np.nan)[:, early, column]
    second = np.abs(np.diff(values, n=2, axis=1))
    return float(np.nanmedian(second)) / (0.6745 * np.sqrt(6.0)) if np.isfinite(second).any() else 0.0
