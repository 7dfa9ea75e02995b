"""A run's folder as the report reads it: the files that must be there, checked, and those that may be."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.files import CONFIG, CORRELATION, DISTRIBUTION, FILMS, FIT, HISTORY, REPLAY, REPLAY_FILM, TRACES
from droid_jax.report.reading import Reader

_READ = Reader("identify")
_ARRAYS = {
    "history": ("names", "generation", "mean", "std", "best_cost", "median_cost"),
    "correlation": ("names", "correlation"),
    "distribution": ("initial_cost", "fitted_cost"),
}
_PARAMETER_KEYS = (
    *(
        "name",
        "unit",
        "group",
        "nuisance",
        "initial_mean",
        "initial_std",
        "low",
        "high",
        "best",
        "mean",
        "std",
    ),
    *("interval", "identifiable", "reason", "truth", "on_bound", "partners"),
)
_TRACE_KEYS = ("time", "measured_mean", "measured_low", "measured_high", "before", "after", "joints")

NO_REPLAY = "No pictures: a log without commands has no replay to show."
NOT_DRAWN = (
    "No pictures: none were drawn, most often for want of OpenGL (Debian, Ubuntu: apt-get install libegl1 "
    "libgl1-mesa-dri). The command of this run draws them from replay.npz when it is called again, or says why not."
)


@dataclass(frozen=True)
class Run:
    """What a run's folder holds.

    config, fit: config.json and fit.json.  traces: per recording the arrays of traces.npz plus
    "phases", a list.  history, correlation: arrays by name.  distribution: None when missing.
    frames: PNG files.  film: of the replay before and after, None when missing.  missing: one
    sentence per optional thing that the page leaves out.
    """

    folder: Path
    config: Mapping[str, Any]
    fit: Mapping[str, Any]
    traces: Mapping[str, Mapping[str, Any]]
    history: Mapping[str, np.ndarray]
    correlation: Mapping[str, np.ndarray]
    distribution: Mapping[str, np.ndarray] | None
    frames: tuple[Path, ...]
    film: Path | None
    missing: tuple[str, ...]

    @property
    def robot(self) -> str:
        """How the page calls what was measured: a stand-in simulation is never called a robot."""
        return "stand-in robot" if self.config["stand_in"] else "robot"

    @property
    def torque_unit(self) -> str:
        """N m, N where slides are measured, "N m or N" for both."""
        return self.fit.get("torque_unit", "N m")

    @property
    def parameters(self) -> list[Mapping[str, Any]]:
        """The parameters of interest, nuisances left out."""
        return [p for p in self.fit["parameters"] if not p["nuisance"]]


def has_run(folder: Path) -> bool:
    """Whether a folder holds, or should hold, an identification beside something else."""
    return (folder / FIT).exists()


def read_run(run: Path) -> Run:
    """Load and check a run's folder; ValueError names the file that is missing or broken."""
    run = Path(run)
    if not run.is_dir():
        raise _READ.fault(f"there is no folder {run}")
    config, fit = _READ.json(run / CONFIG), _READ.json(run / FIT)
    _READ.need(config, ("preset", "scene", "engine", "recordings", "seed", "stand_in"), CONFIG)
    _READ.need(fit, ("parameters", "cost", "gap", "stop", "rule"), FIT)
    for i, p in enumerate(fit["parameters"]):
        _READ.need(p, _PARAMETER_KEYS, f"fit.json, parameter {p.get('name', i)!r}")
    for name, gap in fit["gap"].items():
        _READ.need(gap, ("before", "after", "per_joint_before", "per_joint_after"), f"fit.json, gap {name!r}")
    missing = []
    distribution = None
    if not (run / DISTRIBUTION).is_file():
        missing.append(
            "distribution.npz is not there: the initial and the fitted Gaussian are not compared by samples."
        )
    else:
        distribution = _READ.arrays(run / DISTRIBUTION, _ARRAYS["distribution"])
    frames = tuple(sorted((run / "frames").glob("*.png")))
    film = run / FILMS / REPLAY_FILM
    if not frames:
        missing.append(NOT_DRAWN if (run / REPLAY).is_file() else NO_REPLAY)
    return Run(
        folder=run,
        config=config,
        fit=fit,
        traces=_traces(run / TRACES, list(fit["gap"])),
        history=_READ.arrays(run / HISTORY, _ARRAYS["history"]),
        correlation=_READ.arrays(run / CORRELATION, _ARRAYS["correlation"]),
        distribution=distribution,
        frames=frames,
        film=film if film.is_file() else None,
        missing=tuple(missing),
    )


def _traces(path: Path, recordings: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Arrays per recording, their shapes checked against time [T] and joints [J]."""
    arrays = _READ.arrays(path, [f"{r}/{key}" for r in recordings for key in _TRACE_KEYS])
    traces: dict[str, dict[str, Any]] = {}
    for r in recordings:
        one: dict[str, Any] = {key: arrays[f"{r}/{key}"] for key in _TRACE_KEYS}
        shape = (len(one["time"]), len(one["joints"]))
        for key in _TRACE_KEYS[1:-1]:
            if one[key].shape != shape:
                raise _READ.fault(f"{path}, {r}/{key} must be [time, joints] = {shape}, got {one[key].shape}")
        one["phases"] = json.loads(str(arrays[f"{r}/phases"])) if f"{r}/phases" in arrays else []
        traces[r] = one
    return traces
