"""Smoothed and differentiated positions of a log without commands, against sines with known derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.simulate.measured_motion import EDGE, OVERSAMPLING, measured_motion

TIME = np.arange(0, 6.0, 1e-3)
JOINTS = ("a", "b")
FREQUENCY = np.array([0.4, 1.1])  # Hz


def sines(time: np.ndarray, order: int = 0) -> np.ndarray:
    """[T, 2] the order-th derivative of two sines of 0.5 rad."""
    w = 2 * np.pi * FREQUENCY
    return 0.5 * w**order * np.sin(w * time[:, None] + order * np.pi / 2)


def log(position: np.ndarray, time: np.ndarray = TIME, mask: np.ndarray | None = None) -> Recording:
    """A log of repeats [N, T, 2] without commands."""
    mask = np.ones(position.shape, bool) if mask is None else mask
    channels = {"position": Channel("position", "rad", JOINTS, time, position, mask)}
    convention = TorqueConvention(TorqueSide.LINK, gravity=True)
    return Recording("log", np.zeros(0), np.zeros((0, 0)), (), channels, convention, qpos0={})


def test_a_sine_is_differentiated_twice():
    motion = measured_motion(log(sines(TIME)[None]), JOINTS)
    assert motion.time[0] == pytest.approx(EDGE) and motion.time[-1] <= TIME[-1] - EDGE + 1e-9
    assert motion.timestep == pytest.approx(1 / (OVERSAMPLING * 20.0))
    np.testing.assert_allclose(motion.position, sines(motion.time), atol=1e-3)
    np.testing.assert_allclose(motion.velocity, sines(motion.time, 1), atol=4e-3)
    np.testing.assert_allclose(motion.acceleration, sines(motion.time, 2), atol=0.1)


def test_joints_come_in_the_order_asked_for_and_repeats_are_averaged():
    noise = np.random.default_rng(0).normal(0, 1e-3, (8, len(TIME), 2))
    noise -= noise.mean(axis=0)
    clean = measured_motion(log(sines(TIME)[None]), JOINTS)
    swapped = measured_motion(log(sines(TIME)[None] + noise), ("b", "a"))
    np.testing.assert_allclose(swapped.acceleration, clean.acceleration[:, ::-1], atol=1e-6)


def test_a_gap_in_a_repeat_causes_no_step():
    """Repeats differ by a milliradian.  Without care the mean of the others would jump."""
    rng = np.random.default_rng(4)
    repeats = sines(TIME) + np.array([-1e-3, 0.0, 1e-3])[:, None, None]
    repeats += 3e-5 * rng.normal(size=(3, 1, 1)) * TIME[None, :, None]
    mask = np.ones(repeats.shape, bool)
    mask[0, 2000:2200, 0] = mask[1, 2150:2400, 0] = mask[2, 3000:, 1] = False
    whole, holed = (measured_motion(log(repeats, mask=m), JOINTS) for m in (np.ones_like(mask), mask))
    np.testing.assert_allclose(holed.position, whole.position, atol=1e-4)
    np.testing.assert_allclose(holed.acceleration, whole.acceleration, atol=0.02)
    mask[0] = False
    np.testing.assert_allclose(
        measured_motion(log(repeats, mask=mask), JOINTS).acceleration, whole.acceleration, atol=0.02
    )


def test_a_lower_cutoff_lets_less_noise_through():
    noise = np.random.default_rng(1).normal(0, 1e-4, (1, len(TIME), 2))
    rough, calm = (measured_motion(log(sines(TIME)[None] + noise), JOINTS, cutoff=c) for c in (40.0, 8.0))
    errors = [np.std(m.acceleration - sines(m.time, 2)) for m in (rough, calm)]
    assert errors[1] < 0.1 * errors[0]


def test_a_jittering_clock_is_resampled():
    """A filter that assumed even samples would give hundreds of rad/s^2."""
    jitter = np.random.default_rng(2).uniform(-0.45, 0.45, len(TIME)) * 1e-3
    time = TIME + np.r_[0.0, jitter[1:-1], 0.0]
    kept = np.r_[0:2000, 2010:4000, 4015:6000]  # and where 10 and 15 samples were lost
    motion = measured_motion(log(sines(time[kept])[None], time[kept]), JOINTS)
    np.testing.assert_allclose(motion.position, sines(motion.time), atol=1e-3)
    np.testing.assert_allclose(motion.acceleration, sines(motion.time, 2), atol=0.15)


def test_a_gap_that_no_filter_bridges_is_refused():
    kept = np.r_[0:2000, 2200:6000]
    with pytest.raises(
        ValueError, match=r"no position for 0\.201 s from 1\.999 s on.*--motion-cutoff .*below 1\.99 Hz"
    ):
        measured_motion(log(sines(TIME[kept])[None], TIME[kept]), JOINTS)


def test_a_short_gap_is_bridged():
    """The masked values are not used, and the spline in their place does not disturb the filter."""
    values, mask = sines(TIME)[None].copy(), np.ones((1, len(TIME), 2), bool)
    mask[0, 1234:1243, 1] = False
    values[~mask] = np.nan
    motion = measured_motion(log(values, mask=mask), JOINTS)
    np.testing.assert_allclose(motion.position, sines(motion.time), atol=1e-3)
    np.testing.assert_allclose(motion.acceleration, sines(motion.time, 2), atol=0.3)


@pytest.mark.parametrize("stamps", [True, False], ids=["masked", "without stamps"])
def test_a_lost_sample_of_a_slow_log_is_bridged(stamps: bool):
    """At 50 Hz two steps are more than a quarter of the cutoff's period."""
    time = TIME[::20]
    mask = np.ones((1, len(time), 2), bool)
    mask[0, 133] = False
    kept = np.ones(len(time), bool) if stamps else mask[0, :, 0]
    motion = measured_motion(log(sines(time)[None, kept], time[kept], mask[:, kept]), JOINTS)
    np.testing.assert_allclose(motion.position, sines(motion.time), atol=1e-3)
    np.testing.assert_allclose(motion.acceleration, sines(motion.time, 2), atol=0.3)


def test_what_cannot_be_a_motion_is_refused():
    with pytest.raises(ValueError, match="lack wrist"):
        measured_motion(log(sines(TIME)[None]), ("a", "wrist"))
    mask = np.ones((1, len(TIME), 2), bool)
    mask[0, 1234:1250, 1] = False  # of a longer time than a quarter of the cutoff's period
    with pytest.raises(ValueError, match=r"column .b.: not measured at 1\.234 s; .*convert --start S"):
        measured_motion(log(sines(TIME)[None], mask=mask), JOINTS)
    slow = TIME[::40]
    with pytest.raises(
        ValueError, match=r"25 Hz, too slow to be smoothed at 20 Hz; give --motion-cutoff .*below 10 Hz"
    ):
        measured_motion(log(sines(slow)[None], slow), JOINTS)
    with pytest.raises(ValueError, match=r"1\.2 s long; a motion needs 1\.6 s"):
        measured_motion(log(sines(TIME[:1201])[None], TIME[:1201]), JOINTS)
    with pytest.raises(ValueError, match="unknown channel 'position'"):
        measured_motion(replace(log(sines(TIME)[None]), channels={}), JOINTS)


@pytest.mark.parametrize(("rate", "cutoff"), [(50.0, 20.0), (30.0, 12.0), (100.0, 20.0)])
def test_a_slow_log_of_a_fast_motion_is_differentiated_exactly(rate: float, cutoff: float):
    """Finite differences between its samples would lose up to 15 % of the acceleration."""
    time = np.arange(0, 8.0, 1 / rate)
    wave = 2 * np.pi * 3.0 * time
    position = np.stack([0.2 * np.sin(wave), 0.2 * np.cos(wave)], axis=1)
    found = measured_motion(log(position[None], time), JOINTS, cutoff=cutoff)
    inner = (found.time > 1.5) & (found.time < 6.5)
    _, gain = signal.sosfreqz(signal.butter(4, cutoff, fs=rate, output="sos"), [3.0], fs=rate)
    size = float(np.abs(gain[0]) ** 2)  # the filter's own, in both directions
    for order, values in ((1, found.velocity), (2, found.acceleration)):
        amplitude = np.sqrt(np.mean(np.sum(values[inner] ** 2, axis=1)))
        assert amplitude == pytest.approx(0.2 * (2 * np.pi * 3.0) ** order * size, rel=1e-3)


def test_repeats_of_another_motion_are_not_averaged():
    """A log that was cut a second later is the same motion at another time."""
    later = log(np.stack([sines(TIME), sines(TIME + 1.0)]))
    with pytest.raises(ValueError, match=r"'log' holds no commands, and repeat [01] is another motion.*cut the logs"):
        measured_motion(later, JOINTS)
    scattered = sines(TIME) + np.random.default_rng(2).normal(0, 1e-3, (4, 1, 2))
    measured_motion(log(scattered), JOINTS)
    mask = np.ones((2, len(TIME), 2), bool)
    mask[1, :, 0] = False
    measured_motion(log(np.stack([sines(TIME)] * 2), mask=mask), JOINTS)


def test_joints_without_effect_on_the_torques_may_differ_between_repeats():
    """Such as a wheel below, or a second arm."""
    parked = np.stack([sines(TIME)] * 2)
    parked[:, :, 1] = [[13.2], [15.9]]
    with pytest.raises(ValueError, match=r"b is 1\.35 from it"):
        measured_motion(log(parked), JOINTS)
    measured_motion(log(parked), JOINTS, alike=("a",))
