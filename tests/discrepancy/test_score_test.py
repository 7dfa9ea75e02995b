"""The score test on linear problems: what is known in closed form, and p-values of data with nothing missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from small_gap import largest_t

from droid_jax.cost.noise import DEFAULT_NOISE, estimate_noise
from droid_jax.discrepancy.candidates import (
    ScoreDirection,
    ScoreTest,
    collinear,
    directions_of,
    project,
    proposals,
    scored,
)
from droid_jax.discrepancy.selection import indistinguishable
from droid_jax.discrepancy.statistics import Repeats, largest_detrended_t, resample_weights
from droid_jax.model.effects.candidate import Candidate, EffectKey
from droid_jax.model.parameters import Parameter, Space

REPEATS, SIZE = 10, 400
RNG = np.random.default_rng(0)
BASE = RNG.normal(size=(SIZE, 6))
RAW = RNG.normal(size=(5, SIZE))
DIRECTIONS = tuple(ScoreDirection(Candidate(f"effect{k}", "hinge", (f"a{k}",)), f"a{k}") for k in range(5))
LOOSE = np.full(6, 1e3)


def repeats(seed: int, **coefficients: float) -> np.ndarray:
    """[N, M] noise, and sensitivities times coefficients after the projection on the base columns."""
    common = sum((size * RAW[int(name[1:])] for name, size in coefficients.items()), np.zeros(SIZE))
    left = project(common[None], BASE, LOOSE)[0]
    return left + np.random.default_rng(seed).normal(size=(REPEATS, SIZE))


def score_tested(
    data: np.ndarray, directions: Sequence[ScoreDirection] = DIRECTIONS, raw: np.ndarray = RAW
) -> ScoreTest:
    return scored(data, directions, raw, project(raw, BASE, LOOSE), largest_t)


def key(number: int) -> EffectKey:
    return EffectKey(f"effect{number}", "hinge")


def test_the_projection_leaves_nothing_of_a_base_column():
    np.testing.assert_allclose(project(BASE.T, BASE, LOOSE), 0.0, atol=1e-6)
    once = project(RAW, BASE, LOOSE)
    np.testing.assert_allclose(once @ BASE, 0.0, atol=1e-3)
    np.testing.assert_allclose(project(once, BASE, LOOSE), once, atol=1e-6)


def test_a_base_column_with_a_narrow_prior_explains_little():
    """A well-known parameter cannot absorb a missing effect."""
    np.testing.assert_allclose(project(BASE.T, BASE, np.full(6, 1e-4)), BASE.T, rtol=1e-3)


def test_the_missing_effect_is_found_with_its_size():
    found = score_tested(repeats(1, a3=0.7))
    assert found.ranking()[0] == 3 and found.p == pytest.approx(1 / 512)
    assert found.size[3] == pytest.approx(0.7, abs=0.05)
    assert found.explained[3] > 0.5 > 10 * np.delete(found.explained, 3).max()


def test_noise_alone_is_not_significant():
    p = [score_tested(repeats(seed)).p for seed in range(300)]
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.09


def test_a_difference_that_base_parameters_absorb_is_no_effect():
    raw = np.concatenate([RAW[:4], (BASE @ np.arange(6.0))[None]])
    found = score_tested(repeats(2, a1=0.5), raw=raw)
    assert found.ranking()[0] == 1
    assert abs(found.explained[4]) < 1e-2


def test_proposals_fit_coefficients_together_and_inside_their_bounds():
    space = Space(tuple(Parameter(f"a{k}", "N m", 0.0, 1.0, 0.0 if k == 1 else -5.0, 5.0) for k in range(5)))
    both = Candidate("both", "hinge", ("a3", "a4"))
    directions = (*DIRECTIONS[:3], ScoreDirection(both, "a3"), ScoreDirection(both, "a4"))
    data = repeats(3, a1=-0.8, a3=0.5, a4=-0.6)
    found = score_tested(data, directions)
    first, *rest = proposals(found, data, space)
    assert first.keys == (both.key,)
    assert first.sizes["a3"] == pytest.approx(0.5, abs=0.08) and first.sizes["a4"] == pytest.approx(-0.6, abs=0.08)
    forbidden = next(p for p in rest if p.keys == (key(1),))
    assert forbidden.sizes["a1"] == 0.0 and forbidden.explained == 0.0
    np.testing.assert_allclose(first.start(space, np.zeros(5)), [0, 0, 0, first.sizes["a3"], first.sizes["a4"]])


def test_pairs_are_ranked_together():
    space = Space(tuple(Parameter(f"a{k}", "N m", 0.0, 1.0, -5.0, 5.0) for k in range(5)))
    data = repeats(4, a0=0.5, a2=0.5)
    found = score_tested(data)
    best = proposals(found, data, space, number=2)
    assert len(best) == 10 and set(best[0].keys) == {key(0), key(2)}
    few = proposals(found, data, space, number=2, among={key(1), key(2), key(3)})
    assert len(few) == 3
    both = Candidate("both", "all joints", ("a0", "a1"))  # holds two of the others
    wider = (*DIRECTIONS[:3], ScoreDirection(both, "a0"), ScoreDirection(both, "a1"))
    found = score_tested(data, wider, RAW[[0, 1, 2, 0, 1]])
    pairs = {frozenset(p.keys) for p in proposals(found, data, space, number=2)}
    assert pairs == {frozenset(p) for p in ((key(0), key(1)), (key(0), key(2)), (key(1), key(2)), (key(2), both.key))}


def test_two_shapes_of_one_candidate_are_no_pair():
    space = Space((Parameter("a", "N m", 0.0, 1.0, -5.0, 5.0), Parameter("w", "rad", 0.1, 0.1, 0.0, 1.0)))
    shaped = tuple(ScoreDirection(Candidate("latch", "hinge", ("a",), {"w": w}), "a") for w in (0.1, 0.2, 0.3))
    data = repeats(5, a1=0.7)
    (only,) = proposals(score_tested(data, shaped, RAW[:3]), data, space)
    assert only.parts[0].shape_parameters == {"w": 0.2}


def test_directions_are_coefficients_of_candidates():
    tilted = Candidate("tilted", "hinge", ("a", "b"), {"w": 1.0})
    found = directions_of([tilted, Candidate("drag", "hinge", ("c",))])
    assert [(d.candidate.effect, d.coefficient) for d in found] == [("tilted", "a"), ("tilted", "b"), ("drag", "c")]


def test_collinear_candidates_have_nearly_parallel_sensitivities():
    """By absolute cosine: opposite sensitivities of any size are collinear."""
    near = RAW[0] + 0.3 * np.linalg.norm(RAW[0]) / np.linalg.norm(RAW[1]) * RAW[1]  # cosine of about 0.96
    found = score_tested(repeats(6), raw=np.stack([RAW[0], -5.0 * RAW[0], near, RAW[3], RAW[4]]))
    assert collinear(found, {key(0)}, 0.9) == {key(0), key(1), key(2)}
    assert collinear(found, {key(0)}, 0.99) == {key(0), key(1)}
    assert collinear(found, {key(3), key(4)}, 0.9) == {key(3), key(4)}


def same_models(
    left: np.ndarray, fitted: np.ndarray, losses: np.ndarray, u0: float = 0.0, factor: float = 3.0, doubt: float = 0.05
) -> np.ndarray:
    return indistinguishable(left, fitted, losses, u0, factor, 0.1, doubt)


def test_models_with_similar_discrepancies_are_indistinguishable():
    left = np.array([1.0, 2.5, 10.0, 1.0])
    losses = np.tile([1.0, 2.0, 9.0, 1.5], (400, 1))
    same = same_models(left, np.zeros(4), losses)
    np.testing.assert_array_equal(same, same.T)
    assert same[0].tolist() == [True, True, False, True]
    beyond = same_models(left, np.zeros(4), losses, u0=0.9)  # beyond U0 it is 16 times
    assert beyond[0].tolist() == [True, False, False, True]
    assert same_models(left, np.zeros(4), losses, factor=11.0).all()


def test_models_that_the_training_motion_distinguishes_are_distinguishable():
    """U is the same on the validation recording.  On the training recording it is more than three times as large."""
    left, fitted = np.full(4, 1.0), np.array([0.1, 0.35, 0.45, -0.2])
    losses = np.tile([1.0, 2.0, 3.0, 4.0], (400, 1))
    assert same_models(left, fitted, losses)[0].tolist() == [True, True, False, True]
    noise = np.where(np.arange(400)[:, None] % 2, losses, losses[:, ::-1])  # better half of the time: no fit decides
    assert same_models(left, fitted, noise)[0].all()
    assert same_models(left, fitted, noise, doubt=0.6)[0].tolist() == [True, True, False, True]


def test_models_whose_difference_is_not_significant_are_indistinguishable():
    """Two models whose difference is within the scatter of the repeats, and one that is clearly worse."""
    rng = np.random.default_rng(6)
    commons = 0.05 * rng.normal(size=(3, SIZE))
    commons[1] = commons[0] + 0.005 * rng.normal(size=SIZE)
    commons[2] += 1.0
    deviations = rng.normal(size=(REPEATS, SIZE))
    rows = Repeats(deviations - deviations.mean(axis=0))
    losses = rows.losses(commons, resample_weights(REPEATS, draws=400))
    assert same_models(np.array([1e-4, 1e-3, 1.0]), np.zeros(3), losses)[0].tolist() == [True, True, False]


# Calibration of the score test -------------------------------------------------------------

LENGTH, CASES = 160, 500


def smooth_curves(rng: np.random.Generator, count: int) -> np.ndarray:
    """[LENGTH, count] slow random waves, like the torque changes by parameters."""
    time = np.arange(LENGTH) / DEFAULT_NOISE.rate
    rates, starts = rng.uniform(0.05, 1.5, (6, count)), rng.uniform(0, 2 * np.pi, (6, count))
    return np.sin(2 * np.pi * rates * time[:, None, None] + starts).sum(axis=1)


def sensor_noise(rng: np.random.Generator) -> np.ndarray:
    """[REPEATS, LENGTH] white noise plus first-order noise of 0.15 s, of about the same size."""
    keep = np.exp(-1 / DEFAULT_NOISE.rate / 0.15)
    slow = rng.normal(size=(REPEATS, LENGTH))
    for k in range(1, LENGTH):
        slow[:, k] = keep * slow[:, k - 1] + np.sqrt(1 - keep**2) * slow[:, k]
    return slow + rng.normal(size=(REPEATS, LENGTH))


def case(seed: int, missing: float, drift: float = 0.0) -> tuple[float, int]:
    """The score test's p-value, and the index of the largest of twelve directions.

    missing: coefficient of the third direction in the data.
    drift: increase of the residuals from one repeat to the next.
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
def test_p_values_of_noise_are_uniform(nothing: np.ndarray, level: float, width: float):
    """Within two standard deviations of the counts; without tapered lags 31 % of 1,000 were below 0.25."""
    assert np.mean(nothing < level) == pytest.approx(level, abs=width)


@pytest.mark.slow
def test_a_missing_effect_is_found():
    found = [case(seed, 0.3) for seed in range(100)]
    assert np.mean([p < 0.01 and best == 2 for p, best in found]) > 0.9


@pytest.mark.slow
def test_a_drift_over_the_repeats_changes_neither_level_nor_power():
    """A sensor that warms up."""
    found = [case(seed, 0.3, drift=1.0) for seed in range(100)]
    assert np.mean([p < 0.01 and best == 2 for p, best in found]) > 0.9
    assert np.mean([case(seed, 0.0, drift=1.0)[0] < 0.05 for seed in range(200)]) < 0.1
