"""Reads requested arrays of npz files; checks their sizes before it allocates memory.

    with NpzFile(path) as file:
        time = file.array("time")
        note = file.text("metadata")

    arrays = read_npz(path, ("names", "mean"), optional=("sigma",))

An npz is a zip of npy files.  The sizes declared in its directory and in the heads of its members are checked against
the bytes of the file, so that a small file that declares a large array takes no memory.  numpy is imported when a file
is opened.
"""

from __future__ import annotations

import math
import re
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from droid_jax.arguments import printable, shown
from droid_jax.storage import check_size

if TYPE_CHECKING:
    import numpy as np

MOST_BYTES = 2 * 2**30 - 1  # of a file: beyond it a zip has another kind of directory
MOST_MEMBERS = 10_000
MOST_DIRECTORY = 4 * 2**20  # bytes of the zip's directory, about 100 a member
MOST_HEAD = 4096  # bytes of an npy head; numpy writes 128
MOST_AXES = 8
# Bytes that all arrays read of one file may take: measured numbers hardly compress, masks and zeros do.
FREE_BYTES, COMPRESSED = 64 * 2**20, 16  # as many in any case, and as many times the file's own size
NUMBERS, TEXT = "biuf", "U"  # kinds of numpy's dtypes that are read
WIDEST = 8  # bytes of a number
_END = struct.Struct("<4s4H2LH")  # the record that ends a zip: signature, .., bytes of the directory, its offset, ..
_DEFLATED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_PAIRS = {  # of an npy head, in any order
    "descr": r"['\"]descr['\"]\s*:\s*['\"]([<>|=]?[a-zA-Z]\d*)['\"]",
    "fortran_order": r"['\"]fortran_order['\"]\s*:\s*(True|False)",
    "shape": r"['\"]shape['\"]\s*:\s*\(([\d\s,]*)\)",
}
_PAIR = (
    f"(?:{'|'.join(_PAIRS.values())})".replace("([<", "(?:[<").replace("(True", "(?:True").replace("([\\d", "(?:[\\d")
)
_HEAD = re.compile(rf"\s*\{{\s*{_PAIR}(?:\s*,\s*{_PAIR}){{2}}\s*,?\s*\}}\s*")
_ENCRYPTED = 0x1  # in a member's flags


class NpzFile:
    """An npz file opened for reading; a context manager.

    Raises:
        OSError: there is no such file, or it cannot be opened.
        ValueError: it is empty, no zip, or its directory is damaged; the message begins with the path.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        size = check_size(self.path, MOST_BYTES)
        if size == 0:
            raise ValueError(f"{self.path}: the file is empty")
        self._left = max(FREE_BYTES, COMPRESSED * size)
        self._file = self.path.open("rb")
        try:
            self._archive = _archive(self.path, self._file, size)
            self._members = _members(self.path, self._archive)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> NpzFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays, without ".npy"."""
        return tuple(self._members)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def array(self, name: str, kinds: str = NUMBERS) -> np.ndarray:
        """One array in the machine's byte order.

        Args:
            name: without ".npy".
            kinds: the dtype kinds that it may have, of "biufU".

        Raises:
            ValueError: it is not there, damaged, of another kind, or larger than what the file's own size explains.
        """
        if name not in self._members:
            has = shown(", ".join(sorted(self._members)), 400).strip("'")
            raise ValueError(f"{self.path}: missing array {name!r}; the file has: {has or 'none'}")
        where = f"{self.path}: damaged npz file, member {shown(name)}"
        try:
            return self._read(self._members[name], kinds, where)
        except _Damage as error:
            raise ValueError(str(error)) from None
        except OSError as error:
            raise ValueError(f"{where}: {_first_line(error)}") from None
        except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds where bytes are changed
            raise ValueError(f"{where}: {_first_line(error)}") from None

    def shape(self, name: str, kinds: str = NUMBERS) -> tuple[int, ...] | None:
        """Shape that an array's head declares, its numbers not read; None where it is of another kind or damaged."""
        try:
            with self._archive.open(self._members[name]) as stream:
                dtype, shape, _, _ = _head(stream, name)
        except Exception:  # as in `array`, which says what is wrong
            return None
        return shape if dtype.kind in kinds else None

    def text(self, name: str) -> str:
        """A text that was stored as an array without axes, of characters that can be printed."""
        array = self.array(name, TEXT)
        if array.ndim:
            raise ValueError(f"{self.path}: {name!r} must be one text, got an array of shape {list(array.shape)}")
        return str(array)

    def _read(self, member: zipfile.ZipInfo, kinds: str, where: str) -> np.ndarray:
        import numpy as np

        with self._archive.open(member) as stream:
            dtype, shape, fortran, head = _head(stream, where)
            if dtype.kind not in kinds:
                holds = _KINDS.get(dtype.kind, f"the type {dtype}")
                raise _Damage(f"{where}: holds {holds}, expected {_wanted(kinds)}")
            count = math.prod(shape)
            declared = count * dtype.itemsize
            if declared != member.file_size - head:
                raise _Damage(
                    f"{where}: its head declares {dtype} of shape {list(shape)}, {declared} bytes, where "
                    f"{member.file_size - head} are"
                )
            if declared > self._left:
                raise _Damage(
                    f"{self.path}: array {member.filename.removesuffix('.npy')!r} takes {declared / 2**20:.0f} MiB, "
                    f"{self._left / 2**20:.0f} are left to a file of this size; is it damaged, or meant to fill memory?"
                )
            data = np.empty(declared, np.uint8)
            _fill(stream, data.data, where)
        self._left -= declared
        flat = data.view(dtype) if declared else np.zeros(count, dtype)
        _check_values(flat, where)
        array = flat.reshape(shape, order="F" if fortran else "C")
        return np.ascontiguousarray(array.astype(dtype.newbyteorder("="), copy=False)).reshape(shape)


def read_npz(
    path: str | Path, names: Iterable[str], optional: Iterable[str] = (), *, kinds: str = NUMBERS + TEXT
) -> dict[str, np.ndarray]:
    """Some arrays of an npz file by name; the others are not read.

    Args:
        path: of the file.
        names: of the arrays that must be there.  optional: of those that may be.
        kinds: the dtype kinds that they may have, of "biufU".

    Raises:
        OSError, ValueError: as `NpzFile` and its `array` do.
    """
    with NpzFile(path) as file:
        wanted = dict.fromkeys((*names, *(name for name in optional if name in file)))
        return {name: file.array(name, kinds) for name in wanted}


class _Damage(ValueError):
    """A fault whose message names file and member already."""


_KINDS = {
    "O": "pickled Python objects, which are not read",
    **{"U": "text", "f": "numbers", "i": "numbers", "u": "numbers", "b": "true and false"},
    **{"S": "bytes", "V": "records", "c": "complex numbers", "M": "dates", "m": "durations"},
}


def _wanted(kinds: str) -> str:
    words = (("numbers", "iuf"), ("true and false", "b"), ("text", "U"))
    return " or ".join(word for word, of in words if set(of) & {*kinds})


def _archive(path: Path, file: BinaryIO, size: int) -> zipfile.ZipFile:
    """The zip in a file, whose directory is whole and of bounded length."""
    tail = min(size, 2**16 + _END.size)  # a comment may follow the record
    file.seek(size - tail)
    end = file.read(tail)
    at = end.rfind(b"PK\5\6")
    if at < 0 or len(end) < at + _END.size:
        raise ValueError(f"{path}: not an npz file, or one that was cut off while it was written")
    _, _, _, _, count, length, _, _ = _END.unpack_from(end, at)
    if end[max(at - 20, 0) : at].startswith(b"PK\6\7") or length > MOST_DIRECTORY or count > MOST_MEMBERS:
        raise ValueError(f"{path}: damaged npz file: its directory declares {count} members in {length} bytes")
    try:
        return zipfile.ZipFile(file)
    except Exception as error:  # NotImplementedError, struct.error, UnicodeDecodeError, ...: the directory is damaged
        raise ValueError(f"{path}: damaged npz file: {_first_line(error)}") from None


def _members(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Array name -> member, none of them twice, encrypted, or compressed in another way than numpy's."""
    out: dict[str, zipfile.ZipInfo] = {}
    for member in archive.infolist():
        if not member.filename.endswith(".npy"):
            continue
        where = f"{path}: damaged npz file, member {shown(member.filename)}"
        if member.flag_bits & _ENCRYPTED:
            raise ValueError(f"{where}: is encrypted, which is not read")
        if member.compress_type not in _DEFLATED:
            raise ValueError(f"{where}: is compressed by method {member.compress_type}; only deflate is read")
        if out.setdefault(member.filename.removesuffix(".npy"), member) is not member:
            raise ValueError(f"{where}: is there twice")
    return out


def _head(stream: Any, where: str) -> tuple[np.dtype, tuple[int, ...], bool, int]:
    """dtype, shape, whether the first axis runs fastest, and length in bytes of an npy file's head."""
    from numpy.lib import format as npy

    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise _Damage(f"{where}: npy version {version} is not read")
    width, layout = (2, "<H") if version == (1, 0) else (4, "<I")
    length = stream.read(width)
    if len(length) < width:
        raise _Damage(f"{where}: ends within its head")
    (length,) = struct.unpack(layout, length)
    if length > MOST_HEAD:
        raise _Damage(f"{where}: its head declares {length} bytes, at most {MOST_HEAD} are read")
    text = stream.read(length)
    if len(text) < length:
        raise _Damage(f"{where}: ends within its head")
    dtype, shape, fortran = _declared(text.decode("utf-8" if version == (3, 0) else "latin-1"), where)
    return dtype, shape, fortran, npy.MAGIC_LEN + width + length


def _declared(head: str, where: str) -> tuple[np.dtype, tuple[int, ...], bool]:
    """dtype, shape and order of an npy head, "{'descr': '<f8', 'fortran_order': False, 'shape': (3, 4), }"."""
    import numpy as np

    if re.search(r"['\"]descr['\"]\s*:\s*\[", head):
        raise _Damage(f"{where}: holds records, plain numbers expected")
    found = {key: re.findall(pattern, head) for key, pattern in _PAIRS.items()}
    if not _HEAD.fullmatch(head) or any(len(each) != 1 for each in found.values()):
        raise _Damage(f"{where}: its head does not state descr, fortran_order and shape: {shown(head.strip())}")
    dtype = np.dtype(found["descr"][0])
    shape = tuple(int(n) for n in found["shape"][0].replace(",", " ").split())
    absurd = len(shape) > MOST_AXES or any(n > MOST_BYTES for n in shape)
    if absurd or (dtype.kind in NUMBERS and dtype.itemsize > WIDEST) or (not dtype.itemsize and math.prod(shape) > 1):
        raise _Damage(f"{where}: its head declares {dtype} of shape {shown(list(shape))}, which is not read")
    return dtype, shape, found["fortran_order"][0] == "True"


def _fill(stream: Any, data: memoryview, where: str) -> None:
    """Read exactly this many bytes, and that nothing follows; the checksum is held against them."""
    filled = 0
    while filled < len(data):
        got = stream.readinto(data[filled : filled + 2**20])
        if not got:
            raise _Damage(f"{where}: ends after {filled} of {len(data)} bytes")
        filled += got
    if stream.read(1):
        raise _Damage(f"{where}: goes on behind its array")


def _check_values(flat: np.ndarray, where: str) -> None:
    """ValueError for bytes that are no value of their dtype: numpy takes them as they are."""
    import numpy as np

    if flat.dtype.kind == "b" and flat.size and flat.view(np.uint8).max() > 1:
        raise _Damage(f"{where}: holds bytes that are neither true nor false")
    if flat.dtype.kind == "U" and flat.size and flat.dtype.itemsize:
        order = "utf-32-be" if flat.dtype.byteorder == ">" else "utf-32-le"
        try:
            flat.tobytes().decode(order)
        except UnicodeDecodeError:
            raise _Damage(f"{where}: holds characters that are none") from None
        for text in flat.tolist():
            printable(text, f"{where}: its text", lines=True)


def _first_line(error: BaseException) -> str:
    """Kind and first line of a foreign error, for a message of one line."""
    said = (str(error).splitlines() or [""])[0][:200]
    kind = "" if isinstance(error, (ValueError, zipfile.BadZipFile)) else type(error).__name__
    return f"{kind}: {said}" if kind and said else said or kind or "it cannot be read"
