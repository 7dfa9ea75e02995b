"""Which recordings train, validate and test.

Two or three recordings have a role each.  One alone is divided, by its repeats or, where it has none, into blocks of
time (`discrepancy.case.single_case`).  Both validate on the training motion; `Split.limits` says what that costs.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import replace

from droid_jax.recordings.recording import Recording

FEWEST_REPEATS = 8  # for sign flips: with six the smallest possible p is 0.03
ROLES = ("train", "validation", "test")
HALVES = 2 * FEWEST_REPEATS  # repeats of one recording from which each half is enough
ELSE = (
    "What can still be told: `python -m droid_jax.run identify` fits the parameters, and its report shows in which "
    "joint and phase simulation and robot disagree"
)


ALONE = "one repeat alone"  # of a log without commands


class Split(enum.Enum):
    """What fitted and validation part differ in."""

    RECORDINGS = "recordings"
    REPEATS = "repeats"
    BLOCKS = "blocks"  # of time, of one log without repeats

    @property
    def limits(self) -> str:
        """What cannot be concluded, in words; empty where nothing is to be said."""
        return {
            Split.RECORDINGS: "",
            Split.REPEATS: "One recording both fits and confirms: the validation repeats repeat the fitted motion, so "
            "they tell an effect from noise, but not from another one that acts alike in this motion. Only another "
            "motion would, and nothing was kept as test data.",
            Split.BLOCKS: "There are no repeats: U holds the noise too, and nothing tells a place from noise. The "
            "validation blocks are of the same motion as the fitted ones, so they tell an effect from noise, but not "
            "from another form of it.",
        }[self]


def split_of(recordings: Sequence[Recording]) -> Split:
    """How one to three recordings are to be used.

    Raises ValueError where they are more or fewer, or hold too few repeats for any way; it says what can still be done.
    """
    if not 1 <= len(recordings) <= len(ROLES):
        raise ValueError(f"recordings: one to three are searched ({', '.join(ROLES)}), got {len(recordings)}")
    first, *others = recordings
    if first.repeats == 1 and not first.command.size and len(others) < 2:
        for other in others:
            _check_test(first, other)
        return Split.BLOCKS
    if not others:
        _check_halves(first)
        return Split.REPEATS
    for role, recording in zip(ROLES, recordings, strict=False):
        _check_repeats(role, recording)
    return Split.RECORDINGS


def roles_of(split: Split, recordings: Sequence[Recording]) -> dict[str, Recording]:
    """Role -> recording.  A log that is cut into blocks is "train" and holds the validation blocks too."""
    if split is Split.BLOCKS:
        return dict(zip(("train", "test"), recordings, strict=False))
    if split is Split.RECORDINGS:
        return dict(zip(ROLES, recordings, strict=False))
    (whole,) = recordings
    half, count = whole.repeats // 2, whole.repeats
    return {
        "train": replace(whole.repeats_subset(range(half)), name=f"{whole.name}, first {half} repeats"),
        "validation": replace(
            whole.repeats_subset(range(half, count)), name=f"{whole.name}, last {count - half} repeats"
        ),
    }


def _as_log(recording: Recording) -> str:
    """How a commanded recording with too few repeats can be searched today, and what that loses; empty where it cannot.

    A log is replayed along its measured positions, so it must hold them.
    """
    if not recording.command.size or "position" not in recording.channels:
        return ""
    one = "without its commands" if recording.repeats == 1 else "one repeat of it, without its commands,"
    return (
        f"; and {one} it can be searched as a log, in blocks of time, if it lasts a minute or more "
        '(docs/your-robot.md, "Logs without commands"). Lost are effects of commands, servos and contacts '
        "(delays, gains, elastic gears, the grip), and U then holds the noise"
    )


def _check_test(first: Recording, other: Recording) -> None:
    if other.repeats == 1 and not other.command.size:
        return
    what = _repeats(other) if other.repeats > 1 else "commands"
    raise ValueError(
        f"the second recording {other.name!r} has {what}, and the first, {first.name!r}, is a log without repeats and "
        "commands, beside which only another such log can be test data. Leave the second out, or give it alone: with "
        f"{HALVES} repeats or more one half fits and the other confirms"
    )


def _check_halves(recording: Recording) -> None:
    if recording.repeats >= HALVES:
        return
    raise ValueError(
        f"recording {recording.name!r} is the only one and has {_repeats(recording)}: one half must fit and the other "
        f"validation, and with fewer than {FEWEST_REPEATS} repeats in a half no effect can be told from chance. Record "
        f"{HALVES} or more, or better another motion, {FEWEST_REPEATS} repeats or more of each: "
        f"--recording TRAIN VALIDATION. {ELSE}"
        + (_as_log(recording) if recording.command.size else f"; and {ALONE} is searched as a log, in blocks of time")
    )


def _check_repeats(role: str, recording: Recording) -> None:
    if recording.repeats >= FEWEST_REPEATS:
        return
    log = not recording.command.size
    raise ValueError(
        f"the {role} recording {recording.name!r} has {_repeats(recording)}: with fewer than {FEWEST_REPEATS} no "
        "effect can be "
        f"told from chance. {ELSE}"
        + (f"; and {ALONE}, or of each of two logs, is searched in blocks of time" if log else _as_log(recording))
    )


def _repeats(recording: Recording) -> str:
    return "1 repeat" if recording.repeats == 1 else f"{recording.repeats} repeats"
