"""The low-pass kernel against SciPy and against its purpose; whitening of synthetic noise."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from droid_jax.cost.noise import (
    DEFAULT_NOISE,
    NoiseConfig,
    coarse_clock,
    correlation_time,
    detrend,
    estimate_noise,
    lowpass,
    smooth,
    stated_deviation,
)

CLOCK = np.arange(0, 6.0, 0.002)
COARSE = coarse_clock(0.0, float(CLOCK[-1]))
INSIDE = (COARSE > 0.5) & (COARSE < 5.5)


def test_the_coarse_clock_keeps_its_ends_and_its_rate():
    assert COARSE[0] == 0.0 and COARSE[-1] == CLOCK[-1]
    assert 1 / np.diff(COARSE).mean() == pytest.approx(DEFAULT_NOISE.rate, rel=0.01)
    assert len(coarse_clock(1.0, 1.001)) == 2


@pytest.mark.parametrize("clock", [CLOCK, np.arange(0, 6.0, 0.01), CLOCK[200:-300]])
def test_constants_pass_even_at_the_ends(clock: np.ndarray):
    coarse = coarse_clock(clock[0], clock[-1])
    np.testing.assert_allclose(lowpass(clock, coarse) @ np.full(len(clock), 3.7), 3.7, rtol=1e-12)


def test_constants_pass_on_an_irregular_clock():
    rng = np.random.default_rng(0)
    clock = np.sort(rng.uniform(0, 6, 2000))
    np.testing.assert_allclose(lowpass(clock, COARSE) @ np.full(2000, -2.0), -2.0, rtol=1e-12)


def gain(frequency: float) -> float:
    """Largest output of a sine over all phases, away from the ends."""
    kernel = lowpass(CLOCK, COARSE)[INSIDE]
    phases = 2 * np.pi * frequency * CLOCK
    return float(np.sqrt((kernel @ np.sin(phases)) ** 2 + (kernel @ np.cos(phases)) ** 2).max())


@pytest.mark.parametrize("frequency", [0.5, 1.0, 2.0, 3.0, 4.0])
def test_the_pass_band_passes(frequency: float):
    assert gain(frequency) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("frequency", [12.0, 13.0, 15.0, 20.0, 35.0, 50.0, 100.0, 240.0])
def test_the_stop_band_is_down_by_20_db(frequency: float):
    assert gain(frequency) < 0.1


def test_the_cutoff_is_where_it_says():
    """A windowed sinc is at half its height at the cutoff."""
    assert gain(8.0) == pytest.approx(0.5, abs=0.05)


def test_it_agrees_with_a_butterworth_in_the_pass_band():
    """Random signals below 4 Hz, SciPy's zero-phase filter with the same cutoff."""
    rng = np.random.default_rng(1)
    waves = [rng.normal() * np.sin(2 * np.pi * f * CLOCK + rng.uniform(0, 6.3)) for f in rng.uniform(0.1, 4.0, 20)]
    signal = np.sum(waves, axis=0) + 0.3 * rng.normal(size=len(CLOCK))
    sections = scipy.signal.butter(4, 8.0, fs=500.0, output="sos")
    theirs = np.interp(COARSE, CLOCK, scipy.signal.sosfiltfilt(sections, signal))
    ours = lowpass(CLOCK, COARSE) @ signal
    assert np.sqrt(np.mean((ours - theirs)[INSIDE] ** 2)) < 0.03 * np.std(signal)


def test_the_output_does_not_depend_on_the_rate():
    signal = lambda t: np.sin(2 * np.pi * 1.3 * t) + 0.4 * np.cos(2 * np.pi * 2.9 * t)  # noqa: E731
    results = []
    for rate in (1000.0, 500.0, 200.0):
        clock = np.arange(round(6.0 * rate) + 1) / rate
        coarse = coarse_clock(0.0, 6.0)
        results.append(lowpass(clock, coarse) @ signal(clock))
    inside = slice(10, -10)
    np.testing.assert_allclose(results[1][inside], results[0][inside], atol=1e-3)
    np.testing.assert_allclose(results[2][inside], results[0][inside], atol=1e-3)


def test_a_clock_too_coarse_to_be_smoothed_is_refused():
    clock = np.arange(0, 6.0, 2.0)
    with pytest.raises(ValueError, match=r"steps of 2 s is too coarse to be smoothed at 8.0 Hz"):
        lowpass(clock, coarse_clock(0.0, 4.0))


# ----- masks


def test_without_holes_smoothing_is_the_kernel():
    values = np.random.default_rng(2).normal(size=(3, len(CLOCK), 2))
    kernel = lowpass(CLOCK, COARSE)
    out = smooth(values, np.ones(values.shape, bool), kernel)
    for n in range(3):
        np.testing.assert_allclose(out[n], kernel @ values[n], atol=1e-12)


def test_unmeasured_samples_have_no_influence():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(2, len(CLOCK), 1))
    mask = rng.random(values.shape) > 0.2
    kernel = lowpass(CLOCK, COARSE)
    out = smooth(np.where(mask, values, np.nan), mask, kernel)
    np.testing.assert_array_equal(out, smooth(np.where(mask, values, 1e9), mask, kernel))
    # and the other samples count as if they were the only ones
    expected = [(k * mask[0, :, 0] * values[0, :, 0]).sum() / (k * mask[0, :, 0]).sum() for k in kernel.toarray()]
    np.testing.assert_allclose(out[0, :, 0], expected, rtol=1e-9)


def test_stretches_that_were_hardly_measured_are_nan():
    mask = np.ones((1, len(CLOCK), 1), bool)
    mask[0, (CLOCK > 2.0) & (CLOCK < 3.0)] = False
    out = smooth(np.ones(mask.shape), mask, lowpass(CLOCK, COARSE))[0, :, 0]
    assert np.isnan(out[(COARSE > 2.1) & (COARSE < 2.9)]).all()
    outside = (COARSE < 1.8) | (COARSE > 3.2)
    np.testing.assert_allclose(out[outside], 1.0, rtol=1e-9)


# ----- whitening


def first_order(rng: np.random.Generator, shape: tuple[int, int], keep: float, deviation: float) -> np.ndarray:
    """[N, K] stationary AR(1)."""
    noise = np.empty(shape)
    noise[:, 0] = rng.normal(0, deviation, shape[0])
    for k in range(1, shape[1]):
        noise[:, k] = keep * noise[:, k - 1] + rng.normal(0, deviation * np.sqrt(1 - keep**2), shape[0])
    return noise


def whitened_errors(make, *, repeats: int, length: int, trials: int, minimum: float) -> np.ndarray:
    """[trials, K] whitener @ (truth - mean), the truth being zero."""
    rng = np.random.default_rng(10)
    out = []
    for _ in range(trials):
        noise = estimate_noise(make(rng, (repeats, length))[:, :, None], minimum=minimum)
        out.append(noise.whitened(-noise.mean[None])[0, 0])
    return np.array(out)


def test_white_noise_becomes_unit_noise():
    z = whitened_errors(lambda r, s: r.normal(0, 0.3, s), repeats=10, length=60, trials=300, minimum=1e-3)
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.15)
    correlation = np.mean(z[:, 1:] * z[:, :-1]) / np.mean(z**2)
    assert abs(correlation) < 0.1


def test_correlated_noise_becomes_nearly_white_unit_noise():
    """A tenth of the correlation remains, since the autocovariance is shrunk by a tenth."""
    z = whitened_errors(lambda r, s: first_order(r, s, 0.7, 0.3), repeats=10, length=60, trials=300, minimum=1e-3)
    assert 0.7 < np.mean(z**2) < 1.15
    assert abs(np.mean(z[:, 1:] * z[:, :-1]) / np.mean(z**2)) < 0.25
    raw = np.array([first_order(np.random.default_rng(i), (1, 60), 0.7, 1.0)[0] for i in range(200)])
    assert np.mean(raw[:, 1:] * raw[:, :-1]) > 0.6  # what it was before


def test_a_bias_of_each_repeat_is_part_of_the_noise():
    """AR(1) and a constant that differs between repeats: the sum of z has the variance of noise."""

    def make(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        return first_order(rng, shape, 0.7, 0.1) + rng.normal(0, 0.3, (shape[0], 1))

    z = whitened_errors(make, repeats=10, length=60, trials=300, minimum=1e-3)
    # shrinking counts a tenth of the bias as white noise: too careful by a factor below two
    assert 0.25 < np.mean(z**2) < 1.2
    # without the off-diagonal part, one repeat's bias would count sixty times
    naive = []
    rng = np.random.default_rng(10)
    for _ in range(100):
        repeats = make(rng, (10, 60))
        naive.append(np.sum((repeats.mean(axis=0) / (repeats.std(axis=0, ddof=1) / np.sqrt(10))).mean() ** 2 * 60))
    assert np.var(z.sum(axis=1)) / 60 < 0.3 * np.mean(naive)


def test_noise_is_at_least_the_minimum():
    repeats = np.zeros((4, 30, 2))
    noise = estimate_noise(repeats, minimum=0.02)
    np.testing.assert_allclose(noise.whitener, np.full((2, 30), 2.0 / 0.02), rtol=1e-9)
    np.testing.assert_array_equal(noise.mean, 0.0)


def test_one_repeat_has_the_minimum_as_white_noise():
    values = np.random.default_rng(0).normal(size=(1, 30, 1))
    noise = estimate_noise(values, minimum=0.05)
    np.testing.assert_allclose(noise.whitener, np.full((1, 30), 1 / 0.05))
    np.testing.assert_allclose(noise.whitened(values)[0, 0], values[0, :, 0] / 0.05)
    np.testing.assert_array_equal(noise.mean, values[0])


@pytest.mark.parametrize("absent", [2, 4])
def test_repeats_that_did_not_measure_a_column_have_no_influence(absent: int):
    """The result is that of the other repeats alone."""
    repeats = np.random.default_rng(3).normal(0, 0.3, (7, 60, 1))
    repeats[:absent] = repeats[absent:].mean(axis=0)
    measured = np.ones((7, 60, 1), bool)
    measured[:absent] = False
    found, expected = (
        estimate_noise(repeats, minimum=1e-3, measured=measured),
        estimate_noise(repeats[absent:], minimum=1e-3),
    )
    np.testing.assert_allclose(found.mean, expected.mean)
    np.testing.assert_allclose(found.whitener, expected.whitener, rtol=1e-6, atol=1e-9)
    assert (found.count == 7 - absent).all()


def test_a_stretch_that_some_repeats_missed_has_less_weight():
    rng, left = np.random.default_rng(4), []
    measured = np.ones((5, 60, 1), bool)
    measured[:3, 20:40] = False
    for _ in range(300):
        repeats = rng.normal(0, 0.3, (5, 60, 1))
        repeats = np.where(measured, repeats, np.where(measured, repeats, 0).sum(axis=0) / measured.sum(axis=0))
        noise = estimate_noise(repeats, minimum=1e-3, measured=measured)
        left.append(noise.whitened(-noise.mean[None])[0, 0])
    square = np.mean(np.square(left), axis=0)
    assert square[:20].mean() == pytest.approx(1.0, abs=0.15) and square[20:40].mean() == pytest.approx(1.0, abs=0.15)


def test_columns_are_estimated_separately():
    rng = np.random.default_rng(1)
    repeats = rng.normal(size=(50, 200, 2)) * [0.1, 1.0]
    noise = estimate_noise(repeats, minimum=1e-3)
    weight = noise.weight.sum(axis=0)
    assert weight[0] / weight[1] == pytest.approx(10.0, rel=0.05)


def test_correlation_time_of_a_moving_average():
    white = np.random.default_rng(1).normal(size=(4000, 1))
    averaged = np.convolve(white[:, 0], np.ones(10) / 10, "valid")[:, None]
    # a box of n samples has the triangular autocorrelation, whose two-sided sum is n
    assert correlation_time(averaged)[0] == pytest.approx(10 / DEFAULT_NOISE.rate, rel=0.3)
    assert correlation_time(white)[0] == pytest.approx(1 / DEFAULT_NOISE.rate, rel=0.4)


def test_the_stated_deviation_makes_correlated_residuals_count_once():
    """The mean of K samples correlated over n varies like that of K white ones of sqrt(n) times the deviation."""
    white = np.random.default_rng(2).normal(size=(4000, 2)) * [0.3, 3.0]
    np.testing.assert_allclose(stated_deviation(white), [0.3, 3.0], rtol=0.25)
    averaged = np.stack([np.convolve(c, np.ones(10) / 10, "valid") for c in white.T], axis=1)
    np.testing.assert_allclose(stated_deviation(averaged), [0.3, 3.0], rtol=0.25)
    noise = estimate_noise(averaged[None, :30], minimum=0.01).stated(np.array([0.3, 3.0]))
    np.testing.assert_allclose(noise.weight, np.ones((30, 1)) / np.array([0.3, 3.0]))


def test_a_trend_over_the_repeats_is_removed_and_the_mean_is_not():
    rng = np.random.default_rng(5)
    rest, slope = rng.normal(size=(9, 4)), np.array([2.0, 0.0, -1.0, 30.0])
    with_trend = rest + (np.arange(9)[:, None] - 4.0) * slope
    np.testing.assert_allclose(detrend(with_trend), detrend(rest), atol=1e-12)
    np.testing.assert_allclose(detrend(with_trend).mean(axis=0), rest.mean(axis=0), atol=1e-12)
    seen = rng.uniform(size=(9, 4)) < 0.7
    found = detrend(np.where(seen, with_trend, 0.0), seen)
    for k in range(4):
        at = np.flatnonzero(seen[:, k])
        line = np.polynomial.Polynomial.fit(at, with_trend[at, k], 1)
        expected = with_trend[at, k] - line(at) + with_trend[at, k].mean()
        np.testing.assert_allclose(found[at, k], expected, atol=1e-10)


@pytest.mark.parametrize(("repeats", "forgiven"), [(10, True), (4, False)])
def test_a_trend_over_the_repeats_is_no_noise(repeats: int, forgiven: bool):
    """With few repeats a trend cannot be distinguished from chance."""
    rng = np.random.default_rng(6)
    calm = rng.normal(0, 0.1, (repeats, 200, 1))
    warming = calm + 0.5 * (np.arange(repeats) - (repeats - 1) / 2)[:, None, None]
    still, moving = (estimate_noise(r, minimum=1e-3).whitener[0] @ np.ones(200) for r in (calm, warming))
    assert bool(np.linalg.norm(moving) > 0.95 * np.linalg.norm(still)) is forgiven


def test_the_settings_reach_the_noise():
    """Each one changes the quantity that it describes."""
    rng = np.random.default_rng(7)
    white = rng.normal(0, 0.1, (6, 200, 1))
    averaged = white + np.roll(white, 1, axis=1)  # neighbours share half of their variance
    beside, none = (
        abs(w[1, 0] / w[1, 1])
        for config in (NoiseConfig(), NoiseConfig(longest_lag=0.0))
        for w in [estimate_noise(averaged, minimum=1e-3, config=config).whitener[0]]
    )
    assert none < 0.1 < 0.4 < beside
    flat = estimate_noise(averaged, minimum=1e-3, config=NoiseConfig(shrinkage=1.0)).whitener[0]
    assert abs(flat[1, 0] / flat[1, 1]) == pytest.approx(none)
    slow = lowpass(CLOCK, COARSE, NoiseConfig(cutoff=2.0)) @ np.sin(2 * np.pi * 4.0 * CLOCK)
    fast = lowpass(CLOCK, COARSE) @ np.sin(2 * np.pi * 4.0 * CLOCK)
    assert np.abs(slow[INSIDE]).max() < 0.1 < 0.9 < np.abs(fast[INSIDE]).max()
    assert len(coarse_clock(0.0, 2.0, 50.0)) == 101
    warming = white + 0.5 * np.arange(6)[:, None, None]
    told = estimate_noise(warming, minimum=1e-3, config=NoiseConfig(trend_repeats=7)).whitener[0] @ np.ones(200)
    assert np.linalg.norm(told) < 0.5 * np.linalg.norm(estimate_noise(warming, minimum=1e-3).whitener[0] @ np.ones(200))
    mask = np.ones((1, len(CLOCK), 1), bool)
    mask[:, : len(CLOCK) // 2] = False
    kernel = lowpass(CLOCK, COARSE)
    strict, lax = (np.isnan(smooth(np.ones(mask.shape), mask, kernel, least)).sum() for least in (0.9, 0.1))
    assert strict > lax


@pytest.mark.parametrize("gap", [0.05, 0.08, 0.12, 0.14, 0.16, 0.18, 0.5])
def test_gaps_of_a_clock_are_not_filled(gap: float):
    """A sinc's positive and negative parts nearly cancel over a gap; divided by their sum, noise becomes a spike."""
    clock = CLOCK[(CLOCK < 3.0) | (3.0 + gap < CLOCK)]
    rng = np.random.default_rng(3)
    values = 10.0 + 0.05 * rng.normal(size=(200, len(clock), 1))
    smoothed = smooth(values, np.ones(values.shape, bool), lowpass(clock, COARSE))
    seen = ~np.isnan(smoothed)
    assert np.abs(smoothed[seen] - 10.0).max() < 0.25
    assert seen.all() == (gap < 0.1)


def test_a_channel_of_a_slow_camera_is_refused_where_windows_cancel():
    for rate, coarse in ((7.5, True), (8.0, True), (9.0, False), (15.0, False)):
        clock = np.arange(0, 6.0, 1 / rate)
        if coarse:
            with pytest.raises(ValueError, match="too coarse to be smoothed"):
                lowpass(clock, coarse_clock(0.0, clock[-1]))
        else:
            kernel = lowpass(clock, coarse_clock(0.0, clock[-1])).toarray()
            assert np.abs(kernel).sum(axis=1).max() < 2.0
