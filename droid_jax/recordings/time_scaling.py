"""Recordings of the same path at another speed: slower, faster, there and back, or with a stop half-way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Channel, Recording

STOP = 2.0  # s, duration of the stop


@dataclass(frozen=True)
class TimeScaling:
    """A proposed experiment: the demonstration's path at another speed.

    what: the experiment in words.
    seconds: duration of the demonstration, s -> duration of the experiment, s.
    clock: (instants [K] s of the experiment, duration of the demonstration s) -> instants of the demonstration, s; both
        from their start.
    """

    what: str
    seconds: Callable[[float], float]
    clock: Callable[[np.ndarray, float], np.ndarray]


TIME_SCALINGS = (
    TimeScaling("the same motion three times slower", lambda d: 3 * d, lambda t, d: t / 3),
    TimeScaling("the same motion twice as fast", lambda d: d / 2, lambda t, d: 2 * t),
    TimeScaling("the same motion there and back again", lambda d: 2 * d, lambda t, d: np.minimum(t, 2 * d - t)),
    TimeScaling(
        f"the same motion with a stop of {STOP:.0f} s half-way",
        lambda d: d + STOP,
        lambda t, d: np.where(t < d / 2, t, np.maximum(d / 2, t - STOP)),
    ),
)


def time_scaled(recording: Recording, entry: TimeScaling) -> Recording:
    """A recording as if its path had been followed at another speed; each sample keeps its noise."""
    first, duration = recording.time[0], recording.duration

    def instants(clock: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step = np.median(np.diff(clock))
        new = np.arange(0.0, entry.seconds(duration) + 0.5 * step, step)
        return first + new, first + np.clip(entry.clock(new, duration), 0.0, duration)

    def channel(c: Channel) -> Channel:
        new, old = instants(c.time)
        near = np.clip(np.searchsorted(c.time, old), 0, len(c.time) - 1)
        values = np.nan_to_num(c.values)[:, near]
        return replace(c, time=new, values=values, mask=c.mask[:, near])

    time, old = instants(recording.time)
    command = interpolate(old, recording.time, recording.command)
    channels = {name: channel(c) for name, c in recording.channels.items()}
    return replace(recording, name=entry.what, time=time, command=command, channels=channels, phases=())
