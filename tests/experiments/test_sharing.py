"""What experiments keep from run to run."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.sharing import code_name, kept


def test_what_is_kept_is_made_once(tmp_path: Path):
    made = list[int]()

    def make() -> dict[str, int]:
        made.append(1)
        return {"made": len(made)}

    path = tmp_path / "cases" / "a.json"
    assert kept(path, make) == kept(path, make) == {"made": 1}
    path.unlink()
    assert kept(path, make) == {"made": 2}


def test_what_fails_is_not_kept(tmp_path: Path):
    def fail() -> dict[str, int]:
        raise ValueError("no replay")

    with pytest.raises(ValueError, match="no replay"):
        kept(tmp_path / "a.json", fail)
    assert kept(tmp_path / "a.json", lambda: {"made": 1}) == {"made": 1}


def test_uncommitted_code_finds_nothing_again():
    assert code_name("a" * 40) == code_name("a" * 40) == "a" * 40
    assert code_name("a" * 40 + "-dirty") != code_name("a" * 40 + "-dirty")
    assert code_name(None) != code_name(None)
