"""The trend over repeats: found where one was put in, silent where the repeats are in no order."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from droid_jax.discrepancy.candidates import ScoreDirection, ScoreTest, trend
from droid_jax.model.effects.candidate import Candidate

REPEATS, SIZE = 10, 400


def screen(marks: np.ndarray) -> ScoreTest:
    names = [f"effect{k}" for k in range(len(marks))]
    questions = tuple(ScoreDirection(Candidate(n, "hinge", (f"{n}_size",), {}), f"{n}_size") for n in names)
    none = np.zeros(len(marks))
    return ScoreTest(questions, marks, marks, none, none, none, 1.0)


@pytest.fixture
def marks() -> np.ndarray:
    return 3.0 * np.random.default_rng(1).normal(size=(4, SIZE))


def test_the_slope_that_was_put_in_is_found_with_its_sign_and_size(marks: np.ndarray) -> None:
    noise = np.random.default_rng(2).normal(size=(REPEATS, SIZE))
    rising = -0.02 * np.arange(REPEATS)[:, None] * marks[2]
    found = trend(screen(marks), noise + rising + 5.0 * marks[1])  # what all repeats share is no trend
    assert found is not None
    assert (found.candidate, found.amplitude) == ("effect2 at hinge", "effect2_size")
    assert found.per_repeat == pytest.approx(-0.02, abs=3 / (np.linalg.norm(marks[2]) * np.sqrt(82.5)))
    assert found.p < 0.001


def test_without_a_trend_the_p_value_is_uniform(marks: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    p = [trend(screen(marks), rng.normal(size=(REPEATS, SIZE)), seed=k).p for k in range(200)]  # type: ignore[union-attr]
    assert scipy.stats.kstest(p, "uniform").pvalue > 0.01


def test_two_repeats_have_no_trend(marks: np.ndarray) -> None:
    assert trend(screen(marks), np.zeros((2, SIZE))) is None
