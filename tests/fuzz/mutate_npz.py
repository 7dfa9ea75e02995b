"""Mutations of npz files: the arrays, the headers before them, and the zip archive around them."""

from __future__ import annotations

import functools
import io
import struct
import warnings
import zipfile
import zlib
from random import Random
from typing import Any

import numpy as np
from mutate_json import mutate_json
from mutate_text import mutate_bytes

BOMB = 3 << 29  # bytes that a member of a megabyte unpacks to: 1.5 GiB
_SIGNATURES = (b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06", b"\x93NUMPY")
_DTYPES = ("int8", "uint64", "float16", ">f4", ">f8", "longdouble", "complex128", "bool", "U8", "S4", "M8[s]", "V8")
_HEADERS = (
    "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (250000000,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4294967296, 4294967296, 4294967296), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 99999999999999999999), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': 3, }",
    "{'descr': '<f8', 'fortran_order': True, 'shape': (3, 4), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (True,), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<U1000000000', 'fortran_order': False, 'shape': (), }",
    "{'descr': '<U0', 'fortran_order': False, 'shape': (2,), }",
    "{'descr': [('a', '<f8'), ('b', '|O')], 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a', '<f8', (1000, 1000, 1000))], 'fortran_order': False, 'shape': (1,), }",
    "{'descr': 'bogus', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<f8', 'shape': (1,), }",
    "[1, 2]",
    "(" * 5000 + ")" * 5000,
    "-" * 5000 + "1",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1" + "0" * 5000 + ",), }",
    "\x00\x00",
    "",
)  # fmt: skip


def read_members(content: bytes) -> list[tuple[str, bytes]]:
    """(name, bytes) of every member."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        return [(info.filename, file.read(info)) for info in file.infolist()]


def write_members(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip file of these members; names may stand there twice."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method) as file:
        warnings.simplefilter("ignore")  # of names that stand there twice
        for name, content in members:
            info = zipfile.ZipInfo(name.encode("utf-8", "replace").decode())
            info.compress_type = method
            file.writestr(info, content)
    return buffer.getvalue()


def npy(array: Any) -> bytes:
    """An array as an npy file; objects are pickled, as numpy does unless told otherwise."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asanyarray(array), allow_pickle=True)
    return buffer.getvalue()


def npy_with_header(header: str, data: bytes, version: tuple[int, int] = (1, 0)) -> bytes:
    """An npy file whose header is this text, true or not."""
    text = header.encode("latin-1") + b"\n"
    size = struct.pack("<H", len(text) & 0xFFFF) if version[0] == 1 else struct.pack("<I", len(text))
    return b"\x93NUMPY" + bytes(version) + size + text + data


@functools.cache
def _zeros() -> tuple[bytes, int, int]:
    """An npy file of BOMB bytes of zeros: compressed, its checksum and its size."""
    block = bytes(1 << 24)
    head = npy_with_header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({BOMB // 8},), }}", b"")
    pack, checksum = zlib.compressobj(1, zlib.DEFLATED, -15), zlib.crc32(head)
    packed = [pack.compress(head)]
    for _ in range(BOMB // len(block)):
        packed.append(pack.compress(block))
        checksum = zlib.crc32(block, checksum)
    return b"".join([*packed, pack.flush()]), checksum, len(head) + BOMB


def bomb(name: str) -> bytes:
    """A small npz file whose one member unpacks to BOMB bytes of zeros."""
    packed, checksum, size = _zeros()
    about = (checksum, len(packed), size, len(name), 0)
    first = struct.pack("<4s5H3L2H", b"PK\3\4", 20, 0, 8, 0, 33, *about) + name.encode() + packed
    directory = struct.pack("<4s6H3L5H2L", b"PK\1\2", 20, 20, 0, 8, 0, 33, *about, 0, 0, 0, 0, 0) + name.encode()
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, len(directory), len(first), 0)
    return first + directory + end


def mutate_npz(random: Random, content: bytes) -> bytes:
    """One change of the archive, of a header, of an array or of a text that is kept as one."""
    return random.choices((_archive, _header, _array, _text, _bytes), (4, 3, 8, 3, 3))[0](random, content)


def _bytes(random: Random, content: bytes) -> bytes:
    """Bytes of a member changed below a correct checksum, or those around a signature."""
    if random.random() < 0.5:
        members = read_members(content)
        i = random.randrange(len(members))
        members[i] = (members[i][0], mutate_bytes(random, members[i][1]))
        return write_members(members, random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    signature = random.choice(_SIGNATURES)
    places = [i for i in range(len(content)) if content.startswith(signature, i)]
    out = bytearray(content)
    if places:
        at = random.choice(places)
        for _ in range(random.randint(1, 4)):
            i = min(at + random.randrange(46), len(out) - 1)
            out[i] = random.choice((0, 1, 8, 12, 14, 99, 127, 255, random.randrange(256)))
    return bytes(out)


def _archive(random: Random, content: bytes) -> bytes:
    members = read_members(content)
    i = random.randrange(len(members))
    name, data = members[i]
    what = random.randrange(10)
    if what == 0:
        del members[i]
    elif what == 1:
        members[i] = (random.choice(("x.npy", "../x.npy", "a/b.npy", "", ".npy", "é.npy", "n" * 300 + ".npy")), data)
    elif what == 2:
        members.append((name, random.choice(members)[1]))
    elif what == 3:
        members[i] = (name.removesuffix(".npy"), data)  # numpy hands its bytes on as they are
    elif what == 4:
        members.append((f"extra_{random.randrange(9)}.npy", npy(np.zeros(3))))
    elif what == 5:
        other = random.randrange(len(members))
        members[i], members[other] = (name, members[other][1]), (members[other][0], data)
    elif what == 6:
        members[i] = (name, random.choice((b"", b"\x93NUMPY", b"text", b"\x93NUMPY\x09\x00\x00\x00")))
    elif what == 7:
        return write_members(members, random.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))
    elif what == 8:
        return bomb(name)
    else:
        members += [(f"m{k}.npy", npy(np.zeros(0))) for k in range(2000)]
    return write_members(members)


def _header(random: Random, content: bytes) -> bytes:
    members = read_members(content)
    i = random.randrange(len(members))
    data = random.choice((b"", bytes(64), members[i][1][128:]))
    made = npy_with_header(random.choice(_HEADERS), data, random.choice(((1, 0), (1, 0), (2, 0), (3, 0))))
    members[i] = (members[i][0], made)
    return write_members(members)


def _array(random: Random, content: bytes) -> bytes:
    members = read_members(content)
    for _ in range(random.choice((1, 1, 2))):
        i = random.randrange(len(members))
        try:
            array = np.lib.format.read_array(io.BytesIO(members[i][1]), allow_pickle=False)
        except ValueError:  # of objects, by an earlier change
            continue
        with np.errstate(all="ignore"):
            members[i] = (members[i][0], npy(random.choice(_ARRAYS)(random, array)))
    return write_members(members)


def _text(random: Random, content: bytes) -> bytes:
    """A text changed that is kept as an array: as JSON where it is some, else its letters."""
    members = read_members(content)
    texts = []
    for i, (_, data) in enumerate(members):
        array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        if array.dtype.kind == "U" and array.ndim == 0:
            texts.append((i, str(array)))
    if not texts:
        return _array(random, content)
    i, text = max(texts, key=lambda t: len(t[1])) if random.random() < 0.8 else random.choice(texts)
    if text[:1] in "{[":
        made = mutate_json(random, text.encode()).decode("utf-8", "replace")
    else:
        made = random.choice(("", text + "x", text[:-1], text.upper(), "\x00", "7"))
    members[i] = (members[i][0], npy(np.array(made)))
    return write_members(members)


def _other_type(random: Random, array: np.ndarray) -> Any:
    kind = random.choice((*_DTYPES, "object"))
    try:
        return array.astype(kind)
    except (TypeError, ValueError):
        return np.zeros(array.shape, kind)


def _other_shape(random: Random, array: np.ndarray) -> Any:
    made = [array.reshape(-1), array.T, array[None], array[..., None], np.zeros((1,) * 30)]
    if array.ndim:
        made += [array[:0], array[..., :0], array[: len(array) // 2], array[::-1], np.concatenate([array, array])]
    if array.size:
        made.append(array.reshape(-1)[0])
    return random.choice(made)


def _other_values(random: Random, array: np.ndarray) -> Any:
    if array.dtype.kind not in "fiub" or not array.size:
        texts = ("", "a\x00b", "\x1b[31m", "y" * 100_000, "../x", "<b>", "\ud800")
        return np.full(array.shape, random.choice(texts)) if array.dtype.kind == "U" else array
    out = array.astype(np.float64) if array.dtype.kind != "b" or random.random() < 0.3 else array.copy()
    value = random.choice((np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-320, 1e30, 1e300, -1e300, 3.0))
    if random.random() < 0.3:
        out[...] = value
    else:
        flat = out.reshape(-1)
        for _ in range(random.choice((1, 1, 5))):
            flat[random.randrange(flat.size)] = value
    return out.astype(array.dtype) if random.random() < 0.7 else out


def _scaled_values(random: Random, array: np.ndarray) -> Any:
    if array.dtype.kind not in "fiu":
        return array
    return array * random.choice((-1, 0, 1e-6, 57.3, 1000.0, 1e200)) + random.choice((0, 0, 1, 1e9))


def _other_order(random: Random, array: np.ndarray) -> Any:
    if not array.ndim or not len(array):
        return array
    order = list(range(len(array)))
    random.shuffle(order) if len(order) < 10_000 else order.reverse()
    return np.asfortranarray(array) if random.random() < 0.2 else array[order]


_ARRAYS = (
    _other_type,
    _other_type,
    _other_shape,
    _other_shape,
    _other_values,
    _other_values,
    _scaled_values,
    _other_order,
)
