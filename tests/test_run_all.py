"""`all`: its stages, what they are given, and what is not run again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from droid_jax import runtime
from droid_jax.commands import evaluate, gap, hidden, identify, report, train, whole
from droid_jax.commands.folder import OtherRun
from droid_jax.commands.hidden import known_stand_in
from droid_jax.commands.source import stand_in_of
from droid_jax.run import main

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """The stages' commands, in the order in which they were run; nothing is recorded or fitted."""
    commands: list[Any] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runtime, "tune", lambda *a, **k: None)  # jax runs already in this process
    for module in (identify, gap, train, evaluate):
        monkeypatch.setattr(module, "run", commands.append)
    monkeypatch.setattr(hidden, "kept_recording", lambda path, again, name, record: None)
    monkeypatch.setattr(report, "write", lambda folder: folder / "report.html")
    return commands


def found(folder: Path, effects: list[str]) -> None:
    """A folder with the results of a search."""
    folder.mkdir(parents=True)
    gaps = {role: {"closed": 0.5 + 0.1 * k} for k, role in enumerate(("fit", "confirm", "sealed"))}
    (folder / "gap.json").write_text(
        json.dumps({"effects": effects, "sentence": "The model lacks: latch.", "gaps": gaps})
    )


def test_without_arguments_every_stage_runs_on_one_recording(called, tmp_path: Path, capsys):
    assert main([]) == 0
    fit, search, policy, trials = called
    files = tuple(Path("runs/all/recordings") / f"{name}.npz" for name in "CBA")
    assert fit.recording == files[:2] and search.recording == files
    assert policy.fit == fit.out and policy.out == trials.run == Path("runs/all/train")
    assert known_stand_in(files) == {"springs": 1, "seed": 0, "hide": ["magnetic_catch=1.5"]}
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("[")] == [
        "[1/4] identify", "[2/4] gap", "[3/4] train", "[4/4] evaluate",
    ]  # fmt: skip
    assert lines[-1] == "report: runs/all/report.html"


def test_the_search_for_what_is_missing_begins_at_the_fit(called, tmp_path: Path):
    assert main(["all", "--stages", "gap"]) == 0
    (tmp_path / "runs" / "all" / "identify").mkdir(parents=True)
    (tmp_path / "runs" / "all" / "identify" / "fit.json").write_text("{}")
    assert main(["all", "--stages", "gap"]) == 0
    assert [c.fit for c in called] == [None, Path("runs/all/identify")]


def test_a_policy_is_trained_on_the_extended_model_where_there_is_one(called, tmp_path: Path, capsys):
    found(tmp_path / "runs" / "all" / "gap", ["latch at door_hinge"])
    assert main(["all", "--stages", "train"]) == 0
    assert called[0].fit == Path("runs/all/gap")
    assert "gap: The model lacks: latch.; 70 % of the gap closed on the sealed motion" in capsys.readouterr().out


def test_without_a_named_effect_it_is_trained_on_the_fit(called, tmp_path: Path):
    found(tmp_path / "run" / "gap", [])
    assert main(["all", "--stages", "train", "--out", "run"]) == 0
    assert called[0].fit == Path("run/identify")


def test_a_stage_with_other_inputs_is_run_again(called, monkeypatch: pytest.MonkeyPatch, capsys):
    def changed(command: identify.Identify) -> None:
        called.append(command)
        if not command.again:
            raise OtherRun(command.out, ["recordings_sha256"])

    monkeypatch.setattr(identify, "run", changed)
    assert main(["all", "--stages", "identify"]) == 0
    assert [command.again for command in called] == [False, True]
    assert "other settings (recordings_sha256): it is run again" in capsys.readouterr().out


def test_another_stand_in_is_recorded_anew(called, tmp_path: Path):
    """Also where a stop left some recordings of the one before."""
    files = [tmp_path / "runs" / "all" / "recordings" / f"{name}.npz" for name in "CB"]
    for springs, kept in (("1", True), ("2", False), ("2", True)):
        if not kept or springs == "1":
            assert main(["all", "--stages", "gap", "--springs", "1"]) == 0
            for file in files:
                file.write_text("of this robot")
        else:
            for file in files:
                file.write_text("of this robot")
        assert main(["all", "--stages", "gap", "--springs", springs]) == 0
        assert [file.is_file() for file in files] == [kept] * 2


def test_what_no_policy_can_be_tried_with_is_said_at_once(called, capsys):
    assert main(["all", "--hide", "sensor_delay=0.01"]) == 2
    said = capsys.readouterr().err
    assert "hidden effects sensor_delay change whole traces" in said and "--stages identify gap train" in said
    assert called == []
    assert main(["all", "--hide", "sensor_delay=0.01", "--stages", "identify", "gap"]) == 0


def test_a_search_in_other_recordings_is_not_trained_on(called, tmp_path: Path):
    """The fit is of another robot by now, the search was not run again."""
    for stage, recordings in (("identify", ["new C", "new B"]), ("gap", ["old C", "old B", "old A"])):
        found(tmp_path / "run" / stage, ["latch at hinge"])
        (tmp_path / "run" / stage / "setup.json").write_text(json.dumps({"recordings_sha256": recordings}))
    assert main(["all", "--stages", "train", "--out", "run"]) == 0
    (tmp_path / "run" / "gap" / "setup.json").write_text('{"recordings_sha256": ["new C", "new B", "new A"]}')
    assert main(["all", "--stages", "train", "--out", "run"]) == 0
    assert [c.fit for c in called] == [Path("run/identify"), Path("run/gap")]


def test_your_own_recordings_know_no_stand_in(called, tmp_path: Path):
    assert main(["all", "--recording", "a.npz", "b.npz", "--stages", "identify", "gap"]) == 0
    assert called[0].recording == called[1].recording == (Path("a.npz"), Path("b.npz"))
    (tmp_path / "setup.json").write_text(json.dumps({"command": "identify", "recording": ["a.npz", "b.npz"]}))
    assert stand_in_of(tmp_path) == {}


def test_presets_reach_the_stages(called):
    assert main(["all", "--preset", "paper", "--seed", "3"]) == 0
    fit, search, policy, _ = called
    assert (fit.preset, search.preset, policy.preset) == ("standard", "standard", "paper")
    assert {c.seed for c in called} == {3}
    assert whole.PRESETS["gpu"] == ("gpu", "gpu")


def test_jax_is_tuned_before_the_stand_in_is_recorded(tmp_path: Path):
    """In a process of its own, where nothing has started jax: it could not be tuned afterwards."""
    code = (
        "from droid_jax.commands import hidden, identify, report, whole\n"
        "hidden.kept_recording = lambda path, again, name, record: None\n"
        "def fit(command):\n"
        "    from droid_jax import runtime\n"
        "    runtime.tune()\n"
        "    print('tuned twice')\n"
        "identify.run = fit\n"
        "report.write = lambda folder: folder\n"
        "whole.run(whole.All(stages=('identify',)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
                          capture_output=True, text=True, timeout=120)  # fmt: skip
    assert "tuned twice" in done.stdout, done.stderr
