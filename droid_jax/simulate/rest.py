"""Samples of a measured motion at rest, where the speed does not determine dry friction.

At rest dry friction takes any value between -Fc and Fc.  Below some speed a log does not show whether a joint moves, or
in which direction: measured positions are noisy, and the friction of real joints (and of MuJoCo's soft constraint)
changes gradually with speed.  Samples below that speed count as at rest and are compared with the interval of friction.
All others are compared with sign(speed) Fc.

Source: the set-valued law of dry friction, e.g. Acary and Brogliato, Numerical Methods for Nonsmooth Dynamical
Systems, 2008, ch. 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from droid_jax.arguments import check_fields, number
from droid_jax.recordings.recording import Recording

FILTER_PADDING = 30  # samples with which `sosfiltfilt` pads the torques; shorter series are not filtered


@dataclass(frozen=True)
class RestConfig:
    """When a sample of a joint counts as at rest, and by how much a torque at rest may leave its friction interval.

    A joint is at rest while it is slower than the largest of three speeds: `speed`, `noise` and `share`.  The defaults
    come from 100 synthetic hinges (`experiments/friction_at_rest.py`).

    Attributes:
        speed: rad/s (m/s of a slide), about the presliding speed of gears.
        noise: standard deviations of the smoothed speed's noise, which is estimated from the positions.
        share: of the joint's RMS speed.  It excludes 3 % of a sine's samples and covers friction that changes gradually
            with speed, as MuJoCo's soft constraint.  With a smaller share, friction of 0.4 N m was wrong by 6 standard
            deviations.
        stop: periods of the position's low-pass that a slow phase must last to count as a stop.  Shorter phases are
            turning points, which are not widened by `settle`: widened, correlated noise biases friction upwards.
        settle: periods before and after a stop that count as at rest too, since friction jumps there and smoothed
            accelerations are wrong.  90 % intervals covered damping, friction and armature of 83, 80 and 55 % of the
            hinges at 1, and of 89, 86 and 72 % at 2.  3 brought no further gain.
        tolerance: standard deviations of the torques' noise by which a torque at rest may leave the interval.  Without
            it, noise at the edge of the interval biases friction upwards.
    """

    speed: float = 0.01
    noise: float = 3.0
    share: float = 0.05
    stop: float = 1.5
    settle: float = 2.0
    tolerance: float = 3.0

    def __post_init__(self) -> None:
        fields = ("speed", "noise", "share", "settle", "tolerance")
        check_fields(self, **dict.fromkeys(fields, partial(number, least=0)), stop=partial(number, above=0))


def at_rest(
    position_noise: np.ndarray, velocity: np.ndarray, timestep: float, rate: float, cutoff: float, config: RestConfig
) -> np.ndarray:
    """[T, J] bool, samples of a smoothed motion at rest.

    Args:
        position_noise: [J] rad (m), standard deviation of the white noise of the measured positions.
        velocity: [T, J] rad/s (m/s) of the smoothed motion.
        timestep: s, of the motion.
        rate: Hz, of the measured positions.
        cutoff: Hz, of their low-pass.
        config: the thresholds.
    """
    slowest = np.maximum.reduce(
        [
            np.full(velocity.shape[1], config.speed),
            config.noise * derivative_noise(position_noise, 1, rate, cutoff),
            config.share * np.sqrt(np.mean(velocity**2, axis=0)),
        ]
    )
    slow = np.abs(velocity) < slowest
    duration = math.ceil(config.stop / cutoff / timestep)
    width = 2 * math.ceil(config.settle / cutoff / timestep) + 1
    edge = duration // 2 + 1  # a stop at an end of the log may extend beyond it
    stopped = scipy.ndimage.binary_opening(np.pad(slow, ((edge, edge), (0, 0)), "edge"), np.ones((duration, 1)))
    return slow | scipy.ndimage.binary_dilation(stopped, np.ones((width, 1)))[edge:-edge]


def white_noise(high: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """[J] standard deviation of a signal's white noise, estimated from the residual of a low-pass.

    Args:
        high: [T, J] the signal minus its low-pass.
        rate: Hz, of the signal.
        cutoff: Hz, of the low-pass.
    """
    band = max(1.0 - 2.0 * cutoff / rate, 1e-3)  # share of the signal's band above the cutoff
    return np.median(np.abs(high), axis=0) / 0.6745 / np.sqrt(band)  # the median is robust against impacts


def derivative_noise(white: np.ndarray, order: int, rate: float, cutoff: float) -> np.ndarray:
    """[J] standard deviation of the noise of a smoothed signal's derivative of order `order` (0: the signal).

    White noise with standard deviation s at `rate` Hz has the spectral density 2 s^2 / rate.  Below `cutoff` Hz its
    n-th derivative has the variance 2 s^2 / rate * (2 pi)^(2 n) * cutoff^(2 n + 1) / (2 n + 1).
    """
    power = 2 * order + 1
    return white * (2.0 * np.pi) ** order * np.sqrt(2.0 / rate * cutoff**power / power)


def torque_at(
    recording: Recording, joints: Sequence[str], clock: np.ndarray, cutoff: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean measured torque of `joints` at times `clock` [T] s, and the standard deviation of its noise.

    If the rate allows, the mean of the repeats passes a zero-phase Butterworth filter of order 4 at `cutoff` Hz.  So
    resampling to the clock does not alias noise.  Gaps are interpolated linearly.

    Returns:
        [T, J] N m (N for slides), NaN for joints whose torque was not measured, and [J] N m (N).
    """
    torque, noise = np.full((len(clock), len(joints)), np.nan), np.zeros(len(joints))
    if "torque" not in recording.channels:
        return torque, noise
    channel = recording.channels["torque"]
    rate = (len(channel.time) - 1) / float(channel.time[-1] - channel.time[0])
    sections = scipy.signal.butter(4, cutoff, fs=rate, output="sos") if rate > 2.5 * cutoff else None
    for j, joint in enumerate(joints):
        if joint not in channel.columns:
            continue
        column = channel.columns.index(joint)
        values, mask = channel.values[:, :, column], channel.mask[:, :, column]
        measured = mask.any(axis=0)
        if measured.sum() < 2:
            continue
        mean = np.sum(np.where(mask, values, 0.0), axis=0)[measured] / mask.sum(axis=0)[measured]
        series = np.interp(channel.time, channel.time[measured], mean)
        if sections is not None and len(series) > FILTER_PADDING:
            smoothed = scipy.signal.sosfiltfilt(sections, series)
            white = white_noise(series - smoothed, rate, cutoff)
            noise[j], series = derivative_noise(white, 0, rate, cutoff), smoothed
        torque[:, j] = np.interp(clock, channel.time, series)
    return torque, noise
