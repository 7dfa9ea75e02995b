"""Relations between the folders of runs: options of a run, whether it is complete, which fit a policy used.

Imports little, because commands call it before they import anything that takes time.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, TypedDict

from droid_jax.files import EXTENDED, FULL_GAUSSIAN, GAP, GAUSSIAN, LAST_FILES, SETUP, TO_BE_MADE
from droid_jax.read_json import read_json, typed

_MEND = "start the run of this folder over with --again"


class Robot(TypedDict, total=False):
    """Description of the synthetic robot that was recorded."""

    springs: int
    seed: int
    hide: list[str]


class Setup(TypedDict, total=False):
    """The entries of setup.json that other commands read; the file holds all options of its command."""

    command: str
    preset: str
    recording: list[str]
    scene: str | None
    extended: str | None
    effects: list[str]
    user_effects: str | None
    fit: str | None
    fit_sha256: str | None
    scene_sha256: str
    recordings_sha256: list[str]
    synthetic_robot: bool | dict[str, Any]
    robot: Robot
    springs: int | None
    seed: int
    hide: list[str] | None
    generations: int | None
    versions: dict[str, str]


class Description(TypedDict, total=False):
    """The entries of config.json or gap.json that other commands read."""

    synthetic_robot: bool
    robot: Robot
    setup: Setup
    amendments: dict[str, str]


def setup(folder: Path) -> dict[str, Any]:
    """setup.json of a run's folder, empty where there is none; ValueError for a damaged file."""
    return _read(folder / SETUP, Setup)


def described_in(path: Path) -> dict[str, Any]:
    """Content of a config.json or gap.json, empty where there is none; ValueError for a damaged file."""
    return _read(path, Description)


def _read(path: Path, kind: type) -> dict[str, Any]:
    try:
        content = read_json(path)
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except ValueError as error:
        raise ValueError(f"{error}; {_MEND}") from None
    try:
        typed(content, kind, str(path))
    except ValueError as error:
        raise ValueError(f"{error}; {_MEND}") from None
    return content


def unfinished(folder: Path) -> bool:
    """Whether a run began in a folder and is not complete; other files there may be of an earlier run."""
    return bool(setup(folder)) and not any((folder / last).is_file() for last in LAST_FILES.values())


def to_be_amended(folder: Path) -> bool:
    """Whether a search was stopped after its verdict, so that the same command still has additions to make."""
    states = described_in(folder / GAP).get("amendments")
    return isinstance(states, dict) and TO_BE_MADE in states.values()


def needs_whole(folder: Path) -> None:
    """ValueError for a folder whose run is not complete."""
    if unfinished(folder):
        raise ValueError(f"{folder} holds a run that is not complete: run its command again, which continues it")


def extended_of(folder: Path) -> Path | None:
    """The extended model that a run's Gaussian belongs to: the one it wrote, or the one it was given."""
    given = setup(folder).get("extended")
    return folder / EXTENDED if (folder / EXTENDED).is_file() else Path(given) if given else None


def gaussian_of(folder: Path) -> Path:
    """File of the Gaussian to train on: the one with nuisances, where the fit had any."""
    full = folder / FULL_GAUSSIAN
    return full if full.is_file() else folder / GAUSSIAN


def fingerprint(folder: Path | None) -> str | None:
    """Hash of the model that a policy is trained on; None for the prior."""
    return None if folder is None else _hash_with(gaussian_of(folder), folder)


def _hash_with(gaussian: Path, folder: Path) -> str:
    files = [gaussian, extended_of(folder)]
    return hashlib.sha256(b"".join(f.read_bytes() for f in files if f is not None and f.is_file())).hexdigest()


def left_over(whole: Path) -> frozenset[str]:
    """Stages in a folder of `all` that belong to an earlier run.

    These are a search in other recordings or another scene than the fit's, and a policy of another fit than the
    folder's.
    """
    fit, gap, train = (setup(whole / stage) for stage in LAST_FILES)
    out = set[str]()
    if fit and gap and _apart(fit, gap):
        out.add("gap")
    trained_on = Path(train.get("fit") or "").name
    if trained_on in ("identify", "gap"):
        folder, known = whole / trained_on, train.get("fit_sha256")
        # Policies of earlier versions were trained without the nuisances.
        stale = trained_on in out or known not in (fingerprint(folder), _hash_with(folder / GAUSSIAN, folder))
        out |= {"train"} if stale else set()
    return frozenset(out)


def _apart(fit: dict[str, Any], gap: dict[str, Any]) -> bool:
    """Whether search and fit used other recordings or scenes; the scene may differ by its time step between presets."""
    recorded, searched = (of.get("recordings_sha256") for of in (fit, gap))
    if recorded is None or searched is None:
        return False
    same_scene = fit.get("preset") != gap.get("preset") or fit.get("scene_sha256") == gap.get("scene_sha256")
    return searched[: len(recorded)] != recorded or not same_scene
