"""Every kind of file that the program reads back, by name.  A user's file of effects is code, and is none of them."""

from __future__ import annotations

import model_kinds
import recording_kinds
import run_kinds
from kinds import Kind

KINDS: dict[str, Kind] = {
    kind.name: kind for kinds in (recording_kinds, model_kinds, run_kinds) for kind in kinds.KINDS
}
