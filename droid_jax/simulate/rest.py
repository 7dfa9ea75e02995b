"""Which samples of a measured motion are at rest, where dry friction is no function of the speed.

A joint that stands still may be held by any friction between -Fc and Fc.  Below some speed a log does not tell
whether a joint moves, nor in which direction: because of the noise of the measured positions, because friction of real
joints (and MuJoCo's soft friction constraint) changes over gradually, or because the joint really holds.  Samples
below that speed count as at rest: they are compared with the interval of friction, all others with sign(speed) Fc.
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

SHORTEST = 30  # samples that the torques' low-pass pads itself with


@dataclass(frozen=True)
class RestConfig:
    """When a sample of a joint counts as at rest, and how exactly the interval of its friction is known.

    A joint is at rest while it is slower than the largest of three speeds:
    speed: rad/s (m/s of a slide); gears preslide about as long.
    noise: times the standard deviation of the smoothed speed's noise, which is estimated from the positions.
    share: of the joint's RMS speed.  It costs 3 % of a sine's samples and covers friction that changes over gradually,
      as MuJoCo's soft friction constraint does (below it, friction of 0.4 N m came out wrong by 6 deviations).
    stop: periods of the position's low-pass for which a joint that has stopped is at rest; shorter, it turns round.
      Widened as a stop is, turns take so much of a log that noise which is correlated pulls friction up.
    settle: periods before and after such a stop, for which smoothed accelerations are wrong because friction jumps.
      Of 100 synthetic hinges the 90 % intervals held damping, friction and armature in 83, 80 and 55 at 1, in 89, 86
      and 72 at 2 (least squares on the same samples), at 3 no more.
    tolerance: standard deviations of the torques' noise by which a torque at rest may leave the interval: noise at its
      edge would pull the friction up otherwise.
    Measured on 100 synthetic hinges, `experiments/friction_at_rest.py`.
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
        position_noise: [J] rad (m), deviation of the white noise of the measured positions.
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
    lasts = math.ceil(config.stop / cutoff / timestep)
    around = 2 * math.ceil(config.settle / cutoff / timestep) + 1
    edge = lasts // 2 + 1  # a stop at an end of the log may go on outside of it
    stopped = scipy.ndimage.binary_opening(np.pad(slow, ((edge, edge), (0, 0)), "edge"), np.ones((lasts, 1)))
    return slow | scipy.ndimage.binary_dilation(stopped, np.ones((around, 1)))[edge:-edge]


def white_noise(high: np.ndarray, rate: float, cutoff: float) -> np.ndarray:
    """[J] deviation of the white noise of a signal, from what a low-pass took off it.

    Args:
        high: [T, J] the signal minus its low-pass.
        rate: Hz, of the signal.
        cutoff: Hz, of the low-pass.
    """
    above = max(1.0 - 2.0 * cutoff / rate, 1e-3)  # share of the band that `high` holds
    return np.median(np.abs(high), axis=0) / 0.6745 / np.sqrt(above)  # robust: blows are no noise


def derivative_noise(white: np.ndarray, order: int, rate: float, cutoff: float) -> np.ndarray:
    """[J] deviation of the noise of a smoothed signal's derivative of an order, 0 for the signal itself.

    White noise of a deviation s at `rate` Hz has the density 2 s^2 / rate; below `cutoff` Hz its derivative of order n
    has the variance 2 s^2 / rate * (2 pi)^(2 n) * cutoff^(2 n + 1) / (2 n + 1).
    """
    power = 2 * order + 1
    return white * (2.0 * np.pi) ** order * np.sqrt(2.0 / rate * cutoff**power / power)


def torque_at(
    recording: Recording, joints: Sequence[str], clock: np.ndarray, cutoff: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean measured torque of `joints` at times `clock` [T] s, and the deviation of its noise.

    The mean of the repeats passes a zero-phase Butterworth filter of order 4 at `cutoff` Hz first, where its rate
    allows, so that samples of another clock hold no aliased noise.  Gaps are bridged by lines.

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
        seen = mask.any(axis=0)
        if seen.sum() < 2:
            continue
        mean = np.sum(np.where(mask, values, 0.0), axis=0)[seen] / mask.sum(axis=0)[seen]
        series = np.interp(channel.time, channel.time[seen], mean)
        if sections is not None and len(series) > SHORTEST:
            smoothed = scipy.signal.sosfiltfilt(sections, series)
            white = white_noise(series - smoothed, rate, cutoff)
            noise[j], series = derivative_noise(white, 0, rate, cutoff), smoothed
        torque[:, j] = np.interp(clock, channel.time, series)
    return torque, noise
