"""Reads files of `torch.save`, such as the chirps of PACE, as columns, without torch and without running their code.

A file of torch (1.6 and newer) is a zip.  Its member `data.pkl` lists the tensors, and each storage of numbers is
another member.  The unpickler accepts only the few names that plain tensors need, so that no code in the file is
called.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.arguments import LONGEST_NAME, said, shown
from droid_jax.read_npz import FREE_BYTES
from droid_jax.recordings.log_columns import LogColumns, readable, width_of
from droid_jax.storage import check_size

MOST_BYTES = 2**31
MOST_PICKLE = 2**22  # bytes of data.pkl
MOST_ENTRIES = 10_000
_TYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}


@dataclass(frozen=True)
class _Storage:
    """Numbers of one type, in the zip's member data/<key>."""

    dtype: str
    key: str
    count: int


@dataclass(frozen=True)
class _Tensor:
    """Numbers of a storage as an array; offset and strides are counted in numbers."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def open_torch(path: Path) -> LogColumns:
    """The tensors of a file by name; in nested dictionaries, "outer/inner".

    A list of texts `joint_names` names the components of all vectors of its length.

    Raises:
        ValueError: the file is not of torch.save, or holds more than tensors, numbers, texts, lists and dictionaries.
    """
    check_size(path, MOST_BYTES)
    with readable(path, "file of torch.save (1.6 or newer)"), zipfile.ZipFile(path) as archive:
        root, content = _content(path, archive)
    found = _flat(content, path)
    tensors = {name: value for name, value in found.items() if isinstance(value, _Tensor)}
    if not tensors:
        raise ValueError(f"{path}: holds no tensors")

    def read(name: str) -> np.ndarray:
        with readable(path, "file of torch.save"), zipfile.ZipFile(path) as archive:
            return _array(archive, root, tensors[name], f"{path}, tensor {shown(name)}")

    widths = {name: width_of(t.shape) for name, t in tensors.items()}
    names = _names(content)
    components = {name: names for name, width in widths.items() if names and width == len(names) > 1}
    return LogColumns(str(path), widths, read, components)


def _content(path: Path, archive: zipfile.ZipFile) -> tuple[str, Any]:
    """The folder in the zip, and the saved object, whose tensors are not read yet."""
    members = [m for m in archive.infolist() if m.filename.rpartition("/")[2] == "data.pkl"]
    if len(members) != 1:
        raise ValueError(f"{path}: not a file of torch.save: it has no data.pkl")
    root = members[0].filename.rpartition("/")[0]
    order = [m for m in archive.infolist() if m.filename == f"{root}/byteorder"]
    if order and (order[0].file_size > 6 or archive.read(order[0]) != b"little"):
        raise ValueError(f"{path}: its numbers are big-endian, which is not read")
    if members[0].file_size > MOST_PICKLE:
        raise ValueError(f"{path}: its data.pkl has {members[0].file_size} bytes, at most {MOST_PICKLE} are read")
    try:
        return root, _Unpickler(io.BytesIO(archive.read(members[0]))).load()
    except _Refused as error:
        raise ValueError(
            f"{path}: holds {error}; only tensors, numbers, texts, lists and dictionaries are read"
        ) from None
    except Exception as error:  # a damaged pickle raises anything
        raise ValueError(f"{path}: damaged file of torch.save: {type(error).__name__}: {said(error)}") from None


class _Refused(Exception):
    """The pickle asks for a name that is not accepted."""


class _Unpickler(pickle.Unpickler):
    """Unpickles tensors and plain containers; raises `_Refused` for every other name before anything is called."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _rebuild
        if module in ("torch", "torch.storage") and name in _TYPES:
            return _TYPES[name]
        raise _Refused(f"the object {shown(f'{module}.{name}')}")

    def persistent_load(self, pid: Any) -> _Storage:
        kind, dtype, key, _, count = pid
        if kind != "storage" or dtype not in _TYPES.values():
            raise _Refused(f"the storage {shown(pid)}")
        return _Storage(str(dtype), str(key), int(count))


def _rebuild(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> _Tensor:
    if not isinstance(storage, _Storage):
        raise _Refused("a tensor without numbers")
    return _Tensor(storage, int(offset), tuple(map(int, shape)), tuple(map(int, strides)))


def _flat(content: Any, path: Path) -> dict[str, Any]:
    """Name -> value in nested dictionaries; ValueError where they hold too many values, or hold themselves."""
    out: dict[str, Any] = {}
    waiting, seen = [("", content)], 0
    while waiting:
        name, value = waiting.pop()
        seen += 1
        if isinstance(value, dict):
            waiting += [(f"{name}/{key}" if name else str(key), inner) for key, inner in value.items()]
        else:
            out[name or "tensor"] = value
        if seen + len(waiting) > MOST_ENTRIES or len(name) > LONGEST_NAME:
            raise ValueError(f"{path}: its dictionaries hold more than {MOST_ENTRIES} values, or one another too deep")
    return out


def _names(content: Any) -> tuple[str, ...]:
    names = content.get("joint_names") if isinstance(content, dict) else None
    fine = isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)
    return tuple(names) if fine and names else ()


def _array(archive: zipfile.ZipFile, root: str, tensor: _Tensor, where: str) -> np.ndarray:
    """The numbers of a tensor; ValueError where its storage does not hold them."""
    dtype = np.dtype(tensor.storage.dtype)
    try:
        member = archive.getinfo(f"{root}/data/{tensor.storage.key}")
    except KeyError:
        raise ValueError(f"{where}: its numbers are missing") from None
    last = tensor.offset + sum((n - 1) * s for n, s in zip(tensor.shape, tensor.strides, strict=True) if n)
    fits = min((tensor.offset, *tensor.shape, *tensor.strides), default=0) >= 0 and last < tensor.storage.count
    stored = tensor.storage.count * dtype.itemsize
    if len(tensor.shape) != len(tensor.strides) or not fits or member.file_size != stored:
        raise ValueError(f"{where}: damaged, shape {list(tensor.shape)} of {member.file_size} bytes")
    # A tensor may repeat one number (a stride of 0) and thus be larger than its file.
    if max(stored, math.prod(tensor.shape) * dtype.itemsize) > max(FREE_BYTES, 4 * archive.fp.seek(0, 2)):  # type: ignore[union-attr]
        raise ValueError(f"{where}: declares shape {list(tensor.shape)}, more than a file of this size explains")
    numbers = np.frombuffer(archive.read(member), dtype)[tensor.offset :]
    strides = tuple(s * dtype.itemsize for s in tensor.strides)
    return np.lib.stride_tricks.as_strided(numbers, tensor.shape, strides, writeable=False).copy()
