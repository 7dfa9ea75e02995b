"""Which results in a folder of `all` belong together, and which runs are complete."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from droid_jax.files import EXTENDED, GAUSSIAN, LAST_FILES
from droid_jax.report.page import write_report
from droid_jax.report.stages import extended_of, fingerprint, left_over, needs_whole, setup, unfinished


def run(whole: Path, stage: str, last: bool = True, files: dict[str, str] | None = None, **setup: Any) -> Path:
    """A stage's folder with a setup, results and what is written last."""
    folder = whole / stage
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "setup.json").write_text(json.dumps({"preset": "quick", **setup}))
    for name, text in (files or {}).items():
        (folder / name).write_text(text)
    if last:
        (folder / LAST_FILES[stage]).write_text("{}")
    return folder


def whole_run(place: Path, robot: str = "one") -> Path:
    run(place, "identify", recordings_sha256=[robot], files={GAUSSIAN: robot})
    gap = run(place, "gap", recordings_sha256=[robot, "test"], files={EXTENDED: robot})
    run(place, "train", fit=str(gap), fit_sha256=fingerprint(gap))
    return place


def test_what_was_made_together_belongs_together(tmp_path: Path):
    assert left_over(whole_run(tmp_path)) == frozenset()
    assert left_over(tmp_path / "nothing") == frozenset()


def test_stages_of_an_earlier_robot_are_left_over(tmp_path: Path):
    run(whole_run(tmp_path), "identify", recordings_sha256=["two"])
    assert left_over(tmp_path) == {"gap", "train"}
    run(tmp_path, "gap", recordings_sha256=["two", "test"], files={EXTENDED: "two"})
    assert left_over(tmp_path) == {"train"}  # of another model now


def test_a_search_in_another_scene_is_left_over(tmp_path: Path):
    run(tmp_path, "identify", recordings_sha256=["one"], scene_sha256="a")
    run(tmp_path, "gap", recordings_sha256=["one"], scene_sha256="b")
    assert left_over(tmp_path) == {"gap"}
    run(tmp_path, "gap", recordings_sha256=["one"], scene_sha256="b", preset="standard")  # with a time step of its own
    assert left_over(tmp_path) == frozenset()


@pytest.mark.parametrize("stage", LAST_FILES)
def test_a_run_is_whole_with_what_is_written_last(tmp_path: Path, stage: str):
    folder = run(tmp_path, stage, last=False, files={GAUSSIAN: "of an earlier run"})
    assert unfinished(folder)
    with pytest.raises(ValueError, match="holds a run that is not complete: run its command again"):
        needs_whole(folder)
    with pytest.raises(ValueError, match="run its command again"):  # and not one to run another command
        write_report(folder)
    run(tmp_path, stage)
    assert not unfinished(folder)
    (tmp_path / GAUSSIAN).write_text("given by hand")
    assert not unfinished(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "not valid JSON, line 1"),
        ("[]", "must be an object"),
        ("7", "must be an object"),
        ('{"recordings_sha256": 0}', "'recordings_sha256' must be a list, got 0"),
        ('{"preset": 5}', "'preset' must be text, got 5"),
        ('{"seed": NaN}', "NaN is no number"),
    ],
)
def test_a_damaged_setup_is_said(tmp_path: Path, text: str, said: str):
    """It does not show which results belong together; those of an earlier run could be mistaken for this run's."""
    (tmp_path / "setup.json").write_text(text)
    for ask in (setup, extended_of, unfinished, needs_whole):
        with pytest.raises(ValueError, match=r"setup\.json.*start the run of this folder over with --again") as caught:
            ask(tmp_path)
        assert said in str(caught.value)
    assert setup(tmp_path / "none") == {}


def test_the_extended_model_is_the_folders_own_or_the_one_that_was_fitted(tmp_path: Path):
    told = run(tmp_path, "identify", extended="elsewhere/extended.json")
    assert extended_of(told) == Path("elsewhere/extended.json") and extended_of(tmp_path) is None
    assert extended_of(run(tmp_path, "gap", files={EXTENDED: "{}"})) == tmp_path / "gap" / EXTENDED
