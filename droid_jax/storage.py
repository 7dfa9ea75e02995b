"""Writes files and folders atomically; reads text.

Content is first written under a temporary name beside its final one and then moved there.  A reader sees the old or the
new content, and a run that is killed or finds the disk full leaves the old one.  Replacing a folder takes two moves: a
run that is killed between them leaves the old and the new folder beside the name, in a folder whose name begins with a
dot.  Missing folders are made.  An OSError with the file's name is raised where a path cannot be written.

Only plain files and folders are replaced.  A device, a pipe, a socket, a symbolic link, or a folder in place of a file
is a ValueError.  Code that writes to a path given by the user also checks that existing content is this program's
(`refuse_foreign`, `write_own`).
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import enum
import hashlib
import io
import json
import math
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from droid_jax.console import at_the_end

WRITTEN = ".written.json"  # in a folder of `write_own`: SHA-256 of what was written there, by name
_KINDS = (
    (stat.S_ISLNK, "a symbolic link"),
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISREG, "a file"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def kind_of(path: Path) -> str:
    """Kind of a path: "a file", "a folder", "a device", ...; links are not followed; empty where none exists."""
    try:
        mode = os.lstat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return ""
    return next((name for test, name in _KINDS if test(mode)), "a special file")


def refuse_foreign(path: Path, wanted: str, own: Callable[[Path], bool], what: str) -> None:
    """ValueError where a path holds a file or folder that this program did not write.

    Args:
        path: where something is to be written.
        wanted: "a file" or "a folder".
        own: whether the file or folder there is one that this program wrote.
        what: what this program would write there, "a recording".
    """
    refuse_special(path, wanted)
    if kind_of(path) and not own(path):
        raise ValueError(f"{path} exists and is not {what}: it is not replaced; give another path, or move it away")


def refuse_special(path: Path, wanted: str) -> None:
    """ValueError where anything but "a file" or "a folder", whichever is wanted, stands at a path."""
    if (kind := kind_of(path)) and kind != wanted:
        raise ValueError(f"{path} is {kind}, where {wanted} is to be written: it is not replaced; give another path")


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of the file system name this path: those of a full disk name no file, others the temporary one."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file of these bytes; an existing one is replaced and its permissions are kept."""
    refuse_special(path, "a file")
    temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(4)}")
    with _named(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as file:  # not mkstemp, which ignores the umask and excludes other users
                file.write(content)
            with contextlib.suppress(FileNotFoundError):
                temporary.chmod(stat.S_IMODE(path.stat().st_mode))
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def write_own(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files of these contents in a folder that may hold files of others too.

    Args:
        folder: made where it is missing.
        files: content by name.

    Raises:
        ValueError: a file of one of these names was not written by an earlier call, or was changed since.
    """
    refuse_special(folder, "a folder")
    known = _written(folder)
    for name, content in files.items():
        refuse_special(folder / name, "a file")
        if (folder / name).exists() and file_sha256(folder / name) not in {*known.get(name, ()), _sha256(content)}:
            raise ValueError(
                f"{folder / name} was not written by this program, or was changed since: it is not replaced; give "
                "another folder (--out), or move it away"
            )
    # Written first, with the old hashes: after a stop in between, both old and new files are known as this program's.
    now = {name: sorted({*known.get(name, ()), _sha256(content)}) for name, content in files.items()}
    write_json(folder / WRITTEN, {**known, **now})
    for name, content in files.items():
        write_bytes(folder / name, content)


def remove_own(folder: Path) -> bool:
    """Remove the unchanged files of `write_own` from a folder that it wrote in, and the folder if nothing is left.

    Returns False, and removes nothing, if it has written nothing there.
    """
    if not (written := _written(folder)):
        return False
    for name, known in written.items():
        path = folder / name
        if path.is_file() and file_sha256(path) in known:
            path.unlink()
    if {path.name for path in folder.iterdir()} <= {WRITTEN}:
        (folder / WRITTEN).unlink(missing_ok=True)
        folder.rmdir()
    return True


def _written(folder: Path) -> dict[str, list[str]]:
    """SHA-256 of all contents that `write_own` wrote in the folder, by name; empty where there is no such file."""
    from droid_jax.read_json import read_json, typed  # only here: it imports this module

    try:
        return typed(read_json(folder / WRITTEN), dict[str, list[str]], WRITTEN)
    except (OSError, ValueError):
        return {}


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


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
    """Write a JSON file; ValueError for NaN and infinities, which JSON cannot express."""
    write_text(path, json.dumps(content, indent=indent, allow_nan=False) + "\n")


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, 64 hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def finite(number: float) -> float | None:
    """The number, or None for NaN and infinities, which `write_json` refuses."""
    return float(number) if math.isfinite(number) else None


def config_json(config: Any) -> dict[str, Any]:
    """Settings as plain data, to be stored in a result so that it can be reproduced.

    Args:
        config: a dataclass; its fields may be dataclasses, enumerations, mappings, sequences, numbers, texts or None.

    Returns:
        field -> value, nested as the dataclasses are; numbers that JSON has not as text ("inf").
    """
    return {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def _plain(value: Any) -> Any:
    """A setting's value as plain JSON data."""
    if dataclasses.is_dataclass(value):
        return config_json(value)
    if isinstance(value, enum.Enum):
        return _plain(value.value)
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """A compressed npz file of these arrays by name; ValueError for objects, which would be pickled."""
    write_bytes(path, npz_bytes(arrays))


def npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    """Content of an npz file: the same bytes for the same arrays."""
    import numpy as np  # only here: droid_jax.runtime imports this module, and `--help` waits for that

    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


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
    refuse_special(path, "a folder")
    with _named(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name[:100]}."))
    try:
        new = temporary / "new"
        new.mkdir()
        with at_the_end(lambda: shutil.rmtree(temporary, ignore_errors=True)):
            yield new
        refuse_special(path, "a folder")  # again, since filling it may have taken long
        with _named(path):
            # A folder cannot be replaced in one step: the old one is moved away first.
            if path.exists():
                os.replace(path, temporary / "old")
            os.replace(new, path)
    finally:
        if (temporary / "old").exists() and not path.exists():
            os.replace(temporary / "old", path)
        shutil.rmtree(temporary, ignore_errors=True)
