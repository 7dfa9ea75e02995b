"""What the page of a search says differently by what fitted and validation part differ in ("split" of gap.json)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class Parts:
    """Words for one way to divide the recordings.

    gap: what U is, in a sentence; bars: the same under its figure; sigma: its unit.
    closed: after the share of U that went away.  other: what confirms.  flipped: what the tests turn and draw again.
    lines: what is drawn over time; places: what the maps of U show.  more: what a smaller effect would need.
    repeated: whether there are repeats, which tell noise.  in_turns: whether fitted and validation instants
    take turns in one recording.  halves: whether they are repeats of one recording.
    """

    gap: str
    bars: str
    sigma: str
    closed: str
    other: str
    flipped: str
    lines: str
    places: str
    more: str
    repeated: bool = True
    in_turns: bool = False
    halves: bool = False


_RECORDINGS = Parts(
    gap="the gap U (1: what all repeats share is as large as one repeat's noise)",
    bars="U, the mean square of what all repeats share of the residual, σ being one repeat's noise; noise itself has "
    "no part in it.",
    sigma="one repeat's noise",
    closed="so {share} of what can be closed was closed",
    other="the other recording",
    flipped="repeats",
    lines="black line and band, the repeats' mean and two of their deviations; lines, the simulation.",
    places="Hatched: the sign-flip test (false discoveries 10 %) finds nothing there.",
    more="more repeats, or a motion that also closes, moves at another speed or reaches further",
)
_BLOCKS = Parts(
    gap="the gap U (the mean square of all that is left, noise included, in units of a noise that is itself taken from "
    "what is left)",
    bars="U, the mean square of the residual, noise included; σ is itself taken from what is left, so that only ratios "
    "of bars have a meaning.",
    sigma="the noise that was taken from what is left",
    closed="{share} less, and what is left holds the noise",
    other="the other blocks",
    flipped="blocks of time",
    lines="black, the measurement; lines, the simulation.",
    places="Noise is in every number: without repeats nothing tells a place from noise.",
    more="repeats, a longer log, or a motion that also closes, moves at another speed or reaches further",
    repeated=False,
    in_turns=True,
)
PARTS = {
    "recordings": _RECORDINGS,
    "repeats": replace(_RECORDINGS, other="the other repeats", halves=True),
    "blocks": _BLOCKS,
}
UNSAID = {"by": "recordings", "limits": ""}  # where gap.json does not say


def said_split(found: Mapping[str, Any]) -> Mapping[str, Any]:
    """ "split" of gap.json."""
    return found.get("split", UNSAID)


def parts_of(found: Mapping[str, Any]) -> Parts:
    """The words for a gap.json."""
    return PARTS[said_split(found)["by"]]
