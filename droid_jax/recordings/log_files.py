"""Reads logs of any column names: chooses the reader of a file and the column map."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from droid_jax.arguments import path_of, shown
from droid_jax.errors import named, needs
from droid_jax.read_npz import NpzFile
from droid_jax.recordings.column_map import SUFFIX, ColumnMap, changed_map, layouts, read_map
from droid_jax.recordings.log_columns import INFO, LogColumns, width_of
from droid_jax.recordings.mapped_log import Opened, fits, read_logs, stamped
from droid_jax.recordings.recording import Phase, Recording
from droid_jax.recordings.units import with_torque_constants

TABLES = (".csv", ".tsv", ".csv.gz", ".tsv.gz")
PARQUET, HDF5, NPZ, TORCH = (".parquet",), (".h5", ".hdf5"), (".npz",), (".pt", ".pth")
SUFFIXES = (*TABLES, *PARQUET, *HDF5, *NPZ, *TORCH)


def is_dataset(path: Path) -> bool:
    """Whether a path is the folder of a LeRobot dataset; needs no optional package."""
    return path.is_dir() and (path / INFO).is_file()


def is_log(path: Path) -> bool:
    """Whether a path is a log that needs a column map: a file, a LeRobot dataset, or a folder of such files."""
    if path.is_dir():
        inside = (p.name for p in path.iterdir()) if not (path / "recording.json").exists() else ()
        return is_dataset(path) or any(name.endswith(SUFFIXES) for name in inside)
    return path.name.endswith(SUFFIXES) and not (path.suffix == ".npz" and _is_recording(path))


def _is_recording(path: Path) -> bool:
    """Whether an npz file is a recording of this or another version, or so damaged that it may be one."""
    try:
        with NpzFile(path) as file:
            recorded = any(name.endswith(".values") for name in file.names)
            return "format" in file or ("metadata" in file and (recorded or "command" in file))
    except (OSError, ValueError):
        return True


def read_log(
    paths: Sequence[str | Path],
    columns: ColumnMap | str | Path | None = None,
    *,
    episodes: Sequence[str | int] = (),
    channels: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    beside: Path | None = None,
    name: str | None = None,
    command_tolerance: float = 5e-3,
    phases: Sequence[Phase] = (),
    allow_jitter: bool = False,
    torque_constant: Sequence[float] = (),
    **changes: Any,
) -> tuple[Recording, ColumnMap, str]:
    """Logs, one per repeat, as a recording.

    Args:
        paths: files, or folders.
        columns: their map, its file, or the name of a layout.  By default a map in the folder `beside` whose columns
            the first log has, or the layout of the log's format.
        episodes: of a LeRobot dataset, their numbers; of an HDF5 file, the groups.  Each is one repeat.
        channels, units, changes: replace entries of the map, as in `changed_map`.
        beside: folder that is searched for maps of earlier logs.
        name: of the recording; the first log's by default.
        command_tolerance, phases, allow_jitter: as in `read_logs`.
        torque_constant: N m (N) per unit of the log.  Replaces the map's; torques without one are multiplied by it.

    Returns:
        The recording, the map it was read with, and where that map is from.

    Raises:
        FileNotFoundError: a log does not exist.
        ValueError: a log does not fit its map or makes no valid recording, or no map is given and none is known.
    """
    paths = [path_of(path, "the path of a log") for path in paths]
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"no log at {path}: there is no such file or folder")
    logs = [log for path in paths for log in _parts(path, episodes)]
    if columns is None:

        def changed(known: ColumnMap) -> ColumnMap:
            return changed_map(known, channels or {}, units or {}, torque_constant, **changes)

        found, origin = _known_map(logs[0], paths[0], beside, changed, (units or {}).get("angle"))
    elif isinstance(columns, ColumnMap):
        found, origin = columns, "the given map"
    else:
        found, origin = read_map(columns), str(columns)
    if found is None and not channels:
        raise ValueError(
            f"{paths[0]}: does not say what its columns are: give a map, --map FILE.toml, or --columns "
            f"position=... command=... time=... (docs/file-formats.md); it has: {_columns_of(paths[0], logs[0])}"
        )
    found = changed_map(found, channels or {}, units or {}, torque_constant, **changes)
    if not found.joints and (names := _named_joints(logs[0], found)):
        found = changed_map(found, {}, {}, joints=names)
    if is_dataset(paths[0]):
        _reader("lerobot").check_gripper(logs[0](None), found)
    recording = read_logs(
        logs,
        found,
        name=name or paths[0].name.partition(".")[0],
        command_tolerance=command_tolerance,
        phases=phases,
        allow_jitter=allow_jitter,
    )
    entry = found.channel("torque")
    if torque_constant and (entry is None or entry.torque_constant is None):  # otherwise it is applied with the map
        recording = with_torque_constants(recording, torque_constant)
    return recording, found, origin or "--columns"


def _known_map(
    log: Opened, path: Path, beside: Path | None, changed: Callable[[ColumnMap], ColumnMap], angle: str | None
) -> tuple[ColumnMap | None, str]:
    """A known map that fits a log, and where it is from; (None, "") where there is none.

    changed: applies the caller's changes; two maps that are equal after them count as one.  angle: unit of the angles,
    where the caller states it.
    """
    near = sorted(beside.glob(f"*{SUFFIX}")) if beside is not None and beside.is_dir() else []
    # Gains belong to one log.  Maps that hold some were written by hand or by an earlier version.
    maps = {file: msgspec.structs.replace(read_map(file), stiffness=[], damping=[]) for file in near}
    kept = {file: columns for file, columns in maps.items() if fits(log, columns)}
    if kept:
        newest = max(kept, key=lambda file: file.stat().st_mtime_ns)
        own = changed(kept[newest])
        other = next((file for file, another in kept.items() if not _alike(changed(another), own)), None)
        if other is not None:
            raise ValueError(f"{path}: {newest} and {other} both map its columns, and differ: choose with --map")
        return kept[newest], str(newest)
    if is_dataset(path):
        return _reader("lerobot").usual_map(log(None), angle), "its meta"
    for name in layouts():
        columns = read_map(name)
        # A layout without joints is compared by its columns only; the user has to name the joints.
        probe = columns if columns.joints else changed_map(columns, {}, {}, joints=_as_many(log, columns))
        if fits(log, probe):
            return columns, f"the layout {name!r}"
    return None, ""


def _alike(one: ColumnMap, other: ColumnMap) -> bool:
    """Whether two maps read the same numbers, possibly at different rates."""
    one, other = (msgspec.structs.replace(m, rate=None if stamped(m) else m.rate) for m in (one, other))
    return one == other


def _named_joints(log: Opened, columns: ColumnMap) -> tuple[str, ...]:
    """The joint names that a log states for the positions, velocities or torques of a map."""
    for key in ("position", "velocity", "torque"):
        if (entry := columns.channel(key)) is not None and isinstance(entry.columns, str):
            return log(entry.file).components.get(entry.columns, ())
    return ()


def _as_many(log: Opened, columns: ColumnMap) -> tuple[str, ...]:
    """Numbered names, as many as the layout's position column has numbers."""
    entry = columns.channel("position")
    width = 0 if entry is None else log(None).widths.get(str(entry.columns), 0)
    return tuple(str(i) for i in range(width))


def _columns_of(path: Path, log: Opened) -> str:
    if path.is_dir() and not is_dataset(path):
        return named(sorted(p.name for p in path.iterdir()))
    return named(name for name, width in log(None).widths.items() if width) or "no columns of numbers"


def _parts(path: Path, episodes: Sequence[str | int]) -> list[Opened]:
    """For each repeat at a path, the function that opens its files."""
    if is_dataset(path):
        numbers = [_number(path, e) for e in episodes] or [None]
        return [_once(partial(_dataset, path, number)) for number in numbers]
    if path.name.endswith(HDF5):
        reader = _reader("hdf5_file")
        found = reader.demonstrations(path)
        if not episodes and len(found) > 1:
            raise ValueError(
                f"{path}: holds {len(found)} demonstrations, which are repeats only if they all replay one "
                f"motion: choose with --episodes, e.g. --episodes {found[0]}"
            )
        chosen = [str(e) for e in episodes] or found or [None]
        return [_once(partial(_alone, path, partial(reader.open_hdf5, path, group))) for group in chosen]
    if episodes:
        raise ValueError(f"{path}: --episodes is for LeRobot datasets and HDF5 files")
    if path.is_dir():
        return [_once(partial(_inside, path))]
    return [_once(partial(_alone, path, partial(open_file, path)))]


def _once(opened: Opened) -> Opened:
    """The same function, which opens each file only once."""
    return lru_cache(maxsize=None)(opened)


def _number(path: Path, episode: str | int) -> int:
    try:
        return int(episode)
    except ValueError:
        raise ValueError(f"{path}: an episode of a LeRobot dataset is a number, got {shown(episode)}") from None


def _dataset(path: Path, episode: int | None = None, file: str | None = None) -> LogColumns:
    return _alone(path, partial(_reader("lerobot").open_dataset, path, episode), file)


def _alone(path: Path, opened: Callable[[], LogColumns], file: str | None = None) -> LogColumns:
    if file is not None:
        raise ValueError(
            f"{path}: the map names the file {shown(file)} of a folder: give the folder, not one of its files"
        )
    return opened()


def _inside(path: Path, file: str | None = None) -> LogColumns:
    """One file of a folder, by its name in the map (with `*`)."""
    have = sorted(p.name for p in path.iterdir())
    if file is None:
        raise ValueError(f"{path}: is a folder: give one of its files, or a map that names them (file = ...)")
    if "/" in file or "\\" in file:
        raise ValueError(f"{path}: file = {shown(file)} must be a name inside the folder")
    found = sorted(path.glob(file))
    if len(found) != 1:
        what = "several files" if found else "no file"
        raise ValueError(f"{path}: has {what} like {shown(file)}; it has: {named(have)}")
    return open_file(found[0])


def open_file(path: Path) -> LogColumns:
    """The columns of a file with one of SUFFIXES; ValueError for another suffix or a damaged file."""
    if path.name.endswith(TABLES):
        return _reader("table_file").open_csv(path)
    if path.name.endswith(PARQUET):
        return _reader("table_file").open_parquet(path)
    if path.name.endswith(HDF5):
        return _reader("hdf5_file").open_hdf5(path)
    if path.name.endswith(TORCH):
        return _reader("torch_file").open_torch(path)
    if path.name.endswith(NPZ):
        return open_npz(path)
    raise ValueError(f"{path}: no log that is read; supported are: {', '.join(SUFFIXES)}")


def open_npz(path: Path) -> LogColumns:
    """The arrays of any npz file; ValueError where it is damaged."""
    with NpzFile(path) as file:
        widths = {name: width_of(file.shape(name) or ()) for name in file.names}

    def read(name: str) -> np.ndarray:
        with NpzFile(path) as file:
            return file.array(name)

    return LogColumns(str(path), widths, read)


_NEEDS = {
    "table_file": ("tables (CSV, parquet) need", "polars"),
    "lerobot": ("LeRobot datasets need", "polars"),
    "hdf5_file": ("HDF5 files need", "h5py"),
}


def _reader(module: str) -> Any:
    """A reader module, imported on use; ValueError where its package is not installed."""
    if module in _NEEDS:
        what, package = _NEEDS[module]
        needs(what, "formats", package)
    return importlib.import_module(f"droid_jax.recordings.{module}")
