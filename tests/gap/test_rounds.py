"""Which of several models leads."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from droid_jax.gap.blocks import OUTSIDE, Blocks
from droid_jax.gap.candidates import Candidate
from droid_jax.gap.evidence import Evidence
from droid_jax.gap.rounds import Budget, Hunt, holding, plainest, without


def model(effect: str, amplitudes: int, shapes: int, left: float) -> Any:
    names = tuple(f"{effect}_{k}" for k in range(amplitudes))
    part = Candidate(effect, "slide", names, {f"{effect}_shape_{k}": 1.0 for k in range(shapes)})
    return SimpleNamespace(parts=(part,), name=part.name), SimpleNamespace(gap_confirm=left)


def test_the_fewest_parameters_lead_and_among_equals_the_smallest_gap() -> None:
    stribeck, coulomb, bias = (
        model(*args) for args in (("stribeck", 1, 2, 0.140), ("coulomb", 1, 0, 0.148), ("bias", 1, 0, 0.15))
    )
    assert plainest([stribeck, coulomb, bias]) == coulomb
    assert plainest([stribeck]) == stribeck


def test_one_that_holds_the_leader_as_a_special_case_is_told_from_other_rivals() -> None:
    """Stribeck's friction holds dry friction at its own joint, and no other; the same in a model of two effects."""
    effects: Any = [
        SimpleNamespace(name="coulomb", holds=()),
        SimpleNamespace(name="stribeck", holds=("coulomb",)),
        SimpleNamespace(name="bias", holds=()),
    ]

    def of(*parts: tuple[str, str]) -> Any:
        return SimpleNamespace(parts=[Candidate(effect, place, ()) for effect, place in parts])

    plain = of(("coulomb", "elbow"))
    others = [plain, of(("stribeck", "elbow")), of(("stribeck", "wrist")), of(("bias", "elbow"))]
    assert holding(effects, plain, [*others, of(("stribeck", "elbow"), ("bias", "elbow"))]) == [
        False, True, False, False, False
    ]  # fmt: skip
    both = of(("bias", "hinge"), ("coulomb", "elbow"))
    assert holding(effects, both, [of(("bias", "hinge"), ("stribeck", "elbow")), others[1]]) == [True, False]
    assert holding(effects, others[1], [plain]) == [False]  # not the other way round


def test_a_shape_stays_where_its_effect_does() -> None:
    """A ripple asked about elsewhere has the count of the one in the model, and keeps it when that one goes."""
    first = Candidate("ripple", "elbow", ("ripple_elbow",), {"periods": 48.0})
    second, drag = Candidate("ripple", "wrist", ("ripple_wrist",)), Candidate("drag", "hinge", ("drag",))
    assert without(first, (first, drag, second)) == (
        drag,
        Candidate("ripple", "wrist", ("ripple_wrist",), {"periods": 48.0}),
    )
    assert without(second, (first, drag, second)) == (first, drag)
    assert without(drag, (first, drag)) == (first,)


def test_a_budget_says_what_it_left_out() -> None:
    tight = Budget(1e-9)
    assert list(tight.within("candidates not refitted", "abc")) == ["a"] and tight.spent
    tight.skip("pairs of effects not tried")
    assert tight.cut == "2 of 3 candidates not refitted; pairs of effects not tried"
    free = Budget(None)
    assert list(free.within("candidates not refitted", "abc")) == ["a", "b", "c"] and free.cut == ""


@pytest.mark.parametrize("blocks", [False, True])
def test_the_aim_is_the_objective_of_half_the_share_that_an_effect_must_take(blocks: bool) -> None:
    """U of 4, a fifth of which an effect must take away: the objective falls by a tenth of it."""
    cost, nothing, none = SimpleNamespace(), np.zeros((1, 30)), np.zeros(30)
    block = np.array([0] * 6 + [1] * 6 + [OUTSIDE] * 18)
    known: Any = (cost, nothing, none, none)
    evidence = Blocks(*known, block) if blocks else Evidence(*known)
    count = 12 if blocks else 30
    fitted: Any = SimpleNamespace(parts=(), gap=4.0, refined=SimpleNamespace(objective=0.5 * count * 4.0))
    hunt: Any = SimpleNamespace(case=SimpleNamespace(fit=evidence))
    assert Hunt.aim(hunt, fitted) == pytest.approx(0.9 * fitted.refined.objective)
