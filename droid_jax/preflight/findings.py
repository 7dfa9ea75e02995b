"""What a check of a recording finds: `Finding`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "units", "sign", "order", "gravity", "gains", "clock", "delay", "repeats", "sensor", "saturation", "unused",
    "range", "start", "scene", "motion",
]  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """What of a recording can hardly be right.

    kind: of the fault.  column: the joint, channel or pair of repeats that it is about.  value: as measured; expected:
    what it should be near; both in the sentence's terms.  severity: "certain" where no fit of this recording can mean
    anything, "likely" where something is wrong most often, "note" where nothing is, but has to be known.  sentence:
    what is wrong, where, and what to do.
    """

    kind: Kind
    column: str
    value: float
    expected: float
    severity: Literal["note", "likely", "certain"]
    sentence: str
