"""Which of several models is selected, and the doubts of its effects.

A nuisance of the small scene serves as a shape parameter.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import FLOOR, Small, small

from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.discrepancy.posterior import intervals
from droid_jax.discrepancy.results import gap_json
from droid_jax.discrepancy.selection import (
    WEAK,
    Reason,
    Rejection,
    ValidationTest,
    bound_at,
    doubts,
    more_general,
    selected,
    simplest,
    without_dominated,
)
from droid_jax.discrepancy.verdict import conclude
from droid_jax.model.effects.candidate import Candidate, EffectKey

U0, BASE = 0.1, 1.0  # discretisation error, and U of the base model
CONFIG = SelectionConfig()
SIMPLE = SimpleNamespace(name="coulomb", special_cases=())
GENERAL = SimpleNamespace(name="stribeck", special_cases=("coulomb",))
EFFECTS: Any = [SIMPLE, GENERAL]


def model(
    effect: str, coefficients: int, shapes: int, left: float, *alike: str, reasons: tuple[Reason, ...] = ()
) -> Any:
    """A model with one effect, and its test.  alike: effects that are indistinguishable from it."""
    names = tuple(f"{effect}_{k}" for k in range(coefficients))
    part = Candidate(effect, "slide", names, {f"{effect}_shape_{k}": 1.0 for k in range(shapes)})
    others = tuple((EffectKey(name, "slide"),) for name in alike)
    rejections = tuple(Rejection(reason, "") for reason in reasons)
    test = ValidationTest((part.key,), 0, 0.0, left, 0.0, {}, 1.0, rejections, others)
    return SimpleNamespace(parts=(part,), keys=(part.key,)), test


def select(tested: list[Any], config: SelectionConfig = CONFIG) -> Any:
    return selected(tested, U0, BASE, config)


@pytest.mark.parametrize(
    ("reasons", "passed", "weak"),
    [
        ((), True, False),
        ((Reason.NOT_CONFIRMED,), False, True),
        ((Reason.BELOW_MINIMUM_SIZE, Reason.NOT_CONFIRMED), False, True),
        ((Reason.BELOW_MINIMUM_SIZE, Reason.SMALL_GAIN), False, False),
        ((Reason.DOMINATED,), False, False),
    ],
)
def test_a_test_is_weak_if_it_failed_for_size_or_significance_alone(
    reasons: tuple[Reason, ...], passed: bool, weak: bool
) -> None:
    _, test = model("drag", 1, 0, 0.2, reasons=reasons)
    assert (test.passed, test.weak) == (passed, weak)
    assert {Reason.NOT_CONFIRMED, Reason.BELOW_MINIMUM_SIZE} == WEAK


def test_the_simplest_model_has_the_fewest_parameters_and_then_the_smallest_discrepancy() -> None:
    stribeck, coulomb, bias = (
        model(*args) for args in (("stribeck", 1, 2, 0.140), ("coulomb", 1, 0, 0.148), ("bias", 1, 0, 0.15))
    )
    assert simplest([stribeck, coulomb, bias]) == coulomb
    assert simplest([stribeck]) == stribeck


def test_a_more_general_model_is_recognised() -> None:
    """Stribeck friction holds dry friction of the same joint as a special case, also in models of two effects."""
    effects: Any = [*EFFECTS, SimpleNamespace(name="bias", special_cases=())]

    def of(*parts: tuple[str, str]) -> Any:
        return SimpleNamespace(parts=[Candidate(effect, location, ()) for effect, location in parts])

    plain = of(("coulomb", "elbow"))
    others = [plain, of(("stribeck", "elbow")), of(("stribeck", "wrist")), of(("bias", "elbow"))]
    assert more_general(effects, plain, [*others, of(("stribeck", "elbow"), ("bias", "elbow"))]) == [
        False, True, False, False, False
    ]  # fmt: skip
    both = of(("bias", "hinge"), ("coulomb", "elbow"))
    assert more_general(effects, both, [of(("bias", "hinge"), ("stribeck", "elbow")), others[1]]) == [True, False]
    assert more_general(effects, others[1], [plain]) == [False]  # not the other way round


def test_more_general_models_do_not_depend_on_the_order_of_effects() -> None:
    effects: Any = [
        SimpleNamespace(name=n, special_cases=h) for n, h in zip("abAB", ((), (), ("a",), ("b",)), strict=True)
    ]

    def of(*names: str) -> Any:
        return SimpleNamespace(parts=[Candidate(name, "elbow", ()) for name in names])

    for first, second in (("AB", "ab"), ("BA", "ab"), ("AB", "ba"), ("BA", "ba")):
        assert more_general(effects, of(*second), [of(*first)]) == [True]
    assert more_general(effects, of(*"ab"), [of(*"AA")]) == [False]


def test_the_smallest_discrepancy_is_selected_or_a_simpler_equivalent_model() -> None:
    """Equivalent is a quarter more beyond U0 plus a hundredth of the base model's U: 0.235 for a best of 0.2."""
    flexible = model("stribeck", 1, 2, 0.2, "coulomb", "bias")
    near, far = model("coulomb", 1, 0, 0.234, "stribeck"), model("bias", 1, 0, 0.236, "stribeck")
    assert select([far, flexible]) == flexible
    assert select([far, flexible, near]) == near
    apart = model("drag", 1, 0, 0.234)  # distinguishable from the best
    assert select([flexible, apart]) == flexible
    assert select([far, flexible], replace(CONFIG, simplest_factor=1.3)) == far
    assert select([far, flexible], replace(CONFIG, simplest_share=0.02)) == far
    assert select([near, flexible], replace(CONFIG, simplest_factor=1.0)) == flexible


def test_nothing_is_selected_if_the_best_is_weak_or_all_failed() -> None:
    weak = model("drag", 1, 0, 0.2, reasons=(Reason.BELOW_MINIMUM_SIZE,))
    lost, good = model("bias", 1, 0, 0.1, reasons=(Reason.SMALL_GAIN,)), model("coulomb", 1, 0, 0.3)
    assert select([weak, good]) is None
    assert select([lost]) is None and select([]) is None
    assert select([lost, good]) == good


@pytest.mark.parametrize(("factor", "least"), [(0.9, 0.19), (0.5, 0.15)])
def test_a_more_general_model_must_have_a_smaller_discrepancy(factor: float, least: float) -> None:
    """U beyond U0, which is 0.1 here, must be a tenth smaller by default."""
    winner, config = model("coulomb", 1, 0, 0.2), replace(CONFIG, generality_factor=factor)
    assert CONFIG.generality_factor == 0.9
    for left, stays in ((least - 0.005, True), (least + 0.005, False)):
        for why in ((), (Reason.NOT_CONFIRMED,)):
            other = model("stribeck", 1, 2, left, reasons=why)
            first, second = without_dominated([winner, other], winner, EFFECTS, U0, config)
            assert first == winner[1] and (second == other[1]) is stays
            assert stays or [r.reason for r in second.reasons] == [Reason.DOMINATED]
            assert stays or not second.weak


def test_a_more_general_model_is_dominated_if_both_explain_everything() -> None:
    winner = model("coulomb", 1, 0, 0.5 * U0)
    for left in (-0.1 * U0, 0.4 * U0, U0):
        _, judged = without_dominated([winner, model("stribeck", 1, 2, left)], winner, EFFECTS, U0, CONFIG)
        assert not judged.passed


# Doubts of the effects in a final model ----------------------------------------------------

SHAPE = "torque_offset[elbow]"  # -0.3 to 0.3 N m


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def shaped(found: Small, value: float) -> FittedModel:
    """The final model with a shape parameter of this value."""
    model, whole = found.verdict.model, found.case.full_space
    (part,) = model.parts
    values = model.values.copy()
    values[whole.index(SHAPE)] = np.clip(value, whole[SHAPE].low, whole[SHAPE].high)
    return replace(model, parts=(replace(part, shape_parameters={SHAPE: value}),), values=values)


@pytest.mark.slow
@pytest.mark.parametrize(("value", "side", "at"), [(-1.0, "lower", "-0.3"), (1.0, "upper", "0.3"), (0.1, "", "")])
def test_a_shape_parameter_at_its_bound_is_a_doubt_about_the_form(found: Small, value: float, side: str, at: str):
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


def test_a_poorly_constrained_shape_parameter_is_no_doubt(found: Small):
    train, model, p = found.case.train, shaped(found, -1.0), found.case.full_space[SHAPE]
    share = np.ptp(intervals(train, model, [SHAPE])[SHAPE]) / (p.high - p.low)
    assert share < train.config.shape_interval_share
    for interval_share, said in ((0.9 * share, 0), (1.1 * share, 1)):
        assert (
            len(doubts(replace(train, config=replace(train.config, shape_interval_share=interval_share)), model))
            == said
        )


def test_a_coefficient_at_its_bound_is_a_doubt(found: Small):
    model, whole = found.verdict.model, found.case.full_space
    values = model.values.copy()
    values[whole.index("hinge_preload")] = whole["hinge_preload"].high
    (said,) = doubts(found.case.train, replace(model, values=values))
    most = f"{whole['hinge_preload'].high:g} N m"
    assert said == f"hinge_preload at door is larger than its bounds allow: hinge_preload more than {most}"
    assert doubts(found.case.train, replace(model, values=values), natural_bounds=("hinge_preload",)) == ()


@pytest.mark.slow
def test_a_coefficient_that_may_be_zero_is_a_doubt(found: Small):
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
