"""The pictures of a fit: never an earlier one's beside a new one's numbers, and drawn later where they could not be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from droid_jax.commands import identify
from droid_jax.commands.identify import Identify
from droid_jax.commands.pictures import draw_replay, keep_replay
from droid_jax.model.scene import Scene, load_scene
from droid_jax.recordings.recording import Recording
from droid_jax.report import page, render
from droid_jax.storage import write_npz

OLD = ("frames/after_00_0.0s.png", "films/replay.webp", "replay.npz")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(Path(__file__).resolve().parents[1] / "docs" / "examples" / "two_link.xml")


def replay(folder: Path, states: np.ndarray) -> None:
    write_npz(folder / "replay.npz", {"time": np.arange(len(states)) / 25.0, "before": states, "after": states})


def test_a_log_without_commands_leaves_no_pictures_of_an_earlier_fit(tmp_path: Path):
    for name in OLD:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"old")
    log = Recording("log", np.zeros(0), np.zeros((0, 0)), (), {}, None, {})  # type: ignore[arg-type]
    keep_replay(tmp_path, None, log)  # type: ignore[arg-type]
    assert [name for name in OLD if (tmp_path / name).exists()] == []


def test_what_could_not_be_drawn_is_drawn_later_and_once(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    asked = list[float]()

    def drawn(model, states, rows, camera):
        if not asked:
            raise render.NoOpenGL("no OpenGL here")
        return [np.zeros((4, 4, 3), np.uint8) for _ in rows]

    monkeypatch.setattr(render, "rendered_frames", drawn)
    monkeypatch.setattr(render, "film", lambda path, model, sides, period, camera: asked.append(period))
    draw_replay(tmp_path, scene)  # nothing to draw
    replay(tmp_path, np.zeros((5, scene.model.nq)))
    draw_replay(tmp_path, scene)
    assert "no pictures: no OpenGL here" in capsys.readouterr().err and not (tmp_path / "frames").exists()
    asked.append(0.0)
    for _ in range(2):
        draw_replay(tmp_path, scene)
    assert asked[1:] == [pytest.approx(0.04)] and len(list((tmp_path / "frames").glob("after_*.png"))) == 4


def test_a_replay_that_cannot_be_shown_ends_no_run(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    replay(tmp_path, np.full((5, scene.model.nq), np.nan))
    draw_replay(tmp_path, scene)
    assert "no pictures: frames: qpos row 0 is not finite" in capsys.readouterr().err
    assert not (tmp_path / "frames").exists()


def test_a_finished_run_is_asked_for_its_pictures(tuned: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Before its page is built: OpenGL may be there by now."""
    did = list[str]()
    monkeypatch.setattr(identify, "finished", lambda *_: True)
    monkeypatch.setattr(identify, "draw_replay", lambda out, scene: did.append(f"draw {scene.name}"))
    monkeypatch.setattr(page, "write_report", lambda folder: did.append("report"))
    identify.run(Identify(out=tmp_path))
    assert len(did) == 2 and did[0].startswith("draw door") and did[1] == "report"
