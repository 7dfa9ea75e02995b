"""The motion behind a log without commands: position, velocity and acceleration from measured positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy

from droid_jax.arguments import lists_of_numbers
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention
from droid_jax.simulate.rest import RestConfig, at_rest, derivative_noise, torque_at, white_noise

BRIDGED = 0.25  # periods of the cutoff: over gaps no longer than that positions are interpolated,
LOST = 2.5  # nor, in a slow log, over gaps of so many usual steps: one lost sample
CUTOFF = 20.0  # Hz, of the position before it is differentiated; above that of the torques, which are compared
OVERSAMPLING = 6.0  # rows of a motion per period of its cutoff
REGULAR = 0.01  # largest deviation of a clock's step from their mean, as a share, that a filter may overlook
ALIKE = 0.05  # RMS distance of a repeat from their mean, as a share of the joint's travel, beyond which it is another
STILL = 0.02  # rad or m, the least such distance
PASSES = 20  # see `_common`
EDGE = 0.3  # s left out at both ends, where a zero-phase filter has no neighbours


@dataclass(frozen=True, eq=False)
class Motion:
    """A measured motion of some joints, for logs without commands.

    joints: J names.  time: [T] s, regular.  position, velocity, acceleration: [T, J] rad, rad/s, rad/s^2 (m for
    slides).  torque: convention of the measured torque.  others: joints that stand still -> where, as far as stated.
    rest: [T, J] bool, samples at rest (`simulate.rest`); None: those of speed zero.
    measured: [T, J] N m (N), measured torque at these times, NaN where there is none; None: nowhere.
    torque_slack: [J] N m (N), acceleration_slack: [J] rad/s^2 (m/s^2): by how much a torque at rest may leave the
    interval of its friction, because measured torque and acceleration are noisy; None: not at all.
    known: parameter -> its value in this recording, or what stands for it, whatever a row says (`Recording.known`).
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

    A repeat that was not measured for a while keeps its distance from the others there (see `_common`); gaps of BRIDGED
    periods of the cutoff, or of LOST steps, are bridged.
    The position passes a zero-phase Butterworth filter of order 4 at `cutoff` Hz; velocity and acceleration are those
    of the quintic spline through it; measured velocities are not used.  EDGE s at both ends are left out.
    A clock that jitters is made regular first, along a cubic spline.
    alike: joints of which all repeats must be one motion; None: all.
    rest: below which speed a sample counts as at rest.
    Raises ValueError where a joint's position was not measured throughout, the log is too slow for
    the cutoff (in one long step too), or too short.
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
    usual = 1 / float(np.median(np.diff(channel.time)))  # a lost sample makes no slow log
    if max(rate, usual * (1 + 1e-6)) < 2.5 * cutoff or rate <= 2 * cutoff:
        raise ValueError(
            f"recording {recording.name!r} holds positions at {rate:.4g} Hz, too slow to be smoothed at {cutoff:g} Hz; "
            f"give --motion-cutoff (CompareConfig.motion_cutoff) below {rate / 2.5:.3g} Hz"
        )
    position = _common(values, mask)
    judged = [i for i, joint in enumerate(joints) if alike is None or joint in alike]
    measured = np.ma.masked_array(values, ~mask)[:, :, judged]
    _check_alike(recording.name, [joints[i] for i in judged], measured, position[:, judged])
    position = _regular(recording.name, channel.time, position, cutoff)
    even = np.linspace(channel.time[0], channel.time[-1], len(channel.time))
    clock = _inner_clock(recording.name, channel.time, OVERSAMPLING * cutoff)
    q = scipy.signal.sosfiltfilt(scipy.signal.butter(4, cutoff, fs=rate, output="sos"), position, axis=0)
    path = scipy.interpolate.make_interp_spline(
        even, q, k=5
    )  # differences lose 3 to 15 % of a fast motion in a slow log
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
    """Columns of positions whose every sample some repeat holds, short gaps bridged as `measured_motion` does."""
    _, mask = _bridged(channel.time, channel.values, channel.mask, cutoff)
    throughout: np.ndarray = np.asarray(mask.any(axis=0).all(axis=0))
    return tuple(c for c, held in zip(channel.columns, throughout, strict=True) if held)


def _longest(time: np.ndarray, cutoff: float) -> float:
    """s between two samples, at most, over which positions are interpolated."""
    return max(BRIDGED / cutoff, LOST * float(np.median(np.diff(time))))


def _bridged(time: np.ndarray, values: np.ndarray, mask: np.ndarray, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, T, J] and their mask, with cubic splines over short gaps."""
    values, mask, longest = values.copy(), mask.copy(), _longest(time, cutoff)
    for n, j in np.argwhere(~mask.all(axis=1)):
        seen = np.flatnonzero(mask[n, :, j])
        for gap in np.flatnonzero(np.diff(seen) > 1):
            first, last = int(seen[gap]), int(seen[gap + 1])
            if time[last] - time[first] <= longest:
                between = slice(first + 1, last)
                near = seen[max(0, gap - 3) : gap + 5]
                path = scipy.interpolate.make_interp_spline(time[near], values[n, near, j], k=min(3, len(near) - 1))
                values[n, between, j] = path(time[between])
                mask[n, between, j] = True
    return values, mask


def _common(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[T, J] mean of repeats [N, T, J], without a step where one of them was not measured for a while.

    A repeat keeps its distance from the others there, along a line between the gap's ends: m = (sum of what was
    measured + sum of the distances of what was not) / number measured.  PASSES of it settle gaps that overlap.
    """
    common = np.mean(values, axis=0, where=mask)
    rows = np.arange(values.shape[1])
    for _ in range(0 if mask.all() else PASSES):
        apart = values - common
        for n, j in np.argwhere(~mask.all(axis=1)):
            seen = mask[n, :, j]
            if seen.any():
                apart[n, ~seen, j] = np.interp(rows[~seen], rows[seen], apart[n, seen, j])
            else:
                apart[n, :, j] = 0.0
        common = np.where(mask, values, apart).sum(axis=0) / mask.sum(axis=0)
    return common


def _check_alike(name: str, joints: Sequence[str], values: np.ma.MaskedArray, common: np.ndarray) -> None:
    """ValueError where a repeat [N, T, J], masked where not measured, is another motion than the others."""
    apart = np.sqrt(((values - common) ** 2).mean(axis=1).filled(0.0))  # [N, J]
    travel = np.ptp(values, axis=1).max(axis=0).filled(0.0)  # [J]
    excess = apart - np.maximum(ALIKE * travel, STILL)
    repeat, joint = (int(i) for i in np.unravel_index(int(np.argmax(excess)), excess.shape))
    if excess[repeat, joint] > 0:
        raise ValueError(
            f"recording {name!r} holds no commands, and repeat {repeat} is another motion than their mean: "
            f"{joints[joint]} is {apart[repeat, joint]:.3g} from it (RMS), where it travels {travel[joint]:.3g}; cut "
            "the logs alike, so that each begins where the motion does, or give them as recordings of their own"
        )


def _regular(name: str, time: np.ndarray, position: np.ndarray, cutoff: float) -> np.ndarray:
    """Positions [T, J] of a clock [T] s at as many even instants of its span; as they are where it is even already."""
    steps = np.diff(time)
    usual, longest = float(steps.mean()), int(np.argmax(steps))
    if np.max(np.abs(steps - usual)) <= REGULAR * usual:
        return position
    if steps[longest] > max(1 / (2.5 * cutoff), _longest(time, cutoff)):
        raise ValueError(
            f"recording {name!r} holds no position for {steps[longest]:.3g} s from {time[longest]:g} s on, too long to "
            f"be smoothed at {cutoff:g} Hz; cut the log there or give --motion-cutoff (CompareConfig.motion_cutoff) "
            f"below {1 / (2.5 * steps[longest]):.3g} Hz"
        )
    return scipy.interpolate.CubicSpline(time, position)(np.linspace(time[0], time[-1], len(time)))


def _inner_clock(name: str, time: np.ndarray, rate: float) -> np.ndarray:
    """[T] s at `rate`, EDGE inside the measured time."""
    first, last = float(time[0]) + EDGE, float(time[-1]) - EDGE
    if last - first < 1.0:
        raise ValueError(
            f"recording {name!r} is {time[-1] - time[0]:.3g} s long; a motion needs {1 + 2 * EDGE:g} s "
            "(also what is held out of a lone log without commands, its last third)"
        )
    return first + np.arange(int(np.floor((last - first) * rate + 1e-6)) + 1) / rate
