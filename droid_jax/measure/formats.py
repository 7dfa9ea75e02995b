"""Recordings on disk: one npz file, or a folder of CSV files that any spreadsheet opens.

`load` also reads ROS bags, through `rosbag.py`, which is imported only then.  The layouts are
described in docs/file-formats.md.  Both formats keep every number exactly: a recording that
was saved and loaded has the same `sha256`.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.measure.recording import (
    Channel,
    ObjectPose,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
    TorqueSide,
    check_clock,
    validate,
)

FORMAT = "droid_jax recording 1"
SUPPORTED = (
    ".npz, a folder with recording.json and CSV files, a ROS 1 .bag, a ROS 2 .mcap or .db3, "
    "a ROS 2 bag folder with metadata.yaml, or a folder of such bags, one per repeat"
)
_BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_SAME_CLOCK = 1e-6  # s, repeats whose clocks differ by less share one


def load(
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    resample: bool = False,
    allow_jitter: bool = False,
    **bag_options: Any,
) -> Recording:
    """Reads a recording from an npz file, a CSV folder or ROS bags, and validates it.

    name:         replaces the stored name.
    resample:     CSV only: repeats with clocks of their own are interpolated onto the first's.
    allow_jitter: accept irregular clocks, see `validate`.
    bag_options:  passed to `rosbag.read_bags`; `joints` and `torque` are required for bags.

    Raises FileNotFoundError when there is no such path, ValueError for everything in the
    file that is not as it should be.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no recording at {path}: there is no such file or folder")
    bags = _bags(path)
    if bags:
        return _load_bags(bags, name, allow_jitter, bag_options)
    if bag_options:
        raise ValueError(f"{path}: not a ROS bag, it takes no option {', '.join(sorted(bag_options))}")
    if path.is_dir():
        if not (path / "recording.json").exists():
            raise ValueError(f"{path}: not a recording, the folder has no recording.json; {_supported()}")
        recording = _load_csv(path, resample, allow_jitter)
    elif path.suffix == ".npz":
        recording = _load_npz(path)
    else:
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; {_supported()}")
    if name is not None:
        recording = replace(recording, name=name)
    return validate(recording, source=str(path), allow_jitter=allow_jitter)


def save(recording: Recording, path: str | os.PathLike[str]) -> Path:
    """Writes an npz file (suffix .npz) or a CSV folder (no suffix), atomically; returns its path.

    An existing recording of that name is replaced.  Raises ValueError when the recording is
    not valid, the suffix is another one, or the folder holds something else.
    """
    path = Path(path)
    if path.suffix not in ("", ".npz"):
        raise ValueError(f"{path}: expected the suffix .npz or none (a CSV folder), got {path.suffix!r}")
    # Irregular clocks were a question when the data came in; here they are only kept.
    validate(recording, allow_jitter=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npz":
        _save_npz(recording, path)
    else:
        _save_csv(recording, path)
    return path


def _supported() -> str:
    return f"supported are: {SUPPORTED}"


# Metadata ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Meta:
    """What both formats store beside the arrays of command and channels."""

    name: str
    commands: bool
    command_names: tuple[str, ...]
    units: dict[str, str]
    columns: dict[str, tuple[str, ...]]
    torque: TorqueConvention
    qpos0: dict[str, float]
    gains: ServoGains | None
    phases: tuple[Phase, ...]
    object_pose: ObjectPose | None
    meta: dict[str, str]


_VALID = {  # kind of JSON object -> keys it may have; those it must have
    "recording": (
        (
            *("format", "name", "commands", "command_names", "channels", "torque"),
            *("qpos0", "gains", "phases", "object_pose", "meta"),
        ),
        ("channels", "torque"),
    ),
    "torque": (("side", "gravity"),) * 2,
    "gains": (("stiffness", "damping"),) * 2,
    "object_pose": (("position", "quaternion", "covariance"),) * 2,
    "phase": (("name", "start", "end"),) * 2,
    "channel": (("unit", "columns"), ("unit",)),
}


def _meta_to_json(recording: Recording) -> str:
    gains, pose = recording.gains, recording.object_pose
    meta: dict[str, Any] = {
        "format": FORMAT,
        "name": recording.name,
        "commands": bool(recording.command_names),
        "command_names": list(recording.command_names),
        "torque": {"side": recording.torque.side.value, "gravity": bool(recording.torque.gravity)},
        "channels": {k: {"unit": c.unit, "columns": list(c.columns)} for k, c in recording.channels.items()},
        "qpos0": {joint: float(q) for joint, q in recording.qpos0.items()},
        "phases": [{"name": p.name, "start": float(p.start), "end": float(p.end)} for p in recording.phases],
        "meta": dict(recording.meta),
    }
    if gains is not None:
        meta["gains"] = {"stiffness": _floats(gains.stiffness), "damping": _floats(gains.damping)}
    if pose is not None:
        meta["object_pose"] = {
            "position": _floats(pose.position),
            "quaternion": _floats(pose.quaternion),
            "covariance": _floats(pose.covariance),
        }
    return json.dumps(meta, indent=2, allow_nan=False)


def _floats(array: np.ndarray) -> list[Any]:
    return array.astype(np.float64).tolist()


def _meta_from_json(text: str, where: str) -> _Meta:
    """The metadata; ValueError names the key that is unknown, missing or of the wrong kind."""
    try:
        raw = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{where}: not valid JSON, line {error.lineno}: {error.msg}") from None
    raw = _keys(raw, "recording", where)
    if raw.get("format", FORMAT) != FORMAT:
        raise ValueError(f"{where}: expected format {FORMAT!r}, got {raw['format']!r}")
    commands = raw.get("commands", True)
    if not isinstance(commands, bool):
        raise ValueError(f"{where}: 'commands' must be true or false, got {commands!r}")
    channels = {k: _keys(c, "channel", f"{where}, channel {k!r}") for k, c in _object(raw, "channels", where)}
    return _Meta(
        name=str(raw.get("name", "")),
        commands=commands,
        command_names=_names(raw.get("command_names", []), f"{where}, command_names"),
        units={k: str(c["unit"]) for k, c in channels.items()},
        columns={k: _names(c.get("columns", []), f"{where}, channel {k!r}") for k, c in channels.items()},
        torque=_torque(_keys(raw["torque"], "torque", f"{where}, torque"), where),
        qpos0={joint: _float(q, f"{where}, qpos0, joint {joint!r}") for joint, q in _object(raw, "qpos0", where)},
        gains=_arrays(raw, "gains", ServoGains, where),
        phases=_phases(raw.get("phases", []), f"{where}, phases"),
        object_pose=_arrays(raw, "object_pose", ObjectPose, where),
        meta={k: str(v) for k, v in _object(raw, "meta", where)},
    )


def _keys(raw: Any, kind: str, where: str) -> dict[str, Any]:
    """A JSON object with the keys of its kind, none unknown and none of the required missing."""
    valid, required = _VALID[kind]
    if not isinstance(raw, dict):
        raise ValueError(f"{where}: expected an object with {', '.join(valid)}, got {raw!r}")
    unknown = sorted(set(raw) - set(valid))
    missing = [key for key in required if key not in raw]
    if unknown or missing:
        raise ValueError(
            f"{where}: unknown keys: {', '.join(unknown) or 'none'}; missing keys: "
            f"{', '.join(missing) or 'none'}; valid keys: {', '.join(valid)}"
        )
    return raw


def _object(raw: Mapping[str, Any], key: str, where: str) -> list[tuple[str, Any]]:
    value = raw.get(key, {})
    if not isinstance(value, dict):
        raise ValueError(f"{where}: {key!r} must be an object, got {value!r}")
    return list(value.items())


def _names(raw: Any, where: str) -> tuple[str, ...]:
    if not isinstance(raw, list) or not all(isinstance(n, str) for n in raw):
        raise ValueError(f"{where}: expected a list of joint names, got {raw!r}")
    return tuple(raw)


def _float(raw: Any, where: str) -> float:
    if isinstance(raw, bool) or not isinstance(raw, (int, float)):
        raise ValueError(f"{where}: expected a number, got {raw!r}")
    return float(raw)


def _phases(raw: Any, where: str) -> tuple[Phase, ...]:
    if not isinstance(raw, list):
        raise ValueError(f"{where}: expected a list of objects with name, start and end, got {raw!r}")
    phases = [_keys(p, "phase", where) for p in raw]
    return tuple(Phase(str(p["name"]), _float(p["start"], where), _float(p["end"], where)) for p in phases)


def _torque(raw: Mapping[str, Any], where: str) -> TorqueConvention:
    sides = [side.value for side in TorqueSide]
    if raw["side"] not in sides:
        raise ValueError(f"{where}: torque side must be one of {', '.join(sides)}, got {raw['side']!r}")
    if not isinstance(raw["gravity"], bool):
        raise ValueError(f"{where}: torque gravity must be true or false, got {raw['gravity']!r}")
    return TorqueConvention(TorqueSide(raw["side"]), raw["gravity"])


def _arrays(raw: Mapping[str, Any], key: str, make: Any, where: str) -> Any:
    """ServoGains or ObjectPose from lists of numbers, or None where the key is not given."""
    if raw.get(key) is None:
        return None
    lists = _keys(raw[key], key, f"{where}, {key}")
    try:
        return make(**{k: np.array(v, dtype=np.float64) for k, v in lists.items()})
    except (TypeError, ValueError):
        raise ValueError(f"{where}, {key}: expected lists of numbers, got {lists}") from None


# npz ---------------------------------------------------------------------------------------


def _save_npz(recording: Recording, path: Path) -> None:
    arrays = {
        "format": np.array(FORMAT),
        "metadata": np.array(_meta_to_json(recording)),
        "time": recording.time,
        "command": recording.command,
    }
    for key, c in recording.channels.items():
        arrays |= {f"{key}.time": c.time, f"{key}.values": c.values, f"{key}.mask": c.mask}
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _load_npz(path: Path) -> Recording:
    arrays = _npz_arrays(path)
    if str(arrays.get("format")) != FORMAT:
        raise ValueError(f"{path}: expected the key 'format' with {FORMAT!r}, got {arrays.get('format')}")

    def take(key: str) -> np.ndarray:
        if key not in arrays:
            raise ValueError(f"{path}: missing array {key!r}; the file has: {', '.join(sorted(arrays))}")
        return arrays[key]

    meta = _meta_from_json(str(take("metadata")), f"{path}, metadata")
    channels = {}
    for key, unit in meta.units.items():
        values = take(f"{key}.values")
        mask = arrays.get(f"{key}.mask", np.ones(values.shape, dtype=bool))
        channels[key] = Channel(key, unit, meta.columns[key], take(f"{key}.time"), values, mask)
    return _recording(meta, path, take("time"), take("command"), meta.command_names, channels)


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """Every array of the file, read at once so that damage shows here."""
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: the file is empty")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not an npz file, or one that was cut off while it was written")
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise ValueError(f"{path}: damaged npz file: {error}") from None
        raise ValueError(
            f"{path}: holds pickled Python objects, which are not read; save plain numeric arrays"
        ) from None
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
        raise ValueError(f"{path}: damaged npz file: {error}") from None


def _recording(
    meta: _Meta,
    path: Path,
    time: np.ndarray,
    command: np.ndarray,
    command_names: tuple[str, ...],
    channels: dict[str, Channel],
) -> Recording:
    return Recording(
        name=meta.name or path.stem,
        time=time,
        command=command,
        command_names=command_names,
        channels=channels,
        torque=meta.torque,
        qpos0=meta.qpos0,
        gains=meta.gains,
        phases=meta.phases,
        object_pose=meta.object_pose,
        meta=meta.meta,
    )


# CSV ---------------------------------------------------------------------------------------


def _save_csv(recording: Recording, path: Path) -> None:
    if path.exists() and not (path / "recording.json").exists() and (path.is_file() or any(path.iterdir())):
        raise ValueError(f"{path}: exists and is not a recording's folder, it is not replaced")
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        new = temporary / "new"
        new.mkdir()
        (new / "recording.json").write_text(_meta_to_json(recording) + "\n", encoding="utf-8")
        if recording.command_names:
            _write_table(new / "command.csv", recording.command_names, recording.time, recording.command)
        for key, c in recording.channels.items():
            for r in range(recording.repeats):
                values = np.where(c.mask[r], c.values[r], np.nan)
                _write_table(new / f"{key}_{r:02d}.csv", c.columns, c.time, values)
        # A folder cannot be replaced in one step: the old one steps aside first.
        if path.exists():
            os.replace(path, temporary / "old")
        os.replace(new, path)
    finally:
        if (temporary / "old").exists() and not path.exists():
            os.replace(temporary / "old", path)
        shutil.rmtree(temporary)


def _write_table(path: Path, columns: Sequence[str], time: np.ndarray, values: np.ndarray) -> None:
    """A header and one line per row; NaN becomes an empty cell.

    Numbers are written with the fewest digits that read back as the same float64.
    """
    rows = np.column_stack([time, values]).astype(np.float64).tolist()
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", *columns])
        writer.writerows([["" if cell != cell else repr(cell) for cell in row] for row in rows])


@dataclass(frozen=True, eq=False)
class _Table:
    """One CSV file: time [T], values [T, C] with NaN for empty cells."""

    path: Path
    columns: tuple[str, ...]
    time: np.ndarray
    values: np.ndarray


def _load_csv(path: Path, interpolate: bool, allow_jitter: bool) -> Recording:
    meta = _meta_from_json(_text(path / "recording.json"), str(path / "recording.json"))
    time, command, names = np.zeros(0), np.zeros((0, 0)), ()
    if meta.commands:
        if not (path / "command.csv").exists():
            raise ValueError(
                f'{path}: missing command.csv; a log without commands says "commands": false in its recording.json'
            )
        table = _read_table(path / "command.csv", meta.command_names, True, allow_jitter)
        time, command, names = table.time, table.values, table.columns
    channels = {}
    for key, unit in meta.units.items():
        tables = _read_repeats(path, key, meta.columns[key], allow_jitter)
        times, values = [t.time for t in tables], [t.values for t in tables]
        clock, stacked = (times[0], np.stack(values)) if _same_clock(tables, interpolate) else resample(times, values)
        channels[key] = Channel(key, unit, tables[0].columns, clock, stacked, np.isfinite(stacked))
    return _recording(meta, path, time, command, names, channels)


def _text(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file in UTF-8, byte {error.start} cannot be read") from None
    if not text.strip():
        raise ValueError(f"{path}: the file is empty")
    return text


def _read_repeats(path: Path, key: str, columns: tuple[str, ...], allow_jitter: bool) -> list[_Table]:
    """The tables of key_00.csv, key_01.csv, ... without a gap, all with the same columns."""
    matches = (re.fullmatch(rf"{re.escape(key)}_(\d+)\.csv", p.name) for p in path.iterdir())
    files = {int(m[1]): path / m[0] for m in matches if m}
    missing = [i for i in range(max(files, default=0) + 1) if i not in files]
    if missing:
        raise ValueError(f"{path}: missing {key}_{missing[0]:02d}.csv, repeat {missing[0]} of channel {key!r}")
    tables = []
    for i in range(len(files)):
        table = _read_table(files[i], columns, False, allow_jitter)
        columns = table.columns
        tables.append(table)
    return tables


def _read_table(path: Path, expected: Sequence[str], full: bool, allow_jitter: bool) -> _Table:
    """Reads one CSV file.

    expected: column names that must be there, in the order wanted; empty takes the file's own.
    full:     an empty cell is an error (commands) rather than a missing measurement.
    """
    reader = csv.reader(_text(path).splitlines(keepends=True))
    try:
        header = [cell.strip() for cell in next(reader)]
        rows = [(reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        raise ValueError(f"{path}, line {reader.line_num}: {error}") from None
    order = _column_order(path, header, expected)
    if not rows:
        raise ValueError(f"{path}: empty, there is no row below the header")
    data = np.array([_numbers(path, line, row, header, full) for line, row in rows])
    lines = [line for line, _ in rows]
    check_clock(data[:, 0], str(path), allow_jitter=allow_jitter, label=lambda i: f"line {lines[i]}")
    columns = tuple(header[i] for i in order)
    return _Table(path, columns, data[:, 0], np.ascontiguousarray(data[:, order]))


def _column_order(path: Path, header: list[str], expected: Sequence[str]) -> list[int]:
    """Where the wanted columns stand in the file."""
    if header[0] != "time":
        raise ValueError(f"{path}, line 1: the first column must be 'time' (comma separated), got {header[0]!r}")
    names = header[1:]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice or not names or "" in names:
        what = f"repeated: {', '.join(twice)}" if twice else f"got {names}"
        raise ValueError(f"{path}, line 1: expected one named column per joint beside 'time', {what}")
    wanted = list(expected) or names
    missing, unknown = [n for n in wanted if n not in names], [n for n in names if n not in wanted]
    if missing or unknown:
        raise ValueError(
            f"{path}, line 1: expected {len(wanted)} joint columns, got {len(names)}; missing: "
            f"{', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}"
        )
    return [1 + names.index(n) for n in wanted]


def _numbers(path: Path, line: int, row: list[str], header: list[str], full: bool) -> list[float]:
    """The numbers of one row, NaN for an empty cell."""
    if len(row) != len(header):
        raise ValueError(f"{path}, line {line}: expected {len(header)} cells, got {len(row)}")
    numbers = []
    for cell, column in zip(row, header, strict=True):
        blank = not cell.strip()
        try:
            number = float("nan") if blank else float(cell)
        except ValueError:
            raise ValueError(f"{path}, line {line}, column {column!r}: {cell!r} is not a number") from None
        if blank and (full or column == "time"):
            raise ValueError(f"{path}, line {line}, column {column!r}: expected a number, the cell is empty")
        if not blank and not np.isfinite(number):
            raise ValueError(
                f"{path}, line {line}, column {column!r}: {cell!r} is not a finite number"
                + ("" if full else "; leave the cell empty where nothing was measured")
            )
        numbers.append(number)
    return numbers


def _same_clock(tables: Sequence[_Table], interpolate: bool) -> bool:
    """Whether all repeats share the first one's clock; ValueError if not and that is not allowed."""
    first = tables[0]
    for i, table in enumerate(tables[1:], start=1):
        if len(table.time) != len(first.time):
            what = f"{len(table.time)} rows where {first.path.name} has {len(first.time)}"
        elif np.abs(table.time - first.time).max() > _SAME_CLOCK:
            row = int(np.argmax(np.abs(table.time - first.time) > _SAME_CLOCK))
            what = f"{table.time[row]!s} s in data row {row} where {first.path.name} has {first.time[row]!s} s"
        else:
            continue
        if not interpolate:
            raise ValueError(
                f"{table.path}: repeat {i} has another clock than repeat 0, {what}; "
                "load with resample=True to interpolate it"
            )
        return False
    return True


def resample(
    times: Sequence[np.ndarray], values: Sequence[np.ndarray], clock: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Repeats with clocks of their own -> one clock [Tc] s and values [N, Tc, C].

    times:  N arrays [T_r] s;  values: N arrays [T_r, C], NaN where nothing was measured.
    clock:  where values are wanted, s; the first repeat's clock by default.

    The clock is cut to the part that all repeats cover; in between, values are interpolated
    linearly and are NaN where either neighbour is.  Raises ValueError when no part is common.
    """
    clock = times[0] if clock is None else clock
    first, last = max(float(t[0]) for t in times), min(float(t[-1]) for t in times)
    clock = clock[(clock >= first - _SAME_CLOCK) & (clock <= last + _SAME_CLOCK)]
    if not len(clock):
        spans = ", ".join(f"{t[0]:g} .. {t[-1]:g} s" for t in times)
        raise ValueError(f"the repeats cover no common part of the clock: {spans}")
    columns = [[np.interp(clock, t, v[:, c]) for c in range(v.shape[1])] for t, v in zip(times, values, strict=True)]
    return clock, np.stack([np.stack(repeat, axis=-1) for repeat in columns])


# ROS ---------------------------------------------------------------------------------------


def _bags(path: Path) -> list[Path]:
    """The ROS bags meant by a path, one per repeat; none when it is something else."""

    def is_bag(p: Path) -> bool:
        return (p / "metadata.yaml").exists() if p.is_dir() else p.suffix in _BAG_SUFFIXES

    if is_bag(path):
        return [path]
    if path.is_dir() and not (path / "recording.json").exists():
        return sorted(p for p in path.iterdir() if is_bag(p))
    return []


def _load_bags(bags: list[Path], name: str | None, allow_jitter: bool, options: Mapping[str, Any]) -> Recording:
    missing = [key for key in ("joints", "torque") if key not in options]
    if missing:
        raise ValueError(
            f"{bags[0]}: a ROS bag does not say which joints to read or what its efforts are; "
            f"pass {' and '.join(missing)} as well"
        )
    try:
        from droid_jax.measure.rosbag import read_bags
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != "rosbags":
            raise
        raise ImportError(
            f"{bags[0]}: reading ROS bags needs the package 'rosbags': pip install droid_jax[ros]"
        ) from None
    return read_bags(bags, name=name, allow_jitter=allow_jitter, **options)
