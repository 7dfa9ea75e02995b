"""The search as a whole, where something is wrong: an effect that blows up, a fit that did not settle."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from small_gap import EFFECTS, FLOOR, QUICK, Small, record, small, small_scene

from droid_jax.gap.candidates import candidates
from droid_jax.gap.case import make_case
from droid_jax.gap.screen import questions_of
from droid_jax.gap.verdict import Kind
from droid_jax.gap.workflow import ask, base_fit, find
from droid_jax.model.effects.registry import library
from droid_jax.model.parameters import Parameter
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def bomb(scene: Scene) -> Effect:
    """A force that is neutral at zero and not a number beside it."""
    dof = scene.dof("door")

    def force(theta, state):
        return jnp.zeros_like(state.qvel).at[dof].set(jnp.where(theta["bomb"] > 0.0, jnp.nan, 0.0))

    return Effect(
        "bomb",
        (Parameter("bomb", "N m", 0.0, 1.0, 0.0, 5.0),),
        force=force,
        what="a replay that blows up",
        places={"door": ("bomb",)},
        smallest=0.1,
    )


def test_an_effect_that_blows_up_is_left_out_and_named():
    """What is really missing is found all the same."""
    scene, space = small_scene()
    effects = (*library(scene, EFFECTS), bomb(scene))
    case = make_case(scene, space, effects, record("fit"), record("confirm"), config=QUICK)
    verdict = find(case, base_fit(case, lambda stage, value: None), FLOOR)
    assert verdict.screens[0].failed == ("bomb at door",)
    assert verdict.effects == ("hinge_preload at door",)
    assert not any("bomb" in trial.name for trial in verdict.trials if trial.passed)
    row = next(k for k, q in enumerate(verdict.screens[0].questions) if q.amplitude == "bomb")
    assert verdict.screens[0].t[row] == verdict.screens[0].explained[row] == 0.0


def test_where_nothing_blows_up_nothing_is_left_out(found: Small):
    assert ask(found.case, found.base, questions_of(candidates(found.case.effects))).failed == ()


def test_a_nuisance_goes_no_further_than_its_prior_says(found: Small):
    p = found.case.base["torque_offset[elbow]"]
    assert (p.low, p.high) == (pytest.approx(-0.3), pytest.approx(0.3))  # of bounds of 2 and a deviation of 0.1


def test_a_parameter_at_its_bound_absorbs_nothing_more(found: Small):
    asked, refined = questions_of(candidates(found.case.effects)), found.base.refined
    assert refined.free.all()
    at = refined.space.index("door_stiffness")
    x = refined.x.copy()
    x[at] = refined.space.to_search(refined.space.high)[at]
    stuck = replace(found.base, refined=replace(refined, x=x))
    assert np.flatnonzero(~stuck.refined.free).tolist() == [at]
    before, after = (np.linalg.norm(ask(found.case, m, asked).marks, axis=1) for m in (found.base, stuck))
    assert np.all(after >= before - 1e-9)
    preload = [q.amplitude for q in asked].index("hinge_preload")
    assert after[preload] > 1.1 * before[preload]  # a spring looks like a preload


def test_no_verdict_from_a_base_fit_that_did_not_converge(found: Small):
    base = replace(found.base, refined=replace(found.base.refined, converged=False))
    verdict = find(found.case, base, FLOOR)
    assert verdict.kind is Kind.UNCONVERGED
    assert (verdict.effects, verdict.trials, verdict.screens, verdict.trend) == ((), (), (), None)
    assert verdict.sentence == "The fit of the base model did not converge; nothing can be concluded."


def test_no_name_from_an_extended_fit_that_did_not_converge(found: Small, monkeypatch: pytest.MonkeyPatch):
    from droid_jax.gap import workflow

    def unsettled(hunt, model):
        return replace(model, refined=replace(model.refined, converged=False))

    monkeypatch.setattr(workflow, "polished", unsettled)
    verdict = find(found.case, found.base, FLOOR)
    assert verdict.kind is Kind.UNCONVERGED
    assert "the model with the effects" in verdict.sentence


def test_a_gap_below_the_floor_is_none(found: Small):
    """The test rejects, yet the time step alone would leave as much."""
    verdict = find(found.case, found.base, 2.0 * found.base.gap)
    assert verdict.kind is Kind.NONE
    assert verdict.screens[0].p < 0.01
    assert not verdict.effects and np.isfinite(verdict.closed("confirm"))
