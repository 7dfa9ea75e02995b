"""Recordings on disk: one npz file, or a folder of CSV files that any spreadsheet opens.

`load_recording` also reads ROS bags, through `rosbag.py`, and logs of any column names, through `log_files.py`; the
packages that these need are imported only then.  docs/file-formats.md describes the layouts.  The two formats that are
written keep every number exactly: a recording that was saved and loaded has the same `sha256`.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from droid_jax.arguments import flag, path_of
from droid_jax.errors import needs
from droid_jax.recordings import log_files
from droid_jax.recordings.checks import accept, validate
from droid_jax.recordings.csv_folder import check_folder, load_csv, save_csv
from droid_jax.recordings.npz_file import is_npz, load_npz, save_npz
from droid_jax.recordings.recording import Recording
from droid_jax.storage import refuse_foreign, refuse_special

SUPPORTED = (
    ".npz, a folder with recording.json and CSV files, a ROS 1 .bag, a ROS 2 .mcap or .db3, "
    "a ROS 2 bag folder with metadata.yaml, a folder of such bags, one per repeat, and with a column map .csv, .tsv, "
    ".parquet, .h5, .hdf5, .pt, other .npz and LeRobot datasets"
)
_BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def load_recording(
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    resample: bool = False,
    allow_jitter: bool = False,
    **options: Any,
) -> Recording:
    """Read a recording from an npz file, a CSV folder, ROS bags or a log with a column map, and validate it.

    Args:
        path: of the file, or of the folder.
        name: replaces the stored name.
        resample: for CSV folders, interpolate repeats with different clocks onto the first's. Repeats of bags are
            always interpolated; those of an npz file share one clock.
        allow_jitter: accept irregular clocks, see `validate`. `meta` then says so, and the saved recording can be read
            without this option.
        options: for ROS bags those of `rosbag.read_bags`, of which `joints` and `torque` are required; for other logs
            (`log_files.is_log`) those of `log_files.read_log`: `columns`, `episodes`, ...

    Returns:
        The recording, valid.

    Raises:
        FileNotFoundError: there is no such path.
        ValueError: the file is not in its format (docs/file-formats.md) or the recording is not valid.
    """
    path = path_of(path, "the path of a recording")
    resample, allow_jitter = flag(resample, "resample"), flag(allow_jitter, "allow_jitter")
    if not path.exists():
        raise FileNotFoundError(f"no recording at {path}: there is no such file or folder")
    bags = bags_at(path)
    if bags:
        return _load_bags(bags, name, allow_jitter, options)
    if log_files.is_log(path):
        return log_files.read_log([path], name=name, allow_jitter=allow_jitter, **options)[0]
    if options:
        raise ValueError(f"{path}: is already a recording, for which there is no option {', '.join(sorted(options))}")
    if resample and path.suffix == ".npz" and not path.is_dir():
        raise ValueError(f"{path}: resample is for CSV folders; the repeats of an npz file share one clock already")
    if path.is_dir():
        if not (path / "recording.json").exists():
            raise ValueError(f"{path}: not a recording, the folder has no recording.json; {_supported()}")
        recording = load_csv(path, resample, allow_jitter)
    elif path.suffix == ".npz":
        recording = load_npz(path)
    else:
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; {_supported()}")
    if name is not None:
        recording = replace(recording, name=name)
    return accept(recording, str(path), allow_jitter)


def check_target(path: Path) -> None:
    """ValueError where `save_recording` would not write: another suffix, or an existing file that is no recording."""
    if path.suffix not in ("", ".npz"):
        raise ValueError(f"{path}: expected the suffix .npz or none (a CSV folder), got {path.suffix!r}")
    if path.suffix == ".npz":
        refuse_foreign(path, "a file", is_npz, "a recording")
    else:
        refuse_special(path, "a folder")
        check_folder(path)


def save_recording(recording: Recording, path: str | os.PathLike[str]) -> Path:
    """Write an npz file (suffix .npz) or a CSV folder (no suffix), atomically.

    An existing recording of that name is replaced.

    Args:
        recording: what is written, validated first.
        path: of the file, or of the folder.

    Returns:
        The path that was written.

    Raises:
        ValueError: the recording is not valid, the suffix is another one, or the path exists and is no recording.
        OSError: the path cannot be written.
    """
    path = path_of(path, "the path of a recording")
    check_target(path)
    # Irregular clocks were accepted, or refused, when the data were read.
    validate(recording, allow_jitter=True)
    if path.suffix == ".npz":
        save_npz(recording, path)
    else:
        save_csv(recording, path)
    return path


def _supported() -> str:
    return f"supported are: {SUPPORTED}"


def bags_at(path: Path) -> list[Path]:
    """The ROS bags at a path, one per repeat, run_2 before run_10; none when there are no bags.

    A folder with a recording.json is a recording, whatever other files it holds.
    """

    def is_bag(p: Path) -> bool:
        return (p / "metadata.yaml").exists() if p.is_dir() else p.suffix in _BAG_SUFFIXES

    def numbered(p: Path) -> list[str | int]:  # texts and numbers by turns
        return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", p.name)]

    if (path / "recording.json").exists():
        return []
    if is_bag(path):
        return [path]
    if path.is_dir():
        return sorted((p for p in path.iterdir() if is_bag(p)), key=numbered)
    return []


def rosbag_reader() -> ModuleType:
    """The module `droid_jax.recordings.rosbag`; ValueError where the packages it needs are not installed."""
    needs("ROS bags need", "ros", "rosbags")
    return importlib.import_module("droid_jax.recordings.rosbag")


def _load_bags(bags: list[Path], name: str | None, allow_jitter: bool, options: Mapping[str, Any]) -> Recording:
    missing = [key for key in ("joints", "torque") if key not in options]
    if missing:
        raise ValueError(
            f"{bags[0]}: a ROS bag does not say which joints to read or what its efforts are; "
            f"pass {' and '.join(missing)} as well"
        )
    return rosbag_reader().read_bags(bags, name=name, allow_jitter=allow_jitter, **options)
