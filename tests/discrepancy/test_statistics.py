"""Sign flips of whole repeats: exact where all are tried, no rejection where nothing is there; trends over repeats."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.stats
from small_gap import largest_t

from droid_jax.discrepancy.candidates import ScoreDirection, ScoreTest, trend
from droid_jax.discrepancy.statistics import (
    Repeats,
    benjamini_hochberg,
    detrended,
    detrended_discrepancy_p_values,
    discrepancies,
    discrepancy,
    largest_detrended_t,
    largest_trend,
    one_sided_p,
    resample_weights,
    sign_flips,
    t_values,
)
from droid_jax.model.effects.candidate import Candidate, EffectKey


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
    """1,000 times nothing, 30 correlated directions each: p < 0.05 in about 5 of 100."""
    rng = np.random.default_rng(1)
    mixing = rng.normal(size=(30, 10))
    p = [largest_t(mixing @ rng.normal(size=(10, 8)))[1] for _ in range(1000)]
    assert 0.03 < np.mean(np.array(p) < 0.05) < 0.07


def test_a_trend_changes_no_largest_t():
    scores = np.random.default_rng(5).normal(size=(40, 10))
    trend = 5.0 * (np.arange(10) - 4.5)
    assert largest_detrended_t(scores + trend)[1] == pytest.approx(largest_detrended_t(scores)[1])
    assert largest_t(scores + trend)[1] > 2 * largest_t(scores)[1]
    assert largest_detrended_t(np.tile(np.r_[np.ones(7), 1.1], (2, 1)))[1] == pytest.approx(1 / 128)  # eight can reject


@pytest.mark.slow
def test_without_a_trend_the_largest_t_keeps_its_level():
    """3,000 times nothing, 40 independent directions each; with the degree of freedom forgotten 6.5 % lie below."""
    rng = np.random.default_rng(5)
    noise = [rng.normal(size=(40, 10)) for _ in range(3000)]
    p, forgotten = (np.array([of(scores)[1] for scores in noise]) for of in (
        largest_detrended_t, lambda scores: largest_t(detrended(scores.T).T)
    ))  # fmt: skip
    assert np.mean(p < 0.01) < 0.0135 and 0.04 < np.mean(p < 0.05) < 0.058  # two deviations of the counts
    assert np.mean(forgotten < 0.05) > np.mean(p < 0.05) + 0.008


def test_the_largest_t_finds_what_is_there():
    rng = np.random.default_rng(2)
    scores = rng.normal(size=(30, 10))
    scores[17] += 4.0
    t, p = largest_t(scores)
    assert np.argmax(np.abs(t)) == 17
    assert p == pytest.approx(1 / 512)  # the smallest that ten repeats allow


def test_noise_does_not_bias_the_discrepancy():
    """U of pure noise is zero on average; of a common part it is that part's mean square, whatever the noise."""
    rng = np.random.default_rng(3)
    common = rng.normal(0, 0.4, 200)
    none = [discrepancy(rng.normal(0, 3.0, (10, 200))) for _ in range(400)]
    there = [discrepancy(common + rng.normal(0, 3.0, (10, 200))) for _ in range(400)]
    assert np.mean(none) == pytest.approx(0.0, abs=4 * np.std(none) / 20)
    assert np.mean(there) == pytest.approx(np.mean(common**2), abs=4 * np.std(there) / 20)


def test_the_discrepancy_lies_where_it_was_put():
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
def test_a_small_discrepancy_everywhere_is_found_and_nothing_keeps_its_level(noisy: np.ndarray):
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


def test_one_sided_p():
    assert one_sided_p(np.full(10, 2.0) + np.linspace(-0.1, 0.1, 10)) == pytest.approx(1 / 1024)
    unlike = np.array([1.0, 1.1, 0.9, 1.0, 1.2, 0.8, 1.0, -10.0])
    assert one_sided_p(unlike) == one_sided_p(unlike[::-1]) > 0.4  # whichever repeat it is
    assert one_sided_p(-np.arange(1.0, 11.0)) > 0.9
    assert one_sided_p(np.full(10, 1.0)) < 0.01 < 0.3 < one_sided_p(np.array([1.0, -1.0] * 5))


def test_resample_weights_draw_repeats_with_replacement():
    weights = resample_weights(8, draws=500, seed=3)
    assert weights.shape == (500, 8) and np.all(np.isclose(weights * 8, np.round(weights * 8)))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_array_equal(weights, resample_weights(8, draws=500, seed=3))
    assert np.mean(weights == 0) == pytest.approx((7 / 8) ** 8, abs=0.03)


def test_resampled_losses_are_the_squared_means_of_resamples():
    """What grows or fades steadily over the repeats is no scatter, as everywhere else: a trend changes nothing."""
    rng, count = np.random.default_rng(7), 10
    commons, deviations = rng.normal(size=(2, 30)), rng.normal(size=(count, 30))
    deviations -= deviations.mean(axis=0)
    draws = resample_weights(count, draws=400, seed=8)
    losses = Repeats(deviations).losses(commons, draws)
    expected = np.sum((commons[:, None] + draws @ detrended(deviations)) ** 2, axis=2).T
    np.testing.assert_allclose(losses[:, 0] - losses[:, 1], expected[:, 0] - expected[:, 1])
    trend = np.linspace(-3.0, 3.0, count)[:, None] * rng.normal(size=30)
    np.testing.assert_allclose(Repeats(deviations + trend).losses(commons, draws), losses)


def test_repeats_are_their_common_part_and_their_deviations():
    rng = np.random.default_rng(8)
    deviations, common = rng.normal(size=(8, 30)), rng.normal(size=30)
    deviations -= deviations.mean(axis=0)
    made = Repeats(deviations)
    rows = made.residuals(common)
    assert made.repeated and (made.units, made.size) == (8, 240) and made.counted.all() and len(made.counted) == 30
    np.testing.assert_allclose(rows.mean(axis=0), common)
    assert made.discrepancy(rows) == discrepancy(detrended(rows))
    cells = np.arange(30) < np.array([[10], [30]])
    np.testing.assert_array_equal(made.discrepancies(rows, cells), discrepancies(detrended(rows), cells))
    np.testing.assert_array_equal(made.cell_p_values(rows, cells), detrended_discrepancy_p_values(rows, cells))


def test_the_largest_trend_is_found_with_its_sign_and_size():
    rng = np.random.default_rng(9)
    scores = rng.normal(size=(6, 10))
    scores[4] -= 2.0 * np.arange(10)
    best, slope, p = largest_trend(scores)
    assert best == 4 and slope == pytest.approx(np.polyfit(np.arange(10), scores[4], 1)[0]) and p < 0.001
    assert largest_trend(scores[:4])[2] > 0.05


# Candidates as directions -------------------------------------------------------------------

TREND_REPEATS, TREND_SIZE = 10, 400


def with_sensitivities(sensitivities: np.ndarray) -> ScoreTest:
    """A score test with these sensitivities [K, M] and nothing else."""
    names = [f"effect{k}" for k in range(len(sensitivities))]
    directions = tuple(ScoreDirection(Candidate(n, "hinge", (f"{n}_size",), {}), f"{n}_size") for n in names)
    none = np.zeros(len(sensitivities))
    return ScoreTest(directions, sensitivities, sensitivities, none, none, none, 1.0)


@pytest.fixture
def sensitivities() -> np.ndarray:
    return 3.0 * np.random.default_rng(1).normal(size=(4, TREND_SIZE))


def test_the_slope_that_was_put_in_is_that_of_its_candidate(sensitivities: np.ndarray):
    noise = np.random.default_rng(2).normal(size=(TREND_REPEATS, TREND_SIZE))
    rising = -0.02 * np.arange(TREND_REPEATS)[:, None] * sensitivities[2]
    found = trend(
        with_sensitivities(sensitivities), noise + rising + 5.0 * sensitivities[1]
    )  # what repeats share is no trend
    assert found is not None
    assert (found.key, found.coefficient) == (EffectKey("effect2", "hinge"), "effect2_size")
    assert found.per_repeat == pytest.approx(-0.02, abs=3 / (np.linalg.norm(sensitivities[2]) * np.sqrt(82.5)))
    assert found.p < 0.001


def test_without_a_trend_the_p_value_is_uniform(sensitivities: np.ndarray):
    rng = np.random.default_rng(3)
    found = [
        trend(with_sensitivities(sensitivities), rng.normal(size=(TREND_REPEATS, TREND_SIZE)), seed=k)
        for k in range(200)
    ]
    assert scipy.stats.kstest([t.p for t in found if t is not None], "uniform").pvalue > 0.01
    assert None not in found


def test_two_repeats_or_no_candidate_have_no_trend(sensitivities: np.ndarray):
    assert trend(with_sensitivities(sensitivities), np.zeros((2, TREND_SIZE))) is None
    assert trend(with_sensitivities(sensitivities[:0]), np.zeros((TREND_REPEATS, TREND_SIZE))) is None
