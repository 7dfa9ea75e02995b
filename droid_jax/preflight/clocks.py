"""Clocks that disagree: a nominal rate where stamps say another, and measurements that run away from the commands."""

from __future__ import annotations

import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.signals import log_motion
from droid_jax.preflight.tracking import FOLLOWS, MOVES
from droid_jax.recordings.recording import JOINT_CHANNELS, Recording

DRIFT = 0.03  # s by which two clocks may run apart over a recording: a delay, damping and armature hardly take more in
NEAR = 0.05  # relative deviation within which two rates are meant to be one
LATEST = 1.0  # s: a drift that is looked for
WINDOWS, EVEN = 4, 0.6  # parts in which a lag is looked for; deviation of its steps from a line, of the drift
WINDOW = 0.25  # share of a recording that each part has
FEW = 10  # stamps, below which a clock's unit is not judged
SLOWEST, QUICKEST = 0.45, 2e-5  # s between samples: stamps in ms of 2 kHz at most, or in thousands of s of 50 Hz
GAP, LONG = 5.0, 0.03  # usual steps, and s: a longer step is a gap
REPLAYED = (*JOINT_CHANNELS, "object_angle")  # channels that a replay produces
RATES = ("rate", "rate_hz", "frequency", "frequency_hz", "fps", "hz")  # in `meta`


def check_clocks(scene: Scene, recording: Recording) -> list[Finding]:
    """What is wrong with the clocks."""
    stamps = check_stamps(recording)
    return stamps if any(f.severity != "note" for f in stamps) else [*stamps, *_drift(scene, recording)]


def check_stamps(recording: Recording) -> list[Finding]:
    """The same as far as no scene is needed."""
    return _unit(recording) or [*(_rows(recording) or _nominal(recording)), *_gaps(recording)]


def _gaps(recording: Recording) -> list[Finding]:
    """Times of which a channel has no sample in any repeat."""
    for key, channel in recording.channels.items():
        steps = np.diff(channel.time)
        usual = float(np.median(steps)) if len(steps) else np.inf
        if len(steps) and steps.max() > max(GAP * usual, LONG):
            at = float(channel.time[int(np.argmax(steps))])
            count = int(np.sum(steps > GAP * usual))
            return [
                Finding(
                    "clock", key, float(steps.max()), usual, "note",
                    f"recording {recording.name!r}: channel {key!r} has {'a gap' if count == 1 else f'{count} gaps'} "
                    f"in time, the longest of {steps.max():.2g} s at {at:.4g} s: what is not measured is not compared",
                )
            ]  # fmt: skip
    return []


def _unit(recording: Recording) -> list[Finding]:
    """Stamps so far apart, or so close together, that they are in no seconds.

    Not those of channels that no replay produces, such as a temperature, nor those that span as long as another clock
    of a usual rate: set-points may be far apart.
    """
    clocks = [("the commands", recording.time)] if recording.command.size else []
    clocks += [(f"channel {key!r}", recording.channels[key].time) for key in REPLAYED if key in recording.channels]
    usual = [time for _, time in clocks if QUICKEST <= _step(time) <= SLOWEST]
    for what, time in clocks:
        step = _step(time)
        alike = any(0.5 < np.ptp(time) / np.ptp(other) < 2.0 for other in usual)
        if (step > SLOWEST or 0 < step < QUICKEST) and not alike:
            unit = "milliseconds, or shorter" if step > SLOWEST else "thousands of seconds"
            return [
                Finding(
                    "clock", what, step, SLOWEST if step > SLOWEST else QUICKEST, "certain",
                    f"recording {recording.name!r}: the steps of {what} are {step:.3g} s: are the stamps in {unit}? "
                    "`convert --units time=ms` (us, ns) reads them",
                )
            ]  # fmt: skip
    return []


def _step(time: np.ndarray) -> float:
    """s, the usual step of a clock; 0 of one too short to be judged."""
    return float(np.median(np.diff(time))) if len(time) > FEW else 0.0


def _rows(recording: Recording) -> list[Finding]:
    """A channel with as many rows as commands whose clock is of another, near, rate: one of them is no stamp."""
    count = len(recording.time)
    for key, channel in recording.channels.items():
        if count > 2 and len(channel.time) == count:
            command, own = recording.time[-1] - recording.time[0], channel.time[-1] - channel.time[0]
            if DRIFT < abs(own - command) < NEAR * command:
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
    """A rate in `meta` that the stamps do not have."""
    clocks = {"commands": recording.time, **{f"channel {k!r}": c.time for k, c in recording.channels.items()}}
    for note in (k for k in recording.meta if k.lower() in RATES):
        try:
            stated = float(recording.meta[note])
        except ValueError:
            continue
        for what, time in clocks.items():
            if len(time) < 3 or not stated > 0:
                continue
            rate = (len(time) - 1) / float(time[-1] - time[0])
            apart = abs((len(time) - 1) / stated - float(time[-1] - time[0]))
            if apart > DRIFT and abs(rate / stated - 1) < NEAR:
                return [nominal(f"recording {recording.name!r}: the {what}", stated, rate, apart)]
    return []


def nominal(where: str, stated: float, rate: float, apart: float) -> Finding:
    """Of stamps of a rate, Hz, other than the one that is stated; apart: s by which both differ at the end."""
    return Finding(
        "clock", where, rate, stated, "likely",
        f"{where} are at {rate:.5g} Hz by their stamps, not at the stated {stated:g} Hz; the stamps are used (at "
        f"{stated:g} Hz they would be {apart:.2g} s off at the end)",
    )  # fmt: skip


def _drift(scene: Scene, recording: Recording) -> list[Finding]:
    """Positions that lag their commands by more and more, or less and less."""
    motion = log_motion(scene, recording)
    if motion is None:
        return []
    rows = len(motion.time)
    part, most = int(WINDOW * rows), min(round(LATEST / motion.step), int(WINDOW * rows) // 2)
    drifts = []
    begins = np.linspace(most, rows - part - most, WINDOWS).astype(int)
    moving = [j for j in motion.command if j in motion.position and np.ptp(motion.command[j]) > MOVES]
    for joint in moving:
        lags = []
        for begin in begins:
            command, position = motion.command[joint], motion.position[joint][begin : begin + part]
            if np.ptp(position) < MOVES:
                break
            shifted = {
                lag: float(np.corrcoef(command[begin - lag : begin - lag + part], position)[0, 1])
                for lag in range(-most, most + 1)
                if np.ptp(command[begin - lag : begin - lag + part]) > MOVES
            }
            best = max(shifted, key=lambda lag: shifted[lag], default=None)
            if best is None or shifted[best] < FOLLOWS + 0.05 or abs(best) == most:
                break
            lags.append(best * motion.step)
        if len(lags) == WINDOWS:
            slope = float(np.polyfit(np.arange(WINDOWS), lags, 1)[0]) * (WINDOWS - 1)
            # A clock that runs away does so evenly; a servo's lag changes with the motion.
            if np.abs(np.diff(lags) * (WINDOWS - 1) - slope).max() < EVEN * abs(slope):
                drifts.append(slope)
            else:
                return []
    if (
        len(drifts) < max(1.0, 0.5 * len(moving))
        or abs(np.median(drifts)) < 2 * DRIFT
        or np.ptp(drifts) > 0.5 * abs(np.median(drifts))
    ):
        return []
    drift = float(np.median(drifts)) / (1 - WINDOW)
    return [
        Finding(
            "clock", "position", drift, 0.0, "likely",
            f"recording {recording.name!r}: the positions lag the commands by {abs(drift):.2g} s "
            f"{'more' if drift > 0 else 'less'} at the end than at the beginning: do their clocks run at different "
            "rates, or is one of them a nominal rate? Use the stamps for both",
        )
    ]  # fmt: skip
