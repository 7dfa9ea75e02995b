"""Which recordings, repeats or parts of the time train, validate and test in a search for discrepancies.

Two or three recordings have a role each.  A single recording is divided: by its repeats, or into blocks of time where
it has none (`discrepancy.case.single_case`).  Training and validation data are then of the same motion.
`Split.limits` says what cannot be concluded from such data.
"""

from __future__ import annotations

import enum
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace

from droid_jax.recordings.recording import Recording

FEWEST_REPEATS = 8  # of a recording for a sign-flip test; with six, the smallest possible p is 0.03
ROLES = ("train", "validation", "test")
FEWEST_IN_TWO_HALVES = 2 * FEWEST_REPEATS  # repeats of a single recording, half of which train and half validate
INSTEAD = (
    "Without more repeats, `python -m droid_jax.run identify` fits the parameters, and its report shows in which "
    "joint and phase simulation and robot disagree"
)
SINGLE_REPEAT = "a single repeat"  # of a log without commands
COMMANDED_WINDOWS = (
    "; and commanded logs in which positions were measured are searched in windows of time, with any number of repeats"
)


class Split(enum.Enum):
    """What separates the training data from the validation data."""

    RECORDINGS = "recordings"
    REPEATS = "repeats"
    BLOCKS = "blocks"  # of time, of one log without repeats and commands
    WINDOWS = "windows"  # of commanded logs with few repeats

    @property
    def limits(self) -> str:
        """What cannot be concluded from data that are split so, in words; empty for separate recordings."""
        return {
            Split.RECORDINGS: "",
            Split.REPEATS: "Training and validation data are repeats of one recording. The validation repeats "
            "distinguish an effect from noise, but not from another effect that acts alike in this motion. That needs "
            "another motion. There is no test data.",
            Split.BLOCKS: "There are no repeats: U includes the noise, and a localisation cannot be distinguished from "
            "noise. The validation blocks are of the same motion as the training blocks. They distinguish an effect "
            "from noise, but not from another form of the effect.",
            Split.WINDOWS: "There are too few repeats to separate the noise from the mean over repeats, so windows of "
            "time are used in their place: U includes the noise, and a localisation cannot be distinguished from "
            "noise. The validation windows are of the same motions as the training windows. They distinguish an effect "
            "from noise, but not from another form of the effect.",
        }[self]


def split_of(recordings: Sequence[Recording], judges: Sequence[Recording] = ()) -> Split:
    """How the recordings are divided into training, validation and test data.

    Args:
        recordings: one to three; any number of commanded logs with few repeats.
        judges: test recordings of commanded logs with few repeats.

    Raises:
        ValueError: there are too many recordings, or too few repeats; the message says what can be done instead.
    """
    if _in_windows([*recordings, *judges]) and (judges or any(r.repeats < _needed(recordings) for r in recordings)):
        return Split.WINDOWS
    if judges:
        raise ValueError(
            "test recordings (--test-recording) are for commanded logs whose positions were measured: give the test "
            "recording as the third --recording, or, of logs without commands, as the second"
        )
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


def _in_windows(recordings: Sequence[Recording]) -> bool:
    """Whether all recordings hold commands and positions, so that a replay can begin at any time."""
    return bool(recordings) and all(r.command.size and "position" in r.channels for r in recordings)


def _needed(recordings: Sequence[Recording]) -> int:
    """Repeats that each recording needs for its repeats to be what is resampled."""
    return (
        FEWEST_IN_TWO_HALVES
        if len(recordings) == 1
        else FEWEST_REPEATS
        if len(recordings) <= len(ROLES)
        else sys.maxsize
    )


def roles_of(split: Split, recordings: Sequence[Recording], judges: Sequence[Recording] = ()) -> dict[str, Recording]:
    """Role -> recording.

    A log that is cut into blocks has the role "train" and contains the validation blocks too.  Where several recordings
    share a role, the further ones are called "train 2", "train 3", ... and "test 2", ... (`pooled`).
    """
    if split is Split.WINDOWS:
        numbered = ((role, i, r) for role, rs in (("train", recordings), ("test", judges)) for i, r in enumerate(rs, 1))
        return {role if i == 1 else f"{role} {i}": r for role, i, r in numbered}
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


def pooled(roles: Mapping[str, Recording], role: str) -> list[Recording]:
    """All recordings that share a role: "train", "train 2", ..."""
    return [r for name, r in roles.items() if name.split(" ")[0] == role]


def _check_test(first: Recording, other: Recording) -> None:
    if other.repeats == 1 and not other.command.size:
        return
    what = _repeats(other) if other.repeats > 1 else "commands"
    raise ValueError(
        f"the second recording {other.name!r} has {what}, and the first, {first.name!r}, is a log without repeats and "
        "commands. Only another such log can be its test data. Leave the second out, or give it alone: with "
        f"{FEWEST_IN_TWO_HALVES} repeats or more, one half of them trains and the other validates"
    )


def _check_halves(recording: Recording) -> None:
    if recording.repeats >= FEWEST_IN_TWO_HALVES:
        return
    raise ValueError(
        f"recording {recording.name!r} is the only one and has {_repeats(recording)}: half of its repeats train and "
        f"half validate, and with fewer than {FEWEST_REPEATS} repeats in a half no effect can be "
        f"significant. Record {FEWEST_IN_TWO_HALVES} or more, or better another motion, {FEWEST_REPEATS} repeats or "
        f"more of each: --recording TRAIN VALIDATION. {INSTEAD}"
        + (COMMANDED_WINDOWS if recording.command.size else f"; and {SINGLE_REPEAT} is searched in blocks of time")
    )


def _check_repeats(role: str, recording: Recording) -> None:
    if recording.repeats >= FEWEST_REPEATS:
        return
    log = not recording.command.size
    raise ValueError(
        f"the {role} recording {recording.name!r} has {_repeats(recording)}: with fewer than {FEWEST_REPEATS} no "
        f"effect can be significant. {INSTEAD}"
        + (
            f"; and {SINGLE_REPEAT}, or of each of two logs, is searched in blocks of time"
            if log
            else COMMANDED_WINDOWS
        )
    )


def _repeats(recording: Recording) -> str:
    return "1 repeat" if recording.repeats == 1 else f"{recording.repeats} repeats"
