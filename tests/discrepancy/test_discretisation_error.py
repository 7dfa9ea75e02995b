"""U0: the difference to a finer simulation that base parameters do not absorb, in one repeat's noise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import Small, small

from droid_jax.discrepancy import step_error
from droid_jax.discrepancy.candidates import directions_of, score_test
from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.posterior import fit_posterior, with_step_moves
from droid_jax.discrepancy.step_error import (
    beyond_step_error,
    discretisation_error,
    with_finer_step,
    with_step_difference,
)
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import candidates


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def stepped(found: Small, difference: np.ndarray) -> ResidualSet:
    """The training recording with a finer simulation that differs by [M], in the noise of the repeats' mean."""
    case, base = found.case, found.base
    coarse = case.train.whitened(base.values[None])
    fine: Any = SimpleNamespace(whitened=lambda rows: coarse + difference[None])
    return with_step_difference(case.train, base, fine)


def of(found: Small, difference: np.ndarray) -> float:
    """U0 of a finer simulation that differs by [M]."""
    return discretisation_error(stepped(found, difference), found.base)


def test_a_difference_that_base_parameters_cannot_absorb_is_the_error(found: Small):
    jacobian, count = found.base.refined.jacobian, found.case.train.repeats
    off = np.random.default_rng(0).normal(size=len(jacobian))
    off -= jacobian @ np.linalg.lstsq(jacobian, off, rcond=None)[0]
    assert of(found, off) == pytest.approx(np.mean(off**2) / count, rel=0.01)


def test_a_difference_that_a_base_parameter_absorbs_is_no_error(found: Small):
    jacobian = found.base.refined.jacobian
    constrained = int(np.argmax(np.linalg.norm(jacobian, axis=0)))
    off = 0.5 * jacobian[:, constrained]
    assert of(found, off) < 0.01 * np.mean(off**2) / found.case.train.repeats


def test_a_finer_simulation_that_blows_up_is_refused(found: Small):
    """An infinite U0 would hide every missing effect."""
    with pytest.raises(NotReplayed, match="blows up at a quarter of its time step"):
        of(found, np.full(len(found.base.refined.jacobian), np.nan))


def test_the_finer_simulation_has_a_quarter_of_the_step(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(step_error, "make_cost", lambda scene, *_, **__: scene)
    fine: Any = with_finer_step(found.case.train, found.base.space, found.recordings["train"])
    assert fine.model.opt.timestep == pytest.approx(found.scene.model.opt.timestep / 4)


def test_data_made_with_mj_step_have_no_step_error(found: Small):
    """The finer step is the one with an error there; U0 hid a missing effect."""
    train = found.case.train
    (comparison,) = train.cost.comparisons
    made = replace(comparison, config=replace(comparison.config, mj_step=True))
    own = replace(train, cost=replace(train.cost, comparisons=(made,)))
    assert with_finer_step(own, found.base.space, found.recordings["train"]) is None


def test_inverse_dynamics_has_no_time_step(found: Small):
    train = found.case.train
    measured: Any = (object(),)
    inverse = replace(train, cost=replace(train.cost, drives=measured))
    fine = with_finer_step(inverse, found.base.space, found.recordings["train"])
    assert fine is None
    inverse = with_step_difference(inverse, found.base, fine)
    assert discretisation_error(inverse, found.base) == 0.0
    plain = fit_posterior(found.case.train, found.base)
    assert with_step_moves(inverse, found.base, plain) is plain


def test_an_interval_includes_the_shift_of_the_fit_by_a_finer_step(found: Small):
    """It grows by four thirds of the shift at a quarter of the step, for a well-constrained parameter."""
    refined, train = found.base.refined, found.case.train
    k = int(np.argmax(np.where(refined.free, np.linalg.norm(refined.jacobian, axis=0), 0.0)))
    known = stepped(found, -0.5 * refined.jacobian[:, k])
    plain, wide = (np.diag(fit_posterior(of, found.base).cov) for of in (train, known))
    assert np.sqrt(wide - plain)[k] == pytest.approx(4 / 3 * 0.5, rel=0.05)


def test_an_error_of_first_order_is_up_to_16_ninths_of_u0():
    """U is quadratic in the error, of which the difference to a quarter of the step shows three quarters."""
    assert not beyond_step_error(16 / 9 * 0.1, 0.1) and beyond_step_error(16 / 9 * 0.1 + 1e-6, 0.1)
    assert beyond_step_error(1e-9, 0.0) and not beyond_step_error(0.0, 0.0)


def test_the_score_test_subtracts_the_error_of_the_time_step(found: Small):
    """A residual that is the error of the step shows no effect; half of it remains if the error is half as large."""
    base, asked = found.base, directions_of(candidates(found.case.effects))
    common = base.residuals.mean(axis=0)
    plain = score_test(found.case.train, base, asked)
    assert plain.p < 0.01
    halved = score_test(replace(found.case.train, step_difference=0.5 * common), base, asked)
    assert halved.size == pytest.approx(0.5 * plain.size, rel=0.1, abs=1e-3)
    whole = score_test(replace(found.case.train, step_difference=common), base, asked)
    assert whole.p > 0.1 and np.abs(whole.size).max() < 0.1 * np.abs(plain.size).max()


def test_a_finer_step_is_compared_up_to_the_end_of_the_coarse_replay(found: Small):
    """Samples after its last step are left out."""
    cost = found.case.train.cost
    recording = found.recordings["train"]
    end = float(recording.time[0]) + float(cost.drives[0].time[-1])
    late = {
        name: replace(c, time=np.r_[c.time[c.time <= end], end + 5e-4],
                      values=np.concatenate([c.values[:, c.time <= end], c.values[:, -1:]], axis=1),
                      mask=np.concatenate([c.mask[:, c.time <= end], c.mask[:, -1:]], axis=1))
        for name, c in recording.channels.items()
    }  # fmt: skip
    kept = step_error.until(replace(recording, channels=late), cost.drives[0])
    for name, channel in kept.channels.items():
        assert channel.time[-1] <= end + 1e-9 < late[name].time[-1]
        assert channel.values.shape[1] == channel.mask.shape[1] == len(channel.time) == len(late[name].time) - 1
