"""Which samples of a measured motion are at rest, where dry friction is no function of the speed.

A joint that stands still may be held by any friction between -Fc and Fc.  Below some speed a log does not tell
whether a joint moves, nor in which direction: because of the noise of the measured positions, because friction of real
joints (and MuJoCo's soft friction constraint) changes over gradually, or because the joint really holds.  Samples
below that speed count as at rest: they are compared with the interval of friction, all others with sign(speed) Fc.
Source: the set-valued law of dry friction, e.g. Acary and Brogliato, Numerical Methods for Nonsmooth Dynamical
Systems, 2008, ch. 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from droid_jax.measure.recording import Recording


@dataclass(frozen=True)
class RestConfig:
    """Below which speed a sample of a joint counts as at rest: the largest of the three.

    speed: rad/s (m/s of a slide).  No joint is known to move when it is slower; presliding of gears lasts about as long.
    noise: standard deviations of the smoothed speed's noise, estimated from the positions; three are rarely exceeded.
    share: of the RMS speed of the joint.  It costs 3 % of a sine's samples, and covers friction that changes over
      gradually.
    """

    speed: float = 0.01
    noise: float = 3.0
    share: float = 0.05


def rest_speed(
    measured: np.ndarray, smoothed: np.ndarray, velocity: np.ndarray, rate: float, cutoff: float, config: RestConfig
) -> np.ndarray:
    """[J] rad/s (m/s), the speed below which a joint counts as at rest.

    Args:
        measured: [T, J] positions, rad or m, at `rate` Hz.
        smoothed: [T, J] the same after a low-pass at `cutoff` Hz.
        velocity: [Tm, J] speeds of the smoothed motion, rad/s or m/s.
        rate: Hz, of the positions.
        cutoff: Hz, of the low-pass.
        config: the thresholds.
    """
    return np.maximum.reduce(
        [
            np.full(measured.shape[1], config.speed),
            config.noise * speed_noise(measured - smoothed, rate, cutoff),
            config.share * np.sqrt(np.mean(velocity**2, axis=0)),
        ]
    )


def speed_noise(high: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """[J] rad/s (m/s), standard deviation of the noise of a smoothed position's derivative.

    White position noise of a deviation s at `rate` Hz has the density 2 s^2 / rate; below `cutoff` Hz its derivative
    has the variance 2 s^2 / rate * (2 pi)^2 cutoff^3 / 3.

    Args:
        high: [T, J] measured minus smoothed positions, rad or m: the noise above the cutoff.
        rate: Hz, of the positions.
        cutoff: Hz, of the low-pass.
    """
    above = max(1.0 - 2.0 * cutoff / rate, 1e-3)  # share of the white noise's band that `high` holds
    white = np.median(np.abs(high), axis=0) / 0.6745 / np.sqrt(above)  # a robust deviation: blows are no noise
    return white * 2.0 * np.pi * np.sqrt(2.0 * cutoff**3 / (3.0 * rate))


def torque_at(recording: Recording, joints: Sequence[str], clock: np.ndarray, cutoff: float) -> np.ndarray:
    """[T, J] N m (N for slides), mean measured torque of `joints` at times `clock` [T] s; NaN where none was measured.

    The mean of the repeats passes a zero-phase Butterworth filter of order 4 at `cutoff` Hz first, or as its rate
    allows, so that samples of another clock hold no aliased noise.  Gaps are bridged by lines.
    """
    torque = np.full((len(clock), len(joints)), np.nan)
    if "torque" not in recording.channels:
        return torque
    channel = recording.channels["torque"]
    rate = (len(channel.time) - 1) / float(channel.time[-1] - channel.time[0])
    sections = signal.butter(4, cutoff, fs=rate, output="sos") if rate > 2.5 * cutoff else None
    for j, joint in enumerate(joints):
        if joint not in channel.columns:
            continue
        column = channel.columns.index(joint)
        values, mask = channel.values[:, :, column], channel.mask[:, :, column]
        seen = mask.any(axis=0)
        if seen.sum() < 2:
            continue
        mean = np.sum(np.where(mask, values, 0.0), axis=0)[seen] / mask.sum(axis=0)[seen]
        series = np.interp(channel.time, channel.time[seen], mean)
        if sections is not None and len(series) > 30:
            series = signal.sosfiltfilt(sections, series)
        torque[:, j] = np.interp(clock, channel.time, series)
    return torque
