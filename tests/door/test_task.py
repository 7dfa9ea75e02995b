"""Grip, reward and success against what they should be by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from droid_jax.door.task import (
    HandState,
    Task,
    gripped,
    held_open,
    observation,
    reward,
    succeeded,
    terms,
)
from droid_jax.policy.control import LAYOUT, OBSERVED

TASK = Task()
HELD = HandState(
    angle=0.2, pinch=np.array([0.003, 0.0, 0.004]), pads=np.zeros((2, 3)), normal=1.0, yaw=0.0,
    force=np.array([5.0, 6.0]), sliding=0.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "is_one"),
    [
        ({}, True),
        ({"force": np.array([5.0, 0.0])}, False),  # one finger hooks
        ({"force": np.array([0.5, 5.0])}, False),
        ({"yaw": np.deg2rad(19.0)}, True),
        ({"yaw": np.deg2rad(-21.0)}, False),  # both press, the hand turned aside
        ({"yaw": np.deg2rad(90.0)}, False),
        ({"pads": np.array([[0.01, 0.017, 0.0], [0.01, -0.017, 0.0]])}, True),
        ({"pads": np.array([[0.01, 0.017, 0.0], [0.03, -0.003, 0.0]])}, False),  # one behind the knob's round end
    ],
)
def test_a_grip_takes_both_fingers_and_a_hand_that_faces_the_door(changes, is_one):
    assert bool(gripped(TASK, HELD._replace(**changes))) == is_one


def test_the_door_pays_only_while_it_is_gripped():
    hooked = HELD._replace(force=np.array([9.0, 0.0]), pads=np.array([[0.0, 0.017, 0.0], [0.0, -0.04, 0.0]]))
    assert float(terms(TASK, HELD)["door"]) == pytest.approx(0.25 + 0.2 / np.deg2rad(30))
    assert float(terms(TASK, hooked)["door"]) == pytest.approx(0.125 * (1.0 + np.exp(-2.0)))
    assert float(reward(TASK, HELD)) > float(reward(TASK, hooked))


def test_a_finger_on_its_way_to_the_knob_pays_more_and_more():
    """The other one presses already; the hand faces the door, or nothing of it counts."""

    def worth(gap: float, yaw: float = 0.0) -> float:
        pads = np.array([[0.0, 0.017, 0.0], [0.0, -gap, 0.0]])
        pressed = HELD._replace(pads=pads, force=np.array([5.0, 5.0 if gap <= 0.017 else 0.0]), yaw=yaw)
        return float(terms(TASK, pressed._replace(angle=0.0))["door"])

    assert np.all(np.diff([worth(gap) for gap in (0.04, 0.035, 0.03, 0.025, 0.02, 0.017)]) > 0)
    assert worth(0.02, yaw=0.5) == 0.0


def test_an_open_door_pays_more_than_one_just_short_of_it():
    """Though the distances stop to pay at thirty degrees."""
    before, after = (HELD._replace(angle=TASK.opened + by) for by in (-0.01, 0.01))
    assert float(reward(TASK, after)) > float(reward(TASK, before)) + 1.0


def test_distances_count_below_thirty_degrees_only():
    far = HELD._replace(pinch=np.array([0.0, 0.0, 0.1]))
    opened = far._replace(angle=np.deg2rad(31.0))
    shut = {name: float(value) for name, value in terms(TASK, far).items()}
    open_ = {name: float(value) for name, value in terms(TASK, opened).items()}
    assert shut["distance"] == pytest.approx(-0.1)
    assert shut["log_distance"] == pytest.approx(-np.log(0.1 + TASK.near))
    assert open_["distance"] == open_["log_distance"] == 0.0


def test_the_reward_is_the_weighted_sum():
    """Five numbers by hand; a hand that is turned, to either side, pays less."""
    seen = HELD._replace(yaw=-0.1, normal=0.9, sliding=0.3)
    for yaw in (-0.1, 0.1):
        assert float(terms(TASK, seen._replace(yaw=yaw))["orientation"]) == pytest.approx(0.8)
    weights = Task(door=2.0, orientation=3.0, distance=5.0, log_distance=7.0, slip=11.0)
    by_hand = (
        2.0 * (0.25 + 0.2 / np.deg2rad(30)) + 3.0 * 0.8 - 5.0 * 0.005 - 7.0 * np.log(0.005 + TASK.near) - 11.0 * 0.3
    )
    assert float(reward(weights, seen)) == pytest.approx(by_hand, rel=1e-5)
    expected = float(reward(TASK, seen))
    without_slip = replace(TASK, slip=0.0)
    assert float(reward(without_slip, seen)) == pytest.approx(expected + 0.2 * 0.3)


def test_sliding_past_a_knob_that_is_not_touched_costs_nothing():
    seen = HELD._replace(force=np.zeros(2), sliding=0.5)
    assert float(terms(TASK, seen)["slip"]) == 0.0


def test_a_success_is_held_for_half_a_second_without_a_break():
    """Opening past 30 degrees and flinging the door on is none."""
    opened, lost = HELD._replace(angle=0.55), HELD._replace(angle=0.9, force=np.zeros(2))
    held = longest = 0.0
    for k in range(60):
        held = float(held_open(TASK, lost if k in (0, 24) else opened, held))
        longest = max(longest, held)
        assert bool(succeeded(TASK, longest)) == (k >= 49)
    assert longest == pytest.approx(35 * TASK.control)


def test_the_observation_is_laid_out_as_documented():
    pads = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    seen = HELD._replace(pinch=np.array([7.0, 8.0, 9.0]), pads=pads)
    found = np.asarray(observation(np.arange(7.0), 10 + np.arange(7.0), seen))
    assert found.shape == (OBSERVED,) == (len(LAYOUT),)
    at = dict(zip(LAYOUT, found.tolist(), strict=True))
    assert at["position of joint 3, rad"] == 2.0
    assert at["velocity of joint 1, rad/s"] == 10.0
    assert at["pinch point from the knob, y of the knob's frame, m"] == 8.0
    assert at["right pad from the knob, x of the knob's frame, m"] == pytest.approx(0.4)
