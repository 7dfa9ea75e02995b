"""Fits that begin at the prior: when a round makes them, and what they must not be taken for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import FLOOR, PRELOAD, TRUTH, Small, small

from droid_jax.discrepancy import search_state as hunts
from droid_jax.discrepancy.candidates import candidates
from droid_jax.discrepancy.refit import Model
from droid_jax.discrepancy.restart import base_fit, fitted_anew
from droid_jax.discrepancy.screen import questions_of
from droid_jax.discrepancy.search_state import Budget, Hunt
from droid_jax.discrepancy.selection_step import Round, anew, forward
from droid_jax.discrepancy.workflow import ask
from droid_jax.identify.search import NotReplayed


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def lost(found: Small) -> Round:
    """The first round, as if none of its models had passed."""
    done = forward(
        hunt_of(found), found.base, ask(found.case, found.base, questions_of(candidates(found.case.effects)))
    )
    return replace(done, winner=None, chosen=None)


def hunt_of(found: Small, minutes: float | None = None, told: list[tuple[str, Any]] | None = None) -> Hunt:
    tell = [] if told is None else told
    whole_gap = found.case.confirm.gap_at(found.base.values)
    return Hunt(found.case, whole_gap, FLOOR, Budget(minutes), lambda stage, value: tell.append((stage, value)))


def test_an_extended_model_is_fitted_without_what_the_base_fit_found(found: Small) -> None:
    """The preload, and the base parameters that it had bent."""
    (preload,) = candidates(e for e in found.case.effects if e.name == "hinge_preload")
    model = fitted_anew(found.case, (preload,), lambda stage, value: None)
    assert model.name == "hinge_preload at door" and model.gap < 0.1 * found.base.gap
    fitted = dict(zip(found.case.whole.names, model.values, strict=True))
    assert abs(fitted["hinge_preload"]) == pytest.approx(PRELOAD, rel=0.1)
    assert fitted["forearm_mass"] == pytest.approx(TRUTH["forearm_mass"], rel=0.05)


def test_shapes_are_held_while_the_search_goes_and_free_in_the_refinement(
    found: Small, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = dict[str, Any]()
    (drag,) = candidates(e for e in found.case.effects if e.name == "drag")[:1]
    shaped = replace(drag, shapes={"hinge_preload": 0.25})  # any parameter may be one
    monkeypatch.setattr(
        "droid_jax.discrepancy.restart.search", lambda cost, space, *a, **k: _searched(seen, cost, space)
    )
    monkeypatch.setattr("droid_jax.discrepancy.restart.refit", lambda *a, **k: seen.update(parts=a[2], begin=a[3]))
    fitted_anew(found.case, (shaped,), lambda stage, value: None)
    assert "drag" in seen["space"].names and "hinge_preload" not in seen["space"].names
    assert seen["parts"] == (shaped,) and "hinge_preload" in shaped.free
    at = found.case.whole.index("hinge_preload")
    assert np.all(seen["begin"][:, at] == 0.25)
    drags = seen["begin"][:, found.case.whole.index("drag")]
    assert drags[0] == 0.5 and np.all(drags[1:] == found.case.whole["drag"].mean)


def _searched(seen: dict[str, Any], cost: Any, space: Any) -> Any:
    seen.update(space=space)
    return SimpleNamespace(best=space.values({"drag": 0.5}))


def test_a_base_fit_may_begin_at_an_earlier_one(found: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("droid_jax.discrepancy.restart.search", lambda *a, **k: pytest.fail("there is a start"))
    start = found.base.values[found.case.whole.columns(found.case.base)]
    again = base_fit(found.case, lambda stage, value: None, start)
    assert again.gap == pytest.approx(found.base.gap, rel=1e-2)


def test_a_round_without_a_winner_has_its_best_model_fitted_from_the_prior_on(found: Small, lost: Round) -> None:
    told = list[tuple[str, Any]]()
    again = anew(hunt_of(found, told=told), found.base, lost)
    assert again.winner is not None and again.winner.name == "hinge_preload at door"
    assert {m.name for m in again.tried} >= {m.name for m in lost.tried}
    stages = [value for stage, value in told if stage == "anew"]
    assert any(hasattr(v, "generation") for v in stages) and any(hasattr(v, "iteration") for v in stages)


def test_what_the_basin_takes_by_itself_is_no_effects(
    found: Small, lost: Round, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The base model does as well once it begins where the winner ended: it was the basin, and nothing is named."""
    best = min(lost.tried, key=lambda m: m.refined.objective)
    # A worse fit all the same: it is the other motion that counts.
    worse = replace(best.refined, objective=2 * found.base.refined.objective)
    there = replace(best, parts=(), space=found.base.space, refined=worse)
    usual = Hunt.refit

    def refit(hunt: Hunt, parts: Any, start: np.ndarray, config: Any, note: str = "") -> Model:
        return usual(hunt, parts, start, config, note) if parts else there

    monkeypatch.setattr(Hunt, "refit", refit)
    assert anew(hunt_of(found), found.base, lost).winner is None


def test_a_basin_in_which_the_base_model_blows_up_has_nothing_to_say(
    found: Small, lost: Round, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = Hunt.gap

    def gap(hunt: Hunt, model: Model) -> float:
        if not model.parts and model is not found.base:
            raise NotReplayed("on the other motion")
        return usual(hunt, model)

    monkeypatch.setattr(Hunt, "gap", gap)
    won = anew(hunt_of(found), found.base, lost).winner
    assert won is not None and won.name == "hinge_preload at door"


def test_no_fit_from_the_prior_on_where_there_is_a_winner_or_no_time(
    found: Small, lost: Round, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hunts, "fitted_anew", lambda *a: pytest.fail("was not asked for"))
    won = replace(lost, winner=lost.tried[0])
    assert anew(hunt_of(found), found.base, won) is won
    hunt = hunt_of(found, minutes=1e-9)
    assert anew(hunt, found.base, lost) is lost and hunt.budget.cut == "the fit from the prior on"
    quiet = replace(lost, tried=())
    for gap in (found.base.gap, -0.005):  # U is below zero in half of the cases where nothing is missing
        assert anew(hunt_of(found), replace(found.base, gap=gap), quiet) is quiet
    little = replace(lost, tried=tuple(replace(m, gap=0.9 * found.base.gap) for m in lost.tried))
    assert anew(hunt_of(found), found.base, little) is little
    log: Any = SimpleNamespace(case=SimpleNamespace(fit=SimpleNamespace(repeated=False)))
    assert anew(log, found.base, lost) is lost
