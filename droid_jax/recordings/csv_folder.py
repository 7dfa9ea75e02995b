"""A recording as a folder of CSV files, one per repeat of each channel, and a recording.json."""

from __future__ import annotations

import csv
import itertools
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from droid_jax.arguments import LONGEST_NAME, printable, shown
from droid_jax.errors import faults
from droid_jax.read_json import MOST_BYTES
from droid_jax.recordings.clocks import SLACK, check_clock, resample
from droid_jax.recordings.metadata import Metadata, metadata_from_json, metadata_to_json, recording_of
from droid_jax.recordings.recording import JITTER, Channel, Recording
from droid_jax.storage import check_size, new_folder, read_text, write_csv, write_text

MOST_TABLE = 256 * 2**20  # bytes of one CSV file: ten minutes of seven joints at 1 kHz have 80 MB
MOST_LINE = 2**16  # characters of one of its lines
MOST_COLUMNS = 1000


def check_folder(path: Path) -> None:
    """ValueError where a folder holds anything but a recording, which writing would delete."""
    if path.is_dir() and any(path.iterdir()):
        if not (path / "recording.json").exists():
            raise ValueError(f"{path}: exists and is not a recording's folder, it is not replaced")
        _only_a_recording(path)


def save_csv(recording: Recording, path: Path) -> None:
    """Write a valid recording; ValueError where the folder holds something else."""
    check_folder(path)
    with new_folder(path) as new:
        write_text(new / "recording.json", metadata_to_json(recording) + "\n")
        if recording.command_names:
            _write_table(new / "command.csv", recording.command_names, recording.time, recording.command)
        for key, c in recording.channels.items():
            for r in range(recording.repeats):
                values = np.where(c.mask[r], c.values[r], np.nan)
                _write_table(new / f"{key}_{r:02d}.csv", c.columns, c.time, values)


def _only_a_recording(path: Path) -> None:
    """ValueError where a folder holds more than the recording that its recording.json describes."""
    channels = "|".join(map(re.escape, _metadata(path).units))
    own = re.compile(rf"recording\.json|command\.csv|(?:{channels})_\d+\.csv")
    if strange := sorted(p.name for p in path.iterdir() if not own.fullmatch(p.name)):
        raise ValueError(
            f"{path}: holds {strange[0]} beside a recording, which would be lost: write to another folder, or move it"
        )


def _metadata(path: Path) -> Metadata:
    """The content of a folder's recording.json; ValueError says what is wrong with it."""
    file = path / "recording.json"
    text = read_text(file, most=MOST_BYTES)
    if not text.strip():
        raise ValueError(f"{file}: the file is empty")
    return metadata_from_json(text, str(file))


def _write_table(path: Path, columns: Sequence[str], time: np.ndarray, values: np.ndarray) -> None:
    """A header and one line per row; NaN becomes an empty cell.

    Numbers are written with the fewest digits that read back as the same float64.
    """
    rows = np.column_stack([time, values]).astype(np.float64).tolist()
    cells = [["" if cell != cell else cell for cell in row] for row in rows]
    write_csv(path, ["time", *columns], cells, line_end="\n")


@dataclass(frozen=True, eq=False)
class _Table:
    """One CSV file: time [T], values [T, C] with NaN for empty cells."""

    path: Path
    columns: tuple[str, ...]
    time: np.ndarray
    values: np.ndarray


def load_csv(path: Path, interpolate: bool, allow_jitter: bool) -> Recording:
    """The recording in a folder, not yet validated.

    Args:
        path: of the folder.
        interpolate: put repeats with different clocks on the first one's clock.
        allow_jitter: accept irregular clocks.

    Raises:
        ValueError: the message names the file and line that is wrong.
    """
    meta = _metadata(path)
    allow_jitter = allow_jitter or JITTER in meta.meta
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
    return recording_of(meta, path, time, command, names, channels)


def _read_repeats(path: Path, key: str, columns: tuple[str, ...], allow_jitter: bool) -> list[_Table]:
    """The tables of key_00.csv, key_01.csv, ... without a gap, all with the same columns."""
    matches = (re.fullmatch(rf"{re.escape(key)}_([0-9]+)\.csv", p.name) for p in sorted(path.iterdir()))
    files: dict[int, Path] = {}
    for match in filter(None, matches):
        if other := files.get(int(match[1])):
            raise ValueError(f"{path}: {other.name} and {match[0]} are both repeat {int(match[1])} of channel {key!r}")
        files[int(match[1])] = path / match[0]
    absent = next((i for i in range(len(files) or 1) if i not in files), None)
    if absent is not None:
        beyond = f"; {files[max(files)].name} is there" if files else ""
        raise ValueError(f"{path}: missing {key}_{absent:02d}.csv, repeat {absent} of channel {key!r}{beyond}")
    tables = []
    for i in range(len(files)):
        table = _read_table(files[i], columns, False, allow_jitter)
        columns = table.columns
        tables.append(table)
    return tables


def _read_table(path: Path, expected: Sequence[str], full: bool, allow_jitter: bool) -> _Table:
    """Reads one CSV file.

    expected: column names that must be there, in the order wanted; empty: those of the file.
    full:     an empty cell is an error (commands) rather than a missing measurement.
    """
    if check_size(path, MOST_TABLE) == 0:
        raise ValueError(f"{path}: the file is empty")
    numbers, lines = array("d"), array("q")
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(_lines(path, file))
        try:
            header = [cell.strip() for cell in next(reader, [])]
            order = _column_order(path, header, expected)
            for row in reader:
                if row:
                    numbers.extend(_numbers(path, reader.line_num, row, header, full))
                    lines.append(reader.line_num)
        except UnicodeDecodeError:
            raise ValueError(f"{path}: not a text file in UTF-8 near line {reader.line_num + 1}") from None
        except csv.Error as error:
            raise ValueError(f"{path}, line {reader.line_num}: {error}") from None
    if not lines:
        raise ValueError(f"{path}: empty, there is no row below the header")
    data = np.frombuffer(numbers, np.float64).reshape(len(lines), len(header))
    check_clock(data[:, 0], str(path), allow_jitter=allow_jitter, label=lambda i: f"line {lines[i]}")
    columns = tuple(header[i] for i in order)
    return _Table(path, columns, data[:, 0].copy(), np.ascontiguousarray(data[:, order]))


def _lines(path: Path, file: TextIO) -> Iterator[str]:
    """The lines of a table; ValueError for one longer than MOST_LINE characters."""
    for number in itertools.count(1):
        line = file.readline(MOST_LINE + 1)
        if len(line) > MOST_LINE:
            raise ValueError(f"{path}, line {number}: is longer than {MOST_LINE} characters")
        if "\0" in line:
            raise ValueError(f"{path}, line {number}: holds a zero byte, which no table has")
        if not line:
            return
        yield line


def _column_order(path: Path, header: list[str], expected: Sequence[str]) -> list[int]:
    """Where the wanted columns stand in the file."""
    first = header[0] if header else "an empty line"
    if first != "time":
        raise ValueError(f"{path}, line 1: the first column must be 'time' (comma separated), got {shown(first)}")
    names = header[1:]
    if len(names) > MOST_COLUMNS:
        raise ValueError(f"{path}, line 1: has {len(names)} columns beside 'time', at most {MOST_COLUMNS} are read")
    for column in names:
        printable(column, f"{path}, line 1: the column name")
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice or not names or "" in names:
        what = f"repeated: {', '.join(twice)}" if twice else f"got {names}"
        raise ValueError(f"{path}, line 1: expected one named column per joint beside 'time', {what[:LONGEST_NAME]}")
    wanted = list(expected) or names
    missing, unknown = [n for n in wanted if n not in names], [n for n in names if n not in wanted]
    if wrong := faults({"missing:": missing, "unknown:": unknown}):
        raise ValueError(f"{path}, line 1: expected {len(wanted)} joint columns, got {len(names)}; {wrong}")
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
            number = None
        if number is None or "_" in cell:  # Python reads 1_000 as a thousand, a table does not
            raise ValueError(f"{path}, line {line}, column {column!r}: {shown(cell)} is not a number")
        if blank and (full or column == "time"):
            raise ValueError(f"{path}, line {line}, column {column!r}: expected a number, the cell is empty")
        if not blank and not np.isfinite(number):
            raise ValueError(
                f"{path}, line {line}, column {column!r}: {shown(cell)} is not a finite number"
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
        elif np.abs(table.time - first.time).max() > SLACK:
            row = int(np.argmax(np.abs(table.time - first.time) > SLACK))
            what = f"{table.time[row]!s} s in data row {row} where {first.path.name} has {first.time[row]!s} s"
        else:
            continue
        if not interpolate:
            raise ValueError(
                f"{table.path}: repeat {i} has another clock than repeat 0, {what}; "
                "--resample of `convert` interpolates it (load_recording(..., resample=True))"
            )
        return False
    return True
