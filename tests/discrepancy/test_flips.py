"""Sign flips of whole repeats: exact where all are tried, silent where nothing is there."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.stats
from plain_flips import largest_t

from droid_jax.discrepancy.statistics import (
    benjamini_hochberg,
    detrended,
    detrended_discrepancy_p_values,
    discrepancies,
    discrepancy,
    largest_detrended_t,
    sign_flips,
    t_values,
)


def test_all_flips_up_to_twelve_repeats():
    flips = sign_flips(5)
    assert flips.shape == (16, 5) and np.all(flips[0] == 1)
    both = {tuple(row) for row in np.concatenate([flips, -flips])}
    assert both == set(itertools.product((-1.0, 1.0), repeat=5))
    assert {tuple(row) for row in sign_flips(5, one_sided=True)} == both
    drawn = sign_flips(20, seed=3)
    assert np.all(drawn[0] == 1) and set(np.unique(drawn)) == {-1.0, 1.0}
    np.testing.assert_array_equal(drawn, sign_flips(20, seed=3))


def test_the_unflipped_t_is_students():
    scores = np.random.default_rng(0).normal(0.3, 1.0, (7, 9))
    np.testing.assert_allclose(
        t_values(scores, sign_flips(9))[0], scipy.stats.ttest_1samp(scores, 0.0, axis=1).statistic
    )


def test_the_largest_t_keeps_its_level():
    """1,000 times nothing, 30 correlated questions each: p < 0.05 in about 5 of 100."""
    rng = np.random.default_rng(1)
    mixing = rng.normal(size=(30, 10))
    p = [largest_t(mixing @ rng.normal(size=(10, 8)))[1] for _ in range(1000)]
    assert 0.03 < np.mean(np.array(p) < 0.05) < 0.07


def test_without_a_trend_the_largest_t_keeps_its_level():
    """3,000 times nothing, 40 independent questions each; with the degree of freedom forgotten 6.5 % lie below 0.05."""
    rng = np.random.default_rng(5)
    noise = [rng.normal(size=(40, 10)) for _ in range(3000)]
    p, forgotten = (np.array([of(scores)[1] for scores in noise]) for of in (
        largest_detrended_t, lambda scores: largest_t(detrended(scores.T).T)
    ))  # fmt: skip
    assert np.mean(p < 0.01) < 0.0135 and 0.04 < np.mean(p < 0.05) < 0.058  # two deviations of the counts
    assert np.mean(forgotten < 0.05) > np.mean(p < 0.05) + 0.008
    trend = 5.0 * (np.arange(10) - 4.5)
    assert largest_detrended_t(noise[0] + trend)[1] == pytest.approx(p[0])
    assert largest_detrended_t(np.tile(np.r_[np.ones(7), 1.1], (2, 1)))[1] == pytest.approx(1 / 128)  # eight can reject


def test_the_largest_t_finds_what_is_there():
    rng = np.random.default_rng(2)
    scores = rng.normal(size=(30, 10))
    scores[17] += 4.0
    t, p = largest_t(scores)
    assert np.argmax(np.abs(t)) == 17
    assert p == pytest.approx(1 / 512)  # the smallest that ten repeats allow


def test_noise_does_not_bias_the_gap():
    """U of pure noise is zero on average; of a common part it is that part's mean square, whatever the noise."""
    rng = np.random.default_rng(3)
    common = rng.normal(0, 0.4, 200)
    none = [discrepancy(rng.normal(0, 3.0, (10, 200))) for _ in range(400)]
    there = [discrepancy(common + rng.normal(0, 3.0, (10, 200))) for _ in range(400)]
    assert np.mean(none) == pytest.approx(0.0, abs=4 * np.std(none) / 20)
    assert np.mean(there) == pytest.approx(np.mean(common**2), abs=4 * np.std(there) / 20)


def test_the_gap_lies_where_it_was_put():
    rng = np.random.default_rng(4)
    residuals = rng.normal(size=(10, 300))
    residuals[:, 100:150] += 1.0
    cells = np.zeros((6, 300), bool)
    for k in range(6):
        cells[k, 50 * k : 50 * (k + 1)] = True
    p = detrended_discrepancy_p_values(residuals, cells)
    assert p[2] == pytest.approx(1 / 512)
    assert np.argmax(discrepancies(residuals, cells)) == 2
    np.testing.assert_array_equal(benjamini_hochberg(p, 0.02), np.arange(6) == 2)


@pytest.mark.parametrize("noisy", [np.ones(8), np.r_[1.3, np.ones(7)], np.linspace(0.8, 1.2, 8)[::-1]])
def test_a_small_gap_everywhere_is_found_and_nothing_keeps_its_level(noisy: np.ndarray):
    """What was taken out with the trend must not hide U = 0.02, nor make p of noise anything but uniform."""
    rng, cell = np.random.default_rng(6), np.ones((1, 1400), bool)
    drift = 3.0 * (np.arange(8) - 3.5)[:, None]
    none, there = (
        np.array([
            detrended_discrepancy_p_values(np.sqrt(u) + noisy[:, None] * rng.normal(size=(8, 1400)) + drift, cell)[0]
            for _ in range(400)
        ])
        for u in (0.0, 0.02)
    )  # fmt: skip
    assert np.mean(none < 0.01) < 0.03 and np.mean(none < 0.05) < 0.08
    assert np.mean(there < 0.01) > 0.5


def test_benjamini_hochberg_steps_up():
    """By hand: the largest k with p_(k) <= level k / K, and everything below it."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        p = rng.uniform(size=12) ** 3
        passed = [k for k, value in enumerate(np.sort(p), start=1) if value <= 0.1 * k / 12]
        expected = p <= (np.sort(p)[max(passed) - 1] if passed else -1.0)
        np.testing.assert_array_equal(benjamini_hochberg(p, 0.1), expected)
    assert not benjamini_hochberg(np.ones(4), 0.1).any()
