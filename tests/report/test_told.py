"""What a fit tells of each parameter: nothing, or that it moved, by how much, and why the number is not sure."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_up_run import make_run, parameters
from reader import read_page

from droid_jax.report.page import write_report
from droid_jax.report.run_folder import read_run
from droid_jax.report.told import moved, moved_words, told_words, unsure_words, went_far
from droid_jax.report.words import summary

FRICTION = {  # moved by five deviations of its prior to its upper bound
    "name": "elbow_frictionloss", "unit": "N m", "identifiable": False, "initial_mean": 0.1, "initial_std": 0.05,
    "best": 0.35, "low": 0.0, "high": 0.35, "on_bound": True, "moved": 5.0,
    "reason": "the data leave 40% of the prior's width", "partners": [{"name": "elbow_damping", "correlation": -0.93}],
}  # fmt: skip
SAID = (
    "Elbow frictionloss moved from 0.100 to 0.350 N m (5.0 prior deviations), to its upper bound 0.350 N m, but its "
    "value is not sure, since the data leave 40% of the prior's width, it moves together with elbow damping (−0.93) "
    "and the truth may lie beyond the bound."
)


def test_what_moved_far_is_told_with_how_far_and_why_it_is_not_sure():
    assert told_words([FRICTION]) == [SAID]
    inside = {**FRICTION, "on_bound": False, "partners": [], "best": 0.2, "moved": 2.0}
    assert told_words([inside]) == [
        "Elbow frictionloss moved from 0.100 to 0.200 N m (2.0 prior deviations), but its value is not sure, since the "
        "data leave 40% of the prior's width."
    ]


def test_what_stayed_where_it_was_is_not_told():
    still = {**FRICTION, "best": 0.11, "moved": 0.2, "on_bound": False}
    assert not went_far(still)
    assert told_words([still]) == ["This demonstration does not tell elbow frictionloss; take no number from its row."]
    assert told_words([still, FRICTION])[1:] == [SAID]
    assert told_words([{**FRICTION, "identifiable": True}]) == [
        "Every parameter of interest can be told from this demonstration."
    ]


def test_an_older_fit_tells_how_far_in_its_unit():
    old = {k: v for k, v in FRICTION.items() if k != "moved"}
    assert moved(old) == pytest.approx(5.0) and moved({**FRICTION, "moved": None}) == pytest.approx(5.0)
    assert "(5.0 prior deviations)" in moved_words(old) and "−0.93" in unsure_words(old)


def test_the_page_says_it_in_the_summary_and_in_the_row(tmp_path: Path):
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    (at,) = (i for i, p in enumerate(fit["parameters"]) if p["name"] == "joint_damping_4")
    fit["parameters"][at] |= {"identifiable": False, "best": 90.0, "moved": 5.0, "reason": "the data leave 40% of it"}
    (run / "fit.json").write_text(json.dumps(fit))
    text = " ".join(summary(read_run(run)))
    assert "Joint damping 4 moved from 40.0 to 90.0 N m s/rad (5.0 prior deviations), but its value is not sure" in text
    assert "does not tell door mass;" in text
    row = read_page(write_report(run)).cells["joint_damping_4", "verdict"]["text"]
    assert "moved from 40.0 to 90.0 N m s/rad" in row and "the data leave 40% of it" in row


@pytest.mark.parametrize(
    ("best", "said"),
    [
        (1.5, "shoulder servo scale (more than 1.50, its upper bound)"),
        (0.5, "shoulder servo scale (less than 0.500, its lower bound)"),
    ],
)
def test_a_factor_at_its_bound_is_told_as_beyond_it(tmp_path: Path, best: float, said: str):
    """The servo of the robot is fifty times as stiff as the model's: the fit knows no more than that."""
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    factor = {"name": "shoulder_servo_scale", "unit": "-", "initial_mean": 1.0, "initial_std": 0.1, "low": 0.5}
    fit["parameters"].append({**parameters()[4], **factor, "high": 1.5, "best": best, "on_bound": True})
    (run / "fit.json").write_text(json.dumps(fit))
    assert f"On a bound of its range: hinge friction loss (lower bound 0 N m) and {said}." in summary(read_run(run))
