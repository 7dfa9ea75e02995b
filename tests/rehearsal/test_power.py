"""Sizes that a rehearsal predicts, against the search's own tests on drawn residuals of a linear model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from droid_jax.discrepancy.candidates import ScoreDirection, project
from droid_jax.discrepancy.config import DiscrepancyConfig, SelectionConfig
from droid_jax.discrepancy.statistics import Blocks, Repeats, Resampling, one_sided_p
from droid_jax.model.effects.candidate import Candidate
from droid_jax.rehearsal.linear import LinearModel, LinearPart, RehearsalConfig, rivals_of
from droid_jax.rehearsal.power import smallest_sizes

REPEATS, LENGTH, DIRECTIONS, BASE = 10, 160, 12, 4
CONFIG, CASES = RehearsalConfig(draws=64), 60
WIDE = np.full(BASE, 10.0)


def waves(rng: np.random.Generator, count: int) -> np.ndarray:
    """[count, LENGTH] of slow random waves, as parameters change a torque."""
    time = np.arange(LENGTH) / 20.0
    rates, starts = rng.uniform(0.05, 1.5, (5, count, 1)), rng.uniform(0, 2 * np.pi, (5, count, 1))
    return np.sin(2 * np.pi * rates * time + starts).sum(axis=0)


def directions(count: int) -> tuple[ScoreDirection, ...]:
    return tuple(ScoreDirection(Candidate(f"effect{k}", "joint", (f"c{k}",)), f"c{k}") for k in range(count))


def linear(rows: Resampling, level: float = 0.0, repeats: int = 1, **changes) -> LinearModel:
    rng = np.random.default_rng(3)
    raw, base, channel = waves(rng, DIRECTIONS), waves(rng, BASE).T, np.full(LENGTH, "torque")
    part = LinearPart(raw, base, rows, channel, level)
    usual = dict(
        directions=directions(DIRECTIONS), train=part, validation=part, prior=WIDE, slack=3.0, repeats=repeats,
        step_error=0.0, minimum=np.zeros(DIRECTIONS), low=np.full(DIRECTIONS, -np.inf),
        high=np.full(DIRECTIONS, np.inf),
    )  # fmt: skip
    return LinearModel(**{**usual, **changes})


def of_repeats(**changes) -> LinearModel:
    deviations = np.random.default_rng(4).normal(size=(REPEATS, LENGTH))
    return linear(Repeats(deviations - deviations.mean(axis=0)), repeats=REPEATS, **changes)


def of_blocks(**changes) -> LinearModel:
    return linear(Blocks(np.arange(LENGTH) * REPEATS // LENGTH), level=1.0, **changes)


def found(model: LinearModel, k: int, size: float, seed: int) -> bool:
    """Whether the score test and the gain on other noise find direction k of a size, as the search makes them."""
    rng, count = np.random.default_rng(seed), model.repeats if model.repeated else 1
    part = model.train
    held = model.prior * count**0.5
    gone = np.linalg.solve(part.base.T @ part.base + np.diag(held**-2), part.base.T)

    def residuals() -> tuple[np.ndarray, Resampling]:
        repeats = rng.normal(size=(count, LENGTH)) + size * part.raw[k]
        common = repeats.mean(axis=0)
        rows = Repeats(repeats - common) if model.repeated else part.rows
        common = common - part.base @ (gone @ common)
        return common, rows

    common, rows = residuals()
    projected = project(part.raw, part.base, held * model.slack)
    scores = projected @ rows.residuals(common).T
    _, p = rows.largest_score(scores, projected, part.base, held * model.slack)
    if p >= SelectionConfig().significance:
        return False
    common, rows = residuals()
    before, after = (
        rows.residuals(common),
        rows.residuals(common - size * (part.raw[k] - part.base @ (gone @ part.raw[k]))),
    )
    gains = 0.5 * (np.sum(before**2, axis=1) - np.sum(after**2, axis=1))
    if model.repeated:
        return rows.gain_p_value(gains) < SelectionConfig().confirmation
    less = rows.discrepancy(after) <= (1 - SelectionConfig().least_gain) * rows.discrepancy(before)
    return bool(less) and one_sided_p(gains) < SelectionConfig().confirmation


@pytest.mark.parametrize("make", [of_repeats, of_blocks])
def test_the_smallest_size_is_found_nine_times_of_ten_and_half_of_it_seldom(make: Callable[..., LinearModel]):
    """The oracle is the search's own score test and gain on drawn residuals (60: 4 % of deviation)."""
    model = make()
    (size,) = smallest_sizes(model, [2], CONFIG)
    at = np.mean([found(model, 2, size.size, seed) for seed in range(CASES)])
    below = np.mean([found(model, 2, 0.6 * size.size, seed) for seed in range(CASES)])
    assert 0.78 <= at <= 1.0
    assert below < 0.6


def test_twice_as_many_repeats_find_what_is_smaller():
    """The noncentrality grows with the root of their number, and the threshold falls."""
    few, many = of_repeats(), of_repeats()
    (one,), (four,) = (smallest_sizes(m, [5], CONFIG) for m in (few, linear(few.train.rows, repeats=4 * REPEATS)))
    assert 1.9 < one.size / four.size < 3.2
    assert many.repeats == REPEATS


def test_bounds_and_minimum_sizes_decide_where_noise_does_not():
    (plain,) = smallest_sizes(of_repeats(), [1], CONFIG)
    (least,) = smallest_sizes(of_repeats(minimum=np.full(DIRECTIONS, 100.0)), [1], CONFIG)
    (bound,) = smallest_sizes(of_repeats(high=np.full(DIRECTIONS, 0.5 * plain.size)), [1], CONFIG)
    assert least.size > 100.0 and least.limit == "minimum effect size"
    assert np.isinf(bound.size) and bound.limit == "beyond its bounds"
    (step,) = smallest_sizes(of_repeats(step_error=50.0), [1], CONFIG)
    assert step.limit == "time step" and step.size > plain.size


def test_what_the_base_parameters_absorb_is_not_found():
    """A direction that is a base column leaves nothing but what its prior holds back."""
    model = of_repeats()
    raw = model.train.raw.copy()
    raw[0] = model.train.base[:, 0]
    part = LinearPart(raw, model.train.base, model.train.rows, model.train.channel)
    absorbed = of_repeats(train=part, validation=part)
    (gone,), (kept,) = (smallest_sizes(absorbed, [k], CONFIG) for k in (0, 1))
    assert gone.size > 100 * kept.size


def test_rivals_are_the_candidates_that_act_alike():
    """Of two directions with a cosine of 0.99 each is taken for the other, up to a size; of others, none at it."""
    model = of_repeats()
    raw = model.train.raw.copy()
    raw[1] = raw[0] + 0.1 * raw[2] * np.linalg.norm(raw[0]) / np.linalg.norm(raw[2])
    part = LinearPart(raw, model.train.base, model.train.rows, model.train.channel)
    near = of_repeats(train=part, validation=part)
    (size,) = smallest_sizes(near, [0], CONFIG)
    rivals = rivals_of(near, 0, size.size, DiscrepancyConfig(), CONFIG.share)
    assert rivals[0].key.effect == "effect1" and rivals[0].share > 0.9
    assert size.size < rivals[0].apart < np.inf
    apart = [r.key.effect for r in rivals_of(near, 0, 2 * rivals[0].apart, DiscrepancyConfig(), CONFIG.share)]
    assert "effect1" not in apart
    one_way = np.zeros(DIRECTIONS)
    low = of_repeats(train=part, validation=part, low=one_way, high=np.where(np.arange(DIRECTIONS) == 1, 1e-9, np.inf))
    assert "effect1" not in [
        r.key.effect for r in rivals_of(low, 0, size.size, DiscrepancyConfig(), 0.9) if r.share > 0.9
    ]
