"""The screening on linear problems, where everything is known in closed form."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from plain_flips import largest_t

from droid_jax.cost.cost import Cost
from droid_jax.discrepancy.candidates import ScoreDirection, project, proposals, score_test
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.selection import indistinguishable
from droid_jax.discrepancy.statistics import detrended, one_sided_p, resample_weights
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import Candidate, candidates
from droid_jax.model.parameters import Parameter, Space

REPEATS, SIZE = 10, 400
RNG = np.random.default_rng(0)
BASE = RNG.normal(size=(SIZE, 6))
MARKS = RNG.normal(size=(5, SIZE))
QUESTIONS = tuple(ScoreDirection(Candidate(f"effect{k}", "hinge", (f"a{k}",)), f"a{k}") for k in range(5))
LOOSE = np.full(6, 1e3)


def repeats(seed: int, **amplitudes: float) -> np.ndarray:
    """[N, M] noise and the marks times their amplitudes, with what the base absorbs taken out."""
    common = sum((size * MARKS[int(name[1:])] for name, size in amplitudes.items()), np.zeros(SIZE))
    left = project(common[None], BASE, LOOSE)[0]
    return left + np.random.default_rng(seed).normal(size=(REPEATS, SIZE))


def measured(deviations: np.ndarray) -> ResidualSet:
    """Repeats without a recording behind them."""
    nowhere = np.zeros(deviations.shape[1])
    return ResidualSet(cast(Cost, None), deviations, nowhere, nowhere)


def test_the_projection_leaves_nothing_of_a_base_column():
    np.testing.assert_allclose(project(BASE.T, BASE, LOOSE), 0.0, atol=1e-6)
    once = project(MARKS, BASE, LOOSE)
    np.testing.assert_allclose(once @ BASE, 0.0, atol=1e-3)
    np.testing.assert_allclose(project(once, BASE, LOOSE), once, atol=1e-6)


def test_a_tight_prior_lets_a_base_column_explain_little():
    """A parameter known to be where it is cannot take the blame for a missing effect."""
    np.testing.assert_allclose(project(BASE.T, BASE, np.full(6, 1e-4)), BASE.T, rtol=1e-3)


def test_the_missing_effect_is_found_with_its_size():
    found = score_test(repeats(1, a3=0.7), QUESTIONS, MARKS, project(MARKS, BASE, LOOSE), largest_t)
    assert found.best()[0] == 3 and found.p == pytest.approx(1 / 512)
    assert found.size[3] == pytest.approx(0.7, abs=0.05)
    assert found.explained[3] > 0.5 > 10 * np.delete(found.explained, 3).max()


def test_nothing_missing_names_nothing():
    p = [score_test(repeats(seed), QUESTIONS, MARKS, project(MARKS, BASE, LOOSE), largest_t).p for seed in range(300)]
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.09


def test_what_the_base_can_absorb_is_no_effect():
    marks = np.concatenate([MARKS[:4], (BASE @ np.arange(6.0))[None]])
    found = score_test(repeats(2, a1=0.5), QUESTIONS, marks, project(marks, BASE, LOOSE), largest_t)
    assert found.best()[0] == 1
    assert abs(found.explained[4]) < 1e-2


def test_the_ranking_takes_amplitudes_together_and_inside_their_bounds():
    space = Space(tuple(Parameter(f"a{k}", "N m", 0.0, 1.0, 0.0 if k == 1 else -5.0, 5.0) for k in range(5)))
    both = Candidate("both", "hinge", ("a3", "a4"))
    questions = (*QUESTIONS[:3], ScoreDirection(both, "a3"), ScoreDirection(both, "a4"))
    data = repeats(3, a1=-0.8, a3=0.5, a4=-0.6)
    found = score_test(data, questions, MARKS, project(MARKS, BASE, LOOSE), largest_t)
    first, *rest = proposals(found, data, space)
    assert first.names == ("both at hinge",)
    assert first.sizes["a3"] == pytest.approx(0.5, abs=0.08) and first.sizes["a4"] == pytest.approx(-0.6, abs=0.08)
    forbidden = next(p for p in rest if p.names == ("effect1 at hinge",))
    assert forbidden.sizes["a1"] == 0.0 and forbidden.explained == 0.0
    np.testing.assert_allclose(first.start(space, np.zeros(5)), [0, 0, 0, first.sizes["a3"], first.sizes["a4"]])


def test_pairs_are_ranked_together():
    space = Space(tuple(Parameter(f"a{k}", "N m", 0.0, 1.0, -5.0, 5.0) for k in range(5)))
    data = repeats(4, a0=0.5, a2=0.5)
    found = score_test(data, QUESTIONS, MARKS, project(MARKS, BASE, LOOSE), largest_t)
    best = proposals(found, data, space, number=2)
    assert len(best) == 10 and set(best[0].names) == {"effect0 at hinge", "effect2 at hinge"}
    few = proposals(found, data, space, number=2, among={"effect1 at hinge", "effect2 at hinge", "effect3 at hinge"})
    assert len(few) == 3


def test_shapes_are_not_rivals_of_each_other():
    space = Space((Parameter("a", "N m", 0.0, 1.0, -5.0, 5.0), Parameter("w", "rad", 0.1, 0.1, 0.0, 1.0)))
    shaped = tuple(ScoreDirection(Candidate("latch", "hinge", ("a",), {"w": w}), "a") for w in (0.1, 0.2, 0.3))
    data = repeats(5, a1=0.7)
    (only,) = proposals(score_test(data, shaped, MARKS[:3], project(MARKS[:3], BASE, LOOSE), largest_t), data, space)
    assert only.parts[0].shape_parameters == {"w": 0.2}


def test_one_sided_p():
    assert one_sided_p(np.full(10, 2.0) + np.linspace(-0.1, 0.1, 10)) == pytest.approx(1 / 1024)
    unlike = np.array([1.0, 1.1, 0.9, 1.0, 1.2, 0.8, 1.0, -10.0])
    assert one_sided_p(unlike) == one_sided_p(unlike[::-1]) > 0.4  # whichever repeat it is
    assert one_sided_p(-np.arange(1.0, 11.0)) > 0.9
    assert one_sided_p(np.full(10, 1.0)) < 0.01 < 0.3 < one_sided_p(np.array([1.0, -1.0] * 5))


def test_models_that_leave_much_the_same_are_ties():
    left = np.array([1.0, 2.5, 10.0, 1.0])
    losses = np.tile([1.0, 2.0, 9.0, 1.5], (400, 1))
    same = indistinguishable(left, np.zeros(4), losses, 0.0, 3.0, 0.1)
    np.testing.assert_array_equal(same, same.T)
    assert same[0].tolist() == [True, True, False, True]
    above = indistinguishable(left, np.zeros(4), losses, 0.9, 3.0, 0.1)  # above the floor it is 16 times
    assert above[0].tolist() == [True, False, False, True]


def test_what_the_fitted_demonstration_tells_apart_is_no_tie():
    """The same on the other one; on the fitted one more than three times as much, by more than is no difference."""
    left, fitted = np.full(4, 1.0), np.array([0.1, 0.35, 0.45, -0.2])
    losses = np.tile([1.0, 2.0, 3.0, 4.0], (400, 1))
    same = indistinguishable(left, fitted, losses, 0.0, 3.0, 0.1)
    assert same[0].tolist() == [True, True, False, True]
    noise = np.where(np.arange(400)[:, None] % 2, losses, losses[:, ::-1])  # better half of the time: no fit decides
    assert indistinguishable(left, fitted, noise, 0.0, 3.0, 0.1)[0].all()


def test_models_that_noise_cannot_separate_are_ties():
    """Two models whose difference the repeats' scatter hides, and one that is clearly worse."""
    rng = np.random.default_rng(6)
    commons = 0.05 * rng.normal(size=(3, SIZE))
    commons[1] = commons[0] + 0.005 * rng.normal(size=SIZE)
    commons[2] += 1.0
    deviations = rng.normal(size=(REPEATS, SIZE))
    losses = measured(deviations - deviations.mean(axis=0)).losses(commons, resample_weights(REPEATS))
    same = indistinguishable(np.array([1e-4, 1e-3, 1.0]), np.zeros(3), losses, 0.0, 3.0, 0.1)
    assert same[0].tolist() == [True, True, False]


def test_resampled_losses_are_the_squared_means_of_resamples():
    """What grows or fades steadily over the repeats is no scatter, as everywhere else: a trend changes nothing."""
    rng = np.random.default_rng(7)
    commons, deviations = rng.normal(size=(2, 30)), rng.normal(size=(REPEATS, 30))
    deviations -= deviations.mean(axis=0)
    draws = resample_weights(REPEATS, seed=8)
    losses = measured(deviations).losses(commons, draws)
    expected = np.sum((commons[:, None] + draws @ detrended(deviations)) ** 2, axis=2).T
    np.testing.assert_allclose(losses[:, 0] - losses[:, 1], expected[:, 0] - expected[:, 1])
    trend = np.linspace(-3.0, 3.0, REPEATS)[:, None] * rng.normal(size=30)
    np.testing.assert_allclose(measured(deviations + trend).losses(commons, draws), losses)


def test_candidates_are_effects_at_places_with_shapes():
    made = Effect(
        "ripple",
        tuple(Parameter(n, "-", 0.0, 1.0, -1.0, 1.0) for n in ("s[a]", "c[a]", "s[b]", "c[b]", "n")),
        locations={"a": ("s[a]", "c[a]"), "b": ("s[b]", "c[b]")},
        shape_parameters={"n": (1.0, 2.0, 3.0)},
    )
    found = candidates([made, Effect("plain", locations={"hinge": ("x",)})])
    assert len(found) == 7
    assert {c.name for c in found} == {"ripple at a", "ripple at b", "plain at hinge"}
    assert found[0].free == ("s[a]", "c[a]", "n") and found[-1].free == ("x",)
    assert len({c.key for c in found}) == 7
