"""Repeat-to-repeat noise: the low-pass filter of data and simulation, the covariance of the noise, whitening.

The filter is a linear map from a channel's clock to a coarse clock.  Data of any rate and any mask, and simulated
traces, pass through the same kernel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy

from droid_jax.arguments import check_fields, number, shown, weights, whole

LONGEST_STEP = 0.9  # largest step of a clock, periods of the cutoff; with longer ones the kernel's weights may cancel


def _minimum() -> dict[str, float]:
    return {"torque": 0.01, "position": 2e-5, "velocity": 5e-4, "object_angle": 2e-4}


@dataclass(frozen=True)
class NoiseConfig:
    """Settings of the noise model, which sets the weights of the residuals.

    cutoff: Hz, of the low pass for data and simulation; real Panda residuals double between 8 and 20 Hz.
    rate: Hz, of the coarse clock of the smoothed channels; above twice the cutoff (Nyquist).
    longest_lag: s, the autocovariance is tapered to zero there.  With more lags, ten repeats give p-values that are too
      small under the null hypothesis (tests/discrepancy/test_score_test.py): each lag has nine degrees of freedom, and
      the weights become correlated with the mean.
    shrinkage: share by which an autocovariance is shrunk towards white noise of the same variance.
    least_window: share of the low pass's window that must be measured; the measured part is renormalised, and its noise
      with it.
    trend_repeats: number of repeats from which on a linear trend over the repeats (a sensor that warms up) is removed
      before the noise is estimated; with fewer, a straight line takes too many degrees of freedom.
    moving_share: share of the low pass's window in which a joint must move for its residual to enter the estimate of
      the noise.  At rest along a prescribed motion friction absorbs the residual.
    least_overlap: share of a recording's time that at least two repeats, or the only one, must have measured.
    minimum: channel -> smallest standard deviation of its noise, in the channel's unit: what arms' sensors resolve.
    minimum_share: the same for a channel of one repeat, as a share of the channel's own standard deviation.  It applies
      where it is smaller than `minimum`, which small motors need.
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
    """Return [K] s, evenly spaced from start to end at about `rate` Hz."""
    return np.linspace(start, end, max(2, round((end - start) * rate) + 1))


def lowpass(clock: np.ndarray, coarse: np.ndarray, config: NoiseConfig = DEFAULT_NOISE) -> scipy.sparse.csr_array:
    """Return the low pass as a sparse matrix [K, T], from samples at `clock` to smoothed values at `coarse`.

    The kernel is a windowed sinc (Hann, 1.5 periods of the cutoff to each side).  It is cut and renormalised at the
    ends, so that a constant is preserved.  A row is zero where the samples cover less than `least_window` of the
    window's area.  Source: windowed-sinc design, Oppenheim and Schafer, ch. 7.

    Args:
        clock: [T] s, increasing times of the samples.
        coarse: [K] s, times of the smoothed values.
        config: cutoff and `least_window`.

    Raises:
        ValueError: the whole clock is too coarse for the cutoff.
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
    covered = total > config.least_window / (2.0 * config.cutoff)  # share of the whole window's area
    step = np.median(np.diff(clock)) if len(clock) > 1 else np.inf
    if not covered.all() and step > LONGEST_STEP / config.cutoff:
        raise ValueError(f"a clock with steps of {step:.3g} s is too coarse to be smoothed at {config.cutoff} Hz")
    return scipy.sparse.diags_array(np.where(covered, 1.0 / np.where(covered, total, 1.0), 0.0)) @ weights


def smooth(
    values: np.ndarray,
    mask: np.ndarray,
    kernel: scipy.sparse.csr_array,
    least_window: float = DEFAULT_NOISE.least_window,
) -> np.ndarray:
    """Return values [N, T, C] through a `lowpass` [K, T] as [N, K, C], renormalised over the measured samples.

    The result is NaN where less than a share `least_window` of the kernel's weight was measured.

    mask: [N, T, C] bool, samples that were measured.
    """
    filtered = np.stack([kernel @ np.where(measured, v, 0.0) for v, measured in zip(values, mask, strict=True)])
    weight = np.stack([kernel @ measured.astype(float) for measured in mask])
    return np.where(np.abs(weight) > least_window, filtered / np.where(weight == 0, 1, weight), np.nan)


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of the mean of the repeats, for each column, over the coarse clock.

    mean: [K, C] of the smoothed repeats.  whitener: [C, K, K]; whitener @ (x - mean) has unit covariance if x is the
    noise-free signal.  Of white noise [C, K], its diagonal.  repeats: [N, K, C], smoothed.  count: [K, C] number of
    repeats that measured an instant; 0 in a gap of the only repeat.
    """

    mean: np.ndarray
    whitener: np.ndarray
    repeats: np.ndarray
    count: np.ndarray

    def stated(self, deviation: np.ndarray) -> Noise:
        """Return white noise of a stated standard deviation [C], in the channel's unit, instead of the estimated one.

        Instants that no repeat measured get weight zero.
        """
        return replace(self, whitener=(self.count > 0).T / deviation[:, None])

    @property
    def weight(self) -> np.ndarray:
        """[K, C] diagonal of the whitener: of white noise the weight of each instant."""
        return self.whitener.T if self.whitener.ndim == 2 else np.einsum("ckk->kc", self.whitener)

    def whitened(self, deviations: np.ndarray) -> np.ndarray:
        """Return deviations [N, K, C] from the mean in units of the noise, [N, C, K]."""
        if self.whitener.ndim == 2:
            return self.whitener * np.swapaxes(deviations, 1, 2)
        return np.einsum("ckl,nlc->nck", self.whitener, deviations)


def estimate_noise(
    repeats: np.ndarray, *, minimum: float, measured: np.ndarray | None = None, config: NoiseConfig = DEFAULT_NOISE
) -> Noise:
    """Estimate the noise of smoothed repeats.

    The model of a column has two parts: a constant of each repeat, and a stationary process.  Both are estimated from
    the deviations of the repeats from their mean.  From `trend_repeats` repeats on, a linear trend over the repeats is
    removed first.  The autocovariance of the stationary part is biased, hence positive semi-definite.  It is tapered to
    zero at `longest_lag` by a Parzen window and shrunk by `shrinkage` towards white noise of the same variance.  The
    variance of the constants is added.  One repeat gets white noise of deviation `minimum`.
    Source of the window: Parzen, Mathematical considerations in the estimation of spectra, Technometrics 1961.

    Args:
        repeats: [N, K, C] without gaps.
        minimum: smallest standard deviation of the noise of one repeat, in the channel's unit.
        measured: [N, K, C] bool, True throughout if None.  The other entries hold the mean of the measured repeats and
            have no weight in the estimate.
        config: settings of the noise model.
    """
    _, length, columns = repeats.shape
    mean = repeats.mean(axis=0)
    count = np.full(mean.shape, len(repeats)) if measured is None else measured.sum(axis=0)
    models = list[tuple[np.ndarray, float, float]]()
    for c in range(columns):
        mask = np.ones(repeats.shape[:2], bool) if measured is None else measured[:, :, c]
        lags, constant = _lags(repeats[:, :, c] - mean[:, c], mask, config)
        variance = max(lags[0], minimum**2)
        lags = (1 - config.shrinkage) * lags
        lags[0] = variance
        models.append((lags, constant, variance))
    white = [not (constant or lags[1:].any()) for lags, constant, _ in models]
    if all(white):
        variances = np.array([variance for _, _, variance in models])
        return Noise(mean, np.sqrt(count.T / variances[:, None]), repeats, count)
    whitener = np.zeros((columns, length, length))
    for c, (lags, constant, variance) in enumerate(models):
        if white[c]:
            np.fill_diagonal(whitener[c], np.sqrt(count[:, c] / variance))
            continue
        covariance = (scipy.linalg.toeplitz(lags) + constant) / np.sqrt(np.outer(count[:, c], count[:, c]))
        whitener[c] = np.linalg.inv(np.linalg.cholesky(covariance))
    return Noise(mean, whitener, repeats, count)


def _lags(deviation: np.ndarray, mask: np.ndarray, config: NoiseConfig) -> tuple[np.ndarray, float]:
    """Return the tapered autocovariance [K] of repeats' deviations [N, K], and the variance of the repeats' constants.

    Both are zero where only one repeat was measured.

    mask: [N, K] bool, samples that were measured.
    """
    length, count = deviation.shape[1], mask.sum(axis=0)
    has_trend = count >= config.trend_repeats
    deviation = np.where(has_trend, detrend(deviation, mask), deviation)
    lengths, degrees_of_freedom = mask.sum(axis=1, keepdims=True), (count - 1 - has_trend).clip(0).sum()
    if degrees_of_freedom == 0:
        return np.zeros(length), 0.0
    constants = deviation.sum(axis=1, where=mask, keepdims=True) / np.maximum(lengths, 1)
    stationary = np.where(mask, deviation - constants, 0.0)
    spectrum = np.abs(np.fft.rfft(stationary, 2 * length, axis=1)) ** 2
    lags = np.fft.irfft(spectrum.sum(axis=0), 2 * length)[:length] / degrees_of_freedom
    longest = round(config.longest_lag * config.rate)
    window = np.zeros(length)
    window[: longest + 1] = scipy.signal.windows.parzen(2 * longest + 1)[longest : longest + length]
    return lags * window, float(np.sum(lengths * constants**2) / degrees_of_freedom)


def detrend(x: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Return x [N, ...] without its linear trend over the row number; the mean is preserved.

    mask: bool of the same shape, entries that enter the fit of the line; all if None.  A column with fewer than two
      such entries is returned unchanged.
    """
    mask = np.ones(x.shape, bool) if mask is None else mask
    count = np.maximum(mask.sum(axis=0), 1)
    order = np.arange(len(x)).reshape(-1, *[1] * (x.ndim - 1))
    order = np.where(mask, order - np.sum(order * mask, axis=0) / count, 0.0)
    slope = np.sum(order * x, axis=0) / np.maximum(np.sum(order**2, axis=0), 1e-30)
    return x - order * slope


def correlation_time(residuals: np.ndarray, rate: float = DEFAULT_NOISE.rate) -> np.ndarray:
    """Return the integrated autocorrelation time [C] s of residuals [K, C] at `rate` Hz.

    The autocorrelation is summed on both sides up to its first zero.  So K / (rate * result) is about the number of
    independent samples.
    """
    times = []
    for column in (residuals - residuals.mean(axis=0)).T:
        lags = np.correlate(column, column, "full")[len(column) - 1 :]
        lags = lags / max(lags[0], 1e-30)
        end = int(np.argmax(lags <= 0)) or len(lags)
        times.append((2 * lags[:end].sum() - 1) / rate)
    return np.array(times)


def deviation_of(residuals: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Return the root mean square [C] of residuals [K, C].

    mask: [K, C] bool, residuals that enter it; all if None.  A column without any uses all of its residuals.
    """
    mask = np.ones(residuals.shape, bool) if mask is None else mask | ~mask.any(axis=0)
    return np.sqrt(np.sum(np.where(mask, residuals, 0.0) ** 2, axis=0) / mask.sum(axis=0))


def stated_deviation(
    residuals: np.ndarray, mask: np.ndarray | None = None, rate: float = DEFAULT_NOISE.rate
) -> np.ndarray:
    """Return the standard deviation [C] of white noise that carries as much information as residuals [K, C].

    It is the root mean square, times the square root of the correlation time in samples.  So correlated residuals count
    as often as they hold independent samples.

    mask: see `deviation_of`.
    """
    rms = deviation_of(residuals, mask)
    return rms * np.sqrt(np.maximum(1.0, correlation_time(residuals, rate) * rate))
