"""The whole search on recordings of the synthetic robot: nothing hidden, and two effects hidden at once."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
from small_gap import EFFECTS, FLOOR, PRELOAD, QUICK, quiet, record, small_scene

from droid_jax.discrepancy.case import make_case
from droid_jax.discrepancy.fitting import base_fit
from droid_jax.discrepancy.search import search_effects
from droid_jax.discrepancy.verdict import Conclusion, Verdict
from droid_jax.model.effects.candidate import EffectKey
from droid_jax.model.effects.registry import library

FRICTION = 0.5  # N m


@functools.cache
def verdict(preload: float, friction: float) -> Verdict:
    """What is said of a robot that hides so much."""
    scene, space = small_scene()
    recordings = {name: record(name, preload=preload, friction=friction) for name in ("train", "validation")}
    case = make_case(
        scene, space, library(scene, (*EFFECTS, "joint_coulomb")), **recordings, config=replace(QUICK, max_effects=2)
    )
    return search_effects(case, base_fit(case.train, case.base, case.config, quiet), FLOOR)


@pytest.mark.slow
def test_where_nothing_is_hidden_nothing_is_missing():
    found = verdict(0.0, 0.0)
    assert found.conclusion is Conclusion.NONE and not found.effects
    assert found.score_tests[0].p > 0.01


@pytest.mark.slow
def test_two_effects_are_both_named_and_nothing_else():
    found = verdict(PRELOAD, FRICTION)
    assert found.conclusion is Conclusion.NAMED
    assert set(found.effects) == {EffectKey("hinge_preload", "door"), EffectKey("joint_coulomb", "elbow")}
