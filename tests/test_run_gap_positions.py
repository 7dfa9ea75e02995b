"""The command `gap` on positions alone: of repeats, and of one commanded log in windows of time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pendulum as made
import pytest
from pendulum import swung, write_pendulum

from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Recording
from droid_jax.report.gap_folder import Found, read_gap
from droid_jax.run import main

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_line", "tuned")]
FRICTION, NOISE = 0.05, 1e-4  # N m, rad
ASKED = ("joint_coulomb", "cable_pull", "command_delay")


def found(place: Path, recordings: Sequence[Recording], *options: str) -> Found:
    """The command's answer for recordings of the pendulum; its page exists."""
    for recording in recordings:
        save_recording(recording, place / f"{recording.name}.npz")
    files = [str(place / f"{r.name}.npz") for r in recordings]
    asked = ("--effects", *ASKED, *options, "--out", str(place / "run"))
    assert main(["gap", "--recording", *files, *write_pendulum(place), *asked]) == 0
    assert "Position over time" in (place / "run" / "report.html").read_text(encoding="utf-8")
    return read_gap(place / "run").found


def check(answer: Found) -> None:
    """Friction is named, from positions."""
    assert [p.text for p in answer.effects] == ["joint_coulomb at swing"]
    assert answer.coefficients[0].value == pytest.approx(FRICTION, rel=0.25)
    assert (answer.channel, answer.channels, answer.units, answer.distance_unit) == (
        "position", ["position"], "rad", "rad",
    )  # fmt: skip
    distance = answer.discrepancies["validation"]
    assert distance.torque_before is not None and distance.torque_after is not None
    assert 0 < distance.torque_after < distance.torque_before < 0.2


def test_positions_of_repeats(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    recordings = [
        swung(name, 1.0, frequency, noise=NOISE, repeats=8, friction=FRICTION)
        for name, frequency in (("train", 0.6), ("other", 0.9))
    ]
    check(found(tmp_path, recordings))


def test_positions_of_one_commanded_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """With replays of whole motions, and a test recording."""
    monkeypatch.setattr(made, "SECONDS", 18.0)
    logs = [swung("log", 1.0, 0.31, noise=NOISE, friction=FRICTION)]
    judge = swung("judge", 0.8, 0.43, noise=NOISE, friction=FRICTION)
    save_recording(judge, tmp_path / "judge.npz")
    answer = found(tmp_path, logs, "--test-recording", str(tmp_path / "judge.npz"))
    assert answer.split.by == "windows" and "windows of time" in answer.split.limits
    assert [d.recording for d in answer.discrepancies.values()] == [
        "log, every other block", "log, the blocks between", "judge",
    ]  # fmt: skip
    assert answer.open_loop is not None
    error = answer.open_loop.mean_mae["position"]
    assert error.unit == "rad" and error.before is not None and 0 < error.before < 0.2
    run, log = str(tmp_path / "run"), str(tmp_path / "log.npz")
    both = ["gap", "--recording", log, str(tmp_path / "judge.npz"), *write_pendulum(tmp_path), "--effects", *ASKED]
    assert main([*both, "--out", run]) == 2 and "other settings" in capsys.readouterr().err  # it judged before
    evaluate = ["evaluate-fit", "--fit", run, "--recording", log, str(tmp_path / "judge.npz")]
    assert main([*evaluate, "--out", str(tmp_path / "evaluation")]) == 0
    evaluated = json.loads((tmp_path / "evaluation" / "evaluation.json").read_text())
    assert {r["name"]: r["fitted"] for r in evaluated["recordings"]} == {"log": True, "judge": False}
