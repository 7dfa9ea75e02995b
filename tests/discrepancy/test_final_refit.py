"""The final model: fitted to both motions where there are two and an effect, else the search's own."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import PRELOAD, Small, small

from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.fitting import FinalModel, FittedModel, final_refit, final_refit_due
from droid_jax.discrepancy.results import extended, write_amended, write_gap
from droid_jax.files import GAP
from droid_jax.identify.multistart import RefineConfig
from droid_jax.report.page import write_report

MORE = {"seconds": {"search": 1.0}, "versions": {}, "device": "test", "setup": {"recording": []}}


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


def refitted(case: Case, model: FittedModel) -> FinalModel:
    return final_refit(case.train, case.validation, model, case.config.refine)


@pytest.fixture(scope="module")
def both(found: Small) -> FinalModel:
    return refitted(found.case, found.verdict.model)


def test_it_is_the_best_of_both_motions(found: Small, both: FinalModel):
    """No worse than the search's model by their common log posterior, and where that is flat."""
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


def test_two_motions_constrain_more_than_one(found: Small, both: FinalModel):
    alone = found.verdict.model
    one, two = (np.diag(np.linalg.inv(m.refined.hessian)) for m in (alone, both.model))
    assert np.all(two < 1.02 * one) and np.min(two / one) < 0.8
    model = extended(found.case, both)
    assert model.space.names == alone.space.names
    low, high = model.gaussian.interval(0.9)
    at = model.space.index("hinge_preload")
    assert low[at] < PRELOAD < high[at]


def test_without_an_effect_in_blocks_or_unconverged_it_is_the_searchs_own(found: Small):
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


def test_the_file_says_what_it_is_fitted_to(found: Small, both: FinalModel, tmp_path: Path):
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
    """What the page says of a final model of its own: its U as data, and the sentence."""
    found = re.search(r'<p[^>]*id="final-model" data-value="([^"]*)">(.*?)</p>', page, re.DOTALL)
    return None if found is None else (found[1], found[2])


def test_the_page_says_what_it_is_fitted_to(found: Small, both: FinalModel, tmp_path: Path, quick: None):
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
