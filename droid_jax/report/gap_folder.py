"""The folder of a search for a missing effect as typed values: gap.json and gap.npz, checked.

The one module that knows the keys of gap.json; docs/results-folder.md describes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import Struct, field

from droid_jax.files import EXTENDED, GAP, GAP_TRACES, GAP_VERSION, LOST, NOT_MADE, TO_BE_MADE
from droid_jax.report.neutral_folder import Neutral, read_neutral
from droid_jax.report.reading import FindingEntry, PhaseEntry, Reader
from droid_jax.report.text import label

Role = Literal["train", "validation", "test"]
ROLES: tuple[Role, ...] = ("train", "validation", "test")
_READ = Reader("gap", "--again")  # gap.json comes last: once it is there, the command takes the run for whole
_LINES = ("measured", "scatter", "before", "after")
THRESHOLDS = ("significance", "minimum_closed", "mostly_explained")  # of "config", "selection", that are read


class EffectPlace(Struct, frozen=True):
    """An effect at a place."""

    effect: str
    location: str = ""

    @property
    def text(self) -> str:
        """ "latch at door_hinge"."""
        return f"{self.effect} at {self.location}" if self.location else self.effect


class Placed(Struct, frozen=True):
    """An entry that belongs to an effect at a place."""

    effect: str
    location: str = ""

    @property
    def place(self) -> EffectPlace:
        """The effect and its place."""
        return EffectPlace(effect=self.effect, location=self.location)


class Discrepancy(Struct, frozen=True):
    """Of one recording: U [sigma^2], the share of it that is closed, and the torque distance (equation 1)."""

    recording: str
    before: float | None
    after: float | None
    closed: float | None
    torque_before: float | None
    torque_after: float | None


class HintEntry(Struct, frozen=True):
    """Effects that passed validation and close too little to be named; closed: by held-out role."""

    effects: list[EffectPlace]
    indistinguishable: list[list[list[EffectPlace]]]
    closed: dict[str, float]


class About(Struct, frozen=True):
    """Description of an effect in the library."""

    what: str
    signature: str
    confused_with: list[str]
    remedy: str = ""


class Ranked(Placed, frozen=True, kw_only=True):
    """A candidate in a score test: its statistic and the share of U that it explains linearly."""

    t: float | None
    explained: float | None


class ScoreEntry(Struct, frozen=True):
    """Score test of all candidates on the residuals of a model."""

    p: float | None
    ranking: list[Ranked]
    failed: list[EffectPlace]


class ReasonEntry(Struct, frozen=True):
    """Why a model failed its validation test."""

    reason: str
    text: str


class ValidationEntry(Struct, frozen=True):
    """A model with effects, refitted on the train recording and tested on the validation recording.

    parts_before: how many effects the model had before.  chosen: share of resamples in which it, or one that looks
    like it, wins.
    """

    parts: list[EffectPlace]
    parts_before: int
    discrepancy_train: float | None
    discrepancy_validation: float | None
    p: float | None
    chosen: float | None
    passed: bool
    reasons: list[ReasonEntry]


Axis = Literal[
    "phase", "object_angle", "object_direction", "object_speed", "direction", "position", "load", "hinge_force"
]


class CellEntry(Struct, frozen=True, kw_only=True):
    """U of some instants and joints; what does not apply is None.

    axis: what the instants are sorted by.  found: by the sign-flip test, false discoveries 10 %.
    """

    axis: Axis
    joint: str | None = None
    label: str | None = None
    low: float | None = None
    high: float | None = None
    unit: str | None = None
    discrepancy: float | None
    p: float | None
    found: bool

    @property
    def name(self) -> str:
        """Its axis: "Object angle", "Position of joint 2"; an object that slides has a position and no angle."""
        axis = "Object position" if self.axis == "object_angle" and self.unit == "m" else label(self.axis)
        return f"{axis} of {label(self.joint).lower()}" if self.joint else axis

    @property
    def phase(self) -> tuple[str, float]:
        """Name of its phase, and where that starts, s."""
        return self.label or "", self.low or 0.0


class Cells(Struct, frozen=True):
    """Where the discrepancy is, with the base model and with the final one."""

    before: list[CellEntry]
    after: list[CellEntry]


class Coefficient(Placed, frozen=True, kw_only=True):
    """A coefficient or shape parameter of an effect in the model, with its 90 % interval."""

    name: str
    unit: str
    value: float | None
    low: float | None
    high: float | None
    bound: str = ""  # "lower", "upper" where the value lies on one
    what: str


class Shift(Struct, frozen=True):
    """A base parameter before and after the effects entered; the deviation is the base fit's own."""

    name: str
    unit: str
    before: float | None
    after: float | None
    deviation_before: float | None

    @property
    def deviations(self) -> float:
        """The shift in deviations; NaN where one of its numbers is not known."""
        if self.before is None or self.after is None or not (self.deviation_before or 0.0) > 0:
            return math.nan
        return (self.after - self.before) / self.deviation_before  # type: ignore[operator]  # known one line above


def largest_shifts(shifts: Sequence[Shift]) -> list[Shift]:
    """Those with a known shift, the largest first."""
    return sorted((s for s in shifts if math.isfinite(s.deviations)), key=lambda s: -abs(s.deviations))


class ExperimentEntry(Struct, frozen=True):
    """A motion to record: distance in standard deviations between indistinguishable models."""

    what: str
    distance: float | None
    not_made: str | None = ""


class TrendEntry(Placed, frozen=True, kw_only=True):
    """How a coefficient changes from repeat to repeat."""

    coefficient: str
    per_repeat: float | None
    p: float | None
    unit: str


class OpenLoopMean(Struct, frozen=True):
    """Mean absolute error of one channel over joints and recordings, replayed whole."""

    unit: str
    before: float | None
    after: float | None


class OpenLoop(Struct, frozen=True):
    """Errors of whole replays of commanded logs."""

    mean_mae: dict[str, OpenLoopMean]


class FinalModelEntry(Struct, frozen=True):
    """The model that is written to extended.json."""

    fitted_to: list[str]
    discrepancies: dict[str, float | None]


class SplitEntry(Struct, frozen=True):
    """How the recordings were divided, and what cannot be concluded from that."""

    by: Literal["recordings", "repeats", "blocks", "windows"] = "recordings"
    limits: str = ""


class GapSetup(Struct, frozen=True):
    """Options of the command; its other entries are kept in `Gap.options`."""

    hidden: str = ""
    synthetic_robot: bool | None = None
    recording: list[str] | None = None


class Answer(Struct, frozen=True, kw_only=True):
    """The part of gap.json with the answer."""

    sentence: str
    effects: list[EffectPlace]
    discrepancies: dict[Role, Discrepancy]
    amendments: dict[str, str]
    setup: GapSetup

    @property
    def hidden(self) -> str:
        """Description of the effects hidden in the synthetic robot; empty where it is not known."""
        return self.setup.hidden if self.setup.synthetic_robot else ""

    @property
    def missing_amendments(self) -> dict[str, str]:
        """Missing addition to the verdict -> reason; an empty reason if the same command will still make it."""
        states = {n: s for n, s in self.amendments.items() if s == TO_BE_MADE or s.startswith(NOT_MADE)}
        return {n: s.removeprefix(TO_BE_MADE).removeprefix(NOT_MADE).strip(": .") for n, s in states.items()}


Verdict = Literal["none", "named", "indistinguishable", "partly explained", "unexplained", "fit not converged"]


class Found(Answer, frozen=True, kw_only=True):
    """gap.json."""

    verdict: Verdict
    indistinguishable: list[list[list[EffectPlace]]]  # for each effect its alternatives, each a list of effects
    hints: list[HintEntry]
    doubts: list[str]
    config: dict[str, Any]
    about: dict[str, About]
    p: float | None
    discretisation_error: float | None
    converged: bool
    not_tried: str
    remainder: float | None
    explained: float | None
    phases: dict[Role, list[PhaseEntry]]
    score_tests: list[ScoreEntry]
    failed: list[str]
    validation_tests: list[ValidationEntry]
    cells: Cells
    coefficients: list[Coefficient]
    shape_parameters: list[Coefficient]
    shifts: list[Shift]
    experiments: list[ExperimentEntry]
    trends: list[TrendEntry]
    units: str  # of the leading channel, and so of the traces
    channel: str = "torque"
    channels: list[str] = field(default_factory=lambda: ["torque"])
    distance_unit: str = ""
    ruled_out: list[str] = field(default_factory=list[str])
    final_model: FinalModelEntry
    findings: list[FindingEntry] = field(default_factory=list)
    split: SplitEntry = SplitEntry()
    open_loop: OpenLoop | None = None
    seconds: dict[str, float]
    versions: dict[str, str]
    device: str

    @property
    def quantity(self) -> str:
        """The quantity of the traces: "Torque", "Position", "Object angle"."""
        return self.channel.replace("_", " ").capitalize()

    @property
    def distance(self) -> tuple[str, str]:
        """What is compared by equation 1, and the unit of that: "Torque distance", "N m"; of several channels
        "Distance" in noise units.
        """
        name = f"{self.quantity} distance" if len(self.channels) == 1 else "Distance"
        return name, self.distance_unit or self.units

    def threshold(self, name: str) -> float:
        """A threshold of the selection, of its "config"."""
        return float(self.config["selection"][name])


@dataclass(frozen=True)
class Gap:
    """The folder of a search for a missing effect.

    found: gap.json.  options: its "setup", all of it.  traces: role -> joints [J], time [K] s, and measured,
    scatter, before, after [K, J] in `found.units`, and the role's phases.
    """

    folder: Path
    found: Found
    options: Mapping[str, Any]
    traces: Mapping[Role, Mapping[str, Any]]

    @property
    def roles(self) -> list[Role]:
        """The roles with data: "train", "validation" and possibly "test"."""
        return [r for r in ROLES if r in self.found.discrepancies]

    @property
    def judge(self) -> Role:
        """The role whose discrepancy is reported: test, or validation where there is no test data."""
        return self.roles[-1]

    @property
    def extended(self) -> bool:
        """Whether an effect entered the model: only then is there an "after"."""
        return bool(self.found.effects)

    @property
    def neutral(self) -> Neutral | None:
        """The extended model in MuJoCo's own terms."""
        return read_neutral(self.folder, _READ) if self.extended_file else None

    @property
    def extended_file(self) -> bool:
        """Whether the folder holds the extended model."""
        return (self.folder / EXTENDED).is_file()

    @property
    def lost(self) -> bool:
        """Whether a recording was kept as test data and could not be replayed in the end."""
        return LOST in self.found.failed

    @property
    def blown_up(self) -> list[str]:
        """Candidates and models that were left out because their replay blew up, each once."""
        names = [p.text for test in self.found.score_tests for p in test.failed] + self.found.failed
        return [name for name in dict.fromkeys(names) if name != LOST]

    @property
    def discretisation_error(self) -> float | None:
        """U0; None where it is not known and where there is none, see `timeless`."""
        return self.found.discretisation_error or None

    @property
    def timeless(self) -> bool:
        """Whether a measured motion was replayed, which has no time step and whose discretisation error is zero."""
        return self.found.discretisation_error == 0

    @property
    def coefficients(self) -> list[Coefficient]:
        """Coefficients of the effects in the model, then their shape parameters."""
        return [*self.found.coefficients, *self.found.shape_parameters]

    @property
    def repeated(self) -> bool:
        """Whether there are repeats; without them alternating blocks of time train and validate."""
        return self.found.split.by not in ("blocks", "windows")

    @property
    def sheets(self) -> list[tuple[tuple[Role, ...], Mapping[str, Any]]]:
        """Roles and their traces to draw, the role `judge` first; alternating blocks of time share one figure."""
        first: list[tuple[Role, ...]] = [("train",), ("validation",)] if self.repeated else [("train", "validation")]
        sheets = [*first, *((r,) for r in self.roles[2:])]
        return [(roles, _joined([self.traces[r] for r in roles])) for roles in reversed(sheets)]

    @property
    def synthetic_robot(self) -> bool:
        """Whether the torques come from a synthetic robot: no recording was given."""
        said = self.found.setup.synthetic_robot
        return self.found.setup.recording == [] if said is None else said

    def recording(self, role: Role) -> str:
        """Name of the recording in a role."""
        return self.found.discrepancies[role].recording


def has_gap(folder: Path) -> bool:
    """Whether a folder holds, or should hold, a search for a missing effect."""
    return any((folder / name).exists() for name in (GAP, GAP_TRACES))


def read_answer(folder: Path) -> Answer:
    """The answer in a folder's gap.json; ValueError where it is missing or broken."""
    return _READ.typed(_content(folder / GAP), Answer, str(folder / GAP))


def read_gap(folder: str | Path) -> Gap:
    """Load and check; ValueError names what is missing or broken."""
    folder = Path(folder)
    path = folder / GAP
    content = _content(path)
    found = _READ.typed(content, Found, str(path))
    for fault in _faults(found):
        raise _READ.fault(f"{path}, {fault}")
    roles: list[Role] = [r for r in ROLES if r in found.discrepancies]
    return Gap(folder, found, content["setup"], _traces(folder / GAP_TRACES, roles, found.phases))


def _content(path: Path) -> dict[str, Any]:
    """gap.json as plain values, of the version that this program reads."""
    content = (_READ if path.exists() else Reader("gap")).json(path)
    if content.get("version") != GAP_VERSION:
        raise _READ.fault(f"{path} has version {content.get('version', 1)!r}, this program reads version {GAP_VERSION}")
    return content


def _faults(found: Found) -> Iterator[str]:
    """Faults that the types cannot express."""
    absent = [r for r in ROLES[:2] if r not in found.discrepancies]
    if absent:
        yield f"'discrepancies' lacks {', '.join(map(repr, absent))}"
    selection = found.config.get("selection")
    for name in THRESHOLDS:
        if not isinstance(selection, dict) or not isinstance(selection.get(name), (int, float)):
            yield f"'config', 'selection' has no number {name!r}"
    for said in (found, *found.hints):
        if len(said.indistinguishable) != len(said.effects):
            yield f"'indistinguishable' has {len(said.indistinguishable)} lists for {len(said.effects)} effects"


def _traces(path: Path, roles: Sequence[Role], phases: Mapping[Role, Any]) -> dict[Role, dict[str, Any]]:
    """Arrays by role, their shapes checked against time [K] and joints [J]."""
    keys = ["joints", *(f"{r}.{key}" for r in roles for key in ("time", *_LINES))]
    arrays = _READ.arrays(path, keys, texts=["joints"])
    for key in ("joints", *(f"{r}.time" for r in roles)):
        _READ.shaped(arrays[key], (None,), f"{path}, {key}")
    traces: dict[Role, dict[str, Any]] = {}
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
