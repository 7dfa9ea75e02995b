"""Which recordings train, validate and test.

Two or three recordings have a role each.  One alone is divided, by its repeats or, where it has none, into blocks of
time (`discrepancy.case.single_case`).  Both validate on the training motion; `Split.limits` says what that costs.
"""

from __future__ import annotations

import enum
import sys
from collections.abc import Mapping, Sequence
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
BY_STRETCHES = (
    "; and commanded logs in which positions were measured are searched by stretches of time, with any number of "
    "repeats"
)


class Split(enum.Enum):
    """What fitted and validation part differ in."""

    RECORDINGS = "recordings"
    REPEATS = "repeats"
    BLOCKS = "blocks"  # of time, of one log without repeats and commands
    WINDOWS = "windows"  # of commanded logs with few repeats

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
            Split.WINDOWS: "There are too few repeats to tell noise from what they share: stretches of time take their "
            "place. U holds the noise too, and nothing tells a place from noise. The validation stretches are of the "
            "same motions as the fitted ones, so they tell an effect from noise, but not from another form of it.",
        }[self]


def split_of(recordings: Sequence[Recording], judges: Sequence[Recording] = ()) -> Split:
    """How recordings are to be used; judges: test data of commanded logs with few repeats.

    Raises ValueError where they are more or fewer, or hold too few repeats for any way; it says what can still be done.
    """
    if _in_windows([*recordings, *judges]) and (judges or any(r.repeats < _needed(recordings) for r in recordings)):
        return Split.WINDOWS
    if judges:
        raise ValueError(
            "recordings to judge on are for commanded logs whose positions were measured: give others as a third one, "
            "or a log without commands as a second one"
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
    """Whether all of them hold commands, and positions, from which a replay may begin anywhere."""
    return bool(recordings) and all(r.command.size and "position" in r.channels for r in recordings)


def _needed(recordings: Sequence[Recording]) -> int:
    """Repeats of each from which on they are what is resampled."""
    return HALVES if len(recordings) == 1 else FEWEST_REPEATS if len(recordings) <= len(ROLES) else sys.maxsize


def roles_of(split: Split, recordings: Sequence[Recording], judges: Sequence[Recording] = ()) -> dict[str, Recording]:
    """Role -> recording.  A log that is cut into blocks is "train" and holds the validation blocks too; of several
    that are pooled the others are "train 2", "train 3", ..., and "test 2", ... (`pooled`).
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
    """The recordings of a role and of its numbered ones."""
    return [r for name, r in roles.items() if name.split(" ")[0] == role]


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
        f"recording {recording.name!r} is the only one and has {_repeats(recording)}: half of its repeats train and "
        f"half validate, and with fewer than {FEWEST_REPEATS} repeats in a half no effect stands out from "
        f"chance. Record {HALVES} or more, or better another motion, {FEWEST_REPEATS} repeats or more of each: "
        f"--recording TRAIN VALIDATION. {ELSE}"
        + (BY_STRETCHES if recording.command.size else f"; and {ALONE} is searched as a log, in blocks of time")
    )


def _check_repeats(role: str, recording: Recording) -> None:
    if recording.repeats >= FEWEST_REPEATS:
        return
    log = not recording.command.size
    raise ValueError(
        f"the {role} recording {recording.name!r} has {_repeats(recording)}: with fewer than {FEWEST_REPEATS} no "
        "effect can be "
        f"told from chance. {ELSE}"
        + (f"; and {ALONE}, or of each of two logs, is searched in blocks of time" if log else BY_STRETCHES)
    )


def _repeats(recording: Recording) -> str:
    return "1 repeat" if recording.repeats == 1 else f"{recording.repeats} repeats"
