"""Continuation after a stop: a search that is run again reads the replays that it has made."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_gap import FLOOR, Small, quiet, small

from droid_jax.discrepancy.case import Case, ResidualSet
from droid_jax.discrepancy.fitting import FittedModel, base_fit
from droid_jax.discrepancy.search import search_effects

Wrap = Callable[[Callable[[np.ndarray], np.ndarray]], Callable[[np.ndarray], np.ndarray]]


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def wrapped(case: Case, wrap: Wrap) -> Case:
    """The case with all its replays through `wrap`."""

    def of(e: ResidualSet) -> ResidualSet:
        return dataclasses.replace(e, whitened=wrap(e.whitened), distances=wrap(e.distances))

    return dataclasses.replace(case, **{role: of(e) for role, e in case.residual_sets.items()})


def no_replays(case: Case) -> Case:
    """The case in which every replay fails the test."""
    return wrapped(case, lambda compute: lambda rows: pytest.fail("this replay was made before"))


def fitted(case: Case) -> FittedModel:
    return base_fit(case.train, case.base, case.config, quiet)


def test_recordings_do_not_share_cached_replays(found: Small, tmp_path: Path):
    case = found.case.with_replay_cache(tmp_path)
    row = found.case.full_space.mean[None]
    assert case.train.distances(row)[0, 0] != case.validation.distances(row)[0, 0]
    assert {p.name for p in tmp_path.iterdir()} == {"train", "validation"}
    again = no_replays(found.case).with_replay_cache(tmp_path)
    for role, known in found.case.residual_sets.items():
        np.testing.assert_array_equal(again.residual_sets[role].distances(row), known.distances(row))


def test_a_base_fit_is_resumed_bit_for_bit(found: Small, tmp_path: Path):
    """It is stopped after a third of its replays, run again, and run once more without any replay."""
    left, made = [0], [0]

    def stopping(compute: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        def replay(rows: np.ndarray) -> np.ndarray:
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
            made[0] += 1
            return compute(rows)

        return replay

    left[0] = -1
    whole = fitted(wrapped(found.case, stopping))
    needed, made[0] = made[0], 0
    left[0] = needed // 3
    with pytest.raises(KeyboardInterrupt):
        fitted(wrapped(found.case, stopping).with_replay_cache(tmp_path))
    assert made[0] == needed // 3 > 0
    left[0] = -1
    resumed = fitted(wrapped(found.case, stopping).with_replay_cache(tmp_path))
    assert made[0] == needed
    again = fitted(no_replays(found.case).with_replay_cache(tmp_path))
    for model in (resumed, again):
        assert model.discrepancy == whole.discrepancy and model.refined.converged == whole.refined.converged
        for name in ("values", "residuals"):
            np.testing.assert_array_equal(getattr(model, name), getattr(whole, name))
        for name in ("x", "jacobian", "residual", "objective"):
            np.testing.assert_array_equal(getattr(model.refined, name), getattr(whole.refined, name))


def test_a_search_that_is_run_again_makes_no_replay_and_has_the_same_result(found: Small, tmp_path: Path):
    """A killed run does this when its command is given again."""
    search_effects(found.case.with_replay_cache(tmp_path), found.base, FLOOR)
    again = search_effects(no_replays(found.case).with_replay_cache(tmp_path), found.base, FLOOR)
    assert again.effects == found.verdict.effects and again.discrepancies == found.verdict.discrepancies
    np.testing.assert_array_equal(again.model.values, found.verdict.model.values)
    assert [dataclasses.astuple(t) for t in again.validation_tests] == [
        dataclasses.astuple(t) for t in found.verdict.validation_tests
    ]
