"""Nothing missing in a model that is linear by construction: the score test's p-values are what p-values should be."""

from __future__ import annotations

import numpy as np
import pytest

from droid_jax.cost.noise import DEFAULT_NOISE, estimate_noise
from droid_jax.discrepancy.candidates import project
from droid_jax.discrepancy.statistics import largest_detrended_t

REPEATS, LENGTH, CASES = 10, 160, 500


def smooth_curves(rng: np.random.Generator, count: int) -> np.ndarray:
    """[LENGTH, count] of slow random waves, as parameters change a torque."""
    time = np.arange(LENGTH) / DEFAULT_NOISE.rate
    rates, starts = rng.uniform(0.05, 1.5, (6, count)), rng.uniform(0, 2 * np.pi, (6, count))
    return np.sin(2 * np.pi * rates * time[:, None, None] + starts).sum(axis=1)


def sensor_noise(rng: np.random.Generator) -> np.ndarray:
    """[REPEATS, LENGTH]: white, and of first order with 0.15 s, alike in size."""
    keep = np.exp(-1 / DEFAULT_NOISE.rate / 0.15)
    slow = rng.normal(size=(REPEATS, LENGTH))
    for k in range(1, LENGTH):
        slow[:, k] = keep * slow[:, k - 1] + np.sqrt(1 - keep**2) * slow[:, k]
    return slow + rng.normal(size=(REPEATS, LENGTH))


def case(seed: int, missing: float, drift: float = 0.0) -> tuple[float, int]:
    """The score test's p, and the largest of twelve directions; the third is there, `missing` of it.

    drift: by which every repeat lies above the one before it.
    """
    rng = np.random.default_rng(seed)
    base, raw = smooth_curves(rng, 5), smooth_curves(rng, 12)
    prior = np.full(5, 10.0)  # far wider than what the data leave
    raw = raw - base @ np.linalg.lstsq(base, raw, rcond=None)[0]
    repeats = sensor_noise(rng) + missing * raw[:, 2]
    if drift:
        repeats += drift * (np.arange(REPEATS)[:, None] - (REPEATS - 1) / 2)
    noise = estimate_noise(repeats[:, :, None], minimum=1e-3)
    of_repeat = noise.whitener[0] / np.sqrt(REPEATS)
    columns, projected = of_repeat @ base, project((of_repeat @ raw).T, of_repeat @ base, prior)
    residuals = noise.repeats[:, :, 0] @ of_repeat.T
    common = residuals.mean(axis=0)
    weights = columns.T @ columns + np.diag(prior**-2) / REPEATS
    residuals = residuals - columns @ np.linalg.solve(weights, columns.T @ common)
    t, p = largest_detrended_t(projected @ residuals.T)
    return p, int(np.argmax(np.abs(t)))


@pytest.fixture(scope="module")
def nothing() -> np.ndarray:
    """[CASES] p-values where nothing is missing."""
    return np.array([case(seed, 0.0)[0] for seed in range(CASES)])


@pytest.mark.slow
@pytest.mark.parametrize(("level", "width"), [(0.05, 0.02), (0.25, 0.04), (0.5, 0.045)])
def test_where_nothing_is_missing_p_values_are_uniform(nothing: np.ndarray, level: float, width: float):
    """Two standard deviations of the counts; with all lags as they are estimated 31 % of 1,000 lay below 0.25."""
    assert np.mean(nothing < level) == pytest.approx(level, abs=width)


@pytest.mark.slow
def test_what_is_missing_is_found():
    found = [case(seed, 0.3) for seed in range(100)]
    assert np.mean([p < 0.01 and best == 2 for p, best in found]) > 0.9


@pytest.mark.slow
def test_a_sensor_that_warms_up_from_repeat_to_repeat_hides_nothing():
    """Its drift is no noise: all that is found without it is found with it, and nothing is found where nothing is."""
    found = [case(seed, 0.3, drift=1.0) for seed in range(100)]
    assert np.mean([p < 0.01 and best == 2 for p, best in found]) > 0.9
    assert np.mean([case(seed, 0.0, drift=1.0)[0] < 0.05 for seed in range(200)]) < 0.1
