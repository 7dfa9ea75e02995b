"""The folder of an identification as typed values: fit.json, config.json and their arrays, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from msgspec import Struct, field

from droid_jax.arguments import shown
from droid_jax.files import (
    CONFIG,
    CORRELATION,
    DISTRIBUTION,
    FILMS,
    FIT,
    FIT_VERSION,
    HISTORY,
    REPLAY,
    REPLAY_FILM,
    TRACES,
    VIEWER,
)
from droid_jax.read_json import parse_json
from droid_jax.report.neutral_folder import Neutral, read_neutral
from droid_jax.report.reading import FindingEntry, PhaseEntry, Reader

MOVED = 1.0  # prior deviations: a parameter that is not identifiable and moved no less is reported as moved


class Partner(Struct, frozen=True):
    """A parameter that another one moves together with."""

    name: str
    correlation: float


class FittedParameter(Struct, frozen=True, kw_only=True):
    """A fitted parameter in its unit; `moved` in deviations of its prior."""

    name: str
    unit: str
    group: str
    nuisance: bool
    initial_mean: float
    initial_std: float
    initial_interval: tuple[float, float] | None = None
    low: float
    high: float
    best: float
    mean: float
    std: float
    interval: tuple[float, float]  # 90 %
    identifiable: bool
    reason: str
    on_bound: bool
    partners: list[Partner]
    moved: float | None = None
    truth: float | None

    @property
    def deviations(self) -> float:
        """Shift of the best value in deviations of the prior; in physical units where fit.json does not state it."""
        return self.standardised(self.best) if self.moved is None else self.moved

    @property
    def moved_far(self) -> bool:
        """Whether the parameter moved far although it is not identifiable."""
        return not self.identifiable and abs(self.deviations) >= MOVED

    def standardised(self, value: float) -> float:
        """A value in deviations of the prior from its mean."""
        return (value - self.initial_mean) / self.initial_std

    @property
    def bound(self) -> Literal["", "lower", "upper"]:
        """The bound that the best value lies on, "lower" or "upper"."""
        if not self.on_bound:
            return ""
        return "lower" if abs(self.best - self.low) <= abs(self.best - self.high) else "upper"

    @property
    def bound_value(self) -> float:
        """Value of that bound."""
        return self.low if self.bound == "lower" else self.high

    @property
    def inside(self) -> bool:
        """Whether the true value, where it is known, lies in the 90 % interval."""
        return self.truth is not None and self.interval[0] <= self.truth <= self.interval[1]


class ErrorsEntry(Struct, frozen=True, kw_only=True):
    """Errors of one measured channel, joint by joint [C], in its unit; None where a replay blew up."""

    unit: str
    joints: list[str]
    mae_before: list[float | None]
    mae_after: list[float | None]
    rms_before: list[float | None]
    rms_after: list[float | None]

    @property
    def rows(self) -> list[tuple[str, float | None, float | None, float | None, float | None]]:
        """For each joint its name, mean absolute error before and after, RMS error before and after."""
        columns = (self.joints, self.mae_before, self.mae_after, self.rms_before, self.rms_after)
        return list(zip(*columns, strict=True))

    @property
    def mean_mae(self) -> tuple[float | None, float | None]:
        """Mean absolute error over the joints, before and after the fit."""
        return mean_of(self.mae_before), mean_of(self.mae_after)


def mean_of(values: Sequence[float | None]) -> float | None:
    """The mean; None where a number is missing."""
    there = [v for v in values if v is not None]
    return float(np.mean(there)) if values and len(there) == len(values) else None


class DistanceEntry(Struct, frozen=True, kw_only=True):
    """Distance (equation 1) of one recording before and after the fit, and the difference between repeats.

    per_joint_*: [J] root mean square of the first of the compared channels that figures are of, in per_joint_unit.
    """

    before: float
    after: float
    noise_floor: float | None = None
    closed: float | None = None
    judged: Literal["repeats", "time", "same", "recordings"] = "repeats"  # or the log's last part, what was fitted
    per_joint_before: list[float | None]
    per_joint_after: list[float | None]
    per_joint_noise_floor: list[float] | None = None
    per_joint_unit: str = "N m"
    channels: list[str] = field(default_factory=lambda: ["torque"])
    errors: dict[str, ErrorsEntry] = field(default_factory=dict)

    @property
    def leading(self) -> str:
        """The compared channel that the figures and numbers of each joint show."""
        return "torque" if "torque" in self.channels else self.channels[0]


class CostEntry(Struct, frozen=True):
    """The cost that the search minimised."""

    initial: float | None
    best: float | None
    noise_floor: float | None
    unit: str = "N m"


class Check(Struct, frozen=True):
    """Errors of the time step and of the engine at the fitted values, in `unit`."""

    unit: str
    time_step: float
    remaining: float
    unmeasured: str
    discretisation: float | None
    parity_largest: float | None
    parity_rms: float | None
    parity_angle: float | None
    too_coarse: bool
    engines_differ: bool
    channel: str = "torque"


class Distances(Struct, frozen=True, kw_only=True):
    """The distances of fit.json, by test recording."""

    heldout_distances: dict[str, DistanceEntry] = field(default_factory=dict)
    version: int = 1
    distance_unit: str = "N m"
    compared: dict[str, float] = field(default_factory=dict)  # weight of each channel


class FitFile(Distances, frozen=True, kw_only=True):
    """fit.json."""

    parameters: list[FittedParameter]
    cost: CostEntry
    stop: str
    rule: str
    converged: bool | None = True  # None: a search without refinement, which gives no widths
    mean_square: float | None = None  # of the whitened residuals
    generations: int | None = None
    evaluations: int | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    findings: list[FindingEntry] = field(default_factory=list)
    checks: dict[str, Check] = field(default_factory=dict)

    @property
    def channels(self) -> list[str]:
        """The compared channels, the same in all recordings."""
        return next(iter(self.heldout_distances.values())).channels

    @property
    def of_interest(self) -> list[FittedParameter]:
        """The parameters, nuisances left out."""
        return [p for p in self.parameters if not p.nuisance]

    @property
    def nuisances(self) -> list[FittedParameter]:
        return [p for p in self.parameters if p.nuisance]


class RecordingEntry(Struct, frozen=True):
    """A recording in config.json; duration in s."""

    name: str
    sha256: str
    repeats: int
    heldout: list[int]
    duration: float


class RunConfig(Struct, frozen=True):
    """config.json."""

    preset: str
    scene: str
    engine: str
    recordings: list[RecordingEntry]
    seed: int
    synthetic_robot: bool
    judged_on: list[RecordingEntry] = field(default_factory=list)  # test recordings
    started: str | None = None
    device: str | None = None
    versions: dict[str, str] = field(default_factory=dict)
    setup: dict[str, Any] = field(default_factory=dict)

    @property
    def judges(self) -> list[RecordingEntry]:
        """The recordings with test data: whole ones, or those of which a part was held out."""
        return self.judged_on or self.recordings


_READ = Reader("identify")
Of = TypeVar("Of", bound="Distances")
_ROWS, _TABLES = ("generation", "best_cost", "median_cost"), ("mean", "std")  # of history.npz, [G] and [G, D]
_TRACE_KEYS = ("time", "measured_mean", "measured_low", "measured_high", "before", "after", "joints")


@dataclass(frozen=True)
class Run:
    """The folder of an identification.

    config, fit: config.json and fit.json.  traces: by `trace_places` the arrays of traces.npz plus
    "phases", a list.  history, correlation: arrays by name.  distribution: None when missing.
    frames: PNG files.  film: of the replay before and after, None when missing.  replay: whether there is a replay
    to draw.
    """

    folder: Path
    config: RunConfig
    fit: FitFile
    traces: Mapping[str, Mapping[str, Any]]
    history: Mapping[str, np.ndarray]
    correlation: Mapping[str, np.ndarray]
    distribution: Mapping[str, np.ndarray] | None
    frames: tuple[Path, ...]
    film: Path | None
    replay: bool

    @property
    def viewer(self) -> Path | None:
        """Page of measured and simulated motion side by side, None when missing."""
        return self.folder / VIEWER if (self.folder / VIEWER).is_file() else None

    @property
    def neutral(self) -> Neutral | None:
        """The result in MuJoCo's own terms."""
        return read_neutral(self.folder, _READ)

    @property
    def robot(self) -> str:
        """Word for what was measured: "robot", or "synthetic robot" for a simulation."""
        return "synthetic robot" if self.config.synthetic_robot else "robot"


def has_run(folder: Path) -> bool:
    """Whether a folder holds, or should hold, an identification, possibly with other results."""
    return (folder / FIT).exists()


def read_fit(folder: Path, kind: type[Of] = FitFile) -> Of:
    """fit.json of a folder, all of it or its `Distances`; ValueError where it is missing, broken or of version 1."""
    fit = _READ.json(folder / FIT, kind)
    if fit.version != FIT_VERSION:
        raise _READ.fault(f"{folder / FIT} has version {fit.version}, this program reads version {FIT_VERSION}")
    return fit


def read_run(run: Path) -> Run:
    """Load and check a run's folder; ValueError names the file that is missing or broken."""
    run = Path(run)
    if not run.is_dir():
        raise _READ.fault(f"there is no folder {run}")
    config, fit = _READ.json(run / CONFIG, RunConfig), read_fit(run)
    for key, content in (("parameters", fit.parameters), ("heldout_distances", fit.heldout_distances)):
        if not content:
            raise _READ.fault(f"{run / FIT}, {key!r} is empty")
    if other := [r.name for r in config.judges if r.name not in fit.heldout_distances]:
        key = "judged_on" if config.judged_on else "recordings"
        raise _READ.fault(f"{run / CONFIG}, {key!r} names {shown(other[0])}, of which {FIT} has no 'heldout_distances'")
    names = [p.name for p in fit.parameters]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise _READ.fault(f"{run / FIT}, 'parameters' holds {', '.join(twice)} more than once")
    distribution = None
    if (run / DISTRIBUTION).is_file():
        distribution = _READ.arrays(run / DISTRIBUTION, ("initial_cost", "fitted_cost"))
        for key, costs in distribution.items():
            _READ.shaped(costs, (None,), f"{run / DISTRIBUTION}, {key}", finite=False)
    film = run / FILMS / REPLAY_FILM
    return Run(
        folder=run,
        config=config,
        fit=fit,
        traces=_traces(run / TRACES, trace_places(fit)),
        history=_history(run / HISTORY),
        correlation=_correlation(run / CORRELATION),
        distribution=distribution,
        frames=tuple(sorted((run / "frames").glob("*.png"))),
        film=film if film.is_file() else None,
        replay=(run / REPLAY).is_file(),
    )


def trace_places(fit: Distances) -> list[str]:
    """Keys of the compared channels in traces.npz: the recording for the leading one, recording/channel for others."""
    return [
        name if channel == distance.leading else f"{name}/{channel}"
        for name, distance in fit.heldout_distances.items()
        for channel in distance.channels
    ]


def _history(path: Path) -> dict[str, np.ndarray]:
    """names [D]; generation, best_cost, median_cost [G]; mean, std [G, D]."""
    arrays = _READ.arrays(path, ("names", *_ROWS, *_TABLES), texts=("names",))
    _READ.shaped(arrays["names"], (None,), f"{path}, names")
    _READ.shaped(arrays["generation"], (None,), f"{path}, generation")
    rows, columns = len(arrays["generation"]), len(arrays["names"])
    for key in (*_ROWS, *_TABLES):
        shape = (rows, columns) if key in _TABLES else (rows,)
        _READ.shaped(arrays[key], shape, f"{path}, {key}", finite=False)
    return arrays


def _correlation(path: Path) -> dict[str, np.ndarray]:
    """names [D] and correlation [D, D]."""
    arrays = _READ.arrays(path, ("names", "correlation"), texts=("names",))
    _READ.shaped(arrays["names"], (None,), f"{path}, names")
    _READ.shaped(arrays["correlation"], (len(arrays["names"]),) * 2, f"{path}, correlation")
    return arrays


def _traces(path: Path, recordings: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Arrays by `trace_places`, their shapes checked against time [T] and joints [J]."""
    keys, phases = [f"{r}/{key}" for r in recordings for key in _TRACE_KEYS], [f"{r}/phases" for r in recordings]
    arrays = _READ.arrays(path, keys, phases, texts=[*(f"{r}/joints" for r in recordings), *phases])
    traces: dict[str, dict[str, Any]] = {}
    for r in recordings:
        one: dict[str, Any] = {key: arrays[f"{r}/{key}"] for key in _TRACE_KEYS}
        for key in ("time", "joints"):
            _READ.shaped(one[key], (None,), f"{path}, {r}/{key}")
        shape = (len(one["time"]), len(one["joints"]))
        for key in _TRACE_KEYS[1:-1]:
            if one[key].shape != shape:
                raise _READ.fault(f"{path}, {r}/{key} must be [time, joints] = {shape}, got {one[key].shape}")
        one["phases"] = _phases(arrays[f"{r}/phases"], f"{path}, {r}/phases") if f"{r}/phases" in arrays else []
        traces[r] = one
    return traces


def _phases(text: np.ndarray, where: str) -> list[PhaseEntry]:
    """The phases of a recording, which traces.npz keeps as JSON."""
    _READ.shaped(text, (), where)
    try:
        phases = parse_json(str(text), where)
    except ValueError as error:
        raise _READ.fault(str(error)) from None
    return _READ.typed(phases, list[PhaseEntry], where)
