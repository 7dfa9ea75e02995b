"""Check clocks: unit of the stamps, gaps, nominal rates, and drift between commands and measurements."""

from __future__ import annotations

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.signals import log_motion
from droid_jax.preflight.tracking import FOLLOWING, LEAST_TRAVEL
from droid_jax.recordings.recording import JOINT_CHANNELS, Recording

LEAST_DRIFT = (
    0.03  # s, difference of two clocks at the end of a recording; a larger one is not absorbed by delay and damping
)
SAME_RATE = 0.05  # relative tolerance within which two rates are meant to be equal
LARGEST_LAG = 1.0  # s, largest lag that is tested
WINDOWS = 4  # parts in which a lag is estimated
DRIFT_UNEVENNESS = 0.6  # largest deviation of the lags from a line, relative to the drift
WINDOW_SHARE = 0.25  # share of the recording in each part
FEWEST_STAMPS = 10  # the unit of a clock with fewer stamps is not checked
LONGEST_STEP = 0.45  # s between samples; longer ones are stamps in ms, at up to 2 kHz
SHORTEST_STEP = 2e-5  # s between samples; shorter ones are stamps in thousands of seconds, from 50 Hz on
GAP_STEPS, GAP_SECONDS = 5.0, 0.03  # median steps, and s: a longer step is a gap
REPLAYED = (*JOINT_CHANNELS, "object_angle")  # channels that a replay produces
RATE_NOTES = ("rate", "rate_hz", "frequency", "frequency_hz", "fps", "hz")  # in `meta`


def check_clocks(scene: Scene, recording: Recording) -> list[Finding]:
    """Findings about the clocks."""
    stamps = check_stamps(recording)
    return stamps if any(f.severity != "note" for f in stamps) else [*stamps, *_drift(scene, recording)]


def check_stamps(recording: Recording) -> list[Finding]:
    """Findings about the clocks that need no scene."""
    return _unit(recording) or [*(_rows(recording) or _nominal(recording)), *_gaps(recording)]


def _gaps(recording: Recording) -> list[Finding]:
    """Note about times without samples of a channel in any repeat."""
    for key, channel in recording.channels.items():
        steps = np.diff(channel.time)
        usual = float(np.median(steps)) if len(steps) else np.inf
        if len(steps) and steps.max() > max(GAP_STEPS * usual, GAP_SECONDS):
            at = float(channel.time[int(np.argmax(steps))])
            count = int(np.sum(steps > GAP_STEPS * usual))
            return [
                Finding(
                    "clock", key, float(steps.max()), usual, "note",
                    f"recording {recording.name!r}: channel {key!r} has {'a gap' if count == 1 else f'{count} gaps'} "
                    f"in time, the longest of {steps.max():.2g} s at {at:.4g} s: nothing is compared there",
                )
            ]  # fmt: skip
    return []


def _unit(recording: Recording) -> list[Finding]:
    """Finding for steps so long or so short that the stamps cannot be in seconds.

    Channels that no replay produces, such as a temperature, are not checked.  Neither are clocks that span about as
    long as another clock of a plausible rate, since set-points may be far apart.
    """
    clocks = [("the commands", recording.time)] if recording.command.size else []
    clocks += [(f"channel {key!r}", recording.channels[key].time) for key in REPLAYED if key in recording.channels]
    usual = [time for _, time in clocks if SHORTEST_STEP <= _step(time) <= LONGEST_STEP]
    for what, time in clocks:
        step = _step(time)
        alike = any(0.5 < np.ptp(time) / np.ptp(other) < 2.0 for other in usual)
        if (step > LONGEST_STEP or 0 < step < SHORTEST_STEP) and not alike:
            unit = "milliseconds, or shorter" if step > LONGEST_STEP else "thousands of seconds"
            return [
                Finding(
                    "clock", what, step, LONGEST_STEP if step > LONGEST_STEP else SHORTEST_STEP, "certain",
                    f"recording {recording.name!r}: the steps of {what} are {step:.3g} s: are the stamps in {unit}? "
                    "`convert --units time=ms` (us, ns) reads them",
                )
            ]  # fmt: skip
    return []


def _step(time: np.ndarray) -> float:
    """Median step of a clock, s; 0 if it has at most FEWEST_STAMPS stamps."""
    return float(np.median(np.diff(time))) if len(time) > FEWEST_STAMPS else 0.0


def _rows(recording: Recording) -> list[Finding]:
    """Finding for a channel with as many rows as commands but a slightly different rate: one clock is nominal."""
    count = len(recording.time)
    for key, channel in recording.channels.items():
        if count > 2 and len(channel.time) == count:
            command, own = recording.time[-1] - recording.time[0], channel.time[-1] - channel.time[0]
            if LEAST_DRIFT < abs(own - command) < SAME_RATE * command:
                ends = f"{abs(own - command):.2g} s apart at the end"
                return [
                    Finding(
                        "clock", key, 1e3 * own / (count - 1), 1e3 * command / (count - 1), "likely",
                        f"recording {recording.name!r}: channel {key!r} has as many rows as the commands, at "
                        f"{1e3 * own / (count - 1):.5g} ms where these are at {1e3 * command / (count - 1):.5g} ms, "
                        f"{ends}: is one of the two clocks a nominal rate? Use the stamps for both",
                    )
                ]  # fmt: skip
    return []


def _nominal(recording: Recording) -> list[Finding]:
    """Finding for a rate in `meta` that differs from that of the stamps."""
    clocks = {"commands": recording.time, **{f"channel {k!r}": c.time for k, c in recording.channels.items()}}
    for note in (k for k in recording.meta if k.lower() in RATE_NOTES):
        try:
            stated = float(recording.meta[note])
        except ValueError:
            continue
        for what, time in clocks.items():
            if len(time) < 3 or not stated > 0:
                continue
            rate = (len(time) - 1) / float(time[-1] - time[0])
            apart = abs((len(time) - 1) / stated - float(time[-1] - time[0]))
            if apart > LEAST_DRIFT and abs(rate / stated - 1) < SAME_RATE:
                return [nominal(f"recording {recording.name!r}: the {what}", stated, rate, apart)]
    return []


def nominal(where: str, stated: float, rate: float, apart: float) -> Finding:
    """Finding for stamps whose rate differs from the stated one, Hz; apart: s, difference of both at the end."""
    return Finding(
        "clock", where, rate, stated, "likely",
        f"{where} are at {rate:.5g} Hz by their stamps, not at the stated {stated:g} Hz; the stamps are used (at "
        f"{stated:g} Hz they would be {apart:.2g} s off at the end)",
    )  # fmt: skip


def _drift(scene: Scene, recording: Recording) -> list[Finding]:
    """Finding for positions whose lag behind the commands grows or shrinks steadily."""
    motion = log_motion(scene, recording)
    if motion is None:
        return []
    rows = len(motion.time)
    part, most = int(WINDOW_SHARE * rows), min(round(LARGEST_LAG / motion.step), int(WINDOW_SHARE * rows) // 2)
    drifts = []
    begins = np.linspace(most, rows - part - most, WINDOWS).astype(int)
    moving = [j for j in motion.command if j in motion.position and np.ptp(motion.command[j]) > LEAST_TRAVEL]
    for joint in moving:
        lags = []
        for begin in begins:
            command, position = motion.command[joint], motion.position[joint][begin : begin + part]
            if np.ptp(position) < LEAST_TRAVEL:
                break
            shifted = {
                lag: float(np.corrcoef(command[begin - lag : begin - lag + part], position)[0, 1])
                for lag in range(-most, most + 1)
                if np.ptp(command[begin - lag : begin - lag + part]) > LEAST_TRAVEL
            }
            best = max(shifted, key=lambda lag: shifted[lag], default=None)
            if best is None or shifted[best] < FOLLOWING + 0.05 or abs(best) == most:
                break
            lags.append(best * motion.step)
        if len(lags) == WINDOWS:
            slope = float(np.polyfit(np.arange(WINDOWS), lags, 1)[0]) * (WINDOWS - 1)
            # A clock drifts evenly; a servo's lag changes with the motion.
            if np.abs(np.diff(lags) * (WINDOWS - 1) - slope).max() < DRIFT_UNEVENNESS * abs(slope):
                drifts.append(slope)
            else:
                return []
    if (
        len(drifts) < max(1.0, 0.5 * len(moving))
        or abs(np.median(drifts)) < 2 * LEAST_DRIFT
        or np.ptp(drifts) > 0.5 * abs(np.median(drifts))
    ):
        return []
    drift = float(np.median(drifts)) / (1 - WINDOW_SHARE)
    return [
        Finding(
            "clock", "position", drift, 0.0, "likely",
            f"recording {recording.name!r}: the positions lag the commands by {abs(drift):.2g} s "
            f"{'more' if drift > 0 else 'less'} at the end than at the beginning: do their clocks run at different "
            "rates, or is one of them a nominal rate? Use the stamps for both",
        )
    ]  # fmt: skip
