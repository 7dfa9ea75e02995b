"""The pictures of a fit: never those of an earlier fit beside new numbers, and drawn later where OpenGL was missing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from droid_jax.commands import identify, report
from droid_jax.commands.identify import Identify
from droid_jax.commands.pictures import draw_replay, keep_replay, measured_states
from droid_jax.model.scene import Scene, load_scene
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.report import page, render, viewer
from droid_jax.storage import write_npz

TWO_LINK = Path(__file__).resolve().parents[1] / "docs" / "examples" / "two_link.xml"
OLD = ("frames/after_00_0.0s.png", "films/replay.webp", "replay.npz", "viewer.html")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(TWO_LINK)


def replay(folder: Path, states: np.ndarray) -> None:
    shutil.copy(TWO_LINK, folder / "fitted.xml")
    write_npz(folder / "replay.npz", {"time": np.arange(len(states)) / 25.0, "before": states, "after": states})


def test_a_log_without_commands_leaves_no_pictures_of_an_earlier_fit(tmp_path: Path):
    for name in OLD:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"old")
    log = Recording("log", np.zeros(0), np.zeros((0, 0)), (), {}, None, {})  # type: ignore[arg-type]
    keep_replay(tmp_path, None, log)  # type: ignore[arg-type]
    assert [name for name in OLD if (tmp_path / name).exists()] == []


def test_the_measured_motion_is_the_mean_of_what_was_measured(scene: Scene):
    """On the replay's clock, joint by joint; a joint that was not measured has its simulated position."""
    joint, other = scene.joints[:2]
    clock = np.array([1.0, 2.0, 3.0])
    values = np.array([[[0.0], [1.0], [2.0]], [[0.0], [3.0], [9.0]]])
    mask = np.array([[[True], [True], [True]], [[True], [True], [False]]])
    channel = Channel("position", "rad", (joint,), clock, values, mask)
    log = Recording("log", clock, np.zeros((3, 1)), (joint,), {"position": channel}, None)  # type: ignore[arg-type]
    found = measured_states(scene, log, np.array([0.0, 0.5, 2.0]), np.full((3, scene.model.nq), 7.0))
    assert found["measured_joints"].tolist() == [joint] and found["start"] == 1.0
    np.testing.assert_allclose(found["measured"][:, scene.qpos(joint)], [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(found["measured"][:, scene.qpos(other)], 7.0)
    unmeasured = Channel("position", "rad", (joint,), clock, values, np.zeros_like(mask))
    log = Recording("log", clock, np.zeros((3, 1)), (joint,), {"position": unmeasured}, None)  # type: ignore[arg-type]
    assert measured_states(scene, log, np.zeros(3), np.zeros((3, scene.model.nq))) == {}


def test_the_viewer_holds_pictures_and_residuals_of_every_joint(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Of the measurement and both simulations; older replays, without a measurement, show the simulations."""
    asked = list[np.ndarray]()

    def drawn(model, states, rows, camera, size):
        asked.append(states)
        return [np.zeros((4, 6, 3), np.uint8) for _ in rows]

    monkeypatch.setattr(viewer, "rendered_frames", drawn)
    states = np.linspace(0.0, 1.0, 5)[:, None] * np.ones(scene.model.nq)
    joints = np.array(scene.joints)
    write_npz(
        tmp_path / "replay.npz",
        {"time": np.arange(5) / 25.0, "before": 2 * states, "after": states, "measured": states - 0.5,
         "measured_joints": joints, "recording": np.array("</script>"), "start": np.array(0.0)},
    )  # fmt: skip
    text = viewer.write_viewer(tmp_path, scene.model).read_text()
    assert len(asked) == 3 and "</script>" not in text.replace("</script>\n</body>", "")
    data = json.loads(text.split("const data = ")[1].split(";\n")[0])
    assert {side: len(uris) for side, uris in data["pictures"].items()} == {"measured": 3, "before": 3, "after": 3}
    assert data["time"] == [0.0, 0.08, 0.16] and len(data["series"]) == len(joints)
    assert data["series"][0]["measured"] == [-0.5, -0.25, 0.0, 0.25, 0.5] and data["series"][0]["unit"] == "rad"
    asked.clear()
    replay(tmp_path, states)
    text = viewer.write_viewer(tmp_path, scene.model, None, [np.zeros((4, 6, 3), np.uint8)] * 3).read_text()
    assert not asked and "No joint's position is known" in text
    assert set(json.loads(text.split("const data = ")[1].split(";\n")[0])["pictures"]) == {"before", "after"}


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
    monkeypatch.setattr(viewer, "write_viewer", lambda *_: None)
    draw_replay(tmp_path)  # nothing to draw
    replay(tmp_path, np.zeros((5, scene.model.nq)))
    draw_replay(tmp_path)
    assert "no pictures: no OpenGL here" in capsys.readouterr().err and not (tmp_path / "frames").exists()
    asked.append(0.0)
    for _ in range(2):
        draw_replay(tmp_path)
    assert asked[1:] == [pytest.approx(0.04)] and len(list((tmp_path / "frames").glob("after_*.png"))) == 4


def test_a_replay_that_cannot_be_shown_ends_no_run(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    replay(tmp_path, np.full((5, scene.model.nq), np.nan))
    draw_replay(tmp_path)
    assert "no pictures: frames: qpos row 0 is not finite" in capsys.readouterr().err
    assert not (tmp_path / "frames").exists()


def test_a_finished_run_is_asked_for_its_pictures(tuned: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Before its page is built: OpenGL may be there by now."""
    did = list[str]()
    monkeypatch.setattr(identify, "finished", lambda *_: True)
    monkeypatch.setattr(report, "draw_replay", lambda out: did.append("draw"))
    monkeypatch.setattr(page, "write_report", lambda folder: did.append("report"))
    identify.run(Identify(out=tmp_path))
    assert did == ["draw", "draw", "report"]  # of the folder, or of its part
