"""`view`: the models it shows, and its messages where it cannot show them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from droid_jax.commands import view
from droid_jax.commands.view import page_of, replay_of, serve, side_by_side
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_space
from droid_jax.files import FITTED, REPLAY, VIEWER
from droid_jax.model.mjcf import fitted_mjcf
from droid_jax.run import main

ROOT = Path(__file__).resolve().parents[1]
OPENS_A_WINDOW = "import glfw; assert glfw.init() and glfw.create_window(9, 9, '', None, None)"
# The command as it is; its window closes once the door has stood open and the screen shows more than the panels of the
# viewer, which have less than a hundred colours.
WATCHED = """
import sys, threading, time
import mujoco.viewer
import numpy as np
from droid_jax.run import main

folder, screen = sys.argv[1:]
shown, began, sync = [], time.monotonic(), mujoco.viewer.Handle.sync

def watched(window, *arguments):
    sync(window, *arguments)
    shown.append(window.d.qpos.copy())
    colours = len(np.unique(np.fromfile(screen, np.uint32)[-1280 * 720:]))  # behind the header of an X window dump
    opened = np.ptp(shown, axis=0).max()
    if opened > 0.79 and colours > 500 or time.monotonic() - began > 60.0:
        print(opened, colours)
        window.close()

mujoco.viewer.Handle.sync = watched
assert main(["view", folder]) == 0
assert threading.active_count() == 1  # the window is down, or the end of the program may be a segmentation fault
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder as far as `view` reads it: the built-in scene, and a door that opens in "after" alone."""
    made, scene = tmp_path_factory.mktemp("view"), door_scene()
    space = door_space(scene)
    (made / FITTED).write_text(fitted_mjcf(scene, space, space.mean))
    before = np.tile(scene.model.qpos0, (5, 1))
    after = before.copy()
    after[:, scene.qpos(scene.object_joint)] = np.linspace(0.0, 0.8, 5)
    np.savez(made / REPLAY, time=np.arange(5) / 25.0, before=before, after=after)
    return made


def test_a_replay_that_was_cut_off_is_named(folder: Path, tmp_path: Path):
    whole = (folder / REPLAY).read_bytes()
    (tmp_path / REPLAY).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=f"{REPLAY} cannot be read .*identify` again .* and --again"):
        replay_of(tmp_path)


def test_the_two_stand_side_by_side_and_move_as_they_did(folder: Path):
    clock, states = replay_of(folder)
    (model, moved), one = side_by_side(folder / FITTED), mujoco.MjModel.from_xml_path(str(folder / FITTED))
    assert states.shape == (5, model.nq) == (len(clock), 2 * one.nq)
    both, alone = mujoco.MjData(model), mujoco.MjData(one)
    both.qpos[:] = states[-1] + moved
    mujoco.mj_kinematics(model, both)
    for name, side in (("before", states[-1][: one.nq]), ("after", states[-1][one.nq :])):
        alone.qpos[:] = side
        mujoco.mj_kinematics(one, alone)
        apart = both.site(f"{name}/knob").xpos - alone.site("knob").xpos
        np.testing.assert_allclose(apart[[0, 2]], 0.0, atol=1e-9)
        assert apart[1] > 0.5 if name == "before" else apart[1] < -0.5


def test_free_bodies_stand_side_by_side_too_and_nothing_is_warned_of(tmp_path: Path, capfd):
    """Their positions are the world's; and options that differ from MuJoCo's own are no conflict."""
    (tmp_path / FITTED).write_text(
        '<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>'
        '<body name="cube" pos="0.3 0.1 0.5" euler="0 0 30"><freejoint/><geom size="0.1"/></body>'
        "</worldbody></mujoco>"
    )
    model, moved = side_by_side(tmp_path / FITTED)
    data = mujoco.MjData(model)
    data.qpos[:] = np.tile([1.0, 2.0, 3.0, 0.0, 1.0, 0.0, 0.0], 2) + moved
    mujoco.mj_kinematics(model, data)
    before, after = (data.body(f"{name}/cube").xpos for name in ("before", "after"))
    np.testing.assert_allclose(0.5 * (before + after), [1.0, 2.0, 3.0])
    assert before[1] - after[1] == pytest.approx(1.6 * mujoco.MjModel.from_xml_path(str(tmp_path / FITTED)).stat.extent)
    assert "Attach conflict" not in capfd.readouterr().err


@pytest.mark.parametrize("screen", [None, ":99"])
def test_without_a_screen_it_names_the_film(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys, screen: str | None):
    """Also where one is named that cannot be opened."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if screen:
        monkeypatch.setenv("DISPLAY", screen)
    assert main(["view", str(folder)]) == 2
    said = capsys.readouterr().err
    assert f"no window can be opened here; the same replay is a film in {folder / 'report.html'}" in said


def test_without_a_path_it_shows_what_the_default_command_left(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    (tmp_path / "runs" / "all").mkdir(parents=True)
    (tmp_path / "runs" / "all" / "identify").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view"]) == 2
    assert f"a film in {Path('runs/all/identify/report.html')}" in capsys.readouterr().err


def test_the_page_is_served_until_it_is_interrupted(monkeypatch: pytest.MonkeyPatch, capsys):
    """At the local address and a free port, for every requested path."""
    servers = list[ThreadingHTTPServer]()

    class Kept(ThreadingHTTPServer):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            servers.append(self)

    monkeypatch.setattr(view, "ThreadingHTTPServer", Kept)
    thread = threading.Thread(target=serve, args=(b"<p>page</p>", "127.0.0.1", 0))
    thread.start()
    while not servers:
        thread.join(0.01)
    host, port = servers[0].server_address[:2]
    assert host == "127.0.0.1"
    for path in ("", "anything"):
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=10) as answer:
            assert answer.read() == b"<p>page</p>" and answer.headers["Content-Type"].startswith("text/html")
    with pytest.raises(ValueError, match=f"--port {port}: .*choose another --port"):
        serve(b"", "127.0.0.1", port)
    servers[0].shutdown()
    thread.join(10)
    assert not thread.is_alive() and f"ssh -L {port}:127.0.0.1:{port}" in capsys.readouterr().out


def test_a_page_that_is_there_is_not_drawn_again(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One that is not is drawn first; a port that is none is refused."""
    drawn = list[Path]()

    def write(where: Path, model: mujoco.MjModel) -> None:
        drawn.append(where)
        (where / VIEWER).write_bytes(b"drawn")

    monkeypatch.setattr("droid_jax.report.viewer.write_viewer", write)
    shutil.copytree(folder, tmp_path / "run")
    assert [page_of(tmp_path / "run") for _ in range(2)] == [b"drawn", b"drawn"] and drawn == [tmp_path / "run"]
    with pytest.raises(ValueError, match="from 0 to 65535, got 70000"):
        view.run(view.View(tmp_path / "run", port=70000))


def test_a_folder_without_a_replay_is_refused(tmp_path: Path, capsys):
    assert main(["view", str(tmp_path)]) == 2
    assert f"{tmp_path} holds no replay.npz: `python -m droid_jax.run identify` writes one" in capsys.readouterr().err


@pytest.fixture
def screen(tmp_path: Path) -> Iterator[tuple[dict[str, str], Path]]:
    """A screen in memory: the environment of a program that shall use it, and the file of its pixels.

    Skips where there is none, or no OpenGL on it.
    """
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb on the path")
    reader, writer = os.pipe()
    options = ["-displayfd", str(writer), "-screen", "0", "1280x720x24", "-fbdir", str(tmp_path), "-noreset"]
    with subprocess.Popen(["Xvfb", *options], pass_fds=[writer], stderr=subprocess.DEVNULL) as server:
        os.close(writer)
        with os.fdopen(reader) as told:
            number = told.readline().strip()
        environment = {k: v for k, v in os.environ.items() if k not in ("WAYLAND_DISPLAY", "MUJOCO_GL")}
        environment |= {"DISPLAY": f":{number}", "PYTHONPATH": str(ROOT)}
        try:
            tried = subprocess.run(
                [sys.executable, "-c", OPENS_A_WINDOW], env=environment, capture_output=True, timeout=60
            )
            if not number or tried.returncode:
                pytest.skip("Xvfb opens no window with OpenGL here")
            yield environment, tmp_path / "Xvfb_screen0"
        finally:
            server.terminate()


def test_on_a_screen_it_plays_until_the_window_is_closed(folder: Path, screen: tuple[dict[str, str], Path]):
    environment, pixels = screen
    command = [sys.executable, "-c", WATCHED, str(folder), str(pixels)]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    opened, colours = map(float, run.stdout.split())
    assert opened == pytest.approx(0.8) and colours > 500
