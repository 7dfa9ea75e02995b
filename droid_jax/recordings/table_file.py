"""Tables, CSV or parquet, as columns; read with polars.

A cell may hold a list: as a list of parquet, or as the text "[0.1, 0.2]" of CSV.  Dates become nanoseconds.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import polars as pl

from droid_jax.arguments import shown
from droid_jax.recordings.log_columns import LogColumns, readable
from droid_jax.storage import check_size

MOST_BYTES = 2**31  # of a table: ten minutes of fourteen columns at 1 kHz have 150 MB
SAMPLE = 10_000  # rows that tell the types of columns
SEPARATORS = (",", ";", "\t")
_LIST_SIGNS = r"[\[\]()]"


def open_csv(path: Path) -> LogColumns:
    """The columns of a CSV file, also with gzip; the separator is a comma, a semicolon or a tab.

    Raises:
        ValueError: it is no such table.
    """
    if check_size(path, MOST_BYTES) == 0:
        raise ValueError(f"{path}: the file is empty")
    with readable(path, "table"):
        try:
            frame = _read(path, SAMPLE)
        except pl.exceptions.ComputeError:  # a type that changes further down: all rows are looked at
            frame = _read(path, None)
        # A space behind the separator makes texts of numbers.
        names = [name.strip() for name in frame.columns]
        if len(set(names)) < len(names) or "" in names:
            raise ValueError(f"{path}, line 1: expected a header of different names, got {shown(names, 200)}")
        frame.columns = names
        return _columns(str(path), frame)


def _read(path: Path, sample: int | None) -> pl.DataFrame:
    """The table, its types as `sample` rows have them; None: as all have."""
    return pl.read_csv(path, separator=_separator(path), infer_schema_length=sample, comment_prefix="#")


def open_parquet(path: Path) -> LogColumns:
    """The columns of a parquet file; ValueError where it is none."""
    if check_size(path, MOST_BYTES) == 0:
        raise ValueError(f"{path}: the file is empty")
    return scan_parquet(str(path), pl.scan_parquet(path))


def scan_parquet(where: str, rows: pl.LazyFrame) -> LogColumns:
    """The columns of some rows of parquet files, each read when it is asked for; where: begins messages."""
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
    """Of a column of dates, times or durations, which polars stores in days, milliseconds or finer."""
    if isinstance(column.dtype, pl.Duration):
        return column.dt.total_nanoseconds()
    return column.dt.epoch("ns") if isinstance(column.dtype, pl.Datetime | pl.Date) else column.cast(pl.Int64)


def _separator(path: Path) -> str:
    """The one of SEPARATORS that stands most often in the header."""
    with path.open("rb") as file:
        zipped = file.read(2) == b"\x1f\x8b"
    with gzip.open(path) if zipped else path.open("rb") as file:
        header = b""
        for _ in range(1000):  # lines of comments in front of the header
            header = file.readline(2**16)
            if not header.startswith(b"#"):
                break
    # Commas inside of a list are none between columns; a header has no lists.
    text = header.decode("utf-8-sig", errors="replace")
    return max(SEPARATORS, key=text.count)


def _numeric(kind: pl.DataType) -> bool:
    inner = getattr(kind, "inner", None)
    return kind.is_numeric() or kind.is_temporal() or kind == pl.Boolean or (inner is not None and _numeric(inner))


def _width(column: pl.Series) -> int:
    """Numbers in a row of a column, 0 where it holds none."""
    known = column.drop_nulls()
    if column.dtype == pl.String:
        return _text_width(known[0]) if len(known) else 0
    if column.dtype == pl.Null:
        return 1  # of a CSV file, nothing but empty cells
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
    """[T] or [T, W]; missing cells are NaN."""
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
    """[T, W] of lists of one length; a row that is missing is NaN."""
    lengths = column.list.len()
    width = int(lengths.max() or 0)  # type: ignore[arg-type]
    odd = (lengths != width).fill_null(False).arg_max() if width else None
    if odd is not None and lengths[odd] not in (None, width):
        raise ValueError(f"{where}, row {odd}: expected {width} numbers, as in others, got {lengths[odd]}")
    out = np.full((len(column), width), np.nan)
    rows = (~lengths.is_null()).to_numpy()
    out[rows] = column.drop_nulls().explode().fill_null(np.nan).to_numpy().reshape(-1, width)
    return out[:, 0] if width == 1 else out
