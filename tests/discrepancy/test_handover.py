"""The model that is handed on: of both motions where there are two and an effect, else the search's own."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import PRELOAD, Small, small

from droid_jax.discrepancy.fitting import FinalModel, final_refit
from droid_jax.discrepancy.results import extended, write_gap
from droid_jax.identify.multistart import RefineConfig
from droid_jax.report.gap_folder import read_gap
from droid_jax.report.page import write_report

MORE = {"seconds": {"search": 1.0}, "versions": {}, "device": "test", "setup": {"recording": []}}


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def both(found: Small) -> FinalModel:
    return final_refit(found.case, found.verdict.model)


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


def test_two_motions_tell_more_than_one(found: Small, both: FinalModel):
    alone = found.verdict.model
    one, two = (np.diag(np.linalg.inv(m.refined.hessian)) for m in (alone, both.model))
    assert np.all(two < 1.02 * one) and np.min(two / one) < 0.8
    model = extended(found.case, both)
    assert model.space.names == alone.space.names
    low, high = model.gaussian.interval(0.9)
    at = model.space.index("hinge_preload")
    assert low[at] < PRELOAD < high[at]


def test_without_an_effect_in_blocks_or_unsettled_it_is_the_searchs_own(found: Small):
    case, model = found.case, found.verdict.model
    assert final_refit(case, found.base).model is found.base
    blocks: Any = SimpleNamespace(train=SimpleNamespace(repeated=False))
    assert final_refit(blocks, model).model is model
    short = replace(case, config=replace(case.config, refine=RefineConfig(iterations=1, basin_hops=0)))
    kept = final_refit(short, model)
    assert kept.model is model and kept.fitted_to == (case.train,)


def test_file_and_page_say_what_it_is_fitted_to(found: Small, both: FinalModel, tmp_path):
    write_gap(tmp_path, found.case, found.verdict, both, MORE)
    told: Any = read_gap(tmp_path)
    assert told.fitted_to == ["train", "validation"]
    for role, residual_set in (("train", found.case.train), ("validation", found.case.validation)):
        assert told.found["handed_on"]["gaps"][role] == pytest.approx(residual_set.discrepancy_at(both.model.values))
    page = write_report(tmp_path).read_text()
    assert re.search("was fitted to “train” and “validation” together; on “validation” it leaves U = [0-9.e-]+", page)
    told.found["handed_on"]["gaps"]["validation"] = None  # its replay blew up
    (tmp_path / "gap.json").write_text(json.dumps(told.found))
    assert "was fitted to “train” and “validation” together.</p>" in write_report(tmp_path).read_text()
    write_gap(tmp_path, found.case, found.verdict, found.own, MORE)
    assert "handed-on" not in write_report(tmp_path).read_text()
