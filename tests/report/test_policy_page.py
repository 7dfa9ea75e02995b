"""The pages of a trained policy and of an evaluation: their numbers are the files', and a broken folder is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_gap import make_gap
from made_up_run import make_policy, training_json
from reader import Page, read_page, spaced

from droid_jax.policy.trials import BLOWN_UP
from droid_jax.report import page
from droid_jax.report.evaluation_folder import is_evaluation, read_evaluation
from droid_jax.report.gap_folder import read_gap
from droid_jax.report.policy_folder import read_policy
from droid_jax.report.policy_page import policy_doubts, policy_next_step
from droid_jax.report.text import lines


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = make_policy(tmp_path_factory.mktemp("policy") / "run")
    page.write_report(made)
    return made


def test_the_page_shows_what_the_files_hold(folder: Path):
    html = (folder / "report.html").read_text()
    written, transfer = read_page(folder / "report.html"), json.loads((folder / "transfer.json").read_text())
    for where in ("simulation", "synthetic_robot"):
        row = f"trials:{where.replace('_', ' ')}"
        assert written.cells[row, "success"]["values"] == [transfer[where]["success_rate"]]
        assert written.cells[row, "interval"]["values"] == transfer[where]["interval_95"]
        assert float(written.keys[f"success {where.replace('_', ' ')}"]) == transfer[where]["success_rate"]
    assert float(written.keys["success"]) == 0.96  # of the best policy in training
    answer = spaced(written.ids["policy-answer"]["text"])
    assert "98 % of its trials in the simulation" in answer and "95 % of its trials on the synthetic" in answer
    assert html.count("data:image/webp;base64,") == 2
    assert "not hardware" in html and "Hidden in the synthetic robot: closer (2.00)" in written.text
    assert "2 million actions in 7 minutes" in written.text
    assert "held the door open for 0.50 s at 30 degrees or more, knob in hand" in written.text
    for stem in ("learning", "angles"):
        assert (folder / "figures" / f"{stem}.pdf").is_file() and stem in written.ids


@pytest.mark.parametrize(
    ("successes", "simulated", "step", "command"),
    [
        (None, None, "evaluate", "python -m droid_jax.run evaluate"),
        (38, None, "export", "python -m droid_jax.run export"),
        (10, None, "search", "python -m droid_jax.run gap"),
        (0, 0.1, "train longer", "--steps"),
    ],
)
def test_it_says_what_to_do_next(
    tmp_path: Path, quick: None, successes: int | None, simulated: float | None, step: str, command: str
):
    made = make_policy(tmp_path / "run", successes)
    if simulated is not None:
        content = json.loads((made / "transfer.json").read_text())
        content["simulation"]["success_rate"] = simulated
        (made / "transfer.json").write_text(json.dumps(content))
    following = read_page(page.write_report(made)).ids["policy-next"]
    assert following["data-next"] == policy_next_step(read_policy(made), None) == step
    assert command in spaced(following["text"])


def test_a_search_beside_it_changes_what_to_do(tmp_path: Path, quick: None):
    trained = read_policy(make_policy(tmp_path / "run" / "train", 10))
    gap = make_gap(tmp_path / "run" / "gap", "named")
    assert policy_next_step(trained, read_gap(gap)) == "train on the extended model"
    assert f"train --fit {gap}" in read_page(page.write_report(tmp_path / "run")).ids["policy-next"]["text"]
    assert policy_next_step(trained, read_gap(make_gap(tmp_path / "no", "none"))) == "film"


def test_a_training_that_reached_95_percent_in_no_evaluation_is_not_tried_but_made_longer(tmp_path: Path):
    """One evaluation at 95 % is enough: the best policy is kept."""
    for best, step in ((0.94, "train longer"), (0.95, "evaluate")):
        history = [{"step": 1, "seconds": 1.0, "rate": 1.0, "reward": 1.0, "success": s} for s in (0.0, best, 0.5)]
        assert policy_next_step(read_policy(make_policy(tmp_path / f"{best}", None, history=history)), None) == step


def test_a_synthetic_robot_that_was_not_fitted_says_little(tmp_path: Path, quick: None):
    made = make_policy(tmp_path / "run", 10, synthetic_robot={})
    written = read_page(page.write_report(made))
    assert "another one, and says little of it" in written.doubts["another_robot"]
    assert written.ids["policy-next"]["data-next"] == "another robot"


def test_what_it_was_trained_on_is_said(tmp_path: Path, quick: None):
    written = read_page(page.write_report(make_policy(tmp_path / "a", None, effects=["door_closer"])))
    answer = spaced(written.ids["policy-answer"]["text"])
    assert "doors drawn from the fitted distribution, whose model holds door closer" in answer
    setup = {"method": "fitted", "preset": "quick", "knob": 0, "seed": 3, "fit": None}
    written = read_page(page.write_report(make_policy(tmp_path / "b", None, setup=setup)))
    assert "drawn from the prior, before any fit" in spaced(written.ids["policy-answer"]["text"])


def test_a_search_and_a_policy_share_a_page(tmp_path: Path, quick: None):
    made = make_gap(tmp_path / "run")
    make_policy(tmp_path / "policy", None)
    (made / "training.json").write_text((tmp_path / "policy" / "training.json").read_text())
    written = read_page(page.write_report(made))
    assert {"#missing", "#policy"} <= set(written.links) and {"missing", "policy", "lead"} <= set(written.ids)


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("training.json", "{}", "training.json lacks .*'setup'.*run train` again"),
        ("training.json", "{", "cannot be read"),
        ("transfer.json", '{"simulation": {}}', "lacks .*run evaluate` again"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, name: str, content: str, fault: str):
    made = make_policy(tmp_path / "run")
    (made / name).write_text(content)
    with pytest.raises(ValueError, match=fault):
        page.write_report(made)


@pytest.mark.parametrize(
    ("name", "change", "fault"),
    [
        ("training.json", lambda of: of["setup"].pop("fit"), "'setup' lacks 'fit'"),
        ("training.json", lambda of: of["setup"].update(method="x"), "'method' must be one of"),
        ("training.json", lambda of: of["history"][-1].update(of=[]), r"'of' must be a number, got \[\]"),
        (
            "training.json",
            lambda of: of["synthetic_robot"].update(springs="1"),
            "'springs' must be a whole number, got '1'",
        ),
        ("transfer.json", lambda of: of["robot"]["hidden"][0].update(joint=["x"]), "'joint' must be text or null"),
        ("transfer.json", lambda of: of["simulation"]["success"].pop(), "'success' has 39 trials, 'trials' says 40"),
    ],
)
def test_what_the_page_reads_is_checked(tmp_path: Path, name: str, change, fault: str):
    made = make_policy(tmp_path / "run")
    content = json.loads((made / name).read_text())
    change(content)
    (made / name).write_text(json.dumps(content))
    with pytest.raises(ValueError, match=fault):
        page.write_report(made)


def test_trials_that_blew_up_are_said_and_in_no_figure_of_the_page(tmp_path: Path, quick: None):
    made = make_policy(tmp_path / "run")
    transfer = json.loads((made / "transfer.json").read_text())
    robot = transfer["synthetic_robot"]
    robot |= {"stopped": {BLOWN_UP: 2}, "stopped_each": [BLOWN_UP, BLOWN_UP, *[""] * (robot["trials"] - 2)]}
    (made / "transfer.json").write_text(json.dumps(transfer))
    found = read_policy(made).trials["synthetic robot"]
    assert found.counted == robot["trials"] - 2 and found.angles == robot["angle_deg"]["all"][2:]
    cells = read_page(page.write_report(made)).cells
    assert cells["trials:synthetic robot", "trials"]["values"] == [robot["trials"] - 2]
    assert f"2: {BLOWN_UP}" in cells["trials:synthetic robot", "stopped"]["text"]


def test_the_page_says_why_there_are_no_films(tmp_path: Path, quick: None):
    made = make_policy(tmp_path / "run")
    for picture in (made / "films").iterdir():
        picture.unlink()
    content = json.loads((made / "transfer.json").read_text())
    (made / "transfer.json").write_text(json.dumps({**content, "no_films": "they were not asked for (--no-film)"}))
    written = read_page(page.write_report(made))
    assert written.ids["no-films"]["text"] == "No films: they were not asked for (--no-film)."


def test_a_training_that_ended_in_nan_says_so(tmp_path: Path, quick: None):
    history = training_json()["history"]
    for last, held, ended in ((history, False, False), (history[:3], False, True), (history[:3], True, False)):
        made = make_policy(tmp_path / f"{len(last)}_{held}", None, history=last, held=held)
        assert ("ended_early" in policy_doubts(read_policy(made))) is ended
        said = read_page(page.write_report(made)).doubts.get("ended_early", "")
        assert ("before the 2 million actions" in spaced(said)) is ended


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
