"""The folder of an evaluation of a fit as typed values: evaluation.json and its arrays, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field

from droid_jax.files import EVALUATION, EVALUATION_FORMAT, EVALUATION_TRACES, EVALUATION_VERSION
from droid_jax.read_json import read_json
from droid_jax.report.identify_folder import ErrorsEntry
from droid_jax.report.reading import FindingEntry, Reader

_READ = Reader("evaluate-fit")
_KEYS = ("time", "measured_mean", "measured_low", "measured_high", "before", "after", "joints")


class EvaluatedEntry(Struct, frozen=True):
    """A recording of an evaluation; duration in s; blown_up: "before" and "after", of which the replay gave none."""

    name: str
    sha256: str
    repeats: int
    duration: float
    fitted: bool
    blown_up: list[str]


class MeanEntry(Struct, frozen=True):
    """Mean absolute error of a channel over joints and recordings."""

    unit: str
    before: float | None
    after: float | None


class EvaluationFile(Struct, frozen=True, kw_only=True):
    """evaluation.json."""

    format: str
    version: int
    fit: dict[str, str]
    scene: str
    effects: list[str]
    recordings: list[EvaluatedEntry]
    errors: dict[str, dict[str, ErrorsEntry]]
    mean_mae: dict[str, MeanEntry]
    written: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    device: str = ""
    findings: list[FindingEntry] = field(default_factory=list)


@dataclass(frozen=True)
class Judged:
    """Errors of one recording, as the table of errors takes them."""

    errors: Mapping[str, ErrorsEntry]


@dataclass(frozen=True)
class Evaluation:
    """The folder of an evaluation; traces: by recording/channel the arrays of evaluation.npz."""

    folder: Path
    file: EvaluationFile
    traces: Mapping[str, Mapping[str, Any]]

    @property
    def judged(self) -> dict[str, Judged]:
        """Errors by recording."""
        return {name: Judged(errors) for name, errors in self.file.errors.items()}


def has_evaluation(folder: Path) -> bool:
    """Whether a folder holds an evaluation."""
    return (folder / EVALUATION).exists()


def is_evaluation(path: Path) -> bool:
    """Whether a file is an evaluation.json of this program."""
    try:
        content = read_json(path)
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("format") == EVALUATION_FORMAT


def read_evaluation(folder: Path) -> Evaluation:
    """Load and check an evaluation; ValueError names the file that is missing or broken."""
    file = _READ.json(folder / EVALUATION, EvaluationFile)
    if file.version != EVALUATION_VERSION:
        raise _READ.fault(
            f"{folder / EVALUATION} has version {file.version}, this program reads version {EVALUATION_VERSION}"
        )
    if absent := [r.name for r in file.recordings if not file.errors.get(r.name)]:
        raise _READ.fault(f"{folder / EVALUATION} has no errors of {', '.join(absent)}")
    places = [f"{name}/{channel}" for name, errors in file.errors.items() for channel in errors]
    path = folder / EVALUATION_TRACES
    keys = [f"{place}/{key}" for place in places for key in _KEYS]
    arrays = _READ.arrays(path, keys, texts=[f"{place}/joints" for place in places])
    traces: dict[str, dict[str, np.ndarray]] = {}
    for place in places:
        one = {key: arrays[f"{place}/{key}"] for key in _KEYS}
        _READ.shaped(one["time"], (None,), f"{path}, {place}/time")
        _READ.shaped(one["joints"], (None,), f"{path}, {place}/joints")
        for key in _KEYS[1:-1]:
            _READ.shaped(one[key], (len(one["time"]), len(one["joints"])), f"{path}, {place}/{key}", finite=False)
        traces[place] = one
    return Evaluation(folder, file, traces)
