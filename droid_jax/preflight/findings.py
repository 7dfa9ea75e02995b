"""The result of a check of a recording: `Finding`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "units", "sign", "order", "gravity", "gains", "clock", "delay", "repeats", "sensor", "saturation", "unused",
    "range", "start", "scene", "motion",
]  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """A probable error in a recording, or a note about it.

    Attributes:
        kind: type of the error.
        column: joint, channel or pair of repeats concerned.
        value: measured quantity, as in the sentence.
        expected: value that a correct recording would have.
        severity: "certain" if a fit of this recording would be meaningless, "likely" if most such recordings are wrong,
            "note" if nothing is wrong.
        sentence: the error, its place, and what to do.
    """

    kind: Kind
    column: str
    value: float
    expected: float
    severity: Literal["note", "likely", "certain"]
    sentence: str
