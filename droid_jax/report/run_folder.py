"""A run's folder as the report reads it: the files that must be there, checked, and those that may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from droid_jax.arguments import shown
from droid_jax.files import CONFIG, CORRELATION, DISTRIBUTION, FILMS, FIT, HISTORY, REPLAY, REPLAY_FILM, TRACES
from droid_jax.read_json import parse_json
from droid_jax.report.reading import FINDING, Maybe, Reader

_READ = Reader("identify")
_NUMBER, _MAYBE = (int, float), (int, float, type(None))
_PARAMETER = {
    **dict.fromkeys(("name", "unit", "group", "reason"), str),
    **dict.fromkeys(("nuisance", "identifiable", "on_bound"), bool),
    **dict.fromkeys(("initial_mean", "initial_std", "low", "high", "best", "mean", "std"), _NUMBER),
    **{"interval": tuple[float, float], "truth": _MAYBE, "partners": [{"name": str, "correlation": _NUMBER}]},
    "moved": Maybe(_MAYBE),
}
_GAP = {
    **{"before": _NUMBER, "after": _NUMBER, "per_joint_before": [_NUMBER], "per_joint_after": [_NUMBER]},
    **{"noise_floor": Maybe(_MAYBE), "closed": Maybe(_MAYBE), "judged": Maybe(Literal["repeats", "time", "same"])},
    "per_joint_noise_floor": Maybe(([_NUMBER], type(None))),
}
_CHECK = {
    **{"unit": str, "time_step": _NUMBER, "remaining": _NUMBER, "unmeasured": str},
    **dict.fromkeys(("discretisation", "parity_torque", "parity_rms", "parity_angle"), _MAYBE),
    **{"too_coarse": bool, "engines_differ": bool},
}
_FIT = {
    **{"parameters": [_PARAMETER], "gap": {str: _GAP}, "stop": str, "rule": str},
    "cost": {**dict.fromkeys(("initial", "best", "noise_floor"), _MAYBE), "unit": Maybe(str)},
    **{"torque_unit": Maybe(str), "converged": Maybe((bool, type(None))), "mean_square": Maybe(_MAYBE)},
    **{"generations": Maybe(int), "evaluations": Maybe(int), "seconds": Maybe({str: _NUMBER})},
    **{"mjcf_lacks": Maybe([str]), "notes": Maybe([str]), "findings": Maybe([FINDING])},
    "checks": Maybe({str: _CHECK}),
}
_RECORDING = {
    **{"name": str, "sha256": str, "repeats": int, "heldout": [int], "duration": _NUMBER},
}
_CONFIG = {
    **{"preset": str, "scene": str, "engine": str, "recordings": [_RECORDING], "seed": int, "synthetic_robot": bool},
    **{"started": Maybe(str), "device": Maybe(str), "versions": Maybe({str: str}), "setup": Maybe(dict)},
}
_ROWS, _TABLES = ("generation", "best_cost", "median_cost"), ("mean", "std")  # of history.npz, [G] and [G, D]
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
        """How the page calls what was measured: a simulation is never called a robot."""
        return "synthetic robot" if self.config["synthetic_robot"] else "robot"

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
    _READ.check(config, _CONFIG, CONFIG)
    _READ.check(fit, _FIT, FIT)
    for key in ("parameters", "gap"):
        if not fit[key]:
            raise _READ.fault(f"{FIT}, {key!r} is empty")
    if other := [r["name"] for r in config["recordings"] if r["name"] not in fit["gap"]]:
        raise _READ.fault(f"{CONFIG}, 'recordings' names {shown(other[0])}, of which {FIT} has no 'gap'")
    names = [p["name"] for p in fit["parameters"]]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise _READ.fault(f"{FIT}, 'parameters' holds {', '.join(twice)} more than once")
    missing = []
    distribution = None
    if not (run / DISTRIBUTION).is_file():
        missing.append(
            "distribution.npz is not there: the initial and the fitted Gaussian are not compared by samples."
        )
    else:
        distribution = _READ.arrays(run / DISTRIBUTION, ("initial_cost", "fitted_cost"))
        for key, costs in distribution.items():
            _READ.shaped(costs, (None,), f"{run / DISTRIBUTION}, {key}", finite=False)
    frames = tuple(sorted((run / "frames").glob("*.png")))
    film = run / FILMS / REPLAY_FILM
    if not frames:
        missing.append(NOT_DRAWN if (run / REPLAY).is_file() else NO_REPLAY)
    return Run(
        folder=run,
        config=config,
        fit=fit,
        traces=_traces(run / TRACES, list(fit["gap"])),
        history=_history(run / HISTORY),
        correlation=_correlation(run / CORRELATION),
        distribution=distribution,
        frames=frames,
        film=film if film.is_file() else None,
        missing=tuple(missing),
    )


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
    """Arrays per recording, their shapes checked against time [T] and joints [J]."""
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


def _phases(text: np.ndarray, where: str) -> list[dict[str, Any]]:
    """The phases of a recording, which traces.npz keeps as JSON."""
    _READ.shaped(text, (), where)
    try:
        phases = parse_json(str(text), where)
    except ValueError as error:
        raise _READ.fault(str(error)) from None
    _READ.check(phases, [{"name": str, "start": _NUMBER, "end": _NUMBER}], where)
    return phases
