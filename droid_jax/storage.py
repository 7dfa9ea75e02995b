"""Writing files and folders whole or not at all; reading text.

What is written stands beside its final name first and is then moved there: a reader sees the old
content or the new one, and a run that is killed or finds the disk full leaves the old one behind.
Folders alone have an instant between the two: a run killed then leaves old and new beside the name,
in a folder that begins with a dot and it.
Folders that are missing are made.  OSError where a place cannot be written.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import math
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any


def write_bytes(path: Path, content: bytes) -> None:
    """A file of these bytes; an existing one is replaced, and who may read it stays as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as file:  # not mkstemp: that keeps others out, whatever the umask says
            file.write(content)
        if path.exists():
            temporary.chmod(stat.S_IMODE(path.stat().st_mode))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """A text file in UTF-8, its line ends as they are in `text`."""
    write_bytes(path, text.encode("utf-8"))


def check_size(path: Path, most: int) -> int:
    """Bytes of a regular file; ValueError for a folder, a device or a pipe, and for more than `most`."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"{path}: is no regular file")
    if found.st_size > most:
        raise ValueError(f"{path}: has {found.st_size / 2**20:.0f} MiB, at most {most / 2**20:.0f} are read")
    return found.st_size


def read_text(path: Path, most: int = 64 * 2**20) -> str:
    """A text file in UTF-8, with or without a byte order mark.

    ValueError names the one that is not, is no regular file, or has more bytes than `most`.
    """
    check_size(path, most)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file in UTF-8, byte {error.start} cannot be read") from None


def write_json(path: Path, content: Any, *, indent: int = 1) -> None:
    """A JSON file; ValueError for NaN and infinities, which JSON has no word for."""
    write_text(path, json.dumps(content, indent=indent, allow_nan=False) + "\n")


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, 64 hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def finite(number: float) -> float | None:
    """The number, or None for NaN and infinities: what `write_json` takes."""
    return float(number) if math.isfinite(number) else None


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """A compressed npz file of these arrays by name; ValueError for objects, which would be pickled."""
    import numpy as np  # only here: droid_jax.runtime imports this module, and `--help` waits for that

    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def write_csv(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]], *, line_end: str = "\r\n") -> None:
    """A table of one header line and these rows; a float has as many digits as it takes to read it back."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator=line_end)
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, buffer.getvalue())


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """An empty folder to fill, which takes the place of `path` when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        new = temporary / "new"
        new.mkdir()
        yield new
        # A folder cannot be replaced in one step: the old one steps aside first, and for an instant there is none.
        if path.exists():
            os.replace(path, temporary / "old")
        os.replace(new, path)
    finally:
        if (temporary / "old").exists() and not path.exists():
            os.replace(temporary / "old", path)
        shutil.rmtree(temporary)
