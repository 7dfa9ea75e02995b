"""Noise of measured positions, differentiated into a prescribed motion, is known as noise of the torques."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_log import CONFIG, elbow, elbow_log, elbow_space

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.model.effects.registry import ready
from droid_jax.recordings.recording import Recording

REPEATS = 8
TRUTH = np.array([[0.6, 0.1]])  # damping and torque offset of the log
TREMBLE = 3e-3  # rad: what it makes of the acceleration is worth one and a half times the torque sensor's noise


def log(noise: float, seed: int = 0) -> Recording:
    recording = elbow_log(0.0, repeats=REPEATS)
    position = recording.channel("position")
    off = np.random.default_rng(seed).normal(0.0, noise, position.values.shape)
    return replace(
        recording, channels={**recording.channels, "position": replace(position, values=position.values + off)}
    )


@pytest.fixture(scope="module")
def cost() -> Cost:
    scene = elbow()
    return make_cost(ready(scene), elbow_space(scene), [log(TREMBLE)], config=CONFIG.compare)


def size(cost: Cost) -> float:
    """Mean square of the truth's whitened residuals."""
    return float(np.mean(cost.whitened(TRUTH) ** 2))


def test_residuals_of_the_truth_are_of_unit_size(cost: Cost):
    sizes = [size(cost), *(size(cost.against([log(TREMBLE, seed)])) for seed in (1, 2, 3))]
    np.testing.assert_allclose(sizes, 1.0, atol=0.3)


@pytest.mark.slow
def test_without_it_they_are_not(cost: Cost):
    """Where one repeat's positions are missing somewhere the repeats do not tell, and all share it."""
    recording = log(TREMBLE, seed=1)
    position = recording.channel("position")
    mask = position.mask.copy()
    mask[0, 100] = False
    holed = replace(recording, channels={**recording.channels, "position": replace(position, mask=mask)})
    assert size(cost.against([holed])) > 4.0


def test_the_mean_of_the_repeats_stays_what_was_measured(cost: Cost):
    recording = log(TREMBLE, seed=1)
    found, exact = (cost.against([r]).comparisons[0].channel("torque").noise for r in (recording, log(0.0)))
    np.testing.assert_allclose(found.mean, exact.mean, atol=1e-5)
    assert np.std(found.repeats - found.mean) > 1.5 * np.std(exact.repeats - exact.mean)
