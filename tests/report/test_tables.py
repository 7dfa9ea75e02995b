"""Tables, numbers as text, and figures that are kept."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

import droid_jax as dj
from droid_jax.report import style
from droid_jax.report.text import label, like, percent, quantity, significant, speak, spelled, unbroken, unit_text
from droid_jax.storage import write_csv

HISTORY = ["generation", "best_cost", "median_cost", "sigma", "mean_mass", "mean_damping", "std_mass", "std_damping"]


def fit(folder: Path) -> Path:
    write_csv(folder / "samples.csv", ["mass", "damping"], [[1.0, 2.0], [1.5, 2.5], [1.25, 2.25]])
    write_csv(
        folder / "history.csv",
        HISTORY,
        [[1, 0.5, 0.7, 1.0, 1.2, 2.0, 0.3, 0.1], [2, 0.4, 0.5, 0.8, 1.3, 2.1, 0.2, 0.1]],
    )
    return folder


@pytest.mark.parametrize("below", ["", "identify"])
def test_the_tables_of_a_fit(tmp_path: Path, below: str):
    pytest.importorskip("pandas")
    fit(tmp_path / below)
    found = dj.frames(tmp_path)
    assert list(found.samples.columns) == ["mass", "damping"] and found.samples["mass"].mean() == 1.25
    assert found.history.loc[2, "best_cost"] == 0.4 and list(found.history.columns) == HISTORY[1:]


def test_tables_of_an_earlier_run_are_not_those_of_one_that_is_not_whole(tmp_path: Path):
    pytest.importorskip("pandas")
    (fit(tmp_path) / "setup.json").write_text('{"preset": "quick"}')
    with pytest.raises(ValueError, match="holds a run that is not complete"):
        dj.frames(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    assert len(dj.frames(tmp_path).samples) == 3


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("mean_damping,std_mass", "mean_damping$std_mass", "must have the columns generation, best_cost"),
        ("0.5,0.7", "0.5,0.7,0.9", "holds no tables of a fit"),
        ("0.5,0.7", "0.5,x", "the columns median_cost do not hold numbers"),
        ("0.5,0.7", "0.5,", "has empty cells"),
        ("generation", "", "must have the columns"),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, old: str, new: str, said: str):
    pytest.importorskip("pandas")
    path = fit(tmp_path) / "history.csv"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ValueError, match=said):
        dj.frames(tmp_path)


def test_what_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ValueError, match=r"holds no tables of a fit .*run `python -m droid_jax.run identify` again"):
        dj.frames(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"droid_jax.frames needs pandas: in the checkout, pip install"):
        dj.frames(tmp_path)


# ----- names and numbers as text


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("panda_joint3", "Joint 3"), ("joint_3", "Joint 3"), ("panda_finger_joint1", "Panda finger joint1"),
        ("arm2_joint2", "Arm2 joint2"), ("fr3_joint2", "Joint 2"), ("left_joint3", "Left joint3"),
        ("thumb_joint1", "Thumb joint1"), ("torso_joint_1", "Torso joint 1"), ("lbr_iiwa_joint_1", "Joint 1"),
        ("torque_offset[panda_joint3]", "Torque offset, joint 3"),
    ],
)  # fmt: skip
def test_joints_of_different_names_have_different_labels(name: str, words: str) -> None:
    assert label(name) == words


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1.0, "1.00"), (-0.05, "−0.0500"), (0.0, "0"), (12345.6, "12346"), (2e-6, "2.00·10⁻⁶"), (-3.5e12, "−3.50·10¹²"),
     (None, "–"), (float("nan"), "–")],
)  # fmt: skip
def test_numbers_are_written_with_three_digits(value: float | None, shown: str) -> None:
    assert significant(value) == shown


def test_numbers_follow_their_deviation() -> None:
    assert like(1.23456, 0.021) == "1.235"
    assert like(52.31, 0.83) == "52.31"
    assert like(-1234.5, 40.0) == "−1234"  # half to even, and no digits that mean nothing
    assert percent(0.999) == "99 %" and percent(1.0) == "100 %"
    assert percent(0.837) == "84 %" and percent(0.001) == "< 1 %" and percent(0.0) == "0 %"
    assert percent(float("inf")) == percent(1e307) == "–"


def test_identifiers_and_units_are_spelled() -> None:
    assert spelled("joint_coulomb at panda_joint2 is better") == "joint coulomb at joint 2 is better"
    assert spelled("torque_gain[panda_joint2] ran into") == "torque gain, joint 2 ran into"
    assert unit_text("N m s^2/rad^2") == "N m s²/rad²" and quantity(0.5, "-") == "0.500"
    assert unbroken(Markup("1.2 N m &lt;")) == Markup("1.2\u00a0N\u00a0m &lt;")


@pytest.mark.parametrize(("robot", "said"), [("robot", "the robot"), ("synthetic robot", "the synthetic robot")])
def test_a_simulation_is_never_called_a_robot(robot: str, said: str) -> None:
    assert speak("the robot", robot) == said and speak("Robot", robot).lower() == said.removeprefix("the ")
    assert speak("a synthetic robot", robot) == "a synthetic robot"


drawn = list[float]()


def curve(height: float, width: float) -> Figure:
    drawn.append(height)
    figure = Figure((width, 1.0))
    figure.subplots().plot([0.0, height])
    return figure


def test_a_figure_is_drawn_again_only_for_other_content(tmp_path: Path):
    """Its copies and its HTML are kept beside the page; what is damaged or missing is drawn again."""
    drawn.clear()
    first = style.drawing(tmp_path, "curve", "Curve", curve, 1.0)
    assert style.drawing(tmp_path, "curve", "Curve", curve, 1.0) == first and drawn == [1.0, 1.0]  # wide and narrow
    other = style.drawing(tmp_path, "curve", "Curve", curve, 2.0)
    assert other != first and len(drawn) == 4
    (tmp_path / "figures" / "curve.json").write_text("{")
    assert style.drawing(tmp_path, "curve", "Curve", curve, 2.0) == other and len(drawn) == 6
    (tmp_path / "figures" / "curve.png").write_bytes(b"cut")
    assert style.drawing(tmp_path, "curve", "Curve", curve, 2.0) == other and len(drawn) == 8
    assert (tmp_path / "figures" / "curve.png").stat().st_size > 100
    style.drawing(tmp_path, "curve", "Curve", lambda height, width: curve(height, width), 2.0)  # cannot be pickled
    assert len(drawn) == 10
