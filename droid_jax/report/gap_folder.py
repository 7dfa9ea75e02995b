"""What a search for a missing effect leaves in its folder, as the report reads it: gap.json and gap.npz, checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.files import GAP, GAP_TRACES
from droid_jax.report.gap_parts import PARTS, Parts, parts_of, said_split
from droid_jax.report.reading import FINDING, Maybe, Reader

VERDICTS = ("none", "named", "tie", "partly explained", "unexplained", "fit not converged")
ROLES = ("train", "validation", "test")
_READ = Reader("gap", "--again")  # gap.json comes last: once it is there, the command takes the run for whole
_NUMBER = (int, float)
_MAYBE = (int, float, type(None))
_CELL = {"variable": str, "where": str, "discrepancy": _MAYBE, "p": _MAYBE, "found": bool}
_GAP = {
    "recording": str,
    **dict.fromkeys(("before", "after", "closed", "torque_before", "torque_after"), _MAYBE),
}
_TRIAL = {
    **{"round": int, "name": str, "passed": bool, "reasons": [str]},
    **dict.fromkeys(("discrepancy_train", "discrepancy_validation", "p", "chosen"), _MAYBE),
}
_SIZE = {
    **dict.fromkeys(("name", "unit", "effect", "what"), str),
    **dict.fromkeys(("value", "low", "high"), _MAYBE),
    "bound": Maybe(str),
}
_SHIFT = {"name": str, "unit": str, **dict.fromkeys(("before", "after", "deviation_before"), _MAYBE)}
_TREND = {**dict.fromkeys(("candidate", "amplitude", "unit"), str), "per_repeat": _MAYBE, "p": _MAYBE}
_ABOUT = {"what": str, "mark": str, "confused_with": [str]}
_SETUP = {"hidden": Maybe(str), "synthetic_robot": Maybe(bool), "recording": Maybe([str])}
_EXPERIMENT = {"what": str, "distance": _MAYBE, "not_made": Maybe(str)}
_HINT = {"effects": [str], "indistinguishable": [[str]], "closed": {str: _NUMBER}}
_SCHEMA = {
    **{"verdict": str, "sentence": str, "effects": [str], "indistinguishable": [[str]], "p": _MAYBE, "floor": _MAYBE},
    **{"converged": bool, "cut": str, "seconds": {str: _NUMBER}, "gaps": {str: _GAP}},
    "phases": {str: [{"name": str, "start": _NUMBER, "end": _NUMBER}]},
    "screens": [{"p": _MAYBE, "ranking": [{"candidate": str, "t": _MAYBE, "explained": _MAYBE}], "failed": [str]}],
    "trials": [_TRIAL],
    "cells": {"before": [_CELL], "after": [_CELL]},
    **{"amplitudes": [_SIZE], "shifts": [_SHIFT], "experiments": [_EXPERIMENT]},
    "trends": [_TREND],
    **{"units": str, "versions": {str: str}, "device": str, "setup": _SETUP},
    # what older files lack
    **{"split": Maybe({"by": str, "limits": str}), "shapes": Maybe([_SIZE]), "about": Maybe({str: _ABOUT})},
    **{"handed_on": Maybe({"fitted_to": [str], "gaps": {str: _MAYBE}}), "amendments": Maybe({str: str})},
    **{"remainder": Maybe(_MAYBE), "explained": Maybe(_MAYBE), "failed": Maybe([str])},
    **{"hints": Maybe([_HINT]), "doubts": Maybe([str]), "thresholds": Maybe({str: _NUMBER})},
    "findings": Maybe([FINDING]),
}
_LINES = ("measured", "scatter", "before", "after")


@dataclass(frozen=True)
class Gap:
    """What a search for a missing effect found.

    found: gap.json.  traces: role -> joints [J], time [K] s, and measured, scatter, before, after [K, J]
    in `unit`, and the role's phases.
    """

    folder: Path
    found: Mapping[str, Any]
    traces: Mapping[str, Mapping[str, Any]]

    @property
    def unit(self) -> str:
        """Of torques: N m, N where slides are measured, "N m or N" for both."""
        return self.found["units"]

    @property
    def roles(self) -> list[str]:
        """The recordings there are, by what they were for: "train", "validation" and perhaps "test"."""
        return [r for r in ROLES if r in self.found["gaps"]]

    @property
    def judge(self) -> str:
        """The role that says how large the gap is: the test one, or the best there is."""
        return self.roles[-1]

    @property
    def extended(self) -> bool:
        """Whether an effect entered the model: only then is there an "after"."""
        return bool(self.found["effects"])

    @property
    def lost(self) -> bool:
        """Whether a recording was kept as test data and could not be replayed in the end."""
        from droid_jax.discrepancy.verdict import LOST  # only here: it imports what computes

        return LOST in self.found.get("failed", ())

    @property
    def blown_up(self) -> list[str]:
        """Candidates and models that were left out since their replay blew up, each once."""
        from droid_jax.discrepancy.verdict import LOST  # as above

        names = [
            *(name for screen in self.found["screens"] for name in screen["failed"]),
            *self.found.get("failed", ()),
        ]
        return [name for name in dict.fromkeys(names) if name != LOST]

    @property
    def floor(self) -> float | None:
        """U0; None where it is not known and where there is none, see `timeless`."""
        return self.found["floor"] or None

    @property
    def timeless(self) -> bool:
        """Whether a measured motion was replayed, which has no time step and whose floor is exactly zero."""
        return self.found["floor"] == 0

    @property
    def sizes(self) -> list[Mapping[str, Any]]:
        """Amplitudes of the effects in the model, then their shapes; an older search does not tell these."""
        return [*self.found["amplitudes"], *self.found.get("shapes", [])]

    @property
    def about(self) -> Mapping[str, Mapping[str, Any]]:
        """What the library says of the effects of the answer, by their names there; an older search does not tell."""
        return self.found.get("about", {})

    @property
    def fitted_to(self) -> list[str]:
        """Recordings that the model that was handed on is fitted to; an older search fitted it to the first."""
        return self.found.get("handed_on", {}).get("fitted_to", [self.recording("train")])

    @property
    def hints(self) -> list[Mapping[str, Any]]:
        """Effects that close too little to be named; an older search named them."""
        return self.found.get("hints", [])

    @property
    def amendments(self) -> Mapping[str, str]:
        """What was added to the verdict after it was written, and whether: name -> state; an older search added all."""
        return self.found.get("amendments", {})

    @property
    def parts(self) -> Parts:
        """What is said of how the recordings were divided."""
        return parts_of(self.found)

    @property
    def limits(self) -> str:
        """What cannot be concluded, in words; empty where nothing is to be said."""
        return said_split(self.found)["limits"]

    @property
    def sheets(self) -> list[tuple[tuple[str, ...], Mapping[str, Any]]]:
        """Roles and what is drawn of them over time, the judging role first; parts that take turns are drawn as one."""
        together = [("train", "validation")] if self.parts.in_turns else [("train",), ("validation",)]
        sheets = [*together, *((r,) for r in self.roles[2:])]
        return [(roles, _joined([self.traces[r] for r in roles])) for roles in reversed(sheets)]

    @property
    def synthetic_robot(self) -> bool:
        """Whether the run says that its torques come from a synthetic robot: no recording was given to it."""
        return self.found["setup"].get("synthetic_robot", self.found["setup"].get("recording") == [])

    @property
    def hidden(self) -> str:
        """See `hidden_in`."""
        return hidden_in(self.found)

    def recording(self, role: str) -> str:
        """Name of the recording in a role."""
        return self.found["gaps"][role]["recording"]


def hidden_in(found: Mapping[str, Any]) -> str:
    """What the synthetic robot hid that was searched, of gap.json, in words; empty where nothing is known."""
    setup = found["setup"]
    return setup.get("hidden", "") if setup.get("synthetic_robot") else ""


def has_gap(folder: Path) -> bool:
    """Whether a folder holds, or should hold, a search for a missing effect."""
    return any((folder / name).exists() for name in (GAP, GAP_TRACES))


def read_gap(folder: str | Path) -> Gap:
    """Load and check; ValueError names what is missing or broken."""
    folder = Path(folder)
    path = folder / GAP
    found = (_READ if path.exists() else Reader("gap")).json(path)
    _READ.check(found, _SCHEMA, GAP)
    for fault in _faults(found):
        raise _READ.fault(f"gap.json, {fault}")
    roles = [r for r in ROLES if r in found["gaps"]]
    return Gap(folder, found, _traces(folder / GAP_TRACES, roles, found["phases"]))


def _faults(found: Mapping[str, Any]) -> Iterator[str]:
    """What the schema cannot say."""
    if found["verdict"] not in VERDICTS:
        yield f"'verdict' must be one of {', '.join(VERDICTS)}, got {found['verdict']!r}"
    by = said_split(found)["by"]
    if by not in PARTS:
        yield f"'split', 'by' must be one of {', '.join(PARTS)}, got {by!r}"
    absent = [r for r in ROLES[:2] if r not in found["gaps"]]
    if absent:
        yield f"'gaps' lacks {', '.join(map(repr, absent))}"
    if len(found["indistinguishable"]) > len(found["effects"]):
        yield f"'indistinguishable' has {len(found['indistinguishable'])} lists for {len(found['effects'])} effects"


def _traces(path: Path, roles: Sequence[str], phases: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Arrays by role, their shapes checked against time [K] and joints [J]."""
    keys = ["joints", *(f"{r}.{key}" for r in roles for key in ("time", *_LINES))]
    arrays = _READ.arrays(path, keys, texts=["joints"])
    for key in ("joints", *(f"{r}.time" for r in roles)):
        _READ.shaped(arrays[key], (None,), f"{path}, {key}")
    traces: dict[str, dict[str, Any]] = {}
    for role in roles:
        shape = (len(arrays[f"{role}.time"]), len(arrays["joints"]))
        for key in _LINES:
            if arrays[f"{role}.{key}"].shape != shape:
                got = arrays[f"{role}.{key}"].shape
                raise _READ.fault(f"{path}, {role}.{key} must be [time, joints] = {shape}, got {got}")
        lines: dict[str, np.ndarray] = {key: arrays[f"{role}.{key}"] for key in ("time", *_LINES)}
        traces[role] = {**lines, "joints": [str(j) for j in arrays["joints"]], "phases": phases.get(role, [])}
    return traces


def _joined(traces: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Traces of one recording's parts in order of time."""
    order = np.argsort(np.concatenate([t["time"] for t in traces]), kind="stable")
    lines = {key: np.concatenate([t[key] for t in traces])[order] for key in ("time", *_LINES)}
    return {**traces[0], **lines}
