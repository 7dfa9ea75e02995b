"""Blocks of time in place of repeats: the arithmetic, the level of their test, and a search in one small log."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plain_flips import largest_t
from small_log import ASKED, CONFIG, COULOMB, elbow, elbow_log, elbow_space

from droid_jax.cost.cost import make_cost
from droid_jax.cost.lone_log import LoneLog
from droid_jax.cost.noise import DEFAULT_NOISE, coarse_clock
from droid_jax.discrepancy import single
from droid_jax.discrepancy.candidates import project
from droid_jax.discrepancy.case import base_model, make_case, make_log, single_case
from droid_jax.discrepancy.residual_set import block_residual_set
from droid_jax.discrepancy.search import search_effects
from droid_jax.discrepancy.statistics import OUTSIDE, Blocks, block_length, interleaved, resample_weights
from droid_jax.discrepancy.verdict import Conclusion
from droid_jax.model.effects.registry import library, ready
from droid_jax.model.parameters import Space
from droid_jax.recordings.recording import Recording

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


@pytest.mark.parametrize(("share", "needed"), [(1.0, 32.0), (2 / 3, 48.0)])
def test_too_short_a_log_says_how_long_it_should_be(share: float, needed: float):
    """A log of that length is long enough, where the rest of it is sealed too."""
    with pytest.raises(ValueError, match=f"record for {needed:g} s"):
        interleaved(coarse_clock(0.0, 30.0), 0.0, 20.0, 2.0, 2, share)
    clock = coarse_clock(0.0, needed)
    assert interleaved(clock, 0.0, share * needed + 1e-6, 2.0, 2, share).max() == 7


def test_blocks_are_longer_than_the_correlation():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(4000, 1))
    slow = np.convolve(white[:, 0], np.ones(20))[:4000, None]  # correlated for one second
    assert block_length(white) == 0.5
    assert block_length(slow) == pytest.approx(1.5, rel=0.3)


def made_blocks(count: int = 8, size: int = 25, columns: int = 2) -> Blocks:
    """Blocks without a recording, with a tail that belongs to no block."""
    block = np.r_[np.repeat(np.arange(count), size), np.full(10, OUTSIDE)]
    whole = np.tile(block, columns)
    column = np.repeat(np.arange(columns), len(block))
    return Blocks(None, np.zeros((1, len(whole))), column, np.zeros(len(whole)), whole)  # pyright: ignore


def test_rows_are_blocks_and_their_mean_the_residual():
    made, rng = made_blocks(), np.random.default_rng(1)
    common = rng.normal(size=len(made.block))
    rows = made.residuals(common)
    inside = made.block != OUTSIDE
    np.testing.assert_allclose(rows.mean(axis=0), np.where(inside, common, 0.0))
    assert made.repeats == 1 and made.units == len(rows) == 8
    assert made.discrepancy(rows) == pytest.approx(np.mean(common[inside] ** 2))
    first = made.column == 0
    np.testing.assert_allclose(made.discrepancies(rows, first[None]), np.mean(common[inside & first] ** 2))
    np.testing.assert_array_equal(made.cell_p_values(rows, first[None]), [1.0])
    losses = made.losses(np.stack([common, 2 * common]), np.full((1, 8), 1 / 8))
    np.testing.assert_allclose(losses[0], np.sum(common[inside] ** 2) * np.array([1.0, 4.0]))
    draws = resample_weights(8, seed=0)
    by_hand = draws @ [8 * np.sum(common[made.block == b] ** 2) for b in range(8)]
    np.testing.assert_allclose(made.losses(common[None], draws)[:, 0], by_hand)


# Level and power of the test ---------------------------------------------------------------


def p_values(count: int, present: float) -> np.ndarray:
    """[count, 2] p-values of blocks and of plain flips after a fit of 24 smooth columns, one of 30 marks `present`."""
    made, rng = made_blocks(columns=1), np.random.default_rng(2)
    inside, out = made.block != OUTSIDE, []
    prior = np.full(24, 10.0)
    for _ in range(count):
        base = rng.normal(size=(len(inside), 24)) * inside[:, None]
        marks = rng.normal(size=(30, len(inside))) * inside * rng.gamma(0.5, size=9)[made.block]
        noise = (present * marks[0] + rng.normal(size=len(inside))) * inside
        left, projected = project(noise[None], base, prior)[0], project(marks, base, prior)
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


# One log -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log() -> LoneLog:
    scene = elbow()
    return make_log(scene, elbow_space(scene), library(scene, ASKED), elbow_log(COULOMB), CONFIG)


def test_a_log_is_whitened_as_its_cost_would(log: LoneLog):
    scene = elbow()
    cost = make_cost(ready(scene), elbow_space(scene), [elbow_log(COULOMB)], config=CONFIG.compare)
    values = elbow_space(scene).mean
    whole = log.space.mean
    restated = cost.restated(values)
    deviation = 1 / restated.comparisons[0].channel("torque").noise.whitener[0, 0, 0]
    everywhere = np.ones(len(log.clock), bool)
    stated = log.with_noise(np.array([deviation]), everywhere)
    np.testing.assert_allclose(stated.whitened(whole[None]), restated.whitened(values[None]), atol=1e-3)
    some = log.clock < 5.0
    np.testing.assert_array_equal(log.with_noise(np.ones(1), some).whitened(whole[None])[0] == 0, ~some)
    held = log.with_torques(log.simulated(whole[None])[0])
    np.testing.assert_allclose(held.residual_torque(whole), 0.0, atol=1e-9)


def test_dry_friction_is_found_in_one_log(log: LoneLog):
    scene = elbow()
    effects, base = library(scene, ASKED), elbow_space(scene)
    case = single_case(log, base, effects, config=CONFIG)
    assert case.train.units == case.validation.units >= 8
    assert not np.any((case.train.block >= 0) & (case.validation.block >= 0))  # pyright: ignore
    verdict = search_effects(case, base_model(case), 0.0)
    assert verdict.kind is Conclusion.NAMED and verdict.effects == ("joint_coulomb at elbow",)
    at = case.full_space.index("joint_coulomb[elbow]")
    assert verdict.model.values[at] == pytest.approx(COULOMB, rel=0.1)
    before, after = verdict.discrepancies["test"]
    assert after < 0.1 * before
    assert all(cell.p == 1.0 and not cell.found for cell in verdict.before.cells)


def test_nothing_is_said_where_nothing_is_missing(log: LoneLog):
    scene = elbow()
    effects, base = library(scene, ASKED), elbow_space(scene)
    case = single_case(log.with_torques(elbow_torque(log)), base, effects, config=CONFIG)
    assert search_effects(case, base_model(case), 0.0).kind is Conclusion.NONE


def elbow_torque(log: LoneLog) -> np.ndarray:
    """[K, 1] what the log would hold without its dry friction."""
    values = np.stack([log.space.mean, log.space.values({"joint_coulomb[elbow]": COULOMB})])
    without, with_it = log.simulated(values)
    return log.measured - (with_it - without)


def test_each_joint_of_a_sealed_log_has_its_own_noise(monkeypatch: pytest.MonkeyPatch):
    """Whatever the order of its columns."""
    given: dict[str, np.ndarray] = {}
    clock = np.arange(0.0, 40.0, 0.02)

    def synthetic_robot(name: str, *columns: int) -> Any:
        return SimpleNamespace(
            name=name, clock=clock, columns=list(columns), part=lambda turn: synthetic_robot(turn, *columns)
        )

    monkeypatch.setattr(single, "noise_of", lambda *_: (np.array([1.0, 2.0]), 1.0))
    monkeypatch.setattr(single, "only_comparison", lambda log: log)
    monkeypatch.setattr(single, "_blocks", lambda log, deviation, block: given.update({log.name: deviation}))
    single_case(synthetic_robot("log", 0, 1), elbow_space(elbow()), (), synthetic_robot("test", 1, 0))
    assert {name: noise.tolist() for name, noise in given.items()} == {
        "log, every other block": [1.0, 2.0],
        "log, the blocks between": [1.0, 2.0],
        "test": [2.0, 1.0],
    }


def offset_by(recording: Recording, torque: float, name: str) -> Recording:
    """A recording whose torque sensor shows so much more at rest."""
    channel = recording.channel("torque")
    shifted = replace(channel, values=channel.values + torque)
    return replace(recording, name=name, channels={**recording.channels, "torque": shifted})


@pytest.mark.parametrize("off", [0.0, 0.4, 3.0])
def test_a_sealed_log_has_torque_offsets_of_its_own(off: float):
    """Zeroed on another day, by 0 to 10 deviations of the offset's prior: what is sealed then shows no more than noise.

    As on recordings with repeats, however far off it is; the model that explains the rest stays as it is.
    """
    scene = elbow()
    damping, offset = elbow_space(scene).parameters
    base = Space((damping, replace(offset, nuisance=True)))
    effects, log = library(scene, ["joint_coulomb"]), elbow_log(COULOMB)
    other = offset_by(elbow_log(COULOMB, 30.0), off, "another day")
    logs = [make_log(scene, base, effects, each, CONFIG) for each in (log, other)]
    case = single_case(logs[0], base, effects, logs[1], CONFIG)
    assert (
        case.test is not None and case.test.nuisances == ("torque_offset[elbow]",) and case.validation.nuisances == ()
    )
    truth = case.full_space.values({"elbow_damping": 0.6, "torque_offset[elbow]": 0.1, "joint_coulomb[elbow]": COULOMB})
    least = case.validation.discrepancy_at(truth)
    assert case.test.discrepancy_at(truth) == pytest.approx(least, rel=0.3)
    best = case.test.at_best_nuisances(truth)[0]
    assert best[case.full_space.index("torque_offset[elbow]")] == pytest.approx(0.1 + off, abs=0.03)
    assert single_case(logs[0], base, effects, None, CONFIG).test.nuisances == ()  # pyright: ignore
    if off:
        assert replace(case.test, nuisances=(), nuisance_columns=None).discrepancy_at(truth) > 2.0 * least


def test_repeats_need_no_blocks():
    scene = elbow()
    with pytest.raises(ValueError, match="'elbow' has 2 repeats: use make_case"):
        make_log(scene, elbow_space(scene), library(scene, ASKED), elbow_log(COULOMB, 8.0, 2), CONFIG)
    few = {"train": elbow_log(COULOMB, 8.0, 5), "validation": replace(elbow_log(COULOMB, 9.0, 5), name="other")}
    with pytest.raises(ValueError, match="recordings elbow, other: at least 8 repeats are needed"):
        make_case(scene, elbow_space(scene), library(scene, ASKED), **few, config=CONFIG)


def test_too_few_blocks_are_refused(log: LoneLog):
    with pytest.raises(ValueError, match="3 blocks, at least 8"):
        block_residual_set(log, np.minimum(np.arange(len(log.clock)) // 100, 2))
