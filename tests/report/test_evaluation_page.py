"""The page of an evaluation: its numbers are those of its file, and a broken folder is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reader import Page, read_page, spaced

from droid_jax.report import page
from droid_jax.report.evaluation_folder import is_evaluation, read_evaluation
from droid_jax.report.text import lines

ERRORS = {
    "unit": "rad", "joints": ["elbow", "wrist"],
    "mae_before": [0.04, 0.02], "mae_after": [0.01, 0.004],
    "rms_before": [0.05, 0.03], "rms_after": [0.012, 0.005],
}  # fmt: skip
RECORDING = {"name": "wave", "sha256": "ab" * 32, "repeats": 1, "duration": 6.0, "fitted": False, "blown_up": []}


def make_evaluation(folder: Path, **changes: Any) -> Path:
    """An evaluation of one recording with made-up numbers; changes: of its entry of the recording."""
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "format": "droid_jax evaluation", "version": 1, "fit": {"folder": "runs/fit", "stage": "identify"},
        "scene": "arm", "effects": ["load_friction"], "recordings": [RECORDING | changes],
        "errors": {"wave": {"position": ERRORS}},
        "mean_mae": {"position": {"unit": "rad", "before": 0.03, "after": 0.007}},
    }  # fmt: skip
    (folder / "evaluation.json").write_text(json.dumps(content))
    time = np.linspace(0.0, 6.0, 50)
    traces = {key: np.sin(time)[:, None] * [1.0, 0.5] for key in ("measured_mean", "measured_low", "measured_high")}
    traces |= {"before": 0.8 * traces["measured_mean"], "after": traces["measured_mean"]}
    named = {f"wave/position/{key}": value for key, value in traces.items()}
    np.savez(
        folder / "evaluation.npz", **named, **{"wave/position/time": time, "wave/position/joints": ["elbow", "wrist"]}
    )
    return folder


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, one_line: None) -> Page:
    folder = make_evaluation(tmp_path_factory.mktemp("evaluation") / "run", fitted=True, blown_up=["before"])
    return read_page(page.write_report(folder))


def test_the_page_says_what_the_file_says(written: Page):
    said = spaced(written.ids["evaluation-answer"]["text"])
    assert (
        "The model that identify fitted in runs/fit, with load friction, was replayed open loop over 1 recording"
        in said
    )
    assert "The mean absolute position error fell from 0.0300 to 0.00700 rad" in said
    doubts = spaced(written.ids["evaluation-doubts"]["text"])
    assert "“wave” was given to the fit" in doubts and "“wave” blows up before the fit" in doubts
    table = spaced(written.ids["evaluation-errors"]["text"])
    assert "Elbow 0.0400 0.0100 0.0500 0.0120" in table and "Wrist 0.0200 0.00400 0.0300 0.00500" in table


def test_the_terminal_says_it_too(tmp_path: Path):
    said = lines("evaluation.txt.jinja", found=read_evaluation(make_evaluation(tmp_path)))
    assert said[0] == "wave: mean absolute position error 0.0300 -> 0.00700 rad"
    assert said[-1] == "mean of 1 recording, position: 0.0300 -> 0.00700 rad"


def test_a_broken_folder_is_named(tmp_path: Path):
    folder = make_evaluation(tmp_path / "run")
    np.savez(folder / "evaluation.npz", time=np.arange(3.0))
    with pytest.raises(ValueError, match=r"evaluation\.npz lacks 'wave/position/time'.*evaluate-fit"):
        read_evaluation(folder)
    content = json.loads((folder / "evaluation.json").read_text())
    (folder / "evaluation.json").write_text(json.dumps(content | {"version": 7}))
    with pytest.raises(ValueError, match="has version 7, this program reads version 1"):
        read_evaluation(folder)
    assert is_evaluation(folder / "evaluation.json")
    (folder / "evaluation.json").write_text("{}")
    assert not is_evaluation(folder / "evaluation.json")
