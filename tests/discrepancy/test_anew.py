"""Fits that begin at the prior: when a round makes them, and what they must not be taken for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from droid_jax.discrepancy.search_state import Budget
from droid_jax.discrepancy.selection_step import forward_step
from small_gap import FLOOR, PRELOAD, TRUTH, Small, small

from droid_jax.discrepancy import search_state as search_states
from droid_jax.discrepancy.candidates import directions_of, score_test
from droid_jax.discrepancy.fitting import FittedModel, base_fit, fitted_from_prior
from droid_jax.discrepancy.search import SearchState, restart_from_prior
from droid_jax.discrepancy.selection import SelectionStep
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import candidates


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def lost(found: Small) -> SelectionStep:
    """The first round, as if none of its models had passed."""
    done = forward_step(
        state_of(found), found.base, score_test(found.case, found.base, directions_of(candidates(found.case.effects)))
    )
    return replace(done, selected=None, chosen=None)


def state_of(found: Small, minutes: float | None = None, told: list[tuple[str, Any]] | None = None) -> SearchState:
    tell = [] if told is None else told
    whole_gap = found.case.validation.discrepancy_at(found.base.values)
    return SearchState(found.case, whole_gap, FLOOR, Budget(minutes), lambda stage, value: tell.append((stage, value)))


def test_an_extended_model_is_fitted_without_what_the_base_fit_found(found: Small) -> None:
    """The preload, and the base parameters that it had bent."""
    (preload,) = candidates(e for e in found.case.effects if e.name == "hinge_preload")
    model = fitted_from_prior(found.case, (preload,), lambda stage, value: None)
    assert model.name == "hinge_preload at door" and model.discrepancy < 0.1 * found.base.discrepancy
    fitted = dict(zip(found.case.full_space.names, model.values, strict=True))
    assert abs(fitted["hinge_preload"]) == pytest.approx(PRELOAD, rel=0.1)
    assert fitted["forearm_mass"] == pytest.approx(TRUTH["forearm_mass"], rel=0.05)


def test_shapes_are_held_while_the_search_goes_and_free_in_the_refinement(
    found: Small, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = dict[str, Any]()
    (drag,) = candidates(e for e in found.case.effects if e.name == "drag")[:1]
    shaped = replace(drag, shape_parameters={"hinge_preload": 0.25})  # any parameter may be one
    monkeypatch.setattr(
        "droid_jax.discrepancy.restart.search", lambda cost, space, *a, **k: _searched(seen, cost, space)
    )
    monkeypatch.setattr("droid_jax.discrepancy.restart.refit", lambda *a, **k: seen.update(parts=a[2], begin=a[3]))
    fitted_from_prior(found.case, (shaped,), lambda stage, value: None)
    assert "drag" in seen["space"].names and "hinge_preload" not in seen["space"].names
    assert seen["parts"] == (shaped,) and "hinge_preload" in shaped.free
    at = found.case.full_space.index("hinge_preload")
    assert np.all(seen["begin"][:, at] == 0.25)
    drags = seen["begin"][:, found.case.full_space.index("drag")]
    assert drags[0] == 0.5 and np.all(drags[1:] == found.case.full_space["drag"].mean)


def _searched(seen: dict[str, Any], cost: Any, space: Any) -> Any:
    seen.update(space=space)
    return SimpleNamespace(best=space.values({"drag": 0.5}))


def test_a_base_fit_may_begin_at_an_earlier_one(found: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("droid_jax.discrepancy.restart.search", lambda *a, **k: pytest.fail("there is a start"))
    start = found.base.values[found.case.full_space.columns(found.case.base)]
    again = base_fit(found.case, lambda stage, value: None, start)
    assert again.discrepancy == pytest.approx(found.base.discrepancy, rel=1e-2)


def test_a_round_without_a_winner_has_its_best_model_fitted_from_the_prior_on(
    found: Small, lost: SelectionStep
) -> None:
    told = list[tuple[str, Any]]()
    again = restart_from_prior(state_of(found, told=told), found.base, lost)
    assert again.selected is not None and again.selected.name == "hinge_preload at door"
    assert {m.name for m in again.tried} >= {m.name for m in lost.tried}
    stages = [value for stage, value in told if stage == "anew"]
    assert any(hasattr(v, "generation") for v in stages) and any(hasattr(v, "iteration") for v in stages)


def test_what_the_basin_takes_by_itself_is_no_effects(
    found: Small, lost: SelectionStep, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The base model is equivalent once it begins where the winner ended: it was the basin, and nothing is named."""
    best = min(lost.tried, key=lambda m: m.refined.objective)
    # A worse fit all the same: it is the other motion that counts.
    worse = replace(best.refined, objective=2 * found.base.refined.objective)
    there = replace(best, parts=(), space=found.base.space, refined=worse)
    usual = SearchState.refit

    def refit(state: SearchState, parts: Any, start: np.ndarray, config: Any, note: str = "") -> FittedModel:
        return usual(state, parts, start, config, note) if parts else there

    monkeypatch.setattr(SearchState, "refit", refit)
    assert restart_from_prior(state_of(found), found.base, lost).selected is None


def test_a_basin_in_which_the_base_model_blows_up_has_nothing_to_say(
    found: Small, lost: SelectionStep, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = SearchState.discrepancy

    def gap(state: SearchState, model: FittedModel) -> float:
        if not model.parts and model is not found.base:
            raise NotReplayed("on the other motion")
        return usual(state, model)

    monkeypatch.setattr(SearchState, "discrepancy", gap)
    won = restart_from_prior(state_of(found), found.base, lost).selected
    assert won is not None and won.name == "hinge_preload at door"


def test_no_fit_from_the_prior_on_where_there_is_a_winner_or_no_time(
    found: Small, lost: SelectionStep, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_states, "fitted_from_prior", lambda *a: pytest.fail("was not asked for"))
    won = replace(lost, selected=lost.tried[0])
    assert restart_from_prior(state_of(found), found.base, won) is won
    state = state_of(found, minutes=1e-9)
    assert restart_from_prior(state, found.base, lost) is lost and state.budget.cut == "the fit from the prior on"
    quiet = replace(lost, tried=())
    for gap in (found.base.discrepancy, -0.005):  # U is below zero in half of the cases where nothing is missing
        assert restart_from_prior(state_of(found), replace(found.base, discrepancy=gap), quiet) is quiet
    little = replace(lost, tried=tuple(replace(m, discrepancy=0.9 * found.base.discrepancy) for m in lost.tried))
    assert restart_from_prior(state_of(found), found.base, little) is little
    log: Any = SimpleNamespace(case=SimpleNamespace(train=SimpleNamespace(repeated=False)))
    assert restart_from_prior(log, found.base, lost) is lost
