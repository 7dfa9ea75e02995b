"""The reader of npz files: every damage is one sentence with file and member, before memory is taken."""

from __future__ import annotations

import io
import random
import resource
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from droid_jax.read_npz import NpzFile, read_npz

LIMIT = 200 * 2**20  # bytes by which reading a damaged file may raise the peak of this process


def npy(head: str, data: bytes = b"", version: bytes = b"\1\0") -> bytes:
    width = "<H" if version == b"\1\0" else "<I"
    return b"\x93NUMPY" + version + struct.pack(width, len(head)) + head.encode("latin-1") + data


def head(descr: str = "<f8", shape: str = "(3,)") -> str:
    return f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n"


def zipped(path: Path, *members: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


def said(path: Path, name: str = "a") -> str:
    """The message that reading an array ends in: one line that names the file."""
    with pytest.raises(ValueError) as caught, NpzFile(path) as file:
        file.array(name)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text
    return text


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (npy(head(shape="(1000000000,)")), "8000000000 bytes, where 0 are"),
        (npy(head(shape="(18446744073709551616,)")), "which is not read"),
        (npy(head(shape=f"({'9' * 4000},)")), "which is not read"),
        (npy(head(shape="(0, 1000000000000)")), "which is not read"),
        (npy(head(shape="(1,1,1,1,1,1,1,1,1)"), bytes(8)), "which is not read"),
        (npy(head(shape="(-3,)"), bytes(24)), "does not state"),
        (npy(head(shape="3"), bytes(24)), "does not state"),
        (npy(head("<U0", "(1000000000,)")), "which is not read"),
        (npy(head("|O"), b"cos\nsystem\n"), "pickled Python objects"),
        (npy(head("<U8"), bytes(96)), "holds text, expected numbers"),
        (npy(head("|V8"), bytes(24)), "holds records"),
        (npy(head("<c16"), bytes(48)), "complex numbers"),
        (npy(head("<f16"), bytes(48)), "which is not read"),
        (npy(head("<q99"), bytes(48)), "member 'a'"),
        (npy("{'descr': [('x', '<f8')], 'fortran_order': False, 'shape': (1,), }"), "holds records"),
        (npy("-" * 4000), "does not state"),
        (npy("(" * 4000), "does not state"),
        (npy(head().replace("}", " "), bytes(24)), "does not state"),
        (npy(head().replace("}", "'descr': '<f4', }"), bytes(24)), "does not state"),
        (npy(head() + " " * 5000, bytes(24)), "at most 4096 are read"),
        (npy(head(), bytes(23)), "24 bytes, where 23 are"),
        (npy(head(), bytes(25)), "24 bytes, where 25 are"),
        (npy(head("|b1"), b"\0\1\7"), "neither true nor false"),
        (npy(head(), bytes(24), b"\7\0"), "version"),
        (b"\x80\x04\x95", "member 'a'"),
        (b"", "member 'a'"),
        (npy(head())[:9], "ends within its head"),
        (npy(head())[:40], "ends within its head"),
    ],
)
def test_a_damaged_member(tmp_path: Path, content: bytes, part: str) -> None:
    assert part in said(zipped(tmp_path / "x.npz", ("a.npy", content)))


def test_a_small_file_that_declares_a_large_array_takes_no_memory(tmp_path: Path) -> None:
    before = peak()
    path = zipped(tmp_path / "x.npz", ("a.npy", npy(head("|u1", f"({300 * 2**20},)"), bytes(300 * 2**20))))
    del before
    assert path.stat().st_size < 2**20
    before = peak()
    assert "takes 300 MiB, 64 are left to a file of this size" in said(path)
    assert peak() - before < 10 * 2**20


def test_a_declared_size_that_is_not_there(tmp_path: Path) -> None:
    """Directory and head agree on 60 MB, of which three bytes are there."""
    path = zipped(tmp_path / "x.npz", ("a.npy", npy(head("|u1", "(60000000,)"), b"abc")))
    whole = bytearray(path.read_bytes())
    length = len(npy(head("|u1", "(60000000,)"))) + 60_000_000
    at = whole.rfind(b"PK\1\2")
    whole[at + 24 : at + 28] = struct.pack("<I", length)
    path.write_bytes(whole)
    assert "member 'a'" in said(path)


def test_what_a_directory_may_not_say(tmp_path: Path) -> None:
    member = npy(head(), bytes(24))
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = zipped(tmp_path / "x.npz", ("a.npy", member), ("a.npy", member))
    assert "'a.npy': is there twice" in said(path)
    assert "compressed by method 12" in said(zipped(tmp_path / "y.npz", ("a.npy", member), method=zipfile.ZIP_BZIP2))
    path = zipped(tmp_path / "z.npz", ("a.npy", member))
    whole = bytearray(path.read_bytes())
    whole[whole.rfind(b"PK\1\2") + 8] |= 1
    path.write_bytes(whole)
    assert "is encrypted" in said(path)
    whole[-12:-10] = b"\xff\xff"  # members
    path.write_bytes(whole)
    assert "declares" in said(path)
    path.write_bytes(b"")
    assert "the file is empty" in said(path)
    (tmp_path / "folder.npz").mkdir()
    assert "is no regular file" in said(tmp_path / "folder.npz")
    assert "missing array 'b'; the file has: a" in said(zipped(tmp_path / "w.npz", ("a.npy", member)), "b")


def test_texts_are_checked(tmp_path: Path) -> None:
    for text in ("a\0b", "\ud800", "\x1b[2J"):
        np.savez(tmp_path / "x.npz", a=np.array(text))
        with pytest.raises(ValueError, match="member 'a'"), NpzFile(tmp_path / "x.npz") as file:
            file.text("a")
    np.savez(tmp_path / "x.npz", a=np.array("two\nlines"), b=np.array(["x"]))
    with NpzFile(tmp_path / "x.npz") as file:
        assert file.text("a") == "two\nlines"
        with pytest.raises(ValueError, match="must be one text"):
            file.text("b")


def test_everything_that_numpy_writes_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    arrays = {
        "f": rng.normal(size=(3, 4, 5)),
        "fortran": np.asfortranarray(rng.normal(size=(3, 4))),
        "single": np.float32(2.5),
        "big": rng.normal(size=7).astype(">f8"),
        "i": np.arange(5, dtype=np.int16),
        "b": rng.random((2, 3)) > 0.5,
        "none": np.zeros((0, 3)),
        "text": np.array(["a", "Grüße"]),
        "empty": np.array(""),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "x.npz", **arrays)
        found = read_npz(tmp_path / "x.npz", arrays, ("absent",))
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
            assert found[name].shape == np.shape(array) and found[name].dtype.isnative


def test_bytes_changed_at_random_are_read_or_refused(tmp_path: Path) -> None:
    rng = random.Random(0)
    buffer, arrays = io.BytesIO(), {"a": np.arange(40.0), "b": np.arange(12) > 3, "c": np.array("text")}
    before = peak()
    for compressed in (False, True):
        buffer = io.BytesIO()
        (np.savez_compressed if compressed else np.savez)(buffer, **arrays)
        whole = buffer.getvalue()
        for _ in range(300):
            changed = bytearray(whole)
            for _ in range(rng.choice((1, 1, 4, 30))):
                changed[rng.randrange(len(changed))] = rng.randrange(256)
            start = rng.randrange(len(changed))
            if rng.random() < 0.2:
                del changed[start : start + rng.randrange(200)]
            (tmp_path / "x.npz").write_bytes(changed)
            try:
                read_npz(tmp_path / "x.npz", arrays)
            except ValueError as error:
                assert str(error).startswith(str(tmp_path / "x.npz")) and "\n" not in str(error)
    assert peak() - before < LIMIT


def peak() -> int:
    """Bytes of this process at its largest."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
