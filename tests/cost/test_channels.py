"""Which channels a fit compares, how several weigh, and errors in physical units, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pendulum import pendulum, swung
from small_log import elbow, elbow_log

from droid_jax.cost.channels import check_channels, informative_channels, measured_channels
from droid_jax.cost.errors import channel_errors, errors_json, mean_errors
from droid_jax.model.effect_interface import Rollout
from droid_jax.recordings.recording import Channel, Recording

ALL = ("torque", "position", "velocity")


def dead(recording: Recording, name: str) -> Recording:
    """The recording with one channel set to zero."""
    channel = recording.channels[name]
    silent = replace(channel, values=np.zeros_like(channel.values))
    return replace(recording, channels={**recording.channels, name: silent})


def test_channels_that_depend_on_a_compared_one_are_not_compared():
    scene = pendulum()
    every, moved, fast = (swung("a", 1.0, 1.0, names) for names in (ALL, ALL[1:], ALL[2:]))
    assert informative_channels(scene, [every]) == ("torque",)
    assert informative_channels(scene, [moved]) == informative_channels(scene, [every, moved]) == ("position",)
    assert informative_channels(scene, [fast]) == ("velocity",)


def test_a_constant_channel_is_not_compared():
    scene, recording = pendulum(), swung("a", 1.0, 1.0, ALL)
    assert informative_channels(scene, [dead(recording, "torque")]) == ("position",)
    with pytest.raises(ValueError, match=r"no measured channel in common .*'a': none"):
        informative_channels(scene, [dead(swung("a", 1.0, 1.0), "position")])


def test_along_a_measured_motion_only_torques_are_simulated():
    assert measured_channels(elbow(), elbow_log(0.0, 4.0)) == ("torque",)
    with pytest.raises(ValueError, match=r"'elbow' holds no commands.*position cannot be compared"):
        check_channels([elbow_log(0.0, 4.0)], ["torque", "position"])
    with pytest.raises(ValueError, match="'a' has no channel torque to compare; it has: position"):
        check_channels([swung("a", 1.0, 1.0)], ["torque"])


def rollout(clock: np.ndarray, position: np.ndarray) -> Rollout:
    """A replay of one joint with these positions."""
    flat = np.zeros((len(clock), 1))
    return Rollout(clock, flat, position[:, None], flat, np.zeros(len(clock)), np.zeros((len(clock), 0), bool), True)


def test_errors_are_those_of_the_samples_that_were_measured():
    """Two repeats with errors of +1 and -3 mrad, half of one not measured, and another clock of the replay."""
    time = np.arange(0.0, 1.0, 0.01)
    values = np.stack([time + 1e-3, time - 3e-3])[:, :, None]
    mask = np.ones(values.shape, bool)
    mask[1, 50:] = False
    values[~mask] = 99.0
    channel = Channel("position", "rad", ("swing",), time, values, mask)
    recording = replace(swung("a", 1.0, 1.0), channels={"position": channel})
    clock = np.arange(0.0, 1.0, 0.004)
    found = channel_errors(pendulum(), recording, clock, rollout(clock, clock + 1.0), rollout(clock, clock))
    errors = found["position"]
    assert (errors.unit, errors.joints) == ("rad", ("swing",))
    assert errors.mae_after[0] == pytest.approx((100 * 1e-3 + 50 * 3e-3) / 150)
    assert errors.rms_after[0] == pytest.approx(np.sqrt((100 * 1e-6 + 50 * 9e-6) / 150))
    assert errors.mae_before[0] == pytest.approx((100 * 0.999 + 50 * 1.003) / 150)
    assert mean_errors({"a": found})["position"] == pytest.approx((errors.mae_before[0], errors.mae_after[0]))


def test_a_replay_that_blew_up_has_no_errors_in_its_file():
    clock = np.arange(0.0, 1.0, 0.004)
    lost = rollout(clock, np.where(clock > 0.5, np.nan, clock))
    found = channel_errors(pendulum(), swung("a", 1.0, 1.0), clock, lost, rollout(clock, clock))
    written = errors_json(found)["position"]
    assert written["mae_before"] == [None] and written["mae_after"][0] > 0
