"""The discrepancy on another motion that the uncertainty of a fit does not explain."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_gap import FLOOR, Small, quiet, record, small

from droid_jax.discrepancy.candidates import project
from droid_jax.discrepancy.case import Case, make_case
from droid_jax.discrepancy.fitting import FittedModel, base_fit, refit
from droid_jax.discrepancy.posterior import LONGEST_STEP, remaining_discrepancy, remaining_residuals, transfer_spread
from droid_jax.discrepancy.statistics import Repeats
from droid_jax.identify.identifiability import posterior_of


@pytest.fixture(scope="module")
def found() -> Small:
    return small()


@pytest.fixture(scope="module")
def whole(found: Small) -> tuple[Case, FittedModel]:
    """A search with nothing hidden."""
    case = make_case(
        found.scene, found.case.base, found.case.effects, record("train", preload=0.0),
        record("validation", preload=0.0),
        config=found.case.config,
    )  # fmt: skip
    return case, base_fit(case.train, case.base, case.config, quiet)


def kept(case: Case, model: FittedModel, off: np.ndarray) -> float:
    """Remaining share of a difference `off` [M] on the other recording."""
    validation = case.validation
    other: Any = SimpleNamespace(
        cost=validation.cost,
        repeats=validation.repeats,
        common=lambda values: validation.common(values) + off,
        residuals=lambda values: validation.residuals(values) + off,
    )
    more, usual = (remaining_residuals(case.train, each, model) for each in (other, validation))
    left = np.mean(more - usual, axis=0)
    return float(np.sum(left**2) / np.sum(off**2))


@pytest.mark.slow
def test_only_the_uncertainty_of_the_fit_is_subtracted(whole: tuple[Case, FittedModel]):
    """Two deviations along the axis to which the other recording is most sensitive, and a difference along none."""
    case, model = whole
    slopes = transfer_spread(case.train, case.validation, model)
    shown = slopes[:, np.argmax(np.linalg.norm(slopes, axis=0))]
    else_ = np.random.default_rng(0).normal(size=len(slopes))
    else_ -= slopes @ np.linalg.lstsq(slopes, else_, rcond=None)[0]
    assert kept(case, model, 2.0 * shown) < 0.3
    assert kept(case, model, else_) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
def test_the_slopes_are_of_one_deviation(whole: tuple[Case, FittedModel]):
    """There is one for each axis; together they span the effect of every parameter."""
    case, model = whole
    slopes, refined = transfer_spread(case.train, case.validation, model), model.refined
    assert slopes.shape == (len(case.validation.common(model.values)[0]), len(refined.x))
    step = np.zeros(len(refined.x))
    step[0] = 0.01
    here, there = (case.full_space.embed(model.space, model.space.from_search(x)[None], model.values)
                   for x in (refined.x, refined.x + step))  # fmt: skip
    moved = (case.validation.common(there) - case.validation.common(here))[0]
    # The effect of one parameter is in the span of all axes that are constrained.
    assert np.linalg.norm(project(moved[None], slopes, np.full(len(slopes.T), 1e6))[0]) < 0.1 * np.linalg.norm(moved)


@pytest.mark.slow
def test_a_missing_effect_remains(found: Small):
    """No uncertain parameter acts on the other motion like the hidden preload."""
    case, base = found.case, found.base
    before = case.validation.discrepancy_at(base.values)
    assert before > FLOOR and remaining_discrepancy(case.train, case.validation, base) > 0.5 * before


@pytest.mark.slow
def test_the_verdict_holds_the_remaining_discrepancy(found: Small):
    case, verdict = found.case, found.verdict
    assert verdict.remainder == pytest.approx(remaining_discrepancy(case.train, case.validation, verdict.model))
    # If little is subtracted, it may lie above U by noise: both are unbiased on average only.
    assert verdict.remainder is not None and verdict.remainder <= 1.1 * verdict.discrepancies["validation"][1]


@pytest.mark.slow
def test_the_remaining_discrepancy_of_noise_is_zero_on_average(whole: tuple[Case, FittedModel]):
    """Noise about the model's replay: the projection does not make the mean of U negative."""
    case, model = whole
    validation = case.validation
    assert isinstance(validation.resampling, Repeats)
    slopes, rows = transfer_spread(case.train, validation, model), validation.resampling
    rng, left_over, mean_only = np.random.default_rng(0), list[float](), list[float]()
    for _ in range(300):
        noise = rng.normal(size=rows.deviations.shape)
        left = project(noise, slopes, np.full(len(slopes.T), validation.repeats**0.5))
        left_over.append(rows.discrepancy(left))
        mean_only.append(rows.discrepancy(noise - noise.mean(axis=0) + left.mean(axis=0)))
    less = np.array(left_over) - mean_only
    assert abs(np.mean(left_over)) < 3 * np.std(left_over) / len(left_over) ** 0.5
    assert np.mean(less) > 10 * np.std(less) / len(less) ** 0.5
    drawn = replace(validation, resampling=Repeats(noise - noise.mean(axis=0)))
    common = drawn.residuals(model.values)
    np.testing.assert_allclose(
        remaining_residuals(case.train, drawn, model),
        project(common, slopes, np.full(len(slopes.T), validation.repeats**0.5)),
    )


@pytest.mark.slow
def test_more_repeats_in_the_fit_explain_less(found: Small):
    """A better constrained parameter explains a smaller difference."""

    def size(repeats: int) -> float:
        made = {role: record(role, repeats, preload=0.0) for role in ("train", "validation")}
        case = make_case(found.scene, found.case.base, found.case.effects, **made, config=found.case.config)
        model = refit(case.train, case.base, (), case.full_space.mean[None], case.config.refine)
        return float(np.mean(np.sum(transfer_spread(case.train, case.validation, model) ** 2, axis=1)))

    assert size(32) < 0.6 * size(8)


def test_a_bound_does_not_change_a_slope(whole: tuple[Case, FittedModel]):
    """A linear replay, one parameter at its bound, each parameter a principal axis."""
    case, model = whole
    space, count = model.space, len(model.space)
    x = model.refined.x.copy()
    stuck = space.index("forearm_mass")
    x[stuck] = space.to_search(space.high)[stuck]
    jacobian = np.zeros_like(model.refined.jacobian)
    jacobian[:count] = np.diag(np.linspace(20.0, 40.0, count))
    refined = replace(model.refined, x=x, jacobian=jacobian)
    matrix = np.random.default_rng(0).normal(size=(count, 30))
    linear: Any = SimpleNamespace(
        cost=case.validation.cost, common=lambda rows: space.to_search(rows[:, case.full_space.columns(space)]) @ matrix
    )
    slopes = transfer_spread(case.train, linear, replace(model, refined=refined))
    along = np.linalg.lstsq(matrix.T, slopes, rcond=None)[0]  # each column is an axis in search units
    assert np.all(np.count_nonzero(np.abs(along) > 1e-9, axis=0) == 1)
    deviation = np.sqrt(np.diag(posterior_of(refined, case.train.cost.comparisons, misfit=False).cov))
    np.testing.assert_allclose(np.abs(along).sum(axis=1), np.minimum(deviation, LONGEST_STEP), rtol=1e-6)


@pytest.mark.slow
def test_nothing_is_subtracted_for_blocks_of_one_motion(whole: tuple[Case, FittedModel]):
    case, model = whole
    blocks: Any = SimpleNamespace(resampling=SimpleNamespace(repeated=False))
    left = remaining_residuals(blocks, case.validation, model)
    np.testing.assert_array_equal(left, case.validation.residuals(model.values))
    assert not np.array_equal(left, remaining_residuals(case.train, case.validation, model))
