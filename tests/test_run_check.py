"""`check`: what it prints and writes, with a scene and without."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_link import ARM, measured, recording

from droid_jax.preflight.inspect_log import contents
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Recording
from droid_jax.run import main


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(gravcomp='gravcomp="1"', friction="", sensor=""))
    return path


def wave(**changes: object) -> Recording:
    return recording(channels=measured(0.0), qpos0={}, **changes)


def found(folder: Path) -> list[tuple[str, str]]:
    """(kind, severity) of what check.json holds of its first recording."""
    whole = json.loads((folder / "check.json").read_text())
    assert whole["format"] == "droid_jax check 1"
    return [(f["kind"], f["severity"]) for f in whole["recordings"][0]["findings"]]


def test_contents():
    log = wave()
    position = replace(log.channels["position"], time=np.delete(np.arange(502) * 0.002, 200)[:501])
    position.mask[0, :100, 1] = False
    command, torque, channel = contents(replace(log, channels={**log.channels, "position": position}))
    assert (command.name, command.rows, command.gaps) == ("command", 501, 0) and command.rate == pytest.approx(500)
    assert torque.columns[0].unit == "N m" and torque.columns[0].measured == 1.0
    assert channel.longest == pytest.approx(0.004) and channel.jitter == pytest.approx(1.0)
    assert channel.columns[1].measured == pytest.approx(1 - 100 / 1002)
    seen = position.values[..., 1][position.mask[..., 1]]
    assert (channel.columns[1].low, channel.columns[1].high) == (seen.min(), seen.max())


def test_a_wrong_unit_is_on_the_terminal_in_the_page_and_in_the_json(
    tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]
):
    wrong = {**measured(0.0)}
    wrong["position"] = replace(wrong["position"], values=np.rad2deg(wrong["position"].values))
    path = save_recording(wave().__class__(**{**vars(wave()), "channels": wrong}), tmp_path / "wave.npz")
    out = tmp_path / "check"
    assert main(["check", "--recording", str(path), "--scene", str(scene), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "certain: " in said and "degrees" in said and f"page: {out / 'check.html'}" in said
    assert ("units", "certain") in found(out)
    page = (out / "check.html").read_text()
    assert "in degrees" in page and "<svg" in page and "shoulder" in page
    assert main(["check", "--recording", str(path), "--out", str(out)]) == 0  # again, without a scene
    assert ("units", "certain") not in found(out)
    assert "Without a scene: units, signs and gains were not judged" in (out / "check.html").read_text()


def test_commands_that_the_scene_lacks_are_said(tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]):
    names = {"shoulder": "lift", "elbow": "elbow"}
    log = wave(command_names=tuple(names.values()), gains=None)
    channels = {k: replace(c, columns=tuple(names[j] for j in c.columns)) for k, c in log.channels.items()}
    path = save_recording(replace(log, channels=channels), tmp_path / "wave.npz")
    assert main(["check", "--recording", str(path), "--scene", str(scene), "--out", str(tmp_path / "check")]) == 0
    assert "has no commands for shoulder" in " ".join(capsys.readouterr().out.split())


def test_bad_calls(tmp_path: Path, scene: Path, capsys: pytest.CaptureFixture[str]):
    path = save_recording(wave(), tmp_path / "wave.npz")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "check.json").write_text("dear")
    for arguments, said in (
        ([], "check needs --recording"),
        (["--recording", str(path), "--joints", "elbow"], "give --scene too"),
        (["--recording", str(tmp_path / "no.npz")], "there is no such file or folder"),
        (["--recording", str(path), "--out", str(tmp_path / "mine")], "was not written by this program"),
    ):
        assert main(["check", *arguments]) == 2
        assert said in capsys.readouterr().err
