"""Position, velocity and acceleration from the measured positions of a log without commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy

from droid_jax.arguments import lists_of_numbers
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention
from droid_jax.simulate.rest import RestConfig, at_rest, derivative_noise, torque_at, white_noise

BRIDGED = 0.25  # periods of the cutoff; positions are interpolated over gaps up to this,
LOST = 2.5  # or up to so many median steps (one lost sample), whichever is longer
CUTOFF = 20.0  # Hz, low-pass of the positions before differentiation; above that of the compared torques
OVERSAMPLING = 6.0  # rows of a motion per period of its cutoff
REGULAR = 0.01  # largest deviation of a clock's step from the mean step, as a share of it, of a regular clock
REPEAT_SHARE = 0.05  # of the joint's travel; a repeat whose RMS distance from the mean is larger is another motion
REPEAT_DISTANCE = 0.02  # rad or m, least such distance
PASSES = 20  # of the fixed-point iteration in `_common`
EDGE = 0.3  # s, cut at both ends, where a zero-phase filter is inexact


@dataclass(frozen=True, eq=False)
class Motion:
    """A measured motion of some joints, for logs without commands.

    Attributes:
        joints: J names.
        time: [T] s, regular.
        position, velocity, acceleration: [T, J] rad, rad/s, rad/s^2 (m for slides).
        torque: convention of the measured torque.
        others: joint that stands still -> its stated position, rad or m.
        rest: [T, J] bool, samples at rest (`simulate.rest`); None: those of speed zero.
        measured: [T, J] N m (N), measured torque at these times, NaN if there is none; None: none at all.
        torque_slack: [J] N m (N), by which noise of the torque may leave the interval of friction at rest; None: 0.
        acceleration_slack: [J] rad/s^2 (m/s^2), likewise noise of the acceleration; None: 0.
        known: parameter -> its value in this recording, or the parameter that replaces it; it overrides the fitted
            vector (`Recording.known`).
        variant: numbers of the scene that it was made for (`Recording.variant`).
    """

    joints: tuple[str, ...]
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    torque: TorqueConvention
    others: Mapping[str, float] = field(default_factory=dict)
    rest: np.ndarray | None = None
    measured: np.ndarray | None = None
    torque_slack: np.ndarray | None = None
    acceleration_slack: np.ndarray | None = None
    known: Mapping[str, float | str] = field(default_factory=dict[str, float | str])
    variant: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])

    @property
    def timestep(self) -> float:
        """s between rows."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


def measured_motion(
    recording: Recording,
    joints: Sequence[str],
    *,
    cutoff: float = CUTOFF,
    alike: Sequence[str] | None = None,
    rest: RestConfig | None = None,
) -> Motion:
    """The motion of `joints` in a recording: the mean of the repeats' positions, smoothed and differentiated.

    1. Splines bridge short gaps.  In a longer gap a repeat keeps its distance from the others (see `_common`).
    2. A jittering clock is resampled along a cubic spline.
    3. The mean position passes a zero-phase Butterworth filter of order 4.
    4. Velocity and acceleration are derivatives of a quintic spline.  Measured velocities are not used.
    5. EDGE s are cut at both ends.

    Args:
        recording: with positions.
        joints: whose motion is wanted.
        cutoff: Hz, of the filter.
        alike: joints whose repeats must all be the same motion; None: all.
        rest: which samples count as at rest; None: the defaults.

    Returns:
        The motion at OVERSAMPLING * cutoff Hz.

    Raises:
        ValueError: a joint's position was not measured throughout, repeats are different motions, the log is too
            slow for the cutoff (also in one long step), or it is too short.
    """
    channel = recording.channel("position")
    unknown = [j for j in joints if j not in channel.columns]
    if unknown:
        raise ValueError(
            f"recording {recording.name!r} holds no commands and its positions lack {', '.join(unknown)}: "
            "a motion is prescribed for every measured joint (--joints)"
        )
    columns = [channel.columns.index(j) for j in joints]
    values, mask = _bridged(channel.time, channel.values[:, :, columns], channel.mask[:, :, columns], cutoff)
    if not mask.any(axis=0).all():
        row, column = np.argwhere(~mask.any(axis=0))[0]
        raise ValueError(
            f"recording {recording.name!r}, channel 'position', column {joints[column]!r}: not measured at "
            f"{channel.time[row]:g} s; a motion needs every sample of at least one repeat: cut the log there "
            "(`python -m droid_jax.run convert --start S --end S`)"
        )
    rate = (len(channel.time) - 1) / float(channel.time[-1] - channel.time[0])
    median_rate = 1 / float(np.median(np.diff(channel.time)))  # not affected by a lost sample
    if max(rate, median_rate * (1 + 1e-6)) < 2.5 * cutoff or rate <= 2 * cutoff:
        raise ValueError(
            f"recording {recording.name!r} holds positions at {rate:.4g} Hz, too slow to be smoothed at {cutoff:g} Hz; "
            f"give --motion-cutoff (CompareConfig.motion_cutoff) below {rate / 2.5:.3g} Hz"
        )
    position = _common(values, mask)
    checked = [i for i, joint in enumerate(joints) if alike is None or joint in alike]
    measured = np.ma.masked_array(values, ~mask)[:, :, checked]
    _check_alike(recording.name, [joints[i] for i in checked], measured, position[:, checked])
    position = _regular(recording.name, channel.time, position, cutoff)
    even = np.linspace(channel.time[0], channel.time[-1], len(channel.time))
    clock = _inner_clock(recording.name, channel.time, OVERSAMPLING * cutoff)
    q = scipy.signal.sosfiltfilt(scipy.signal.butter(4, cutoff, fs=rate, output="sos"), position, axis=0)
    # Finite differences would lose 3 to 15 % of a fast motion in a slow log.
    path = scipy.interpolate.make_interp_spline(even, q, k=5)
    rows = (path(clock), path.derivative(1)(clock), path.derivative(2)(clock))
    config, timestep = rest or RestConfig(), (clock[-1] - clock[0]) / (len(clock) - 1)
    white = white_noise(position - q, rate, cutoff)
    torque, noise = torque_at(recording, joints, clock, 2.0 * cutoff)
    return Motion(
        tuple(joints),
        clock,
        *rows,
        torque=recording.torque,
        others={joint: q for joint, q in recording.qpos0.items() if joint not in joints},
        rest=at_rest(white, rows[1], timestep, rate, cutoff, config),
        measured=torque,
        torque_slack=config.tolerance * noise,
        acceleration_slack=config.tolerance * derivative_noise(white, 2, rate, cutoff),
        known=dict(recording.known),
        variant=lists_of_numbers(recording.variant),
    )


def measured_throughout(channel: Channel, cutoff: float = CUTOFF) -> tuple[str, ...]:
    """Columns of positions of which at least one repeat holds every sample, after short gaps are bridged."""
    _, mask = _bridged(channel.time, channel.values, channel.mask, cutoff)
    throughout: np.ndarray = np.asarray(mask.any(axis=0).all(axis=0))
    return tuple(column for column, complete in zip(channel.columns, throughout, strict=True) if complete)


def _longest(time: np.ndarray, cutoff: float) -> float:
    """s, the longest gap over which positions are interpolated."""
    return max(BRIDGED / cutoff, LOST * float(np.median(np.diff(time))))


def _bridged(time: np.ndarray, values: np.ndarray, mask: np.ndarray, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, T, J] and their mask after cubic splines bridge short gaps."""
    values, mask, longest = values.copy(), mask.copy(), _longest(time, cutoff)
    for n, j in np.argwhere(~mask.all(axis=1)):
        measured = np.flatnonzero(mask[n, :, j])
        for gap in np.flatnonzero(np.diff(measured) > 1):
            first, last = int(measured[gap]), int(measured[gap + 1])
            if time[last] - time[first] <= longest:
                between = slice(first + 1, last)
                near = measured[max(0, gap - 3) : gap + 5]
                path = scipy.interpolate.make_interp_spline(time[near], values[n, near, j], k=min(3, len(near) - 1))
                values[n, between, j] = path(time[between])
                mask[n, between, j] = True
    return values, mask


def _common(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[T, J] mean of repeats [N, T, J], without steps at the ends of a repeat's gaps.

    In a gap a repeat keeps its distance from the mean, linearly interpolated between the gap's ends.  So the mean is
    (sum of measured values + sum of interpolated distances) / number of measured values.  PASSES iterations converge
    if gaps overlap.
    """
    common = np.mean(values, axis=0, where=mask)
    rows = np.arange(values.shape[1])
    for _ in range(0 if mask.all() else PASSES):
        distance = values - common
        for n, j in np.argwhere(~mask.all(axis=1)):
            measured = mask[n, :, j]
            if measured.any():
                distance[n, ~measured, j] = np.interp(rows[~measured], rows[measured], distance[n, measured, j])
            else:
                distance[n, :, j] = 0.0
        common = np.where(mask, values, distance).sum(axis=0) / mask.sum(axis=0)
    return common


def _check_alike(name: str, joints: Sequence[str], values: np.ma.MaskedArray, common: np.ndarray) -> None:
    """Raise ValueError if a repeat [N, T, J] (masked samples were not measured) is another motion than the others."""
    distance = np.sqrt(((values - common) ** 2).mean(axis=1).filled(0.0))  # [N, J]
    travel = np.ptp(values, axis=1).max(axis=0).filled(0.0)  # [J]
    excess = distance - np.maximum(REPEAT_SHARE * travel, REPEAT_DISTANCE)
    repeat, joint = (int(i) for i in np.unravel_index(int(np.argmax(excess)), excess.shape))
    if excess[repeat, joint] > 0:
        raise ValueError(
            f"recording {name!r} holds no commands, and repeat {repeat} is another motion than the mean of the "
            f"repeats: {joints[joint]} is {distance[repeat, joint]:.3g} from it (RMS) and travels {travel[joint]:.3g}; "
            "cut the logs so that each begins where the motion does, or give them as separate recordings"
        )


def _regular(name: str, time: np.ndarray, position: np.ndarray, cutoff: float) -> np.ndarray:
    """Positions [T, J] of a clock [T] s, resampled to T even instants; unchanged if the clock is regular."""
    steps = np.diff(time)
    mean, longest = float(steps.mean()), int(np.argmax(steps))
    if np.max(np.abs(steps - mean)) <= REGULAR * mean:
        return position
    if steps[longest] > max(1 / (2.5 * cutoff), _longest(time, cutoff)):
        raise ValueError(
            f"recording {name!r} holds no position for {steps[longest]:.3g} s from {time[longest]:g} s on, too long to "
            f"be smoothed at {cutoff:g} Hz; cut the log there or give --motion-cutoff (CompareConfig.motion_cutoff) "
            f"below {1 / (2.5 * steps[longest]):.3g} Hz"
        )
    return scipy.interpolate.CubicSpline(time, position)(np.linspace(time[0], time[-1], len(time)))


def _inner_clock(name: str, time: np.ndarray, rate: float) -> np.ndarray:
    """[T] s at `rate` Hz, without EDGE s at both ends of the measured time."""
    first, last = float(time[0]) + EDGE, float(time[-1]) - EDGE
    if last - first < 1.0:
        raise ValueError(
            f"recording {name!r} is {time[-1] - time[0]:.3g} s long; a motion needs {1 + 2 * EDGE:g} s "
            "(so does the last third of a single log without commands, which is held out)"
        )
    return first + np.arange(int(np.floor((last - first) * rate + 1e-6)) + 1) / rate
