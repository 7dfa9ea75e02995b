"""Repeat-to-repeat noise: one low-pass filter for data and simulation alike, its covariance, whitening.

The filter is a linear map from a channel's clock to a coarse clock, so data of any rate and any
mask and simulated traces pass through the same kernel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy

from droid_jax.arguments import check_fields, number, shown, weights, whole

COARSEST = 0.9  # periods of the cutoff from one sample to the next; beyond, a window holds two of opposite signs


def _minimum() -> dict[str, float]:
    return {"torque": 0.01, "position": 2e-5, "velocity": 5e-4, "object_angle": 2e-4}


@dataclass(frozen=True)
class NoiseConfig:
    """What decides the noise of a recording's channels, and with it the weights of its residuals.

    cutoff: Hz, of the low pass that data and simulation go through; real Panda residuals double between 8 and 20 Hz.
    rate: Hz, of the coarse clock of what is smoothed; above twice the cutoff (Nyquist).
    longest_lag: s, beyond it an autocovariance counts as noise of its estimate: ten repeats estimate a hundred lags
      with nine degrees of freedom each, the weights then depend on the mean that they weigh, and p-values of nothing
      are too small (tests/discrepancy/test_score_test.py).
    shrinkage: share by which an autocovariance is shrunk towards white noise of the same variance.
    least_window: share of the low pass's window that must be measured; the rest is renormalised, and its noise with it.
    trend_repeats: repeats from which on what grows or fades steadily from one to the next (a sensor that warms up) is
      no noise; of fewer a straight line takes too much.
    moving_share: share of the low pass's window at least in which a joint moves, where what a fit leaves tells of
      noise: at rest along a prescribed motion friction takes what is left.
    least_overlap: share of a recording's time that two repeats at least, or the only one, must have measured.
    minimum: channel -> deviation below which its noise is never believed, in the channel's unit: what sensors of arms
      resolve.
    minimum_share: likewise of a channel that one repeat measured, as a share of what moves in it where its motor is
      small.
    """

    cutoff: float = 8.0
    rate: float = 20.0
    longest_lag: float = 1.0
    shrinkage: float = 0.1
    least_window: float = 0.2
    trend_repeats: int = 5
    moving_share: float = 0.5
    least_overlap: float = 0.1
    minimum: Mapping[str, float] = field(default_factory=_minimum)
    minimum_share: float = 1e-3

    def __post_init__(self) -> None:
        share = partial(number, least=0, most=1)
        check_fields(
            self,
            cutoff=partial(number, above=0),
            rate=partial(number, above=0),
            longest_lag=partial(number, least=0),
            shrinkage=share,
            least_window=partial(number, above=0, most=1),
            trend_repeats=partial(whole, least=3),
            moving_share=share,
            least_overlap=share,
            minimum=weights,
            minimum_share=share,
        )
        if self.rate <= 2.0 * self.cutoff:
            raise ValueError(
                f"rate must be above twice the cutoff of {self.cutoff:g} Hz (Nyquist), got {self.rate:g} Hz"
            )
        if set(self.minimum) != set(_minimum()) or not all(self.minimum.values()):
            raise ValueError(
                f"minimum must give each of {', '.join(_minimum())} a deviation above 0, got {shown(self.minimum)}"
            )


DEFAULT_NOISE = NoiseConfig()


def coarse_clock(start: float, end: float, rate: float = DEFAULT_NOISE.rate) -> np.ndarray:
    """[K] s from start to end at about `rate` Hz."""
    return np.linspace(start, end, max(2, round((end - start) * rate) + 1))


def lowpass(clock: np.ndarray, coarse: np.ndarray, config: NoiseConfig = DEFAULT_NOISE) -> scipy.sparse.csr_array:
    """[K, T] matrix from samples at a growing `clock` to smoothed values at `coarse`, sparse: a window is short.

    A windowed sinc (Hann, 1.5 periods of the cutoff to each side), cut and renormalised at the
    ends so that a constant stays that constant.  Where the clock is silent for so long that less than `least_window` of
    the window is left, the row is zero.  Source: windowed-sinc design, Oppenheim and Schafer, ch. 7.
    Raises ValueError for a clock that is too coarse for the cutoff throughout.
    """
    half = 1.5 / config.cutoff
    first, last = np.searchsorted(clock, coarse - half), np.searchsorted(clock, coarse + half, side="right")
    begins = np.concatenate([[0], np.cumsum(last - first)])
    rows = np.repeat(np.arange(len(coarse)), last - first)
    columns = np.arange(begins[-1]) + (first - begins[:-1])[rows]
    lag = coarse[rows] - clock[columns]
    spacing = np.gradient(clock) if len(clock) > 1 else np.ones_like(clock)
    spacing[[0, -1]] *= 0.5  # trapezoidal rule: the same result at every sampling rate
    kernel = np.sinc(2 * config.cutoff * lag) * (0.5 + 0.5 * np.cos(np.pi * np.clip(lag / half, -1, 1)))
    shape = (len(coarse), len(clock))
    weights = scipy.sparse.csr_array((kernel * spacing[columns], columns, begins), shape=shape)
    total = weights.sum(axis=1)
    enough = total > config.least_window / (2.0 * config.cutoff)  # of the whole window's area
    usual = np.median(np.diff(clock)) if len(clock) > 1 else np.inf
    if not enough.all() and usual > COARSEST / config.cutoff:
        raise ValueError(f"a clock with steps of {usual:.3g} s is too coarse to be smoothed at {config.cutoff} Hz")
    return scipy.sparse.diags_array(np.where(enough, 1.0 / np.where(enough, total, 1.0), 0.0)) @ weights


def smooth(
    values: np.ndarray,
    mask: np.ndarray,
    kernel: scipy.sparse.csr_array,
    least_window: float = DEFAULT_NOISE.least_window,
) -> np.ndarray:
    """[N, T, C] with mask, through a `lowpass` [K, T] -> [N, K, C], renormalised over the samples that were measured.

    NaN where less than a share `least_window` of the kernel's weight was measured.
    """
    top = np.stack([kernel @ np.where(seen, repeat, 0.0) for repeat, seen in zip(values, mask, strict=True)])
    weight = np.stack([kernel @ seen.astype(float) for seen in mask])
    return np.where(np.abs(weight) > least_window, top / np.where(weight == 0, 1, weight), np.nan)


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of the mean of the repeats, per column, over the coarse clock.

    mean: [K, C] of the smoothed repeats.  whitener: [C, K, K]; whitener @ (x - mean) has unit
    covariance when x is the truth.  repeats: [N, K, C], smoothed; count: [K, C] how many of them were measured, none
    in a gap of one repeat.
    """

    mean: np.ndarray
    whitener: np.ndarray
    repeats: np.ndarray
    count: np.ndarray

    def stated(self, deviation: np.ndarray) -> Noise:
        """White noise of a stated deviation [C], in the channel's unit, in place of the estimated one.

        What no repeat measured counts for nothing.
        """
        seen = (self.count > 0).T[:, None]  # [C, 1, K]
        return replace(self, whitener=np.eye(len(self.mean)) * seen / deviation[:, None, None])


def estimate_noise(
    repeats: np.ndarray, *, minimum: float, measured: np.ndarray | None = None, config: NoiseConfig = DEFAULT_NOISE
) -> Noise:
    """Noise of smoothed repeats [N, K, C], whole in time.

    measured: [N, K, C] bool, all unless given; what was not holds the mean of the others, and counts for nothing.

    Per column, the repeats' deviations from their mean, from `trend_repeats` on without their trend over the order,
    are a constant of each repeat and a stationary rest.
    The rest's autocovariance (biased, hence positive semi-definite) is tapered to `longest_lag` by a Parzen
    window, shrunk by `shrinkage` towards white noise of the same variance, and never less than `minimum` (a deviation
    in the channel's unit: what one repeat alone would have); the constants' variance is added to it.  With one repeat
    only `minimum` is used, as white noise.  Source of the window: Parzen, Mathematical considerations in the estimation
    of spectra, Technometrics 1961.
    """
    _, length, columns = repeats.shape
    mean = repeats.mean(axis=0)
    count = np.full(mean.shape, len(repeats)) if measured is None else measured.sum(axis=0)
    whitener = np.empty((columns, length, length))
    for c in range(columns):
        seen = np.ones(repeats.shape[:2], bool) if measured is None else measured[:, :, c]
        lags, constant = _lags(repeats[:, :, c] - mean[:, c], seen, config)
        variance = max(lags[0], minimum**2)
        lags = (1 - config.shrinkage) * lags
        lags[0] = variance
        if not (constant or lags[1:].any()):  # white
            whitener[c] = np.diag(np.sqrt(count[:, c] / variance))
            continue
        of_mean = (scipy.linalg.toeplitz(lags) + constant) / np.sqrt(np.outer(count[:, c], count[:, c]))
        whitener[c] = np.linalg.inv(np.linalg.cholesky(of_mean))
    return Noise(mean, whitener, repeats, count)


def _lags(error: np.ndarray, seen: np.ndarray, config: NoiseConfig) -> tuple[np.ndarray, float]:
    """[K] tapered autocovariance of what repeats [N, K] are apart, and the variance of their constants beside it.

    seen: [N, K] bool; both are zero for what but one repeat measured.
    """
    length, count = error.shape[1], seen.sum(axis=0)
    enough = count >= config.trend_repeats
    error = np.where(enough, detrend(error, seen), error)
    lengths, freedom = seen.sum(axis=1, keepdims=True), (count - 1 - enough).clip(0).sum()
    if freedom == 0:
        return np.zeros(length), 0.0
    constants = error.sum(axis=1, where=seen, keepdims=True) / np.maximum(lengths, 1)
    rest = np.where(seen, error - constants, 0.0)
    spectrum = np.abs(np.fft.rfft(rest, 2 * length, axis=1)) ** 2
    lags = np.fft.irfft(spectrum.sum(axis=0), 2 * length)[:length] / freedom
    longest = round(config.longest_lag * config.rate)
    window = np.zeros(length)
    window[: longest + 1] = scipy.signal.windows.parzen(2 * longest + 1)[longest : longest + length]
    return lags * window, float(np.sum(lengths * constants**2) / freedom)


def detrend(x: np.ndarray, seen: np.ndarray | None = None) -> np.ndarray:
    """x [N, ...] without its straight line over the order of the rows; their mean stays.

    seen: bool of the same shape, which entries count; all unless given.  Where fewer than two do, x stays.
    """
    seen = np.ones(x.shape, bool) if seen is None else seen
    count = np.maximum(seen.sum(axis=0), 1)
    order = np.arange(len(x)).reshape(-1, *[1] * (x.ndim - 1))
    order = np.where(seen, order - np.sum(order * seen, axis=0) / count, 0.0)
    slope = np.sum(order * x, axis=0) / np.maximum(np.sum(order**2, axis=0), 1e-30)
    return x - order * slope


def correlation_time(residuals: np.ndarray, rate: float = DEFAULT_NOISE.rate) -> np.ndarray:
    """[C] s, how long residuals [K, C] at `rate` Hz stay correlated: their autocorrelation's sum up to its first zero.

    Two-sided, so that K / (rate * this) is about the number of independent samples.
    """
    times = []
    for column in (residuals - residuals.mean(axis=0)).T:
        lags = np.correlate(column, column, "full")[len(column) - 1 :]
        lags = lags / max(lags[0], 1e-30)
        end = int(np.argmax(lags <= 0)) or len(lags)
        times.append((2 * lags[:end].sum() - 1) / rate)
    return np.array(times)


def deviation_of(residuals: np.ndarray, counts: np.ndarray | None = None) -> np.ndarray:
    """[C] root mean square of residuals [K, C].

    counts: [K, C] bool, the residuals that tell of noise; all unless given, and of a column that has none.
    """
    counts = np.ones(residuals.shape, bool) if counts is None else counts | ~counts.any(axis=0)
    return np.sqrt(np.sum(np.where(counts, residuals, 0.0) ** 2, axis=0) / counts.sum(axis=0))


def stated_deviation(
    residuals: np.ndarray, counts: np.ndarray | None = None, rate: float = DEFAULT_NOISE.rate
) -> np.ndarray:
    """[C] deviation to state as noise so that correlated residuals [K, C] count as often as they are independent.

    counts: see `deviation_of`.
    """
    rms = deviation_of(residuals, counts)
    return rms * np.sqrt(np.maximum(1.0, correlation_time(residuals, rate) * rate))
