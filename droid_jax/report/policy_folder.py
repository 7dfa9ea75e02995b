"""What training and trials leave in a folder, as the report reads it: training.json, transfer.json, films; checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from droid_jax.files import FILMS, TRAINING, TRANSFER
from droid_jax.policy.trials import BLOWN_UP
from droid_jax.report.reading import Maybe, Reader

_READ = Reader("train")
_NUMBER = (int, float)
_TRAINING = {
    "setup": {
        **{"method": Literal["fitted", "mean", "prior"], "preset": str, "knob": int, "seed": int},
        "fit": (str, type(None)),
    },
    "synthetic_robot": {"springs": Maybe(int), "seed": Maybe(int), "hide": Maybe([str])},
    **{"task": {"opened": _NUMBER, "held": _NUMBER, "control": _NUMBER, "steps": int}, "scene": str},
    **{"effects": [str], "versions": dict, "device": str},
    "history": [
        {"step": int, **dict.fromkeys(("seconds", "rate", "reward", "success"), _NUMBER), "of": Maybe(_NUMBER)}
    ],
}
_MAYBE = (int, float, type(None))
_SPREAD = {"mean": _MAYBE, "std": _MAYBE, "all": [_NUMBER]}
_TRIALS = {
    **{"trials": int, "success_rate": _NUMBER, "interval_95": [_NUMBER], "success": [bool], "stopped": {str: int}},
    **{"angle_deg": _SPREAD, "steps": _SPREAD, "grip": {"mean": _NUMBER}, "stopped_each": Maybe([str])},
}
_HIDDEN = {"name": str, "amplitude": _NUMBER, "joint": Maybe((str, type(None))), "unit": Maybe(str)}
_TRANSFER = {
    **{"simulation": _TRIALS, "synthetic_robot": _TRIALS, "robot": {"hidden": [_HIDDEN]}},
    **{"no_films": Maybe(str), "setup": Maybe(dict)},
}


@dataclass(frozen=True)
class Trained:
    """What a folder of `train` holds.

    training: training.json.  transfer: transfer.json, None before `evaluate`.  films: by name, "good" and "bad".
    """

    folder: Path
    training: Mapping[str, Any]
    transfer: Mapping[str, Any] | None
    films: Mapping[str, Path]

    @property
    def trials(self) -> dict[str, Mapping[str, Any]]:
        """Where the policy was tried -> what came of it; `counted` and `angles` without trials that blew up."""
        if self.transfer is None:
            return {}
        places = {"simulation": "simulation", "synthetic robot": "synthetic_robot"}
        return {where: _without_blown_up(self.transfer[name]) for where, name in places.items()}

    @property
    def no_films(self) -> str:
        """Why there are no films of the trials."""
        why = (self.transfer or {}).get("no_films") or "none are there"
        return f"No films: {why}."


def _without_blown_up(found: Mapping[str, Any]) -> dict[str, Any]:
    each = found.get("stopped_each", [""] * found["trials"])
    angles = [a for a, why in zip(found["angle_deg"]["all"], each, strict=True) if why != BLOWN_UP]
    return {**found, "counted": found["trials"] - found["stopped"].get(BLOWN_UP, 0), "angles": angles}


def _faults(trials: Mapping[str, Any]) -> Iterator[str]:
    """What the schema cannot say."""
    count = trials["trials"]
    for key, of in (("angle_deg", trials["angle_deg"]["all"]), ("success", trials["success"])):
        if len(of) != count:
            yield f"{key!r} tells of {len(of)} trials, 'trials' says {count}"
    if len(trials.get("stopped_each", [""] * count)) != count:
        yield f"'stopped_each' tells of {len(trials['stopped_each'])} trials, 'trials' says {count}"
    if len(trials["interval_95"]) != 2:
        yield f"'interval_95' must be two numbers, got {len(trials['interval_95'])}"


def has_policy(folder: Path) -> bool:
    """Whether a folder holds, or should hold, a trained policy."""
    return (folder / TRAINING).exists()


def read_training(folder: Path) -> Mapping[str, Any]:
    """training.json, checked; ValueError where it is missing or broken."""
    training = _READ.json(folder / TRAINING)
    _READ.check(training, _TRAINING, TRAINING)
    return training


def read_policy(folder: Path) -> Trained:
    """Load and check; ValueError names the file that is missing or broken."""
    training = read_training(folder)
    transfer = None
    if (folder / TRANSFER).is_file():
        read = Reader("evaluate")
        transfer = read.json(folder / TRANSFER)
        read.check(transfer, _TRANSFER, TRANSFER)
        for where in ("simulation", "synthetic_robot"):
            for fault in _faults(transfer[where]):
                raise read.fault(f"{TRANSFER}, {where!r}, {fault}")
    films = {path.stem: path for path in sorted((folder / FILMS).glob("*.webp"))}
    return Trained(folder, training, transfer, films)
