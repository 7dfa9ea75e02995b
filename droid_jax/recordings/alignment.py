"""Puts the repeats of one motion, from any logs, on one clock, and gives their command and initial positions."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from droid_jax.recordings.recording import Channel

LARGEST_DRIFT = 0.03  # s at the end of the log, if its samples were at --rate; a larger drift gives a warning
SAME_RATE = 0.05  # largest relative difference at which --rate is taken to mean the rate of the stamps


def common_clock(times: Sequence[np.ndarray], rate: float | None, places: Sequence[object]) -> np.ndarray:
    """Uniform instants [T] s, multiples of one step, over the part from 0 on that all repeats cover.

    Args:
        times: stamps [M] s of each repeat.
        rate: Hz; by default that of the first repeat's median step.
        places: where each repeat comes from, for messages.

    Raises:
        ValueError: a repeat ends before 0 or much earlier than others, or they have no part in common.
    """
    if rate is not None and not rate > 0:
        raise ValueError(f"rate must be positive, got {rate} Hz")
    step = 1.0 / rate if rate else float(np.median(np.diff(times[0])))
    ends = [float(t[-1]) for t in times]
    if min(ends) < 0.5 * max(ends):
        i = int(np.argmin(ends))
        raise ValueError(
            f"{places[i]}: lasts {ends[i]:.3f} s, less than half of the longest repeat's {max(ends):.3f} s; "
            "was it cut off?"
        )
    first = max(0.0, *(float(t[0]) for t in times))
    # A sample that misses the end by rounding still counts.
    low, high = int(np.ceil(first / step - 1e-6)), int(np.floor(min(ends) / step + 1e-6))
    if high - low < 1:
        raise ValueError(f"the repeats have no common part: {', '.join(map(str, places))}")
    return step * np.arange(low, high + 1)


def warn_of_rate(stamps: np.ndarray, rate: float | None, place: object) -> None:
    """Warn where the stated rate differs slightly from that of the stamps [M] s: it may be a mistake.

    A very different rate is that of a clock onto which the log is resampled.
    """
    steps = np.diff(stamps)
    steps = steps[steps > 0.0]
    if not rate or len(steps) < 2:
        return
    own = 1.0 / float(np.mean(steps[steps < 1.5 * np.median(steps)]))  # where no samples were lost
    late = (len(stamps) - 1) * abs(1.0 / rate - 1.0 / own)
    if late > LARGEST_DRIFT and abs(own / rate - 1.0) < SAME_RATE:
        warnings.warn(
            f"{place}: the stamps are at {own:.5g} Hz, not at the {rate:g} Hz of --rate; they are used and the log is "
            f"resampled (by its number of samples it would be {late:.2g} s off at the end)",
            stacklevel=3,
        )


def one_command(
    commands: Sequence[np.ndarray],
    clock: np.ndarray,
    joints: Sequence[str],
    tolerance: float,
    places: Sequence[object],
) -> np.ndarray:
    """The first repeat's command [T, U]; ValueError when another repeat's differs by more than the tolerance.

    Args:
        commands: [T, U] of each repeat, rad or m, all on the same clock.
        clock: instants [T] s of the commands.
        joints: U names.
        tolerance: rad or m.
        places: where each repeat comes from, for messages.
    """
    for place, command in zip(places[1:], commands[1:], strict=True):
        gap = np.abs(command - commands[0])
        i, j = map(int, np.unravel_index(int(np.argmax(gap)), gap.shape))
        if gap[i, j] > tolerance:
            raise ValueError(
                f"{place}: its command is not that of {places[0]}, joint {joints[j]!r} differs by "
                f"{gap[i, j]:.4g} at {clock[i]:.3f} s; repeats must replay one motion, within "
                f"--command-tolerance {tolerance:g} (command_tolerance)"
            )
    return commands[0]


def start_positions(channels: Mapping[str, Channel]) -> dict[str, float]:
    """Joint -> first measured position, mean over the repeats that measured it; nothing without positions."""
    if "position" not in channels:
        return {}
    position = channels["position"]
    first, seen = position.values[:, 0], position.mask[:, 0]
    return {joint: float(first[seen[:, c], c].mean()) for c, joint in enumerate(position.columns) if seen[:, c].any()}
