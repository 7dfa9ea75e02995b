"""Blocks of time in place of repeats: the arithmetic, and the level and power of their test."""

from __future__ import annotations

import numpy as np
import pytest
from small_gap import largest_t

from droid_jax.cost.noise import DEFAULT_NOISE, coarse_clock
from droid_jax.discrepancy.candidates import project
from droid_jax.discrepancy.config import BlocksConfig
from droid_jax.discrepancy.statistics import (
    OUTSIDE,
    Blocks,
    block_length,
    fewest_blocks,
    in_turns,
    interleaved,
    resample_weights,
)
from droid_jax.recordings.split import FEWEST_REPEATS

# Arithmetic --------------------------------------------------------------------------------


def test_parts_take_turns():
    clock = coarse_clock(0.0, 30.0)
    parts = interleaved(clock, 0.0, 20.0, 1.0, 2)
    assert parts.shape == (2, len(clock)) and parts.max() == 9
    assert np.all((parts[0] == OUTSIDE) | (parts[1] == OUTSIDE))
    assert np.all((parts.max(axis=0) == OUTSIDE) == (clock >= 20.0))
    for part in parts:
        for block in range(10):
            at = np.flatnonzero(part == block)
            assert np.all(np.diff(at) == 1) and len(at) >= 1.0 * DEFAULT_NOISE.rate - 1


def test_the_blocks_of_both_parts_are_numbered_as_they_come():
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
def test_too_short_a_log_says_how_long_it_should_be(share: float, needed: float):
    """A log of that length is long enough, where the rest of it is test data too."""
    with pytest.raises(ValueError, match=f"record for {needed:g} s"):
        interleaved(coarse_clock(0.0, 30.0), 0.0, 20.0, 2.0, 2, share)
    clock = coarse_clock(0.0, needed)
    assert interleaved(clock, 0.0, share * needed + 1e-6, 2.0, 2, share).max() == 7
    with pytest.raises(ValueError, match=f"4 are needed .* record for {needed / 2:g} s"):
        interleaved(coarse_clock(0.0, 12.0), 0.0, 12.0, 2.0, 2, share, 4)


def test_what_is_not_tested_has_as_few_blocks_as_there_may_be():
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
    """With a tail that belongs to no block."""
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


def test_an_effect_that_lives_in_few_blocks_is_found():
    """Student's t of uneven blocks does not grow with the effect; the standardised score does."""
    p = p_values(40, 3.0)
    assert np.mean(p[:, 0] < 0.01) > 0.8
    assert np.mean(p[:, 1] < 0.01) < 0.5
