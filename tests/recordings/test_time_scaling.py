"""A motion on another clock, in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from small_gap import record

from droid_jax.recordings.recording import Recording
from droid_jax.recordings.time_scaling import STOP, TIME_SCALINGS, time_scaled


@pytest.fixture(scope="module")
def demonstration() -> Recording:
    return record("train")


@pytest.mark.parametrize(
    ("number", "seconds", "at"),
    [
        (0, lambda d: 3 * d, {0.9: 0.3, 6.0: 2.0}),
        (1, lambda d: d / 2, {0.5: 1.0, 1.2: 2.4}),
        (2, lambda d: 2 * d, {1.0: 1.0, 5.0: 0.996}),
        (3, lambda d: d + STOP, {1.0: 1.0, 2.5: 1.499, 4.5: 2.5}),
    ],
)
def test_a_motion_on_another_clock(
    demonstration: Recording, number: int, seconds: Callable[[float], float], at: dict[float, float]
):
    """`at`: instants of the new motion and of the demonstration (2.998 s long) that have the same command."""
    new = time_scaled(demonstration, TIME_SCALINGS[number])
    assert new.duration == pytest.approx(seconds(demonstration.duration), abs=0.005)
    for later, before in at.items():
        expected = [np.interp(before, demonstration.time, c) for c in demonstration.command.T]
        found = [np.interp(later, new.time, c) for c in new.command.T]
        np.testing.assert_allclose(found, expected, atol=2e-3)
    for channel in new.channels.values():
        assert channel.values.shape[1] == len(channel.time) == channel.mask.shape[1]
        assert channel.time[-1] <= new.time[-1] + 0.1
