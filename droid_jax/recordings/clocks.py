"""Checks the clock of a measurement, and interpolates repeats onto a common clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

SLACK = 1e-6  # s, two instants closer than this are the same
_DAY = 86400.0  # s
_GAP = 5.0  # median steps; between stamps further apart, nothing counts as measured
_JITTER = 0.5  # largest deviation of a clock's step from its median, as a fraction


def check_clock(
    time: np.ndarray,
    where: str,
    *,
    allow_jitter: bool = False,
    seconds: bool = True,
    label: Callable[[int], str] = lambda i: f"row {i}",
    remedy: str = "",
) -> None:
    """ValueError unless time [T] is finite, in seconds, strictly increasing and regular.

    Args:
        time: instants [T].
        where: what the clock belongs to, for messages.
        allow_jitter: accept steps that are irregular.
        seconds: also check that the numbers can be seconds.
        label: row index -> name of that row in messages.
        remedy: end of the message about stamps that repeat.
    """
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise ValueError(f"{where}, {label(int(bad[0]))}: time must be finite, got {time[bad[0]]}")
    steps = np.diff(time.astype(np.float64))
    bad = np.flatnonzero(steps <= 0)
    if bad.size:
        i = int(bad[0]) + 1
        what, rest = ("repeats", f"; {remedy}" if remedy else "") if steps[i - 1] == 0 else ("goes backwards:", "")
        raise ValueError(
            f"{where}, {label(i)}: time must increase, it {what} {float(time[i])!r} s after "
            f"{float(time[i - 1])!r} s{rest}"
        )
    if seconds:
        _check_seconds(time, steps, where)
    if steps.size and not allow_jitter:
        typical = float(np.median(steps))
        i = int(np.argmax(np.abs(steps - typical)))
        if abs(steps[i] - typical) > _JITTER * typical:
            raise ValueError(
                f"{where}, {label(i + 1)}: irregular rate, a step of {steps[i]:.6g} s where "
                f"{typical:.6g} s is usual; resample the log, or accept it with --allow-jitter of `convert` "
                "(allow_jitter=True)"
            )


def _check_seconds(time: np.ndarray, steps: np.ndarray, where: str) -> None:
    """ValueError when the numbers of a clock can hardly be seconds since the start."""
    hint = "time must be in seconds; is it in milliseconds, microseconds or nanoseconds?"
    if not steps.size:
        return
    duration, typical = float(time[-1] - time[0]), float(np.median(steps))
    if duration > _DAY:
        raise ValueError(f"{where}: the clock runs over {duration:.6g} s, more than a day; {hint}")
    # At or above, not only above: a 1 kHz log in milliseconds has steps of exactly 1.
    if typical >= 1.0 - SLACK:
        raise ValueError(f"{where}: the clock's usual step is {typical:.6g} s, 1 s or more; {hint}")
    if typical < 1e-5:
        raise ValueError(f"{where}: the clock's usual step is {typical:.3g} s, below 1e-5 s; {hint}")
    if abs(float(time[0])) > _DAY:
        raise ValueError(
            f"{where}: the clock starts at {float(time[0]):.6g} s, more than a day from 0; "
            "subtract the time of the first command from every clock"
        )


def interpolate(clock: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """values [M, J] at time [M] -> [T, J] at clock [T]; beyond the ends the last value holds."""
    return np.stack([np.interp(clock, time, column) for column in values.T], axis=-1)


def in_gap(clock: np.ndarray, time: np.ndarray) -> np.ndarray:
    """[T] bool of clock [T] s, True strictly between two stamps of time [M] s further apart than _GAP median steps."""
    if len(time) < 2:
        return np.zeros(len(clock), bool)
    steps = np.diff(time)
    i = np.clip(np.searchsorted(time, clock, side="right") - 1, 0, len(steps) - 1)
    inside = (clock > time[i] + 1e-9) & (clock < time[i + 1] - 1e-9)
    return inside & (steps[i] > _GAP * np.median(steps))


def resample(times: Sequence[np.ndarray], values: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Interpolates repeats with different clocks onto one clock.

    Args:
        times: N arrays [T_r] s.
        values: N arrays [T_r, C], NaN where nothing was measured.

    Returns:
        The first repeat's clock [Tc] s, cut to the part that all repeats cover, and values [N, Tc, C], interpolated
        linearly.  They are NaN where either neighbour is, and in gaps (`in_gap`).

    Raises:
        ValueError: no part is covered by all repeats.
    """
    first, last = max(float(t[0]) for t in times), min(float(t[-1]) for t in times)
    clock = times[0][(times[0] >= first - SLACK) & (times[0] <= last + SLACK)]
    if not len(clock):
        spans = ", ".join(f"{t[0]:g} .. {t[-1]:g} s" for t in times)
        raise ValueError(f"the repeats cover no common part of the clock: {spans}")
    pairs = zip(times, values, strict=True)
    return clock, np.stack([np.where(in_gap(clock, t)[:, None], np.nan, interpolate(clock, t, v)) for t, v in pairs])
