"""Fits from the prior, and the final refit to both motions."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import PRELOAD, TRUTH, Small, problem_of, quiet, small

from droid_jax.discrepancy import candidate_fits, fitting, search
from droid_jax.discrepancy.candidate_fits import Notes, Problem
from droid_jax.discrepancy.candidates import from_neutral
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import (
    FinalModel,
    FittedModel,
    base_fit,
    final_refit,
    final_refit_due,
    fitted_from_prior,
)
from droid_jax.discrepancy.results import extended, gap_json, write_amended, write_gap
from droid_jax.discrepancy.search import SearchState, restart_from_prior, selection_step
from droid_jax.discrepancy.selection import SelectionStep
from droid_jax.files import GAP
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effects.candidate import EffectKey, candidates
from droid_jax.report.page import write_report

PRELOAD_KEY = EffectKey("hinge_preload", "door")


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def lost(found: Small) -> SelectionStep:
    """The first step, as if no model had passed."""
    _, info = selection_step(SearchState(found.base), problem_of(found))
    assert info is not None and info.selected is not None
    return replace(info, selected=None, chosen=None)


@pytest.mark.parametrize("share", [0.7, 0.2])
def test_the_shares_at_which_an_effect_is_tried_are_those_of_the_config(
    found: Small, share: float, monkeypatch: pytest.MonkeyPatch
):
    """They are in the result too."""
    looks: list[Any] = []

    def kept(whitened: Any, asked: Any, config: Any) -> list[tuple[np.ndarray, float]]:
        looks.extend(asked)
        return [(look.starts[0], 0.0) for look in asked]

    monkeypatch.setattr(fitting, "chords", kept)
    case, space = (
        replace(found.case, config=replace(found.case.config, one_step_shares=(share,))),
        found.case.full_space,
    )
    (part,) = candidates(e for e in case.effects if e.name == "hinge_preload")
    proposed, slopes = found.base.values.copy(), {"hinge_preload": np.zeros(len(found.base.refined.residual))}
    proposed[space.index("hinge_preload")] = 0.1
    fitting.one_step_fits(case.train, found.base, [(part, slopes, proposed)], case.config)
    tried = looks[0].starts[2][looks[0].space.index("hinge_preload")]
    assert tried == pytest.approx(share * from_neutral(space["hinge_preload"], case.config.selection.sensitivity_step))
    assert gap_json(case, found.verdict)["config"]["one_step_shares"] == [share]
    with pytest.raises(ValueError, match="one_step_shares, entry 0 must be"):
        DiscrepancyConfig(one_step_shares=(0.0,))


@pytest.mark.slow
def test_a_fit_from_the_prior_finds_the_truth_without_the_base_fit(found: Small) -> None:
    """It finds the preload, and the base parameters that were biased without it."""
    case = found.case
    (preload,) = candidates(e for e in case.effects if e.name == "hinge_preload")
    model = fitted_from_prior(case.train, case.base, (preload,), case.config, quiet)
    assert model.keys == (PRELOAD_KEY,) and model.discrepancy < 0.1 * found.base.discrepancy
    fitted = dict(zip(case.full_space.names, model.values, strict=True))
    assert abs(fitted["hinge_preload"]) == pytest.approx(PRELOAD, rel=0.1)
    assert fitted["forearm_mass"] == pytest.approx(TRUTH["forearm_mass"], rel=0.05)


def test_shape_parameters_are_fixed_in_the_search_and_free_in_the_refinement(
    found: Small, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, case = dict[str, Any](), found.case
    (drag,) = candidates(e for e in case.effects if e.name == "drag")[:1]
    shaped = replace(drag, shape_parameters={"hinge_preload": 0.25})  # any parameter may be one

    def searched(cost: Any, space: Any, *rest: Any, **options: Any) -> Any:
        seen.update(space=space)
        return SimpleNamespace(best=space.values({"drag": 0.5}))

    monkeypatch.setattr(fitting, "cma_search", searched)
    monkeypatch.setattr(fitting, "refit", lambda *a, **k: seen.update(parts=a[2], begin=a[3]))
    fitted_from_prior(case.train, case.base, (shaped,), case.config, quiet)
    assert "drag" in seen["space"].names and "hinge_preload" not in seen["space"].names
    assert seen["parts"] == (shaped,) and "hinge_preload" in shaped.free
    assert np.all(seen["begin"][:, case.full_space.index("hinge_preload")] == 0.25)
    drags = seen["begin"][:, case.full_space.index("drag")]
    assert drags[0] == 0.5 and np.all(drags[1:] == case.full_space["drag"].mean)


@pytest.mark.slow
def test_a_base_fit_can_begin_at_given_values(found: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "cma_search", lambda *a, **k: pytest.fail("there is a start"))
    case = found.case
    start = found.base.values[case.full_space.columns(case.base)]
    again = base_fit(case.train, case.base, case.config, quiet, start)
    assert again.discrepancy == pytest.approx(found.base.discrepancy, rel=1e-2)


@pytest.mark.slow
def test_a_step_that_selects_nothing_refits_its_best_model_from_the_prior(found: Small, lost: SelectionStep) -> None:
    reported = list[tuple[str, Any]]()
    problem = problem_of(found, progress=lambda stage, value: reported.append((stage, value)))
    again, notes = restart_from_prior(problem, lost)
    assert again.selected is not None and again.selected.keys == (PRELOAD_KEY,) and notes == Notes()
    assert {m.keys for m in again.tried} >= {m.keys for m in lost.tried}
    values = [value for stage, value in reported if stage == "restart"]
    assert any(hasattr(v, "generation") for v in values) and any(hasattr(v, "iteration") for v in values)


@pytest.mark.slow
def test_a_gain_of_the_base_model_in_another_basin_is_no_gain_of_an_effect(
    found: Small, lost: SelectionStep, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The base model is as good as the winner in the winner's basin, so nothing is named."""
    best = min(lost.tried, key=lambda m: m.refined.objective)
    # Although its fit is worse: the validation motion decides.
    worse = replace(best.refined, objective=2 * found.base.refined.objective)
    there = replace(best, parts=(), space=found.base.space, refined=worse)
    usual = candidate_fits.refit

    def refit(residual_set: Any, base: Any, parts: Any, *rest: Any) -> FittedModel:
        return usual(residual_set, base, parts, *rest) if parts else there

    monkeypatch.setattr(candidate_fits, "refit", refit)
    assert restart_from_prior(problem_of(found), lost)[0].selected is None


@pytest.mark.slow
def test_the_base_model_is_kept_if_it_blows_up_in_another_basin(
    found: Small, lost: SelectionStep, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = Problem.discrepancy

    def discrepancy(problem: Problem, model: FittedModel) -> float:
        if not model.parts and model is not found.base:
            raise NotReplayed("on the other motion")
        return usual(problem, model)

    monkeypatch.setattr(Problem, "discrepancy", discrepancy)
    won = restart_from_prior(problem_of(found), lost)[0].selected
    assert won is not None and won.keys == (PRELOAD_KEY,)


@pytest.mark.slow
def test_there_is_no_fit_from_the_prior_after_a_selection_or_without_time(
    found: Small, lost: SelectionStep, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search, "fitted_from_prior", lambda *a: pytest.fail("was not asked for"))
    won = replace(lost, selected=lost.tried[0])
    assert restart_from_prior(problem_of(found), won) == (won, Notes())
    done, notes = restart_from_prior(problem_of(found, deadline=0.0), lost)
    assert done is lost and notes == Notes(not_tried=("the fit from the prior",))
    empty = replace(lost, tried=())
    for left in (found.base.discrepancy, -0.005):  # U is below zero in half of the cases where nothing is missing
        problem = replace(problem_of(found), base=replace(found.base, discrepancy=left))
        assert restart_from_prior(problem, empty) == (empty, Notes())
    little = replace(lost, tried=tuple(replace(m, discrepancy=0.9 * found.base.discrepancy) for m in lost.tried))
    assert restart_from_prior(problem_of(found), little) == (little, Notes())
    train: Any = SimpleNamespace(resampling=SimpleNamespace(repeated=False))
    log = replace(problem_of(found), case=replace(found.case, train=train))
    assert restart_from_prior(log, lost) == (lost, Notes())


# The final refit ---------------------------------------------------------------------------

MORE = {"seconds": {"search": 1.0}, "versions": {}, "device": "test", "setup": {"recording": []}}


def refitted(case: Case, model: FittedModel) -> FinalModel:
    return final_refit(case.train, case.validation, model, case.config.refine)


@pytest.fixture(scope="module")
def both(found: Small) -> FinalModel:
    return refitted(found.case, found.verdict.model)


def test_the_final_refit_is_the_optimum_of_both_motions(found: Small, both: FinalModel):
    """Its common log posterior is no lower than that of the search's model, and flat."""
    case, alone = found.case, found.verdict.model
    assert (
        both.fitted_to == (case.train, case.validation)
        and both.model.parts == alone.parts
        and both.model.refined.converged
    )

    def objective(values: np.ndarray) -> float:
        squares = sum(e.repeats * np.sum(e.common(values)[0] ** 2) for e in both.fitted_to)
        x = both.model.space.to_search(values[case.full_space.columns(both.model.space)])
        return 0.5 * float(squares + np.sum((x / both.model.refined.prior) ** 2))

    assert both.model.refined.objective == pytest.approx(objective(both.model.values), rel=1e-5)
    assert both.model.refined.objective <= objective(alone.values)
    for name in both.model.space.names:
        at = case.full_space.index(name)
        for by in (0.97, 1.03):
            moved = both.model.values.copy()
            moved[at] = np.clip(moved[at] * by, case.full_space.low[at], case.full_space.high[at])
            assert objective(moved) > both.model.refined.objective - RefineConfig().tolerance, name


def test_two_motions_constrain_parameters_better_than_one(found: Small, both: FinalModel):
    alone = found.verdict.model
    one, two = (np.diag(np.linalg.inv(m.refined.hessian)) for m in (alone, both.model))
    assert np.all(two < 1.02 * one) and np.min(two / one) < 0.8
    model = extended(found.case, both)
    assert model.space.names == alone.space.names
    low, high = model.gaussian.interval(0.9)
    at = model.space.index("hinge_preload")
    assert low[at] < PRELOAD < high[at]


def test_the_model_is_unchanged_without_effects_for_blocks_and_without_convergence(found: Small):
    case, model = found.case, found.verdict.model
    assert final_refit_due(case.train, model) and not final_refit_due(case.train, found.base)
    base = refitted(case, found.base)
    assert base.model is found.base and base.fitted_to == (case.train,) and not base.not_made
    blocks: Any = replace(case.train, resampling=SimpleNamespace(repeated=False))
    assert not final_refit_due(blocks, model)
    assert final_refit(blocks, case.validation, model, case.config.refine).model is model
    short = replace(case, config=replace(case.config, refine=RefineConfig(iterations=1, basin_hops=0)))
    kept = refitted(short, model)
    assert kept.model is model and kept.fitted_to == (case.train,) and kept.not_made


def test_the_file_lists_the_recordings_of_the_final_refit(found: Small, both: FinalModel, tmp_path: Path):
    write_gap(tmp_path, found.case, found.verdict, both, MORE)
    final = json.loads((tmp_path / GAP).read_text())["final_model"]
    assert final["fitted_to"] == ["train", "validation"]
    for role, residual_set in found.case.residual_sets.items():
        assert final["discrepancies"][role] == pytest.approx(residual_set.discrepancy_at(both.model.values))
    write_gap(tmp_path, found.case, found.verdict, found.own, MORE)
    assert json.loads((tmp_path / GAP).read_text())["final_model"] == {
        "fitted_to": ["train"],
        "discrepancies": {role: after for role, (_, after) in found.verdict.discrepancies.items()},
    }


def test_a_final_model_that_blows_up_has_no_discrepancy_in_the_file(found: Small, both: FinalModel, tmp_path: Path):
    validation, at = found.case.validation, found.case.full_space.index("hinge_preload")

    def whitened(rows: np.ndarray) -> np.ndarray:
        return np.where(rows[:, at, None] == both.model.values[at], np.nan, validation.whitened(rows))

    case = replace(found.case, validation=replace(validation, whitened=whitened))
    write_amended(tmp_path, case, found.verdict, both, MORE)
    final = json.loads((tmp_path / GAP).read_text())["final_model"]
    assert final["discrepancies"]["validation"] is None and final["discrepancies"]["train"] > 0


def final_model_of(page: str) -> tuple[str, str] | None:
    """U of the final model on the page as data, and the sentence about it."""
    found = re.search(r'<p[^>]*id="final-model" data-value="([^"]*)">(.*?)</p>', page, re.DOTALL)
    return None if found is None else (found[1], found[2])


def test_the_page_names_the_recordings_of_the_final_refit(found: Small, both: FinalModel, tmp_path: Path, quick: None):
    write_gap(tmp_path, found.case, found.verdict, both, MORE)
    said = final_model_of(write_report(tmp_path).read_text())
    assert said is not None and "“train” and “validation”" in said[1]
    assert float(said[0]) == pytest.approx(found.case.validation.discrepancy_at(both.model.values))
    written = json.loads((tmp_path / GAP).read_text())
    written["final_model"]["discrepancies"]["validation"] = None  # its replay blew up
    (tmp_path / GAP).write_text(json.dumps(written))
    said = final_model_of(write_report(tmp_path).read_text())
    assert said is not None and said[0] == "" and "U =" not in said[1]
    write_gap(tmp_path, found.case, found.verdict, found.own, MORE)
    assert final_model_of(write_report(tmp_path).read_text()) is None
