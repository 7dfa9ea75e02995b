"""U0: what a finer simulation does otherwise, less what the base parameters absorb, in one repeat's noise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import Small, small

from droid_jax.discrepancy import fitting
from droid_jax.discrepancy.fitting import beyond_step_error, discretisation_error, with_finer_step
from droid_jax.identify.search import NotReplayed


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def of(found: Small, difference: np.ndarray) -> float:
    """U0 where the finer simulation differs by [M] of the noise of the repeats' mean."""
    case, base = found.case, found.base
    coarse = case.train.whitened(base.values[None])
    fine: Any = SimpleNamespace(whitened=lambda rows: coarse + difference[None])
    return discretisation_error(case.train, base, fine)


def test_what_no_base_parameter_can_do_is_the_error(found: Small):
    jacobian, count = found.base.refined.jacobian, found.case.train.repeats
    off = np.random.default_rng(0).normal(size=len(jacobian))
    off -= jacobian @ np.linalg.lstsq(jacobian, off, rcond=None)[0]
    assert of(found, off) == pytest.approx(np.mean(off**2) / count, rel=0.01)


def test_what_a_base_parameter_can_do_is_none(found: Small):
    jacobian = found.base.refined.jacobian
    constrained = int(np.argmax(np.linalg.norm(jacobian, axis=0)))
    off = 0.5 * jacobian[:, constrained]
    assert of(found, off) < 0.01 * np.mean(off**2) / found.case.train.repeats


def test_a_finer_simulation_that_blows_up_gives_no_error(found: Small):
    """It would be so high that nothing could be missing."""
    with pytest.raises(NotReplayed, match="blows up at a quarter of its time step"):
        of(found, np.full(len(found.base.refined.jacobian), np.nan))


def test_the_finer_simulation_has_a_quarter_of_the_step(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fitting, "make_cost", lambda scene, *_, **__: scene)
    fine: Any = with_finer_step(found.case.train, found.base.space, found.recordings["train"])
    assert fine.model.opt.timestep == pytest.approx(found.scene.model.opt.timestep / 4)


def test_inverse_dynamics_has_no_time_step(found: Small):
    train = found.case.train
    measured: Any = (object(),)
    inverse = replace(train, cost=replace(train.cost, drives=measured))
    fine = with_finer_step(inverse, found.base.space, found.recordings["train"])
    assert fine is None
    assert discretisation_error(inverse, found.base, fine) == 0.0


def test_an_error_of_first_order_may_be_nearly_twice_what_a_quarter_of_the_step_shows():
    """U of such an error is square in the step, of which three quarters are seen: 16/9 of U0."""
    assert not beyond_step_error(16 / 9 * 0.1, 0.1) and beyond_step_error(16 / 9 * 0.1 + 1e-6, 0.1)
    assert beyond_step_error(1e-9, 0.0) and not beyond_step_error(0.0, 0.0)
