"""The tests by sign flips of whole repeats and of blocks of time: their arithmetic, level and power."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.stats
from small_gap import largest_t

from droid_jax.cost.noise import DEFAULT_NOISE, coarse_clock
from droid_jax.discrepancy.candidates import ScoreDirection, ScoreTest, project, trend
from droid_jax.discrepancy.config import BlocksConfig
from droid_jax.discrepancy.statistics import (
    OUTSIDE,
    Blocks,
    Repeats,
    benjamini_hochberg,
    block_length,
    detrended,
    detrended_discrepancy_p_values,
    discrepancies,
    discrepancy,
    fewest_blocks,
    in_turns,
    interleaved,
    largest_detrended_t,
    largest_trend,
    one_sided_p,
    resample_weights,
    sign_flips,
    t_values,
)
from droid_jax.model.effects.candidate import Candidate, EffectKey
from droid_jax.recordings.split import FEWEST_REPEATS


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
    """1,000 draws of noise with 30 correlated directions each: p < 0.05 in about 5 of 100."""
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
    """3,000 draws of noise with 40 independent directions each; without the degree of freedom 6.5 % have p < 0.05."""
    rng = np.random.default_rng(5)
    noise = [rng.normal(size=(40, 10)) for _ in range(3000)]
    p, forgotten = (np.array([of(scores)[1] for scores in noise]) for of in (
        largest_detrended_t, lambda scores: largest_t(detrended(scores.T).T)
    ))  # fmt: skip
    assert np.mean(p < 0.01) < 0.0135 and 0.04 < np.mean(p < 0.05) < 0.058  # two deviations of the counts
    assert np.mean(forgotten < 0.05) > np.mean(p < 0.05) + 0.008


def test_the_largest_t_finds_a_common_part():
    rng = np.random.default_rng(2)
    scores = rng.normal(size=(30, 10))
    scores[17] += 4.0
    t, p = largest_t(scores)
    assert np.argmax(np.abs(t)) == 17
    assert p == pytest.approx(1 / 512)  # the smallest that ten repeats allow


def test_noise_does_not_bias_the_discrepancy():
    """U of noise is zero on average; U of a common part is its mean square for any noise."""
    rng = np.random.default_rng(3)
    common = rng.normal(0, 0.4, 200)
    none = [discrepancy(rng.normal(0, 3.0, (10, 200))) for _ in range(400)]
    there = [discrepancy(common + rng.normal(0, 3.0, (10, 200))) for _ in range(400)]
    assert np.mean(none) == pytest.approx(0.0, abs=4 * np.std(none) / 20)
    assert np.mean(there) == pytest.approx(np.mean(common**2), abs=4 * np.std(there) / 20)


def test_the_discrepancy_is_in_its_cell():
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
def test_a_small_discrepancy_is_found_and_noise_keeps_its_level(noisy: np.ndarray):
    """Removing the trend hides no U = 0.02, and p-values of noise stay uniform."""
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
    """A trend over the repeats is no scatter and changes nothing."""
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
    """A score test with given sensitivities [K, M]."""
    names = [f"effect{k}" for k in range(len(sensitivities))]
    directions = tuple(ScoreDirection(Candidate(n, "hinge", (f"{n}_size",), {}), f"{n}_size") for n in names)
    none = np.zeros(len(sensitivities))
    return ScoreTest(directions, sensitivities, sensitivities, none, none, none, 1.0)


@pytest.fixture
def sensitivities() -> np.ndarray:
    return 3.0 * np.random.default_rng(1).normal(size=(4, TREND_SIZE))


def test_the_slope_of_a_trend_is_that_of_its_candidate(sensitivities: np.ndarray):
    noise = np.random.default_rng(2).normal(size=(TREND_REPEATS, TREND_SIZE))
    rising = -0.02 * np.arange(TREND_REPEATS)[:, None] * sensitivities[2]
    found = trend(
        with_sensitivities(sensitivities), noise + rising + 5.0 * sensitivities[1]
    )  # a common part is no trend
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


# Blocks of time in place of repeats --------------------------------------------------------


def test_blocks_of_two_parts_alternate():
    clock = coarse_clock(0.0, 30.0)
    parts = interleaved(clock, 0.0, 20.0, 1.0, 2)
    assert parts.shape == (2, len(clock)) and parts.max() == 9
    assert np.all((parts[0] == OUTSIDE) | (parts[1] == OUTSIDE))
    assert np.all((parts.max(axis=0) == OUTSIDE) == (clock >= 20.0))
    for part in parts:
        for block in range(10):
            at = np.flatnonzero(part == block)
            assert np.all(np.diff(at) == 1) and len(at) >= 1.0 * DEFAULT_NOISE.rate - 1


def test_blocks_of_both_parts_are_numbered_in_order_of_time():
    clock = coarse_clock(0.0, 30.0)
    train, validation = interleaved(clock, 0.0, 20.0, 1.0, 2)
    both = in_turns([train, validation])
    assert np.all((both == OUTSIDE) == (clock >= 20.0)) and np.all(np.diff(both[both != OUTSIDE]) >= 0)
    for part in (train, validation):
        assert len({*both[part != OUTSIDE].tolist()}) == 10
        for block in range(10):
            assert len({*both[part == block].tolist()}) == 1
    assert both.max() == 19


@pytest.mark.parametrize(("share", "needed"), [(1.0, 32.0), (2 / 3, 48.0)])
def test_the_error_of_a_short_log_states_the_length_it_needs(share: float, needed: float):
    """A log of the stated length is long enough, also if a part of it is test data."""
    with pytest.raises(ValueError, match=f"record for {needed:g} s"):
        interleaved(coarse_clock(0.0, 30.0), 0.0, 20.0, 2.0, 2, share)
    clock = coarse_clock(0.0, needed)
    assert interleaved(clock, 0.0, share * needed + 1e-6, 2.0, 2, share).max() == 7
    with pytest.raises(ValueError, match=f"4 are needed .* record for {needed / 2:g} s"):
        interleaved(coarse_clock(0.0, 12.0), 0.0, 12.0, 2.0, 2, share, 4)


def test_fits_that_are_not_tested_have_as_few_blocks_as_allowed():
    clock = coarse_clock(0.0, 30.0)
    block = fewest_blocks(clock, 10.0)
    assert block.max() + 1 == FEWEST_REPEATS and np.all((block == OUTSIDE) == (clock < 10.0))


def test_blocks_are_longer_than_the_correlation():
    rng, config = np.random.default_rng(0), BlocksConfig()
    white = rng.normal(size=(4000, 1))
    slow = np.convolve(white[:, 0], np.ones(20))[:4000, None]  # correlated for one second
    assert block_length(white, config) == config.shortest == 0.5
    assert block_length(slow, config) == pytest.approx(1.5, rel=0.3)
    longer = BlocksConfig(correlation_times=3.0, shortest=0.7)
    assert block_length(slow, longer) == pytest.approx(2.0 * block_length(slow, config))
    assert block_length(white, longer) == 0.7


COLUMNS = 2


def made_blocks(count: int = 8, size: int = 25, columns: int = COLUMNS) -> Blocks:
    """Blocks with a tail that belongs to none."""
    return Blocks(np.tile(np.r_[np.repeat(np.arange(count), size), np.full(10, OUTSIDE)], columns))


def test_rows_are_blocks_and_their_mean_the_residual():
    made, rng = made_blocks(), np.random.default_rng(1)
    common = rng.normal(size=len(made.block))
    rows = made.residuals(common)
    inside = made.block != OUTSIDE
    np.testing.assert_array_equal(made.counted, inside)
    np.testing.assert_allclose(rows.mean(axis=0), np.where(inside, common, 0.0))
    assert not made.repeated and made.units == len(rows) == 8 and made.size == inside.sum()
    assert made.discrepancy(rows) == pytest.approx(np.mean(common[inside] ** 2))
    first = np.arange(len(common)) < len(common) // COLUMNS
    np.testing.assert_allclose(made.discrepancies(rows, first[None]), np.mean(common[inside & first] ** 2))
    np.testing.assert_array_equal(made.cell_p_values(rows, first[None]), [1.0])
    losses = made.losses(np.stack([common, 2 * common]), np.full((1, 8), 1 / 8))
    np.testing.assert_allclose(losses[0], np.sum(common[inside] ** 2) * np.array([1.0, 4.0]))
    draws = resample_weights(8, draws=400, seed=0)
    by_hand = draws @ [8 * np.sum(common[made.block == b] ** 2) for b in range(8)]
    np.testing.assert_allclose(made.losses(common[None], draws)[:, 0], by_hand)


# Level and power of the test ---------------------------------------------------------------


def p_values(count: int, present: float) -> np.ndarray:
    """[count, 2] p-values after a fit of 24 smooth columns: of blocks, and of plain flips.

    present: how much of one of the 30 sensitivities the data hold.
    """
    made, rng = made_blocks(columns=1), np.random.default_rng(2)
    inside, out = made.block != OUTSIDE, []
    prior = np.full(24, 10.0)
    for _ in range(count):
        base = rng.normal(size=(len(inside), 24)) * inside[:, None]
        raw = rng.normal(size=(30, len(inside))) * inside * rng.gamma(0.5, size=9)[made.block]
        noise = (present * raw[0] + rng.normal(size=len(inside))) * inside
        left, projected = project(noise[None], base, prior)[0], project(raw, base, prior)
        scores = projected @ made.residuals(left).T
        out.append((made.largest_score(scores, projected, base, prior)[1], largest_t(scores)[1]))
    return np.array(out)


def test_blocks_keep_their_level_after_a_fit():
    p = p_values(400, 0.0)
    assert np.mean(p[:, 0] < 0.05) < 0.08


def test_an_effect_in_few_blocks_is_found():
    """Student's t of such blocks does not grow with the effect; the standardised score does."""
    p = p_values(40, 3.0)
    assert np.mean(p[:, 0] < 0.01) > 0.8
    assert np.mean(p[:, 1] < 0.01) < 0.5
