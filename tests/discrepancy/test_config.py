"""All thresholds of the search: what no search could use is refused when it is set."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import pytest

import droid_jax as dj
from droid_jax.discrepancy.config import BlocksConfig, SelectionConfig

FROM_ONE = {"nuisance_bound", "prior_slack", "equivalence_factor", "simplest_factor"}  # factors
SHARES = {f.name for f in fields(SelectionConfig)} - FROM_ONE - {"resamples"}


def changed(name: str, value: Any) -> dict[str, Any]:
    return {name: value}


@pytest.mark.parametrize("name", sorted(SHARES))
def test_shares_and_levels_are_between_zero_and_one(name: str):
    for value in (0.0, 0.5, 1.0):
        assert getattr(SelectionConfig(**changed(name, value)), name) == value
    for value in (-0.01, 1.01, float("nan"), "0.5", None, True):
        with pytest.raises(ValueError, match=name):
            SelectionConfig(**changed(name, value))


@pytest.mark.parametrize("name", sorted(FROM_ONE))
def test_factors_are_no_less_than_one(name: str):
    assert getattr(SelectionConfig(**changed(name, 7.5)), name) == 7.5
    for value in (0.99, -1.0, float("inf"), float("nan"), "3"):
        with pytest.raises(ValueError, match=name):
            SelectionConfig(**changed(name, value))


@pytest.mark.parametrize("value", [0, -1, 1.5, "400"])
def test_resamples_are_a_whole_number(value: Any):
    with pytest.raises(ValueError, match="resamples"):
        SelectionConfig(resamples=value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"correlation_times": -1.0}, "correlation_times"),
        ({"shortest": -0.1}, "shortest"),
        ({"fitted_share": 1.1}, "fitted_share"),
        ({"noise_share": -0.1}, "noise_share"),
        ({"equivalence_factor": 0.9}, "equivalence_factor"),
        ({"prior_slack": 0.5}, "prior_slack"),
    ],
)
def test_blocks_that_no_log_could_have_are_refused(changes: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        BlocksConfig(**changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"max_effects": 0}, "max_effects must be at least 1, got 0"),
        ({"pair_refits": 0}, "pair_refits must be at least 1, got 0"),
        ({"budget_minutes": -1.0}, "budget_minutes"),
        ({"selection": 0.01}, "selection"),
        ({"blocks": SelectionConfig()}, "blocks"),
        ({"polish": 12}, "polish"),
        ({"channels": ("torque", "current")}, "current"),
    ],
)
def test_settings_that_no_search_could_use_are_refused(changes: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=said):
        dj.DiscrepancyConfig(**changes)


def test_thresholds_do_not_change_once_set():
    config = dj.DiscrepancyConfig()
    with pytest.raises(FrozenInstanceError):
        config.selection.significance = 0.5  # pyright: ignore[reportAttributeAccessIssue]
    other = replace(config, selection=replace(config.selection, significance=0.5))
    assert (config.selection.significance, other.selection.significance) == (0.01, 0.5)


def test_the_thresholds_are_those_of_the_published_runs():
    """A changed default changes verdicts: then the documents' tables are of another program."""
    assert SelectionConfig() == SelectionConfig(
        significance=0.01, nuisance_bound=3.0, prior_slack=3.0, collinear=0.9, confirmation=0.05, least_gain=0.2,
        least_further_gain=0.4, least_share=0.05, stability=0.8, resamples=400, interval_level=0.9, bound_margin=0.02,
        equivalence_factor=3.0, equivalence_doubt=0.05, equal_fit=0.05, simplest_factor=1.25, simplest_share=0.01,
        generality_factor=0.9, open_share=0.1, minimum_closed=0.4, mostly_explained=0.5, shape_interval_share=0.5,
        false_discovery_rate=0.1,
    )  # fmt: skip
    assert BlocksConfig() == BlocksConfig(1.5, 0.5, 2 / 3, 0.2, 0.3, 0.08, 2, 1.5, 30.0)
