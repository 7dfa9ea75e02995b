"""The search as a whole, where something is wrong: an effect that blows up, a fit that did not settle."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from droid_jax.discrepancy.search_state import Budget
from droid_jax.discrepancy.select import AT_BOUND, TOO_SMALL, UNCONFIRMED
from droid_jax.discrepancy.selection_step import forward_step
from small_gap import EFFECTS, FLOOR, QUICK, Small, record, small, small_scene

from droid_jax.discrepancy import workflow
from droid_jax.discrepancy.candidates import ScoreTest, directions_of, proposals, score_test
from droid_jax.discrepancy.case import make_case
from droid_jax.discrepancy.fitting import FittedModel, base_fit, remaining_residuals
from droid_jax.discrepancy.search import SearchState, search_effects
from droid_jax.discrepancy.selection import SelectionStep
from droid_jax.discrepancy.verdict import Conclusion
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import Candidate, candidates
from droid_jax.model.effects.registry import library
from droid_jax.model.parameters import Parameter
from droid_jax.model.scene import Scene


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
        description="a replay that blows up",
        locations={"door": ("bomb",)},
        minimum_size=0.1,
    )


def test_an_effect_that_blows_up_is_left_out_and_named():
    """What is really missing is found all the same."""
    scene, space = small_scene()
    effects = (*library(scene, EFFECTS), bomb(scene))
    case = make_case(scene, space, effects, record("train"), record("validation"), config=QUICK)
    verdict = search_effects(case, base_fit(case, lambda stage, value: None), FLOOR)
    assert verdict.score_tests[0].failed == ("bomb at door",)
    assert verdict.effects == ("hinge_preload at door",)
    assert not any("bomb" in trial.name for trial in verdict.validation_tests if trial.passed)
    row = next(k for k, q in enumerate(verdict.score_tests[0].directions) if q.coefficient == "bomb")
    assert verdict.score_tests[0].t[row] == verdict.score_tests[0].explained[row] == 0.0


def late_bomb(scene: Scene) -> Effect:
    """A preload that is neutral at its upper bound, and no number at the size that the preload has."""
    dof = scene.dof("door")

    def force(theta, state):
        pull = jnp.where(theta["late_bomb"] < -0.3, jnp.nan, theta["late_bomb"])
        return jnp.zeros_like(state.qvel).at[dof].set(pull)

    return Effect(
        "late_bomb",
        (Parameter("late_bomb", "N m", 0.0, 0.5, -5.0, 0.0),),
        force=force,
        description="a preload that blows up",
        locations={"door": ("late_bomb",)},
        minimum_size=0.1,
    )


def test_a_refit_that_blows_up_where_it_begins_is_left_out_and_named(monkeypatch: pytest.MonkeyPatch):
    """The screening's small step is replayed, the proposal is not."""
    monkeypatch.setattr(
        SearchState, "one_step_fit", lambda state, model, part, found: (_proposed(state, model, part, found), -np.inf)
    )
    scene, space = small_scene()
    case = make_case(scene, space, (late_bomb(scene),), record("train"), record("validation"), config=QUICK)
    verdict = search_effects(case, base_fit(case, lambda stage, value: None), FLOOR)
    assert verdict.score_tests[0].failed == () and verdict.score_tests[0].explained[0] > 0.5
    assert verdict.failed == ("late_bomb at door",) and verdict.validation_tests == ()
    assert verdict.kind is Conclusion.UNEXPLAINED


def _proposed(state: SearchState, model: FittedModel, part: Candidate, found: ScoreTest) -> np.ndarray:
    (proposal,) = proposals(found, model.residuals, state.case.full_space)
    return proposal.start(state.case.full_space, model.values)


def test_a_search_ends_where_all_that_was_asked_about_is_in_the_model():
    scene, space = small_scene()
    effects, config = library(scene, ["hinge_preload"]), replace(QUICK, max_effects=2)
    case = make_case(scene, space, effects, record("train"), record("validation"), config=config)
    verdict = search_effects(case, base_fit(case, lambda stage, value: None), FLOOR)
    assert verdict.effects == ("hinge_preload at door",) and len(verdict.score_tests) == 1


def test_no_more_effects_are_tried_together_than_are_asked_for(found: Small, monkeypatch: pytest.MonkeyPatch):
    """Where two might explain more, pairs are tried, and the screening that they come from is told once."""
    tried = list[str]()

    def pairs(state, base, model, first):
        tried.append(model.name)
        return SelectionStep(first.screen)

    monkeypatch.setattr(workflow, "pair_step", pairs)
    monkeypatch.setattr(workflow, "_unsettled", lambda state, model: True)
    monkeypatch.setattr(workflow, "open_directions", lambda asked, model: () if model.parts else asked)
    assert found.case.config.max_effects == 1
    assert len(search_effects(found.case, found.base, FLOOR).score_tests) == 1 and not tried
    monkeypatch.setattr(
        workflow,
        "forward_step",
        lambda state, model, screen: replace(forward_step(state, model, screen), selected=None),
    )
    monkeypatch.setattr(workflow, "restart_from_prior", lambda state, base, done: done)
    two = replace(found.case, config=replace(found.case.config, max_effects=2))
    assert len(search_effects(two, found.base, FLOOR).score_tests) == 1 and tried == [found.base.name]


def test_what_blows_up_on_the_other_motion_while_it_settles_stays_as_it_was(monkeypatch: pytest.MonkeyPatch):
    class Judge:
        def common(self, values):
            return values[None] * np.where(values[0] > 1.0, np.nan, 1.0)

    state: Any = SearchState(SimpleNamespace(validation=Judge()), 1.0, 0.0, Budget(None), lambda stage, value: None)  # type: ignore
    model: Any = SimpleNamespace(parts=(), values=np.array([0.5]))
    ends: Any = [SimpleNamespace(parts=(), values=np.array([x])) for x in (0.7, 1.5)]
    monkeypatch.setattr(SearchState, "refit", lambda self, parts, start, config, note: ends[0])
    assert state.polished(model, None, "") is ends[0]
    monkeypatch.setattr(SearchState, "refit", lambda self, parts, start, config, note: ends[1])
    assert state.polished(model, None, "") is model


def test_effects_without_places_cannot_be_asked_about(found: Small):
    placeless = tuple(replace(e, locations={}) for e in found.case.effects)
    with pytest.raises(ValueError, match="none of the effects says its locations"):
        search_effects(replace(found.case, effects=placeless), found.base, FLOOR)


def test_where_nothing_blows_up_nothing_is_left_out(found: Small):
    assert score_test(found.case, found.base, directions_of(candidates(found.case.effects))).failed == ()


def test_a_nuisance_goes_no_further_than_its_prior_says(found: Small):
    p = found.case.base["torque_offset[elbow]"]
    assert (p.low, p.high) == (pytest.approx(-0.3), pytest.approx(0.3))  # of bounds of 2 and a deviation of 0.1


def test_a_parameter_at_its_bound_absorbs_nothing_more(found: Small):
    asked, refined = directions_of(candidates(found.case.effects)), found.base.refined
    assert refined.free.all()
    at = refined.space.index("door_stiffness")
    x = refined.x.copy()
    x[at] = refined.space.to_search(refined.space.high)[at]
    stuck = replace(found.base, refined=replace(refined, x=x))
    assert np.flatnonzero(~stuck.refined.free).tolist() == [at]
    before, after = (
        np.linalg.norm(score_test(found.case, m, asked).sensitivities, axis=1) for m in (found.base, stuck)
    )
    assert np.all(after >= before - 1e-9)
    preload = [q.coefficient for q in asked].index("hinge_preload")
    assert after[preload] > 1.1 * before[preload]  # a spring looks like a preload


def test_no_verdict_from_a_base_fit_that_did_not_converge(found: Small):
    base = replace(found.base, refined=replace(found.base.refined, converged=False))
    verdict = search_effects(found.case, base, FLOOR)
    assert verdict.kind is Conclusion.UNCONVERGED
    assert (verdict.effects, verdict.validation_tests, verdict.score_tests, verdict.trend) == ((), (), (), None)
    assert verdict.sentence == "The fit of the base model did not converge; nothing can be concluded."


def test_no_name_from_an_extended_fit_that_did_not_converge(found: Small, monkeypatch: pytest.MonkeyPatch):
    def unsettled(state, model):
        return replace(model, refined=replace(model.refined, converged=False))

    monkeypatch.setattr(workflow, "polished", unsettled)
    verdict = search_effects(found.case, found.base, FLOOR)
    assert verdict.kind is Conclusion.UNCONVERGED
    assert "the model with the effects" in verdict.sentence
    assert (verdict.effects, verdict.indistinguishable, verdict.indistinguishable_models) == (
        (),
        (),
        (),
    ) and verdict.model is found.base
    assert any(trial.passed for trial in verdict.validation_tests)  # the grounds are told


def of_gap(residual_set: Any, gap: float) -> Any:
    """A residual set whose every U is this."""
    return SimpleNamespace(discrepancy=lambda residuals: gap, cell_p_values=residual_set.cell_p_values)


def test_what_is_left_counts_where_chance_would_not_leave_it(found: Small):
    """A remainder that no candidate looks like is one: half of what was there, or half of noise."""
    case = found.case
    left = remaining_residuals(case.train, case.validation, found.base)
    state: Any = SimpleNamespace(
        case=case, discretisation_error=FLOOR, base_discrepancy=2.0 * case.validation.discrepancy(left)
    )
    assert workflow._remains(state, left, quiet=True)
    vast: Any = SimpleNamespace(case=case, discretisation_error=FLOOR, base_discrepancy=1e3)
    assert not workflow._remains(vast, left, quiet=False)
    signs = np.where(np.arange(case.validation.repeats) % 2, 1.0, -1.0)[:, None]
    by_chance = signs * np.ones((case.validation.repeats, 6))
    state.case = SimpleNamespace(validation=of_gap(case.validation, found.base.discrepancy))
    assert not workflow._remains(state, by_chance, quiet=True) and workflow._remains(state, by_chance, quiet=False)


LITTLE = {"train": (4.0, 2.0), "validation": (4.0, 2.8), "test": (3.0, 2.07)}  # closes 30 and 31 % of held-out data


@pytest.mark.parametrize(
    ("kind", "gaps", "least", "little"),
    [
        (Conclusion.PARTLY, LITTLE, 0.4, True),
        (Conclusion.PARTLY, LITTLE, 0.25, False),
        (Conclusion.PARTLY, {**LITTLE, "validation": (4.0, 0.8)}, 0.4, True),  # the test motion alone says so
        (Conclusion.PARTLY, {**LITTLE, "test": (3.0, 0.3)}, 0.4, True),
        (
            Conclusion.PARTLY,
            {"train": (4.0, 3.6), "validation": (4.0, 0.8)},
            0.4,
            False,
        ),  # what was fitted decides nothing
        (
            Conclusion.PARTLY,
            {"train": (4.0, 2.0), "validation": (4.0, 0.8), "test": (0.011, 0.0105)},
            0.4,
            False,
        ),  # no gap there
        (Conclusion.NAMED, LITTLE, 0.4, False),  # nothing significant is left
        (Conclusion.INDISTINGUISHABLE, LITTLE, 0.4, False),
    ],
)
def test_beside_a_remainder_a_name_needs_its_share_of_held_out_data(
    found: Small, kind: Conclusion, gaps: dict[str, tuple[float, float]], least: float, little: bool
):
    verdict = replace(found.verdict, kind=kind, discrepancies=gaps)
    assert workflow.too_little(verdict, least) is little


def test_a_name_for_a_third_of_a_discrepancy_is_a_hint(found: Small, monkeypatch: pytest.MonkeyPatch):
    """An effect that passed, a significant remainder, and 31 % closed on one held-out motion: unexplained."""
    monkeypatch.setattr(workflow, "_remains", lambda *arguments: True)
    monkeypatch.setattr(workflow, "_gaps", lambda state, base, model: {"train": (4.0, 2.0), "validation": (4.01, 2.77)})
    verdict = search_effects(found.case, found.base, FLOOR)
    assert verdict.kind is Conclusion.UNEXPLAINED and (
        verdict.effects,
        verdict.indistinguishable,
        verdict.indistinguishable_models,
    ) == ((), (), ())
    assert verdict.model is found.base and verdict.discrepancies["validation"] == (4.01, 4.01)
    (hint,) = verdict.hints
    assert hint.effects == ("hinge_preload at door",) and hint.closed == {"validation": pytest.approx(0.31)}
    assert verdict.sentence == (
        "The model lacks something that is not in the library. Hints, not names, since they may only imitate it: "
        "hinge_preload at door (closes 31%)."
    )
    assert any(trial.passed for trial in verdict.validation_tests)  # the grounds are told
    weaker = replace(found.case, config=replace(found.case.config, minimum_closed=0.3))
    verdict = search_effects(weaker, found.base, FLOOR)
    assert verdict.kind is Conclusion.PARTLY and verdict.effects == ("hinge_preload at door",) and verdict.hints == ()


def candidate(name: str, place: str = "door", **shapes: float) -> Candidate:
    return Candidate(name, place, (f"{name}[{place}]",), shapes)


def chosen(stood: list[str], winner: list[str], *rivals: list[str]) -> Any:
    """A round: names of effects that stood, that won, that did as well."""

    def model(names: list[str]) -> Any:
        return SimpleNamespace(parts=[candidate(n) for n in names])

    places = [f"{name} at door" for name in stood]
    return SimpleNamespace(before=places, selected=model(winner), indistinguishable=[model(names) for names in rivals])


def ties(names: str, *rounds: Any) -> dict[str, tuple[str, ...]]:
    """Of a model with these effects, one letter each."""
    model: Any = SimpleNamespace(parts=[candidate(n) for n in names])
    return {n: workflow._tied(f"{n} at door", model, rounds) for n in names}


def test_ties_are_those_of_the_last_round_that_chose_an_effect():
    first, pair = chosen([], ["a"], ["x"]), chosen([], ["a", "b"], ["y", "b"])
    assert ties("a", first) == {"a": ("x at door",)}
    assert ties("ab", first, pair) == {"a": ("y at door",), "b": ()}
    lost: Any = SimpleNamespace(before=[], selected=None, indistinguishable=[])
    assert ties("a", first, lost) == {"a": ("x at door",)}


def test_an_effect_of_the_model_is_no_rival_of_another():
    first, second = chosen([], ["a"], ["b"], ["x"]), chosen(["a"], ["a", "b"])
    assert ties("ab", first, second) == {"a": ("x at door",), "b": ()}


def test_a_rival_without_any_of_the_models_effects_is_named_whole():
    assert ties("ab", chosen([], ["a", "b"], ["c", "e"])) == {n: ("c at door + e at door",) for n in "ab"}
    assert ties("ab", chosen([], ["a", "b"], ["c"])) == {n: ("c at door",) for n in "ab"}


def test_an_effect_is_asked_about_elsewhere_with_the_shape_it_has():
    speeds = [candidate("ripple", place, periods=periods) for place in ("one", "two") for periods in (10.0, 20.0)]
    asked = directions_of([*speeds, candidate("latch", width=0.1)])
    model: Any = SimpleNamespace(parts=speeds[:1], coefficients=("ripple[one]",))
    left = [q.candidate for q in workflow.open_directions(asked, model)]
    assert left == [candidate("ripple", "two"), candidate("latch", width=0.1)]


@pytest.mark.parametrize(
    ("tied", "said"),
    [
        (((), ()), "The model lacks: a and b."),
        ((("x",), ()), "The model lacks b, and one of: a or x."),
        ((("x",), ("y", "z")), "The model lacks one of: a or x, and one of: b or y or z."),
    ],
)
def test_the_sentence_keeps_what_is_certain(found: Small, tied: Any, said: str):
    verdict = search_effects(found.case, found.base, 2.0 * found.base.discrepancy)
    kind = Conclusion.INDISTINGUISHABLE if any(tied) else Conclusion.NAMED
    assert replace(verdict, kind=kind, effects=("a", "b"), indistinguishable=tied).sentence == said
    before = verdict.discrepancies["validation"][0]
    partly = replace(
        verdict,
        kind=Conclusion.PARTLY,
        effects=("a", "b"),
        indistinguishable=tied,
        discretisation_error=0.0,
        remainder=0.4 * before,
    )
    assert partly.explained == pytest.approx(0.6)
    assert partly.sentence == said.replace("lacks: ", "lacks ")[:-1] + "; a remainder is unexplained."
    little = replace(partly, remainder=0.77 * before).sentence
    assert little.startswith(
        "Most of what the model lacks is not in the library; what there is explains or imitates 23%"
    )
    assert little.endswith(said.removeprefix("The model lacks").removeprefix(":")[1:])


def test_a_gap_below_the_floor_is_none(found: Small):
    """The test rejects, yet the time step alone would leave as much."""
    verdict = search_effects(found.case, found.base, 2.0 * found.base.discrepancy)
    assert verdict.kind is Conclusion.NONE
    assert verdict.score_tests[0].p < 0.01
    assert not verdict.effects and np.isfinite(verdict.closed("validation"))


def test_a_gap_that_an_error_of_first_order_could_leave_is_none(found: Small):
    """A quarter of the step leaves a quarter of such an error: U0 shows nine sixteenths of its U."""
    assert search_effects(found.case, found.base, 0.6 * found.base.discrepancy).kind is Conclusion.NONE
    assert search_effects(found.case, found.base, 0.5 * found.base.discrepancy).kind is not Conclusion.NONE


def test_what_lost_for_its_size_alone_is_said(found: Small):
    verdict = replace(found.verdict, kind=Conclusion.UNEXPLAINED, effects=(), indistinguishable=())
    assert verdict.sentence == "The model lacks something that is not in the library."
    tiny, both = (
        replace(verdict.validation_tests[0], reasons=r) for r in ((TOO_SMALL,), (TOO_SMALL, "another reason"))
    )
    assert replace(verdict, validation_tests=(both,)).sentence == verdict.sentence
    said = replace(verdict, validation_tests=(tiny, tiny)).sentence
    assert said.endswith(f"not in the library, or {tiny.name}, below the minimum effect size.")
    large = replace(tiny, reasons=(f"its_torque {AT_BOUND}",))
    said = replace(
        verdict, validation_tests=(large, replace(large, reasons=(*large.reasons, "another reason")))
    ).sentence
    assert said.endswith(f"not in the library, or {large.name}, larger than its bounds allow.")
    chance = replace(tiny, reasons=(f"{UNCONFIRMED} (p = 0.014)",))
    said = replace(
        verdict, validation_tests=(chance, replace(chance, reasons=(*chance.reasons, "another reason")))
    ).sentence
    assert said.endswith(f"not in the library, or {chance.name}, {UNCONFIRMED}.")


def test_a_sealed_motion_that_blows_up_is_left_out_and_said_so(found: Small) -> None:
    """It is opened when hours of search are over, which must not be lost."""

    def gap_at(values: np.ndarray) -> float:
        raise NotReplayed("the simulation of 'test' blows up")

    sealed: Any = SimpleNamespace(discrepancy_at=gap_at)
    state = SearchState(replace(found.case, test=sealed), 1.0, FLOOR, Budget(None), lambda stage, value: None)
    gaps = workflow._gaps(state, found.base, found.verdict.model)
    assert gaps == found.verdict.discrepancies and state.failed == ["the fitted model on the test recording"]
