"""What is to be doubted of effects in a final model; a nuisance of the small scene serves as a shape parameter here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_gap import FLOOR, Small, small

from droid_jax.discrepancy.fitting import FittedModel, intervals
from droid_jax.discrepancy.results import gap_json
from droid_jax.discrepancy.selection import bound_at, doubts
from droid_jax.discrepancy.verdict import conclude

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


@pytest.mark.slow
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
    (shape,) = answer["shape_parameters"]
    assert shape["bound"] == side and shape["low"] <= shape["value"] <= shape["high"]
    assert answer["doubts"] == list(said)
    assert answer["sentence"] == found.verdict.sentence + (f" But {form}." if side else "")


def test_a_shape_that_is_poorly_constrained_says_nothing_of_the_form(found: Small):
    train, model, p = found.case.train, shaped(found, -1.0), found.case.full_space[SHAPE]
    share = np.ptp(intervals(train, model, [SHAPE])[SHAPE]) / (p.high - p.low)
    assert share < train.config.shape_interval_share
    for interval_share, said in ((0.9 * share, 0), (1.1 * share, 1)):
        assert (
            len(doubts(replace(train, config=replace(train.config, shape_interval_share=interval_share)), model))
            == said
        )


def test_a_coefficient_past_its_bound_is_larger_than_its_bounds_allow(found: Small):
    model, whole = found.verdict.model, found.case.full_space
    values = model.values.copy()
    values[whole.index("hinge_preload")] = whole["hinge_preload"].high
    (said,) = doubts(found.case.train, replace(model, values=values))
    most = f"{whole['hinge_preload'].high:g} N m"
    assert said == f"hinge_preload at door is larger than its bounds allow: hinge_preload more than {most}"
    assert doubts(found.case.train, replace(model, values=values), natural_bounds=("hinge_preload",)) == ()


@pytest.mark.slow
def test_a_coefficient_that_may_be_zero_is_said(found: Small):
    model, whole = found.verdict.model, found.case.full_space
    values = model.values.copy()
    values[whole.index("hinge_preload")] = 0.0
    (said,) = doubts(found.case.train, replace(model, values=values))
    assert said.startswith("of hinge_preload at door, its coefficient may be zero")


@pytest.mark.slow
def test_the_verdict_carries_its_doubts(found: Small):
    assert found.verdict.doubts == ()
    model = shaped(found, -1.0)
    again = conclude(found.case, found.base, model, (), FLOOR)
    assert again.doubts == doubts(found.case.train, model) != ()
