"""What is to be doubted of effects in a final model; a nuisance of the small scene plays a shape here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_gap import FLOOR, Small, small

from droid_jax.discrepancy import doubts as doubts_module
from droid_jax.discrepancy import workflow
from droid_jax.discrepancy.fitting import FittedModel, intervals
from droid_jax.discrepancy.results import gap_json
from droid_jax.discrepancy.selection import bound_at, doubts

SHAPE = "torque_offset[elbow]"  # -0.3 to 0.3 N m


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def shaped(found: Small, value: float) -> FittedModel:
    """The final model, whose effect has a shape of this value."""
    model, whole = found.verdict.model, found.case.full_space
    (part,) = model.parts
    values = model.values.copy()
    values[whole.index(SHAPE)] = np.clip(value, whole[SHAPE].low, whole[SHAPE].high)
    return replace(model, parts=(replace(part, shape_parameters={SHAPE: value}),), values=values)


@pytest.mark.parametrize(("value", "side", "at"), [(-1.0, "lower", "-0.3"), (1.0, "upper", "0.3"), (0.1, "", "")])
def test_a_shape_at_its_bound_says_that_the_form_does_not_fit(found: Small, value: float, side: str, at: str):
    model = shaped(found, value)
    said = doubts(found.case.train, model)
    form = f"the form of hinge_preload at door does not fit: {SHAPE} at its {side} bound, {at} N m"
    assert said == ((form,) if side else ())
    low, high = intervals(found.case.train, model, [SHAPE])[SHAPE]
    assert low <= model.values[found.case.full_space.index(SHAPE)] <= high
    assert bound_at(found.case.train, model, SHAPE) == side
    verdict = replace(found.verdict, model=model, doubts=said)
    answer = gap_json(found.case, verdict)
    (shape,) = answer["shapes"]
    assert shape["bound"] == side and shape["low"] <= shape["value"] <= shape["high"]
    assert answer["doubts"] == list(said)
    assert answer["sentence"] == found.verdict.sentence + (f" But {form}." if side else "")


def test_a_shape_that_is_hardly_told_says_nothing_of_the_form(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doubts_module, "intervals", lambda residual_set, model, names: {SHAPE: (-0.3, 0.1)})
    assert doubts(found.case.train, shaped(found, -1.0)) == ()


def test_an_amplitude_past_its_bound_is_larger_than_its_bounds_allow(found: Small):
    model, whole = found.verdict.model, found.case.full_space
    values = model.values.copy()
    values[whole.index("hinge_preload")] = whole["hinge_preload"].high
    (said,) = doubts(found.case.train, replace(model, values=values))
    most = f"{whole['hinge_preload'].high:g} N m"
    assert said == f"hinge_preload at door is larger than its bounds allow: hinge_preload more than {most}"


def test_the_verdict_carries_its_doubts(found: Small, monkeypatch: pytest.MonkeyPatch):
    assert found.verdict.doubts == ()
    monkeypatch.setattr(workflow, "doubts", lambda residual_set, model, ends: ("the form of it does not fit",))
    assert workflow.search_effects(found.case, found.base, FLOOR).doubts == ("the form of it does not fit",)
