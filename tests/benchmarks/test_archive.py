"""Archives of scored runs: restored byte for byte, compared with their manifest, and scored again."""

from __future__ import annotations

import json
import lzma
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import archive

ROOT = Path(__file__).resolve().parents[2]
CONTENTS = {"results/a.json": b'{"x": "\xc3\xa9\\n"}\r\n', "sealed/deep/a.json": b"{}", "made": b"\x00\xff\xfe"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, content in CONTENTS.items():
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).write_bytes(content)
    (tmp_path / "run" / "results" / "a.json.lock").touch()
    return tmp_path / "run"


def test_files_come_back_byte_for_byte(folder: Path, tmp_path: Path):
    archive.pack(folder, tmp_path / "archive", "run")
    assert archive.unpack("run", tmp_path / "back", tmp_path / "archive") == len(CONTENTS)
    found = {p.relative_to(tmp_path / "back").as_posix(): p for p in (tmp_path / "back").rglob("*") if p.is_file()}
    assert {name: path.read_bytes() for name, path in found.items()} == CONTENTS
    assert archive.faults(tmp_path / "archive") == []


def test_what_was_changed_is_found(folder: Path, tmp_path: Path):
    place = tmp_path / "archive"
    for name in ("changed", "gone"):
        archive.pack(folder, place, name)
    changed = place / f"changed{archive.ENDING}"
    changed.write_bytes(changed.read_bytes()[:-1] + b"x")
    (place / f"gone{archive.ENDING}").rename(place / f"strange{archive.ENDING}")
    wrong = {"changed", f"gone{archive.ENDING}", f"strange{archive.ENDING}"}
    assert {fault.split(":")[0] for fault in archive.faults(place)} == wrong


def test_runs_of_one_kind_lie_in_one_file(folder: Path, tmp_path: Path):
    """Each is restored by its name, also after another was packed again."""
    place = tmp_path / "archive"
    for name in ("null_22222ab", "null_11111ab", "null_22222ab"):
        archive.pack(folder, place, name)
        (folder / "made").write_text(name)
    assert sorted(p.name for p in place.iterdir()) == [archive.MANIFEST, f"null{archive.ENDING}"]
    assert archive.faults(place) == []
    for name, made in (("null_11111ab", "null_22222ab"), ("null_22222ab", "null_11111ab")):
        assert archive.unpack(name, tmp_path / name, place) == len(CONTENTS)
        assert (tmp_path / name / "made").read_text() == made


@pytest.mark.parametrize(
    "line", ['{"path": "../a", "text": ""}', '{"path": "/a", "text": ""}', '{"path": "a"}', "[]", "no JSON"]
)
def test_what_is_no_archive_is_refused(tmp_path: Path, line: str):
    with pytest.raises(ValueError, match="is no archive of"):
        list(archive.contents(lzma.compress(line.encode()), "bad"))


def test_an_empty_folder_is_no_archive(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="no files to pack"):
        archive.pack(tmp_path, tmp_path / "archive", "empty")


def test_those_of_this_repository_are_whole():
    assert archive.faults(archive.PLACE) == [] and len(archive.manifest(archive.PLACE)) > 20


def test_a_scored_run_is_scored_again_as_it_was(tmp_path: Path):
    """The blind run that the results cite, with its oracles."""
    archive.unpack("blind_d1a4e04", tmp_path / "run")
    before = json.loads((tmp_path / "run" / "hidden_effects.json").read_text())
    script = [sys.executable, ROOT / "experiments" / "hidden_effects.py", "score", "--out", tmp_path / "run"]
    subprocess.run(script, cwd=ROOT, check=True, capture_output=True)
    after = json.loads((tmp_path / "run" / "hidden_effects.json").read_text())
    assert {k for k in before if before[k] != after.get(k)} <= {
        "commit",
        "versions",
        "device",
        "platform",
        "jax_devices",
        "cores",
        "date",
    }
    assert before["summary"] == after["summary"]
