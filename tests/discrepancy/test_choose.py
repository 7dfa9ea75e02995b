"""Which of several models leads."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from droid_jax.discrepancy.selection import ValidationTest, more_general, selected, simplest, without_dominated
from droid_jax.model.effects.candidate import Candidate

FLOOR, WHOLE = 0.1, 1.0


def model(effect: str, amplitudes: int, shapes: int, left: float, *rivals: str, **lost: Any) -> Any:
    """A model of one effect and its trial.  rivals: effects that cannot be told from it."""
    names = tuple(f"{effect}_{k}" for k in range(amplitudes))
    part = Candidate(effect, "slide", names, {f"{effect}_shape_{k}": 1.0 for k in range(shapes)})
    alike = tuple(f"{name} at slide" for name in rivals)
    trial = ValidationTest(
        part.name, 0.0, left, 0.0, {}, 1.0, lost.get("reasons", ()), alike, weak=lost.get("weak", False)
    )
    return SimpleNamespace(parts=(part,), name=part.name), trial


def test_the_fewest_parameters_lead_and_among_equals_the_smallest_gap() -> None:
    stribeck, coulomb, bias = (
        model(*args) for args in (("stribeck", 1, 2, 0.140), ("coulomb", 1, 0, 0.148), ("bias", 1, 0, 0.15))
    )
    assert simplest([stribeck, coulomb, bias]) == coulomb
    assert simplest([stribeck]) == stribeck


def test_one_that_holds_the_leader_as_a_special_case_is_told_from_other_rivals() -> None:
    """Stribeck's friction holds dry friction at its own joint, and no other; the same in a model of two effects."""
    effects: Any = [
        SimpleNamespace(name="coulomb", special_cases=()),
        SimpleNamespace(name="stribeck", special_cases=("coulomb",)),
        SimpleNamespace(name="bias", special_cases=()),
    ]

    def of(*parts: tuple[str, str]) -> Any:
        return SimpleNamespace(parts=[Candidate(effect, place, ()) for effect, place in parts])

    plain = of(("coulomb", "elbow"))
    others = [plain, of(("stribeck", "elbow")), of(("stribeck", "wrist")), of(("bias", "elbow"))]
    assert more_general(effects, plain, [*others, of(("stribeck", "elbow"), ("bias", "elbow"))]) == [
        False, True, False, False, False
    ]  # fmt: skip
    both = of(("bias", "hinge"), ("coulomb", "elbow"))
    assert more_general(effects, both, [of(("bias", "hinge"), ("stribeck", "elbow")), others[1]]) == [True, False]
    assert more_general(effects, others[1], [plain]) == [False]  # not the other way round


def test_which_of_two_at_one_joint_holds_which_does_not_depend_on_their_order() -> None:
    effects: Any = [
        SimpleNamespace(name=n, special_cases=h) for n, h in zip("abAB", ((), (), ("a",), ("b",)), strict=True)
    ]

    def of(*names: str) -> Any:
        return SimpleNamespace(parts=[Candidate(name, "elbow", ()) for name in names])

    for first, second in (("AB", "ab"), ("BA", "ab"), ("AB", "ba"), ("BA", "ba")):
        assert more_general(effects, of(*second), [of(*first)]) == [True]
    assert more_general(effects, of(*"ab"), [of(*"AA")]) == [False]


def test_the_one_that_leaves_least_wins_and_a_plainer_one_that_does_as_well_before_it() -> None:
    """A quarter more above the floor, and a hundredth of the whole gap, is as well: 0.235 for a best of 0.2."""
    flexible = model("stribeck", 1, 2, 0.2, "coulomb", "bias")
    near, far = model("coulomb", 1, 0, 0.234, "stribeck"), model("bias", 1, 0, 0.236, "stribeck")
    assert selected([far, flexible], FLOOR, WHOLE) == flexible
    assert selected([far, flexible, near], FLOOR, WHOLE) == near
    apart = model("drag", 1, 0, 0.234)  # no rival of the best
    assert selected([flexible, apart], FLOOR, WHOLE) == flexible


def test_nothing_wins_where_the_best_is_too_weak_or_all_lost() -> None:
    weak = model("drag", 1, 0, 0.2, reasons=("below the minimum effect size",), weak=True)
    lost, good = model("bias", 1, 0, 0.1, reasons=("takes only 3 %",)), model("coulomb", 1, 0, 0.3)
    assert selected([weak, good], FLOOR, WHOLE) is None
    assert selected([lost], FLOOR, WHOLE) is None and selected([], FLOOR, WHOLE) is None
    assert selected([lost, good], FLOOR, WHOLE) == good


def test_what_holds_the_winner_loses_unless_it_leaves_a_tenth_less() -> None:
    effects: Any = [
        SimpleNamespace(name="coulomb", special_cases=()),
        SimpleNamespace(name="stribeck", special_cases=("coulomb",)),
    ]
    winner = model("coulomb", 1, 0, 0.2)
    for left, stays in ((0.185, True), (0.195, False)):  # above the floor: 0.085 and 0.095 of 0.1
        other = model("stribeck", 1, 2, left)
        kept, judged = without_dominated([winner, other], winner, effects, FLOOR)
        assert kept == winner[1] and (judged == other[1]) is stays
        assert stays or judged.reasons == ("holds coulomb at slide as a special case and leaves no less",)


def test_where_neither_leaves_anything_what_holds_the_winner_loses() -> None:
    effects: Any = [
        SimpleNamespace(name="coulomb", special_cases=()),
        SimpleNamespace(name="stribeck", special_cases=("coulomb",)),
    ]
    winner = model("coulomb", 1, 0, 0.5 * FLOOR)
    for left in (-0.1 * FLOOR, 0.4 * FLOOR, FLOOR):
        _, judged = without_dominated([winner, model("stribeck", 1, 2, left)], winner, effects, FLOOR)
        assert not judged.passed
