"""Reads tables, CSV or parquet, as columns, with polars.

A cell may hold a list: in parquet as a list, in CSV as the text "[0.1, 0.2]".  Dates become nanoseconds.  CSV files may
be written by pandas, by numpy's savetxt, or by spreadsheets with decimal commas.
"""

from __future__ import annotations

import contextlib
import csv
import gzip
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from droid_jax.arguments import shown
from droid_jax.recordings.log_columns import LogColumns, readable
from droid_jax.storage import check_size

MOST_BYTES = 2**31  # of a table: ten minutes of fourteen columns at 1 kHz have 150 MB
ROWS_FOR_TYPES = 10_000  # first rows, from which the types of the columns are inferred
SEPARATORS = (",", ";", "\t")
_LIST_SIGNS = r"[\[\]()]"
# A number, with a decimal comma or without, or nan or inf.
_DECIMAL = r"^(?i:[+-]?(nan|inf)|[+-]?\d*,?\d+(e[+-]?\d+)?)$"


def open_csv(path: Path) -> LogColumns:
    """The columns of a CSV file, possibly with gzip; the separator is a comma, a semicolon or a tab.

    Columns without a name get the name that pandas gives them, "Unnamed: 0".

    Raises:
        ValueError: the file is not such a table.
    """
    if check_size(path, MOST_BYTES) == 0:
        raise ValueError(f"{path}: the file is empty")
    with readable(path, "table"):
        comments, header = _head(path)
        # Counted in the header, where commas cannot belong to a list.
        separator = max(SEPARATORS, key=header.count)
        options: dict[str, Any] = {"separator": separator}
        _check_names(header, separator, path)
        if names := _names_in_comments(comments, header, separator, path):
            options |= {"has_header": False, "new_columns": names}
        frame = _read(path, options)
        if separator != ",":
            frame = frame.with_columns(_with_points(column) for column in frame if _decimal_commas(column))
        # Names may begin with a space, where one follows the separator.
        names = [name.strip() or f"Unnamed: {i}" for i, name in enumerate(frame.columns)]
        frame.columns = names
        return _columns(str(path), frame)


def _check_names(header: str, separator: str, path: Path) -> None:
    """ValueError where two columns have one name, which polars would change: q1 to q1_duplicated_0."""
    names = [name.strip() for name in next(csv.reader([header], delimiter=separator), [])]
    if all(_text_width(name) for name in names):  # numbers: the names are in a comment
        return
    if twice := [name for name in dict.fromkeys(names) if name and names.count(name) > 1]:
        raise ValueError(
            f"{path}: expected a header of different names, but {shown(twice[0])} stands over {names.count(twice[0])} "
            f"columns of {shown(names, 200)}"
        )


def _read(path: Path, options: dict[str, Any]) -> pl.DataFrame:
    """The table; types of columns are inferred from its first rows or, where later rows differ, from all rows."""
    # The last attempt is for texts that look like dates but are not.
    for sample, dates in ((ROWS_FOR_TYPES, True), (None, True)):
        with contextlib.suppress(pl.exceptions.ComputeError):
            return _read_as(path, sample, dates, options)
    return _read_as(path, None, False, options)


def _read_as(path: Path, sample: int | None, dates: bool, options: dict[str, Any]) -> pl.DataFrame:
    return pl.read_csv(path, infer_schema_length=sample, comment_prefix="#", try_parse_dates=dates, **options)


def _decimal_commas(column: pl.Series) -> bool:
    """Whether all texts of a column are numbers, some of them with decimal commas."""
    if column.dtype != pl.String:
        return False
    known = column.drop_nulls().str.strip_chars()
    return bool(known.str.contains(",").any() and known.str.contains(_DECIMAL).all())


def _with_points(column: pl.Series) -> pl.Series:
    return column.str.strip_chars().str.replace(",", ".", literal=True).cast(pl.Float64)


def _names_in_comments(comments: Sequence[str], header: str, separator: str, path: Path) -> list[str]:
    """Names of the columns from a comment, as numpy's savetxt writes them; none where a header follows the comments.

    ValueError where there is no header and no comment has as many names as there are columns.
    """
    first = header.split(separator)
    if not all(_text_width(text) for text in first):
        return []
    for line in comments:  # the first one with as many words: a later one may hold the units
        if len(names := line.lstrip("# ").split(separator)) == len({*names}) == len(first):
            return names
    if first in ([str(i + begin) for i in range(len(first))] for begin in (0, 1)):  # a header that numbers the columns
        return []
    raise ValueError(
        f"{path}, line {len(comments) + 1}: expected the names of the columns, got numbers, {shown(header, 60)}; "
        "write a header above them"
    )


def open_parquet(path: Path) -> LogColumns:
    """The columns of a parquet file; ValueError where the file is not parquet."""
    if check_size(path, MOST_BYTES) == 0:
        raise ValueError(f"{path}: the file is empty")
    return scan_parquet(str(path), pl.scan_parquet(path))


def scan_parquet(where: str, rows: pl.LazyFrame) -> LogColumns:
    """The columns of rows from parquet files, each read when it is asked for; where: begins messages."""
    with readable(where, "table"):
        schema = rows.collect_schema()
        first = rows.select([name for name, kind in schema.items() if _numeric(kind)]).head(1).collect()

    def read(name: str) -> np.ndarray:
        with readable(where, "table"):
            return _array(rows.select(name).collect()[name], f"{where}, column {shown(name)}")

    widths = {name: _width(first[name]) if name in first.columns else 0 for name in schema}
    return LogColumns(where, widths, read, units=_units(schema))


def _columns(where: str, frame: pl.DataFrame) -> LogColumns:
    def read(name: str) -> np.ndarray:
        with readable(where, "table"):
            return _array(frame[name], f"{where}, column {shown(name)}")

    return LogColumns(where, {name: _width(frame[name]) for name in frame.columns}, read, units=_units(frame.schema))


def _units(schema: pl.Schema) -> dict[str, str]:
    return {name: "ns" for name, kind in schema.items() if kind.is_temporal()}


def _nanoseconds(column: pl.Series) -> pl.Series:
    """Nanoseconds of a column of dates, times or durations, which polars stores in days or finer units."""
    if isinstance(column.dtype, pl.Duration):
        return column.dt.total_nanoseconds()
    return column.dt.epoch("ns") if isinstance(column.dtype, pl.Datetime | pl.Date) else column.cast(pl.Int64)


def _head(path: Path) -> tuple[list[str], str]:
    """The comments in front of the header, and the header."""
    with path.open("rb") as file:
        zipped = file.read(2) == b"\x1f\x8b"
    with gzip.open(path) if zipped else path.open("rb") as file:
        lines: list[str] = []
        while not lines or (lines[-1].startswith("#") and len(lines) < 1000):
            lines.append(file.readline(2**16).decode("utf-8-sig", errors="replace").rstrip("\r\n"))
    return lines[:-1], lines[-1]


def _numeric(kind: pl.DataType) -> bool:
    inner = getattr(kind, "inner", None)
    return kind.is_numeric() or kind.is_temporal() or kind == pl.Boolean or (inner is not None and _numeric(inner))


def _width(column: pl.Series) -> int:
    """Numbers in a row of a column; 0 for a column without numbers."""
    known = column.drop_nulls()
    if column.dtype == pl.String:
        return _text_width(known[0]) if len(known) else 0
    if column.dtype == pl.Null:
        return 1  # a column of a CSV file whose cells are all empty
    if not _numeric(column.dtype):
        return 0
    if isinstance(column.dtype, pl.List | pl.Array):
        return int(np.size(known[0].to_numpy())) if len(known) else 0
    return 1


def _text_width(text: str) -> int:
    """Numbers in the text of a cell: "[0.1, 0.2]" has two, " 0.1" one, "STATE" none."""
    words = text.strip().strip("[]()").replace(",", " ").split()
    try:
        return len([float(word) for word in words])
    except ValueError:
        return 0


def _array(column: pl.Series, where: str) -> np.ndarray:
    """Numbers of a column, [T] or [T, W]; missing cells are NaN."""
    if column.dtype == pl.String:
        column = (
            column.str.replace_all(_LIST_SIGNS, " ").str.strip_chars().str.replace_all(r"[\s,]+", " ").str.split(" ")
        ).list.eval(pl.element().cast(pl.Float64, strict=True))
    if isinstance(column.dtype, pl.List | pl.Array):
        return _vectors(column.cast(pl.List(pl.Float64)), where)
    if column.dtype.is_temporal():
        column = _nanoseconds(column)
    if column.dtype == pl.Null or column.null_count():
        column = column.cast(pl.Float64).fill_null(np.nan)
    return column.to_numpy()


def _vectors(column: pl.Series, where: str) -> np.ndarray:
    """Numbers [T, W] of a column of lists of equal length; a missing row is NaN."""
    lengths = column.list.len()
    width = int(lengths.max() or 0)  # type: ignore[arg-type]
    odd = (lengths != width).fill_null(False).arg_max() if width else None
    if odd is not None and lengths[odd] not in (None, width):
        raise ValueError(f"{where}, row {odd}: expected {width} numbers, as in other rows, got {lengths[odd]}")
    out = np.full((len(column), width), np.nan)
    rows = (~lengths.is_null()).to_numpy()
    out[rows] = column.drop_nulls().explode().fill_null(np.nan).to_numpy().reshape(-1, width)
    return out[:, 0] if width == 1 else out
