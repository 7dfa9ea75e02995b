"""The search, step by step and as a whole."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import small_gap
from small_gap import EFFECTS, FLOOR, QUICK, Small, problem_of, quiet, record, small, small_scene

from droid_jax.discrepancy import candidate_fits, cross_validation, search
from droid_jax.discrepancy.candidate_fits import (
    Notes,
    Problem,
    converged_model,
    polished,
    pruned,
    staged_refit,
    target_objective,
    without,
)
from droid_jax.discrepancy.candidates import directions_of, proposals, score_test
from droid_jax.discrepancy.case import Case, make_case, restrained
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FittedModel, base_fit
from droid_jax.discrepancy.search import SearchState, open_directions, pair_step, search_effects, selection_step
from droid_jax.discrepancy.selection import Reason, Rejection, SelectionStep, ValidationTest
from droid_jax.discrepancy.statistics import OUTSIDE, Blocks, Repeats
from droid_jax.discrepancy.verdict import Conclusion, Verdict
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import Candidate, EffectKey, candidates, keys_of
from droid_jax.model.effects.registry import library
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene

PRELOAD = EffectKey("hinge_preload", "door")
FRICTION = 0.5  # N m


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def first(found: Small) -> tuple[SearchState, SelectionStep]:
    """The state after one step, and the step."""
    state, info = selection_step(SearchState(found.base), problem_of(found))
    assert info is not None
    return state, info


def case_of(scene: Scene, space: Space, effects: tuple[Effect, ...], config: DiscrepancyConfig = QUICK) -> Case:
    return make_case(scene, space, effects, record("train"), record("validation"), config=config)


def searched(case: Case) -> Any:
    return search_effects(case, base_fit(case.train, case.base, case.config, quiet), FLOOR)


# Logs, whose U includes the noise -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("repeated", "left", "reasons", "kept"),
    [
        (
            False,
            {"a": 0.3, "b": 0.02},
            (Reason.SMALL_GAIN,),
            {"b", "c"},
        ),  # beside b the score test finds more, beside a not
        (
            False,
            {"a": 0.02},
            (Reason.SMALL_GAIN,),
            {"a", "b", "c"},
        ),  # it finds more beside the best: the others are not tested
        (False, {"a": 0.3, "b": 0.3}, (Reason.SMALL_GAIN,), {"c"}),  # the gain of c is too small in any case
        (False, {"a": 0.3, "b": 0.3}, (Reason.SMALL_GAIN, Reason.NOT_CONFIRMED), {"c"}),  # weak: tested too
        (False, {}, (Reason.SMALL_GAIN, Reason.MAY_BE_ZERO), {"a", "b", "c"}),
        (True, {}, (Reason.SMALL_GAIN,), {"a", "b", "c"}),  # U of repeats holds no noise
    ],
)
def test_a_small_gain_is_accepted_if_the_score_test_finds_nothing_more(
    monkeypatch: pytest.MonkeyPatch, repeated: bool, left: dict[str, float], reasons: tuple[Reason, ...], kept: set[str]
):
    models: Any = [SimpleNamespace(name=name, parts=(), coefficients=()) for name in "cab"]
    tests: Any = [
        ValidationTest((), 0, 0.9, u, 0.001, {}, 1.0, tuple(Rejection(r, "") for r in reasons))
        for u in (0.93, 0.88, 0.91)
    ]
    case = SimpleNamespace(
        train=SimpleNamespace(resampling=SimpleNamespace(repeated=repeated)), both=None, config=DiscrepancyConfig()
    )
    problem: Any = SimpleNamespace(case=case, base_discrepancy=1.0, directions=(), late=False, progress=quiet)
    asked = dict(left)
    monkeypatch.setattr(search, "open_directions", lambda *_: ("another",))
    monkeypatch.setattr(
        cross_validation, "score_test", lambda _, model, *rest: SimpleNamespace(p=0.4 * asked.pop(model.name))
    )
    base: Any = SimpleNamespace(parts=())
    extended: Any = SimpleNamespace(parts=("drag",))
    judged = search.without_small_gains(problem, base, models, tests)
    small = [any(r.reason is Reason.SMALL_GAIN for r in t.reasons) for t in judged]
    assert {m.name for m, too_small in zip(models, small, strict=True) if too_small} == kept
    assert all(
        {*t.reasons} >= {r for r in before.reasons if r.reason is not Reason.SMALL_GAIN}
        for t, before in zip(judged, tests, strict=True)
    )
    assert not asked  # each was tested once
    assert search.without_small_gains(problem, extended, models, tests) == tests  # for a further effect


@pytest.mark.parametrize(
    ("both", "reasons", "asked"),
    [
        ("both", (Reason.NOT_CONFIRMED,), "bc"),  # the two best
        ("both", (Reason.NOT_CONFIRMED, Reason.BELOW_MINIMUM_SIZE, Reason.SMALL_GAIN), "bc"),
        ("both", (Reason.NOT_CONFIRMED, Reason.MAY_BE_ZERO), ""),  # there is another reason
        ("both", (Reason.SMALL_GAIN,), ""),  # it is confirmed
        (None, (Reason.NOT_CONFIRMED,), ""),  # other repeats or motions validate
    ],
)
def test_the_best_models_are_cross_validated(
    monkeypatch: pytest.MonkeyPatch, both: Any, reasons: tuple[Reason, ...], asked: str
):
    models: Any = [SimpleNamespace(name=name) for name in "abc"]
    tests: Any = [
        ValidationTest((), 0, 0.9, u, 0.2, {}, 1.0, tuple(Rejection(r, "") for r in reasons)) for u in (0.93, 0.88, 0.9)
    ]
    case = SimpleNamespace(both=both, config=DiscrepancyConfig())
    problem: Any = SimpleNamespace(case=case, late=False, progress=quiet)
    found = {"b": 0.01, "c": 0.3}
    monkeypatch.setattr(cross_validation, "_cross_validated_p", lambda case, before, model: found[model.name])
    judged = cross_validation.cross_validated(problem, SimpleNamespace(), models, tests)  # type: ignore[arg-type]
    assert [t.p for t in judged] == [found[m.name] if m.name in asked else 0.2 for m in models]
    confirmed = {
        m.name for m, t in zip(models, judged, strict=True) if Reason.NOT_CONFIRMED not in {r.reason for r in t.reasons}
    }
    assert confirmed == ({"b"} if asked else {"a", "b", "c"} if Reason.NOT_CONFIRMED not in reasons else set())


def test_a_small_gain_is_accepted_if_there_is_no_other_direction():
    """One effect at one location: there is no direction for a score test."""
    model: Any = SimpleNamespace(name="a", parts=(), coefficients=())
    small: Any = ValidationTest((), 0, 0.9, 0.88, 0.001, {}, 1.0, (Rejection(Reason.SMALL_GAIN, ""),))
    case = SimpleNamespace(
        train=SimpleNamespace(resampling=SimpleNamespace(repeated=False)), config=DiscrepancyConfig()
    )
    problem: Any = SimpleNamespace(case=case, base_discrepancy=1.0, directions=(), late=False, progress=quiet)
    (judged,) = search.without_small_gains(problem, SimpleNamespace(parts=()), [model], [small])  # type: ignore[arg-type]
    assert judged.reasons == ()


# Selection steps -----------------------------------------------------------------------


def test_a_step_selects_an_effect_and_does_not_change_its_state(found: Small, first: tuple[SearchState, SelectionStep]):
    begin = SearchState(found.base)
    before, values = copy.copy(vars(begin)), found.base.values.copy()
    state, info = selection_step(begin, problem_of(found))
    assert vars(begin) == before and begin.model is found.base and begin.steps == ()
    np.testing.assert_array_equal(found.base.values, values)
    assert info is not None and info.selected is not None and state.model.keys == (PRELOAD,) == info.selected.keys
    assert state.steps == (info,) and not state.finished and not state.exhausted
    assert state.notes == Notes(ruled_out=((EffectKey("drag", "door"),),))
    again, same = selection_step(begin, problem_of(found))  # the same state, the same step
    assert same is not None and again.model.keys == state.model.keys
    np.testing.assert_array_equal(again.model.values, state.model.values)
    assert same.tests == info.tests == first[1].tests


def test_there_is_no_step_beyond_the_largest_number_of_effects(found: Small, first: tuple[SearchState, SelectionStep]):
    state, _ = first
    assert found.case.config.max_effects == 1
    ended, info = selection_step(state, problem_of(found))
    assert info is None and ended.finished and not ended.exhausted and ended.model is state.model


def test_a_step_without_directions_has_exhausted_the_candidates(found: Small):
    ended, info = selection_step(SearchState(found.base), replace(problem_of(found), directions=()))
    assert info is None and ended.finished and ended.exhausted and ended.model is found.base


def test_a_step_without_a_significant_discrepancy_refits_nothing(found: Small):
    """The score test rejects, but the error of the time step is as large."""
    problem = replace(problem_of(found), discretisation_error=2.0 * found.base.discrepancy)
    ended, info = selection_step(SearchState(found.base), problem)
    assert info is not None and (info.tried, info.tests, info.selected) == ((), (), None)
    assert info.score_test.p < found.case.config.selection.significance
    assert ended.finished and ended.exhausted and ended.steps == (info,)


def test_the_significance_is_configured(found: Small):
    """The p-value is 1/128, the smallest of eight repeats."""
    strict = replace(found.case.config, selection=replace(found.case.config.selection, significance=0.001))
    problem = replace(problem_of(found), case=replace(found.case, config=strict))
    ended, info = selection_step(SearchState(found.base), problem)
    assert info is not None and info.score_test.p == pytest.approx(1 / 128) and info.tried == () and ended.exhausted


def test_a_search_without_time_makes_one_batch_of_one_step_fits(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(candidate_fits, "ONE_STEP_BATCH", 1)
    state, info = selection_step(SearchState(found.base), problem_of(found, deadline=0.0))
    assert info is not None and [m.keys for m in info.tried] == [(PRELOAD,)]
    assert state.notes.not_tried[0] == "2 of 3 candidates without a one-step fit" and state.notes.failed == ()


def test_a_search_without_time_refits_one_candidate_and_reports_the_others(found: Small):
    state, info = selection_step(SearchState(found.base), problem_of(found, deadline=0.0))
    assert info is not None and [m.keys for m in info.tried] == [(PRELOAD,)]
    assert state.notes.not_tried[0] == "2 of 3 candidates not refitted" and state.notes.failed == ()
    case = replace(found.case, config=replace(found.case.config, budget_minutes=0.0))
    verdict = search_effects(case, found.base, FLOOR)
    assert verdict.not_tried == state.notes.not_tried and verdict.effects == (PRELOAD,)


def test_the_first_refit_is_made_after_the_deadline_too(found: Small, monkeypatch: pytest.MonkeyPatch):
    def refit(train: Any, base: Any, parts: Any, *rest: Any) -> Any:
        if parts[0].effect == "payload":
            raise NotReplayed("none of the starts could be replayed")
        return SimpleNamespace(keys=(parts[0].key,), refined=SimpleNamespace(objective=1.0))

    monkeypatch.setattr(candidate_fits, "refit", refit)
    starts = [((part,), found.base.values) for part in candidates(found.case.effects)]
    names = [str(part.key) for (part,), _ in starts]
    models, notes = staged_refit(problem_of(found), starts, 1e9, "candidates not refitted")
    assert notes == Notes(failed=tuple(n for n in names if n.startswith("payload")))
    assert len(models) == len(starts) - len(notes.failed) == 2
    hinge = [s for s in starts if s[0][0].effect != "payload"]
    models, notes = staged_refit(problem_of(found, deadline=0.0), hinge, 1e9, "candidates not refitted")
    assert len(models) == 1 and notes == Notes(not_tried=("1 of 2 candidates not refitted",))
    assert notes + Notes(("a",), ("b",)) == Notes(("a",), ("1 of 2 candidates not refitted", "b"))


def test_the_target_of_a_refit_is_the_best_objective_so_far(found: Small, monkeypatch: pytest.MonkeyPatch):
    targets, objectives = list[float](), iter([7.0, 3.0, 5.0])

    def refit(train: Any, base: Any, parts: Any, start: Any, config: Any) -> Any:
        targets.append(config.target_objective)
        return SimpleNamespace(refined=SimpleNamespace(objective=next(objectives)))

    monkeypatch.setattr(candidate_fits, "refit", refit)
    starts = [((part,), found.base.values) for part in candidates(found.case.effects)][:3]
    staged_refit(problem_of(found), starts, 6.0, "candidates not refitted")
    assert targets == [6.0, 6.0, 3.0]


def test_a_candidate_whose_one_step_is_hopeless_against_the_best_refit_is_not_refitted(
    found: Small, monkeypatch: pytest.MonkeyPatch
):
    """The base leaves 100.  One step reached 40, 60 and 99; the first refit reaches 10, which 60 - 5 * 40 may reach too
    and 99 - 5 * 1 cannot."""
    fitted = list[str]()

    def refit(train: Any, base: Any, parts: Any, start: Any, config: Any) -> Any:
        fitted.append(str(parts[0].key))
        return SimpleNamespace(refined=SimpleNamespace(objective=10.0))

    monkeypatch.setattr(candidate_fits, "refit", refit)
    starts = [((part,), found.base.values) for part in candidates(found.case.effects)][:3]
    names = [str(part.key) for (part,), _ in starts]
    models, notes = staged_refit(problem_of(found), starts, 90.0, "not refitted", one_step=(100.0, [40.0, 60.0, 99.0]))
    assert fitted == names[:2] and len(models) == 2 and notes == Notes(ruled_out=(keys_of(starts[2][0]),))
    fitted.clear()  # the first one is refitted whatever its step reached
    staged_refit(problem_of(found), starts[:1], 10.0, "not refitted", one_step=(100.0, [99.0]))
    assert fitted == names[:1]


@pytest.mark.parametrize("blocks", [False, True])
def test_the_target_is_half_of_the_gain_that_an_effect_must_reach(found: Small, blocks: bool):
    """An effect must reduce U = 4 by a fifth; the target is the objective with a tenth less."""
    rows = Blocks(np.array([0] * 6 + [1] * 6 + [OUTSIDE] * 18)) if blocks else Repeats(np.zeros((1, 30)))
    count = 12 if blocks else 30
    problem = problem_of(found)
    case = replace(found.case, train=replace(found.case.train, resampling=rows))
    problem, objective = replace(problem, case=case), 0.5 * count * 4.0
    fitted: Any = SimpleNamespace(parts=(), discrepancy=4.0, refined=SimpleNamespace(objective=objective))
    assert target_objective(problem, fitted) == pytest.approx(0.9 * objective)
    further: Any = SimpleNamespace(**{**vars(fitted), "parts": ("one",)})
    assert target_objective(problem, further) == pytest.approx(0.8 * objective)
    selection = replace(found.case.config.selection, least_gain=0.5)
    strict = replace(problem, case=replace(case, config=replace(case.config, selection=selection)))
    assert target_objective(strict, fitted) == pytest.approx(0.75 * objective)


# Pairs -------------------------------------------------------------------------------------


def two_effects(found: Small, **changes: Any) -> Problem:
    case = replace(found.case, config=replace(found.case.config, max_effects=2))
    return replace(problem_of(found, **changes), case=case)


def test_pairs_are_refitted_if_nothing_is_selected_and_their_score_test_is_reported_once(
    found: Small, first: tuple[SearchState, SelectionStep]
):
    _, info = first
    unnamed = SearchState(found.base, (replace(info, selected=None, chosen=None),), finished=True)
    state = pair_step(unnamed, two_effects(found))
    assert len(state.steps) == 2 and state.steps[1].score_test is info.score_test
    assert len(state.steps[1].tried) == 3 and all(len(m.parts) == 2 for m in state.steps[1].tried)
    assert unnamed.steps == state.steps[:1]
    for test in state.steps[1].tests:
        assert test.before == 0 and len(test.keys) == 2


def test_there_are_no_pairs_if_they_are_not_allowed_or_not_needed(
    found: Small, first: tuple[SearchState, SelectionStep]
):
    state, info = first
    unnamed = SearchState(found.base, (replace(info, selected=None, chosen=None),), finished=True)
    assert pair_step(unnamed, problem_of(found)) is unnamed  # one effect at most
    assert pair_step(state, two_effects(found)) is state  # one effect that explains the discrepancy
    for done in (
        replace(unnamed, exhausted=True),
        replace(unnamed, steps=()),
        replace(unnamed, steps=(replace(info, tried=(), tests=(), selected=None, chosen=None),)),
    ):
        assert pair_step(done, two_effects(found)) is done
    late = pair_step(unnamed, two_effects(found, deadline=0.0))
    assert late.notes == Notes(not_tried=("pairs of effects not tried",)) and late.steps == unnamed.steps


# Failures ---------------------------------------------------------------------------


def bomb(scene: Scene) -> Effect:
    """An effect whose force is zero at neutral and NaN elsewhere."""
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


@pytest.mark.slow
def test_an_effect_that_blows_up_is_left_out_and_reported():
    """The missing effect is found nevertheless."""
    scene, space = small_scene()
    verdict = searched(case_of(scene, space, (*library(scene, EFFECTS), bomb(scene))))
    explosive = EffectKey("bomb", "door")
    assert verdict.score_tests[0].failed == (explosive,)
    assert verdict.effects == (PRELOAD,)
    assert not any(explosive in test.keys for test in verdict.validation_tests if test.passed)
    row = next(k for k, d in enumerate(verdict.score_tests[0].directions) if d.coefficient == "bomb")
    assert verdict.score_tests[0].t[row] == verdict.score_tests[0].explained[row] == 0.0


def late_bomb(scene: Scene) -> Effect:
    """A preload that is neutral at its upper bound, and NaN at the true size of the preload."""
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


@pytest.mark.slow
def test_a_refit_that_blows_up_at_its_start_is_left_out_and_reported(monkeypatch: pytest.MonkeyPatch):
    """The replay of the score test's step is finite, that of the proposal is not."""

    def unmoved(train: Any, model: Any, asked: Any, config: Any) -> list[tuple[np.ndarray, float]]:
        return [(proposed, -np.inf) for *_, proposed in asked]

    monkeypatch.setattr(candidate_fits, "one_step_fits", unmoved)
    scene, space = small_scene()
    verdict = searched(case_of(scene, space, (late_bomb(scene),)))
    assert verdict.score_tests[0].failed == () and verdict.score_tests[0].explained[0] > 0.5
    assert verdict.failed == (str(EffectKey("late_bomb", "door")),) and verdict.validation_tests == ()
    assert verdict.conclusion is Conclusion.UNEXPLAINED


@pytest.mark.slow
def test_a_search_ends_when_all_effects_are_in_the_model():
    scene, space = small_scene()
    verdict = searched(case_of(scene, space, library(scene, ["hinge_preload"]), replace(QUICK, max_effects=2)))
    assert verdict.effects == (PRELOAD,) and len(verdict.score_tests) == 1


@pytest.mark.parametrize("fitted_further", [converged_model, polished])
def test_a_model_is_unchanged_if_a_further_fit_blows_up_on_the_validation_motion(
    found: Small, monkeypatch: pytest.MonkeyPatch, fitted_further: Any
):
    def common(values: np.ndarray) -> np.ndarray:
        return values[None] * np.where(values[0] > 1.0, np.nan, 1.0)

    validation: Any = SimpleNamespace(common=common)
    problem = replace(problem_of(found), case=replace(found.case, validation=validation))
    refined = replace(found.base.refined, converged=False)
    model = replace(found.verdict.model, values=np.array([0.5]), refined=refined)
    whole, lost = (replace(model, values=np.array([x])) for x in (0.7, 1.5))
    monkeypatch.setattr(candidate_fits, "refit", lambda *arguments: whole)
    assert fitted_further(problem, model) == (whole, Notes())
    monkeypatch.setattr(candidate_fits, "refit", lambda *arguments: lost)
    kept, notes = fitted_further(problem, model)
    assert kept is model and len(notes.failed) == 1 and notes.failed[0].startswith(model.name)


def test_a_converged_model_is_not_fitted_further(found: Small, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(candidate_fits, "refit", lambda *arguments: pytest.fail("it has converged"))
    assert converged_model(problem_of(found), found.verdict.model) == (found.verdict.model, Notes())
    assert polished(problem_of(found), found.base) == (found.base, Notes())  # no intervals to report


def test_effects_without_locations_are_refused(found: Small):
    nowhere = tuple(replace(e, locations={}) for e in found.case.effects)
    with pytest.raises(ValueError, match="none of the effects states its locations"):
        search_effects(replace(found.case, effects=nowhere), found.base, FLOOR)


def test_no_candidate_fails_in_the_small_scene(found: Small):
    asked = directions_of(candidates(found.case.effects))
    assert score_test(found.case.train, found.base, asked).failed == ()


def test_a_nuisance_is_bounded_by_its_prior(found: Small):
    p = found.case.base["torque_offset[elbow]"]
    assert (p.low, p.high) == (pytest.approx(-0.3), pytest.approx(0.3))  # of bounds of 2 and a deviation of 0.1
    assert found.case.config.selection.nuisance_bound == 3.0
    wider = restrained(small_scene()[1], 5.0)["torque_offset[elbow]"]
    assert (wider.low, wider.high) == (pytest.approx(-0.5), pytest.approx(0.5))


def test_a_parameter_at_its_bound_absorbs_nothing_more(found: Small):
    asked, refined, train = directions_of(candidates(found.case.effects)), found.base.refined, found.case.train
    assert refined.free.all()
    at = refined.space.index("door_stiffness")
    x = refined.x.copy()
    x[at] = refined.space.to_search(refined.space.high)[at]
    stuck = replace(found.base, refined=replace(refined, x=x))
    assert np.flatnonzero(~stuck.refined.free).tolist() == [at]
    before, after = (np.linalg.norm(score_test(train, m, asked).sensitivities, axis=1) for m in (found.base, stuck))
    assert np.all(after >= before - 1e-9)
    preload = [d.coefficient for d in asked].index("hinge_preload")
    assert after[preload] > 1.1 * before[preload]  # a spring looks like a preload


# Parts ------------------------------------------------------------------------------------


def candidate(name: str, location: str = "door", **shapes: float) -> Candidate:
    return Candidate(name, location, (f"{name}[{location}]",), shapes)


def test_other_locations_of_an_effect_have_its_shape():
    speeds = [candidate("ripple", place, periods=periods) for place in ("one", "two") for periods in (10.0, 20.0)]
    asked = directions_of([*speeds, candidate("latch", width=0.1)])
    model: Any = SimpleNamespace(parts=speeds[:1], coefficients=("ripple[one]",))
    left = [d.candidate for d in open_directions(asked, model)]
    assert left == [candidate("ripple", "two"), candidate("latch", width=0.1)]


def test_a_shape_parameter_remains_while_its_effect_does():
    """A ripple at another location has the periods of the one in the model, and keeps them without it."""
    first = Candidate("ripple", "elbow", ("ripple_elbow",), {"periods": 48.0})
    second, drag = Candidate("ripple", "wrist", ("ripple_wrist",)), Candidate("drag", "hinge", ("drag",))
    assert without(first, (first, drag, second)) == (
        drag,
        Candidate("ripple", "wrist", ("ripple_wrist",), {"periods": 48.0}),
    )
    assert without(second, (first, drag, second)) == (first, drag)
    assert without(drag, (first, drag)) == (first,)


def test_a_part_is_kept_if_the_replay_blows_up_without_it(found: Small, monkeypatch: pytest.MonkeyPatch):
    """The replay needs the damper; drag has nearly no gain and is removed."""
    damper, drag = Candidate("closer", "hinge", ("closer",)), Candidate("drag", "hinge", ("drag",))

    def refit(train: Any, base: Any, parts: Any, starts: Any, config: Any) -> Any:
        if damper not in parts:
            raise NotReplayed("none of the starts could be replayed")
        assert starts[0].tolist() == [2.0, 0.0]  # the drag at neutral
        return SimpleNamespace(parts=parts, keys=(damper.key,), values=starts[0], left=1.01)

    monkeypatch.setattr(candidate_fits, "refit", refit)
    monkeypatch.setattr(Problem, "discrepancy", lambda problem, model: model.left)
    whole = Space(tuple(Parameter(name, "N m", 0.0, 1.0, -5.0, 5.0) for name in ("closer", "drag")))
    case: Any = SimpleNamespace(full_space=whole, config=found.case.config, train=None, base=None)
    problem = replace(problem_of(found), case=case, base_discrepancy=10.0)
    model: Any = SimpleNamespace(parts=(damper, drag), values=np.array([2.0, 1.0]), left=1.0)
    assert pruned(problem, model).parts == (damper,)
    selection = replace(found.case.config.selection, least_share=0.0005)
    case.config = replace(found.case.config, selection=selection)
    assert pruned(problem, model) is model  # it takes 0.1 % of the base model's U


def test_proposals_start_at_the_values_of_the_model(found: Small, first: tuple[SearchState, SelectionStep]):
    _, info = first
    ranked = proposals(info.score_test, found.base.residuals, found.case.full_space)
    assert [p.keys for p in ranked] == [p.keys for p in info.ranked]
    start = ranked[0].start(found.case.full_space, found.base.values)
    moved = np.flatnonzero(start != found.base.values)
    assert [found.case.full_space.names[k] for k in moved] == list(ranked[0].sizes)


def test_a_selected_model_has_converged(found: Small, first: tuple[SearchState, SelectionStep]):
    state, _ = first
    model: FittedModel = state.model
    assert model.refined.converged


def test_a_further_fit_that_does_not_converge_does_not_replace_a_converged_model(monkeypatch: pytest.MonkeyPatch):
    """It is not reported as blown up.  A fit that converges, or continues an unfinished one, is taken."""

    def model(converged: bool, value: float = 1.0) -> Any:
        return SimpleNamespace(
            name="a", parts=("drag",), values=np.array([value]), refined=SimpleNamespace(converged=converged)
        )

    validation = SimpleNamespace(common=lambda values: values)
    problem: Any = SimpleNamespace(case=SimpleNamespace(validation=validation, config=DiscrepancyConfig()))
    for before, after, taken, notes in (
        (True, model(True, 2.0), True, Notes()),
        (False, model(False, 2.0), True, Notes()),
        (True, model(False, 2.0), False, Notes(not_tried=("a polished to the end",))),
        (True, model(True, np.nan), False, Notes(failed=("a polished",))),
    ):
        monkeypatch.setattr(candidate_fits, "search_refit", lambda *_, after=after: after)
        begun = model(before)
        found, said = candidate_fits.polished(problem, begun)
        assert found is (after if taken else begun) and said == notes


@functools.cache
def whole_search(preload: float, friction: float) -> Verdict:
    """What is said of a robot that hides so much."""
    scene, space = small_scene()
    recordings = {name: record(name, preload=preload, friction=friction) for name in ("train", "validation")}
    case = make_case(
        scene, space, library(scene, (*EFFECTS, "joint_coulomb")), **recordings, config=replace(QUICK, max_effects=2)
    )
    return search_effects(case, base_fit(case.train, case.base, case.config, quiet), FLOOR)


@pytest.mark.slow
def test_where_nothing_is_hidden_nothing_is_missing():
    found = whole_search(0.0, 0.0)
    assert found.conclusion is Conclusion.NONE and not found.effects
    assert found.score_tests[0].p > 0.01


@pytest.mark.slow
def test_two_effects_are_both_named_and_nothing_else():
    found = whole_search(small_gap.PRELOAD, FRICTION)
    assert found.conclusion is Conclusion.NAMED
    assert set(found.effects) == {PRELOAD, EffectKey("joint_coulomb", "elbow")}
