"""What the default command's printed lines tell of time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import default_run
from benchmarks.default_run import Line, command_lines, figures
from droid_jax.commands import all_stages as whole


def test_times_are_those_of_the_lines():
    said = ["starting jax ...", "", "[1/2] record", "[1/2] record: 0.5 minutes", "[2/2] gap", "[2/2] gap: 6.0 minutes"]
    found = figures([Line(s, text) for s, text in zip((2.0, 2.5, 9.0, 39.0, 39.0, 400.0), said, strict=True)])
    assert (found["first_line_s"], found["first_stage_s"], found["longest_silence_s"]) == (2.0, 9.0, 361.0)
    assert found["minutes"] == {"record": 0.5, "gap": 6.0} and found["whole_minutes"] == pytest.approx(400 / 60)
    assert figures([Line(3.0, "starting jax ...")])["longest_silence_s"] == 3.0  # the one before the first counts


def test_the_time_that_is_said_to_be_left_is_the_measured_one():
    measured = json.loads((default_run.ROOT / "benchmarks" / "results" / "default_run.json").read_text())
    assert measured["minutes"] == whole.MINUTES


def test_a_command_that_fails_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "droid_jax").mkdir()
    (tmp_path / "droid_jax" / "__init__.py").touch()
    (tmp_path / "droid_jax" / "run.py").write_text("print('begun'); raise SystemExit('error: no room')")
    monkeypatch.setattr(default_run, "ROOT", tmp_path)
    monkeypatch.setattr(default_run, "empty_cache", lambda folder: {"PYTHONPATH": str(tmp_path)})
    with pytest.raises(RuntimeError, match=r"ended with 1: error: no room"):
        list(command_lines(tmp_path / "out", str(tmp_path)))
