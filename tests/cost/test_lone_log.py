"""Logs without commands: their cost, and what noise of the motion does to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_log import ASKED, CONFIG, COULOMB, elbow, elbow_log, elbow_space

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.lone_log import LoneLog, lone_log
from droid_jax.model.effects.registry import joined, library, ready
from droid_jax.recordings.recording import Recording


@pytest.fixture(scope="module")
def log() -> LoneLog:
    scene = elbow()
    effects = library(scene, ASKED)
    space = joined(elbow_space(scene), effects)
    return lone_log(ready(scene), space, elbow_log(COULOMB), CONFIG.compare, effects)


def test_a_log_is_whitened_as_by_its_cost(log: LoneLog):
    scene = elbow()
    cost = make_cost(ready(scene), elbow_space(scene), [elbow_log(COULOMB)], config=CONFIG.compare)
    values = elbow_space(scene).mean
    whole = log.space.mean
    stated = cost.with_estimated_noise(values)
    deviation = 1 / stated.comparisons[0].channel("torque").noise.weight[0, 0]
    everywhere = np.ones(len(log.clock), bool)
    own = log.with_noise(np.array([deviation]), everywhere)
    np.testing.assert_allclose(own.whitened(whole[None]), stated.whitened(values[None]), atol=1e-3)
    some = log.clock < 5.0
    np.testing.assert_array_equal(log.with_noise(np.ones(1), some).whitened(whole[None])[0] == 0, ~some)
    fitted = log.with_torques(log.simulated(whole[None])[0])
    np.testing.assert_allclose(fitted.residual(whole), 0.0, atol=1e-9)


def test_distances_are_over_the_instants_with_a_weight(log: LoneLog):
    """Equation 1 over half of the instants, those at which the residual is small."""
    (comparison,) = log.comparisons
    plain = replace(log, comparisons=(replace(comparison, config=replace(comparison.config, whitened=False)),))
    left = np.abs(log.residual(log.space.mean))[:, 0]
    everywhere, some = np.ones(len(left), bool), left < np.median(left)
    values = log.space.mean[None]
    whole, part = (plain.with_noise(np.ones(1), at).distances(values)[0, 0] for at in (everywhere, some))
    assert left[some].mean() < 0.85 * left.mean()
    assert part / whole == pytest.approx(left[some].mean() / left.mean(), rel=0.08)


def test_repeats_are_refused_and_parts_have_names(log: LoneLog):
    scene = elbow()
    space = elbow_space(scene)
    with pytest.raises(ValueError, match="'elbow' has 2 repeats, and a log in blocks has one"):
        lone_log(scene, space, elbow_log(COULOMB, 8.0, 2), CONFIG.compare)
    assert log.part("another").comparisons[0].name == "another" and log.comparisons[0].name == "elbow"


# ----- noise of measured positions, differentiated into a prescribed motion, is known as noise of the torques


REPEATS = 8
TRUTH = np.array([[0.6, 0.1]])  # damping and torque offset of the log
TREMBLE = 3e-3  # rad: what it makes of the acceleration is worth one and a half times the torque sensor's noise


def trembling(noise: float, seed: int = 0) -> Recording:
    recording = elbow_log(0.0, repeats=REPEATS)
    position = recording.channel("position")
    off = np.random.default_rng(seed).normal(0.0, noise, position.values.shape)
    return replace(
        recording, channels={**recording.channels, "position": replace(position, values=position.values + off)}
    )


@pytest.fixture(scope="module")
def cost() -> Cost:
    scene = elbow()
    return make_cost(ready(scene), elbow_space(scene), [trembling(TREMBLE)], config=CONFIG.compare)


def size(cost: Cost) -> float:
    """Mean square of the truth's whitened residuals."""
    return float(np.mean(cost.whitened(TRUTH) ** 2))


def test_residuals_of_the_truth_have_unit_size(cost: Cost):
    sizes = [size(cost), *(size(cost.against([trembling(TREMBLE, seed)])) for seed in (1, 2, 3))]
    np.testing.assert_allclose(sizes, 1.0, atol=0.3)


@pytest.mark.slow
def test_without_it_they_are_not(cost: Cost):
    """If positions of one repeat are missing, the common error of the motion is not estimated."""
    recording = trembling(TREMBLE, seed=1)
    position = recording.channel("position")
    mask = position.mask.copy()
    mask[0, 100] = False
    holed = replace(recording, channels={**recording.channels, "position": replace(position, mask=mask)})
    assert size(cost.against([holed])) > 4.0


def test_the_mean_of_the_repeats_is_the_measurement(cost: Cost):
    recording = trembling(TREMBLE, seed=1)
    found, exact = (cost.against([r]).comparisons[0].channel("torque").noise for r in (recording, trembling(0.0)))
    np.testing.assert_allclose(found.mean, exact.mean, atol=1e-5)
    assert np.std(found.repeats - found.mean) > 1.5 * np.std(exact.repeats - exact.mean)
