"""Files and folders are written completely or not at all."""

from __future__ import annotations

import csv
import enum
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from droid_jax import storage


@pytest.mark.parametrize(
    "write",
    [
        lambda path: storage.write_bytes(path, b"new"),
        lambda path: storage.write_text(path, "new"),
        lambda path: storage.write_json(path, ["new"]),
        lambda path: storage.write_npz(path, {"new": np.ones(3)}),
        lambda path: storage.write_csv(path, ["new"], [[1.0]]),
    ],
)
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    write: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    target = tmp_path / "result"
    target.write_bytes(b"old")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(storage.os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write(target)
    assert target.read_bytes() == b"old" and list(tmp_path.iterdir()) == [target]
    monkeypatch.undo()
    write(target)
    assert target.read_bytes() != b"old" and list(tmp_path.iterdir()) == [target]


def test_missing_folders_are_made(tmp_path: Path):
    path = tmp_path / "a" / "b" / "text"
    storage.write_text(path, "m²\n")
    assert path.read_bytes() == "m²\n".encode()


def test_who_may_read_is_as_the_user_has_it(tmp_path: Path):
    """The umask decides of a new file, its mode of an existing one."""
    path = tmp_path / "result"
    before = os.umask(0o007)
    try:
        storage.write_text(path, "first")
        assert path.stat().st_mode & 0o777 == 0o660
        path.chmod(0o604)
        storage.write_text(path, "second")
        assert path.stat().st_mode & 0o777 == 0o604
    finally:
        os.umask(before)


def test_json_has_no_word_for_nan(tmp_path: Path):
    path = tmp_path / "result.json"
    storage.write_json(path, {"a": 1.5})
    with pytest.raises(ValueError):
        storage.write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1.5}


def test_an_npz_holds_no_objects(tmp_path: Path):
    path = tmp_path / "arrays.npz"
    with pytest.raises(ValueError, match="allow_pickle"):
        storage.write_npz(path, {"a": np.array([{}, None])})
    assert list(tmp_path.iterdir()) == []
    storage.write_npz(path, {"a": np.arange(3)})
    with np.load(path, allow_pickle=False) as file:
        assert file["a"].tolist() == [0, 1, 2]


def test_a_table_reads_back(tmp_path: Path):
    path = tmp_path / "table.csv"
    rows = np.array([[0.1, 1 / 3], [1e-300, -7.0]]).tolist()
    storage.write_csv(path, ("x", 'a "quoted", name'), rows, line_end="\n")
    head, *cells = csv.reader(path.read_text().splitlines())
    assert head == ["x", 'a "quoted", name']
    assert [[float(c) for c in row] for row in cells] == rows
    assert b"\r" not in path.read_bytes()


def test_a_folder_takes_the_place_of_an_old_one(tmp_path: Path):
    target = tmp_path / "deep" / "folder"
    for content in ("first", "second"):
        with storage.new_folder(target) as new:
            (new / content).write_text(content)
            assert not (target / content).exists()
        assert [p.name for p in target.iterdir()] == [content]
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("failing", [1, 2, 3])
def test_a_failed_folder_leaves_the_old_one(failing: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Where the block fails (1), where the old folder is to step aside (2), where the new one is to take its place."""
    target = tmp_path / "folder"
    with storage.new_folder(target) as new:
        (new / "old").touch()
    replace, calls = storage.os.replace, []

    def fail(*paths: Path) -> None:
        calls.append(paths)
        if len(calls) == failing - 1:
            raise OSError("disk full")
        replace(*paths)

    monkeypatch.setattr(storage.os, "replace", fail)
    with pytest.raises(OSError, match="disk full"), storage.new_folder(target) as new:
        (new / "new").touch()
        if failing == 1:
            raise OSError("disk full")
    assert [p.name for p in target.iterdir()] == ["old"]
    assert list(tmp_path.iterdir()) == [target]


def test_a_files_hash_is_of_its_bytes(tmp_path: Path):
    """The standard's own example: FIPS 180-4, "abc"."""
    (tmp_path / "file").write_bytes(b"abc")
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert storage.file_sha256(tmp_path / "file") == expected


class Colour(enum.Enum):
    RED = "red"


@dataclass(frozen=True)
class Inner:
    colour: Colour = Colour.RED
    bound: float = float("inf")


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    none: Inner | None = None
    ratios: tuple[float, ...] = (3.0, 1.5)
    weights: dict[str, float] = field(default_factory=lambda: {"torque": 1.0})


def test_settings_become_plain_data():
    plain = storage.config_json(Outer())
    expected = {
        "inner": {"colour": "red", "bound": "inf"},
        "none": None,
        "ratios": [3.0, 1.5],
        "weights": {"torque": 1.0},
    }
    assert plain == expected == json.loads(json.dumps(plain, allow_nan=False))
