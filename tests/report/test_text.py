"""Names and numbers as text."""

from __future__ import annotations

import pytest
from markupsafe import Markup

from droid_jax.report.text import label, like, percent, quantity, significant, speak, spelled, unbroken, unit_text


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
