"""The verdict of a search: from its models and steps to the conclusion, and the conclusion in words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import FLOOR, Small, problem_of, small

from droid_jax.discrepancy import search
from droid_jax.discrepancy.candidate_fits import Notes
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.config import SelectionConfig
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.discrepancy.posterior import remaining_discrepancy
from droid_jax.discrepancy.results import gap_json
from droid_jax.discrepancy.search import SearchState, search_effects, selection_step
from droid_jax.discrepancy.selection import Reason, Rejection, SelectionStep, ValidationTest
from droid_jax.discrepancy.statistics import Repeats
from droid_jax.discrepancy.verdict import Conclusion, Verdict, closes_too_little, conclude, worsened
from droid_jax.files import LOST
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import Candidate, EffectKey, Keys

PRELOAD = EffectKey("hinge_preload", "door")


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def steps(found: Small) -> tuple[SelectionStep, ...]:
    state, _ = selection_step(SearchState(found.base), problem_of(found))
    return state.steps


def with_thresholds(case: Case, **thresholds: float) -> Case:
    """The case with other thresholds in all its residual sets."""
    selection = replace(case.config.selection, **thresholds)
    config = replace(case.config, selection=selection)
    sets = {role: replace(e, config=selection) for role, e in case.residual_sets.items()}
    return replace(case, config=config, **sets)


# Fits without a conclusion ----------------------------------------------------------------------


def test_there_is_no_conclusion_if_the_base_fit_did_not_converge(found: Small):
    base = replace(found.base, refined=replace(found.base.refined, converged=False))
    verdict = search_effects(found.case, base, FLOOR)
    assert verdict.conclusion is Conclusion.UNCONVERGED
    assert (verdict.effects, verdict.validation_tests, verdict.score_tests, verdict.trend) == ((), (), (), None)
    assert verdict.remainder is None
    assert "the base model did not converge" in verdict.sentence


def test_nothing_is_named_if_the_fit_with_effects_did_not_converge(found: Small, monkeypatch: pytest.MonkeyPatch):
    def unconverged(problem: Any, model: FittedModel) -> tuple[FittedModel, Notes]:
        return replace(model, refined=replace(model.refined, converged=False)), Notes()

    monkeypatch.setattr(search, "polished", unconverged)
    verdict = search_effects(found.case, found.base, FLOOR)
    assert verdict.conclusion is Conclusion.UNCONVERGED
    assert "the model with the effects" in verdict.sentence
    assert (verdict.effects, verdict.indistinguishable, verdict.indistinguishable_models) == ((), (), ())
    assert verdict.model is found.base
    assert any(test.passed for test in verdict.validation_tests)  # the tests are in the verdict


def test_a_discrepancy_below_the_discretisation_error_is_none(found: Small):
    """The score test rejects, but the error of the time step is as large."""
    verdict = search_effects(found.case, found.base, 2.0 * found.base.discrepancy)
    assert verdict.conclusion is Conclusion.NONE
    assert verdict.score_tests[0].p < found.case.config.selection.significance
    assert not verdict.effects and np.isfinite(verdict.closed("validation"))


def test_a_discrepancy_within_an_error_of_first_order_is_none(found: Small):
    """A quarter of such an error remains at a quarter of the step, so U0 is nine sixteenths of its U."""
    assert search_effects(found.case, found.base, 0.6 * found.base.discrepancy).conclusion is Conclusion.NONE
    assert search_effects(found.case, found.base, 0.5 * found.base.discrepancy).conclusion is not Conclusion.NONE


def test_a_test_motion_that_blows_up_is_left_out_and_reported(found: Small, steps: tuple[SelectionStep, ...]):
    """It is replayed at the end of a search of hours, whose result must not be lost."""

    def discrepancy_at(values: np.ndarray) -> float:
        raise NotReplayed("the simulation of 'test' blows up")

    lost: Any = SimpleNamespace(discrepancy_at=discrepancy_at)
    verdict = conclude(replace(found.case, test=lost), found.base, found.verdict.model, steps, FLOOR, failed=("x",))
    assert verdict.discrepancies == found.verdict.discrepancies and verdict.failed == ("x", LOST)
    assert verdict.conclusion is Conclusion.NAMED


# Remainders -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Known(Repeats):
    """Repeats with a given U and a given p-value."""

    p: float

    def discrepancy(self, residuals: np.ndarray) -> float:
        return 5.0

    def cell_p_values(self, residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
        return np.full(len(cells), self.p)


@pytest.mark.parametrize(
    ("exhausted", "p", "open_share", "remains"),
    [
        (True, 0.001, 0.1, True),
        (True, 0.5, 0.1, False),  # not significant
        (False, 0.5, 0.1, True),  # a score test found more
        (True, 0.001, 1.0, False),  # below the open share
    ],
)
def test_a_large_and_significant_remainder_counts(
    found: Small, steps: tuple[SelectionStep, ...], exhausted: bool, p: float, open_share: float, remains: bool
):
    """A remainder may resemble no candidate: it counts by its share of U and its significance over the repeats."""
    case = with_thresholds(found.case, open_share=open_share, minimum_closed=0.0)
    assert isinstance(case.validation.resampling, Repeats)
    known = Known(case.validation.resampling.deviations, p)
    case = replace(case, validation=replace(case.validation, resampling=known))
    verdict = conclude(case, found.base, found.verdict.model, steps, FLOOR, exhausted=exhausted)
    assert verdict.discrepancies["validation"] == (5.0, 5.0)
    assert verdict.conclusion is (Conclusion.PARTLY if remains else Conclusion.NAMED)


LITTLE = {"train": (4.0, 2.0), "validation": (4.0, 2.8), "test": (3.0, 2.07)}  # explains 30 and 31 % of held-out data


@pytest.mark.parametrize(
    ("conclusion", "discrepancies", "least", "little"),
    [
        (Conclusion.PARTLY, LITTLE, 0.4, True),
        (Conclusion.PARTLY, LITTLE, 0.25, False),
        (Conclusion.PARTLY, {**LITTLE, "validation": (4.0, 0.8)}, 0.4, True),  # by the test motion alone
        (Conclusion.PARTLY, {**LITTLE, "test": (3.0, 0.3)}, 0.4, True),
        # The training recording does not count.
        (Conclusion.PARTLY, {"train": (4.0, 3.6), "validation": (4.0, 0.8)}, 0.4, False),
        # No discrepancy in the test recording.
        (
            Conclusion.PARTLY,
            {"train": (4.0, 2.0), "validation": (4.0, 0.8), "test": (0.011, 0.0105)},
            0.4,
            False,
        ),
        (Conclusion.NAMED, LITTLE, 0.4, False),  # no significant remainder
        (Conclusion.INDISTINGUISHABLE, LITTLE, 0.4, False),
    ],
)
def test_beside_a_remainder_effects_must_explain_their_share_of_held_out_data(
    found: Small, conclusion: Conclusion, discrepancies: dict[str, tuple[float, float]], least: float, little: bool
):
    config = replace(found.verdict.config, minimum_closed=least)
    verdict = replace(found.verdict, conclusion=conclusion, discrepancies=discrepancies, config=config)
    assert closes_too_little(verdict) is little


def a_third(found: Small) -> FittedModel:
    """A model a sixth of the way from the base model to the extended one: it explains 31 % of U, which is quadratic."""
    share = 1 - np.sqrt(0.69)
    return replace(found.verdict.model, values=(1 - share) * found.base.values + share * found.verdict.model.values)


def test_an_effect_that_explains_a_third_is_a_hint(found: Small, steps: tuple[SelectionStep, ...]):
    """An effect that passed and explains a third of a held-out motion beside a significant remainder: unexplained."""
    assert found.case.config.selection.minimum_closed == 0.4
    verdict = conclude(found.case, found.base, a_third(found), steps, FLOOR)
    assert verdict.conclusion is Conclusion.UNEXPLAINED and verdict.model is found.base
    assert (verdict.effects, verdict.indistinguishable, verdict.indistinguishable_models) == ((), (), ())
    before = found.case.validation.discrepancy_at(found.base.values)
    assert verdict.discrepancies["validation"] == (before, before)
    assert verdict.remainder == remaining_discrepancy(found.case.train, found.case.validation, found.base)
    assert verdict.before == verdict.after
    (hint,) = verdict.hints
    assert hint.effects == (PRELOAD,) and hint.indistinguishable == ((),)
    assert hint.closed == {"validation": pytest.approx(0.31, abs=0.08)}
    assert verdict.sentence.endswith(f"{PRELOAD} (closes {hint.closed['validation']:.0%}).")
    assert any(test.passed for test in verdict.validation_tests)  # the tests are in the verdict


def test_a_threshold_set_from_python_changes_the_verdict_and_is_in_the_file(
    found: Small, steps: tuple[SelectionStep, ...]
):
    case = with_thresholds(found.case, minimum_closed=0.2)
    verdict = conclude(case, found.base, a_third(found), steps, FLOOR)
    assert verdict.conclusion is Conclusion.PARTLY and verdict.effects == (PRELOAD,) and verdict.hints == ()
    assert verdict.config.minimum_closed == 0.2
    answer = gap_json(case, verdict)
    assert answer["verdict"] == Conclusion.PARTLY.value and answer["config"]["selection"]["minimum_closed"] == 0.2
    usual = gap_json(found.case, conclude(found.case, found.base, a_third(found), steps, FLOOR))
    assert usual["verdict"] == Conclusion.UNEXPLAINED.value and usual["config"]["selection"]["minimum_closed"] == 0.4


# Alternatives -------------------------------------------------------------------------------


def at_door(names: str) -> Keys:
    """Keys of effects named by one letter each."""
    return tuple(EffectKey(name, "door") for name in names)


def made_up(found: Small, names: str) -> FittedModel:
    """A model with effects without coefficients."""
    return replace(found.verdict.model, parts=tuple(Candidate(name, "door", ()) for name in names))


def passing(names: str, *alike: str) -> ValidationTest:
    return ValidationTest(at_door(names), 0, 0.0, 0.1, 0.0, {}, 1.0, (), tuple(map(at_door, alike)))


def selecting(found: Small, before: str, winner: str, *alike: str) -> SelectionStep:
    """A step with the effects before it, the selected ones, and those indistinguishable from these."""
    models = (winner, *alike)
    return SelectionStep(
        found.verdict.score_tests[0], at_door(before), (), tuple(made_up(found, names) for names in models),
        (passing(winner, *alike), *(passing(names, winner) for names in alike)),
        made_up(found, winner), passing(winner, *alike),
    )  # fmt: skip


def alternatives(found: Small, names: str, *made: SelectionStep) -> dict[str, set[str]]:
    """Effect -> alternatives of a model, one letter for each effect."""
    verdict = conclude(found.case, found.base, made_up(found, names), made, FLOOR)
    each = zip(verdict.effects, verdict.indistinguishable, strict=True)
    return {key.effect: {"".join(k.effect for k in keys) for keys in others} for key, others in each}


def test_alternatives_are_those_of_the_last_step_that_selected_an_effect(found: Small):
    first, pair = selecting(found, "", "a", "x"), selecting(found, "", "ab", "yb")
    assert alternatives(found, "a", first) == {"a": {"x"}}
    assert alternatives(found, "ab", first, pair) == {"a": {"y"}, "b": set()}
    lost = SelectionStep(found.verdict.score_tests[0])
    assert alternatives(found, "a", first, lost) == {"a": {"x"}}


def test_an_effect_of_the_model_is_no_alternative_to_another_one(found: Small):
    first, second = selecting(found, "", "a", "b", "x"), selecting(found, "a", "ab")
    assert alternatives(found, "ab", first, second) == {"a": {"x"}, "b": set()}


def test_an_alternative_to_several_effects_is_listed_for_each(found: Small):
    assert alternatives(found, "ab", selecting(found, "", "ab", "ce")) == {"a": {"ce"}, "b": {"ce"}}
    assert alternatives(found, "ab", selecting(found, "", "ab", "c")) == {"a": {"c"}, "b": {"c"}}


def test_alternatives_make_the_verdict_indistinguishable_and_their_models_are_in_it(found: Small):
    made = selecting(found, "", "a", "x")
    rejected = replace(made.tests[1], reasons=(Rejection(Reason.RARELY_BEST, ""),))
    verdict = conclude(found.case, found.base, made_up(found, "a"), (made,), FLOOR)
    assert verdict.conclusion is Conclusion.INDISTINGUISHABLE
    assert [[m.keys for m in group] for group in verdict.indistinguishable_models] == [[at_door("a"), at_door("x")]]
    alone = conclude(
        found.case, found.base, made_up(found, "a"), (replace(made, tests=(made.tests[0], rejected)),), FLOOR
    )
    assert alone.conclusion is Conclusion.NAMED and alone.indistinguishable_models == ()


def groups(found: Small, names: str, *made: SelectionStep) -> list[list[str]]:
    """The groups of indistinguishable models of a verdict, one letter for each effect."""
    verdict = conclude(found.case, found.base, made_up(found, names), made, FLOOR)
    return [["".join(k.effect for k in m.keys) for m in group] for group in verdict.indistinguishable_models]


def test_the_models_of_every_step_whose_choice_is_open_are_in_the_verdict(found: Small):
    """Without those of the first step no experiment would be computed for its alternatives."""
    first, second = selecting(found, "", "a", "x"), selecting(found, "a", "ab")
    assert groups(found, "ab", first, second) == [["a", "x"]]
    assert groups(found, "ab", first, selecting(found, "a", "ab", "ay")) == [["a", "x"], ["ab", "ay"]]
    assert groups(found, "ab", selecting(found, "", "a"), selecting(found, "a", "ab", "ay")) == [["ab", "ay"]]
    assert groups(found, "ab", first, selecting(found, "", "ab")) == []  # the pair was selected instead
    assert groups(found, "b", first, second) == []  # a was taken out again
    assert groups(found, "ax", first, selecting(found, "a", "ax")) == []  # both are in the model


# In words -----------------------------------------------------------------------------------


def keys(*names: str) -> tuple[Keys, ...]:
    """Alternatives of one effect each."""
    return tuple(at_door(name) for name in names)


@pytest.mark.parametrize(
    ("alternatives", "said"),
    [
        (((), ()), "The model lacks: a at door and b at door."),
        ((keys("x"), ()), "The model lacks b at door, and one of: a at door or x at door."),
        (
            (keys("x"), (*keys("y"), at_door("zw"))),
            "The model lacks one of: a at door or x at door, and one of: b at door or y at door or z at door + w at "
            "door.",
        ),
    ],
)
def test_the_sentence_separates_certain_effects_from_alternatives(found: Small, alternatives: Any, said: str):
    conclusion = Conclusion.INDISTINGUISHABLE if any(alternatives) else Conclusion.NAMED
    verdict = replace(found.verdict, conclusion=conclusion, effects=at_door("ab"), indistinguishable=alternatives)
    assert verdict.sentence == said
    before = verdict.discrepancies["validation"][0]
    partly = replace(verdict, conclusion=Conclusion.PARTLY, discretisation_error=0.0, remainder=0.4 * before)
    assert partly.explained == pytest.approx(0.6)
    assert partly.sentence == said.replace("lacks: ", "lacks ")[:-1] + "; a remainder is unexplained."
    little = replace(partly, remainder=0.77 * before).sentence
    assert little.startswith("Most of what the model lacks is not in the library") and "23%" in little
    assert little.endswith(said.removeprefix("The model lacks").removeprefix(":")[1:])
    most = replace(partly, remainder=0.77 * before, config=replace(partly.config, mostly_explained=0.2))
    assert most.sentence == partly.sentence


def rejected(test: ValidationTest, *reasons: Reason) -> ValidationTest:
    return replace(test, reasons=tuple(Rejection(reason, f"text of {reason.value}") for reason in reasons))


@pytest.mark.parametrize(
    ("reason", "why"),
    [
        (Reason.BELOW_MINIMUM_SIZE, "{name}, below the minimum effect size"),
        (Reason.AT_BOUND, "{name} (text of at bound), larger than its bounds allow"),
        (Reason.NOT_CONFIRMED, "{name}, not confirmed by the validation recording"),
    ],
)
def test_a_model_rejected_for_one_reason_alone_is_in_the_sentence(found: Small, reason: Reason, why: str):
    verdict = replace(found.verdict, conclusion=Conclusion.UNEXPLAINED, effects=(), indistinguishable=())
    nothing = "The model lacks something that is not in the library."
    assert verdict.sentence == nothing
    test = verdict.validation_tests[0]
    alone, both = rejected(test, reason), rejected(test, reason, Reason.SMALL_GAIN)
    assert replace(verdict, validation_tests=(both,)).sentence == nothing
    said = replace(verdict, validation_tests=(alone, both, alone)).sentence
    assert said == f"{nothing[:-1]}, or {why.format(name=PRELOAD)}."
    assert test.keys == (PRELOAD,)
    other = rejected(replace(test, keys=at_door("z")), Reason.SMALL_GAIN)
    assert replace(verdict, validation_tests=(other,)).sentence == nothing


def test_doubts_end_the_sentence(found: Small):
    doubted: Verdict = replace(found.verdict, doubts=("it is large", "its form does not fit"))
    assert doubted.sentence == f"{found.verdict.sentence} But it is large. But its form does not fit."


def test_a_worse_match_of_the_test_recording_is_a_doubt(found: Small):
    """Friction fitted at low gains let a servo stick at a higher one, and the verdict did not say so."""
    model = found.verdict.model
    assert model.parts and found.verdict.doubts == ()
    config = SelectionConfig()
    assert worsened({"test": (1.0, 1.1)}, model, 0.0, config) == ()
    assert worsened({"validation": (0.1, 0.2)}, model, 0.0, config) == ()
    assert worsened({"test": (0.1, 0.2)}, replace(model, parts=()), 0.0, config) == ()
    (said,) = worsened({"test": (0.1155, 1.0168)}, model, 0.01, config)
    assert said == "the test recording is matched worse with it, U 0.116 before and 1.02 after"
    # A U about zero, below the discretisation error, was called worse.
    assert worsened({"test": (-0.001, 0.005)}, model, 0.01, config) == ()
    assert len(worsened({"test": (-0.001, 0.05)}, model, 0.01, config)) == 1
