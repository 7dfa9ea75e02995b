"""`view`: a fit's replay in MuJoCo's viewer, before and after side by side, or in a browser beside the measurement."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from droid_jax.commands.folder import stage_folder
from droid_jax.files import FITTED, REPLAY, VIEWER

if TYPE_CHECKING:
    import mujoco
    import numpy as np

DISTANCE = 1.6  # between the two copies, relative to the scene's extent


@dataclass(frozen=True)
class View:
    """Show the replay in MuJoCo's viewer: before the fit on the left, after it on the right. Needs a screen.

    With --port it serves a page for a browser instead, with the measured motion, a slider, and the residuals of every
    joint.
    """

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of `identify` or of `all`. Default: runs/identify if it has a replay, otherwise runs/all."""
    speed: float = 1.0
    """Speed relative to real time, in MuJoCo's viewer."""
    port: int | None = None
    """Serve the page for a browser at this port until Ctrl-C; 0 takes a free port."""
    host: str = "127.0.0.1"
    """Address of the server. The default is reachable only from this machine, or by `ssh -L`."""


def run(command: View) -> None:
    """Play replay.npz in a loop until the window is closed, or serve the viewer's page."""
    if command.port is not None and not 0 <= command.port < 65536:
        raise ValueError(f"--port must be a number from 0 to 65535, got {command.port}")
    if not command.speed > 0:
        raise ValueError(f"--speed must be above 0, got {command.speed:g}")
    folder = stage_folder(command.run, "identify", REPLAY)
    if not (folder / REPLAY).is_file():
        raise ValueError(
            f"{folder} holds no {REPLAY}: `python -m droid_jax.run identify` writes one for recordings that hold "
            "commands"
        )
    if command.port is not None:
        serve(page_of(folder), command.host, command.port)
        return
    if not _opens():
        raise ValueError(
            f"no window can be opened here; the same replay is a film in {folder / 'report.html'}, "
            "and with --port 8080 a page for a browser"
        )
    import mujoco

    clock, states = replay_of(folder)
    model, moved = side_by_side(folder / FITTED)
    if states.shape[1] != model.nq:
        raise ValueError(f"{folder / REPLAY} has {states.shape[1]} positions, two of {folder / FITTED} have {model.nq}")
    data = mujoco.MjData(model)
    with _window(model, data) as window:
        began = time.monotonic()
        while window.is_running():
            at = command.speed * (time.monotonic() - began) % (clock[-1] + 1.0)  # a second's pause at the end
            data.qpos[:] = states[min(int(clock.searchsorted(at, "right")) - 1, len(states) - 1)] + moved
            mujoco.mj_forward(model, data)
            window.sync()
            time.sleep(0.02)


def page_of(folder: Path) -> bytes:
    """The viewer's page of a fit's folder; it is drawn first if it is missing."""
    if not (folder / VIEWER).is_file():
        import mujoco

        from droid_jax.report.render import NoOpenGL
        from droid_jax.report.viewer import write_viewer

        print("drawing the pictures ...", flush=True)
        try:
            write_viewer(folder, mujoco.MjModel.from_xml_path(str(folder / FITTED)))
        except NoOpenGL as error:
            raise ValueError(str(error)) from None
    return (folder / VIEWER).read_bytes()


def serve(page: bytes, host: str, port: int) -> None:
    """Serve one page at every path until Ctrl-C.

    Raises ValueError if the port is not available.
    """

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            with contextlib.suppress(ConnectionError):  # the browser left
                self.wfile.write(page)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    try:
        server = ThreadingHTTPServer((host, port), Page)
    except OSError as error:
        raise ValueError(f"--host {host} --port {port}: {error.strerror or error}; choose another --port") from None
    with server, contextlib.suppress(KeyboardInterrupt):
        port = server.server_address[1]
        print(f"open http://{host}:{port} in a browser; Ctrl-C ends it")
        print(f"from another machine: ssh -L {port}:{host}:{port} USER@THIS_MACHINE, then the same address", flush=True)
        server.serve_forever()


def replay_of(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times [K] s, and the states before and after the fit beside each other [K, 2 nq].

    Raises ValueError where the file cannot be read.
    """
    import numpy as np

    from droid_jax.report.reading import Reader, read_replay

    time, before, after = read_replay(folder / REPLAY, Reader("identify", "--again"))
    return time, np.concatenate([before, after], axis=1)


def side_by_side(mjcf: Path) -> tuple[mujoco.MjModel, np.ndarray]:
    """A model with two copies of an MJCF, the first on the left; its positions are those of both copies in turn.

    Also an offset [2 nq] to add to these positions, since positions of free bodies are in the world frame.
    """
    import mujoco
    import numpy as np

    one = mujoco.MjModel.from_xml_path(str(mjcf))
    half = 0.5 * DISTANCE * float(one.stat.extent)
    both = mujoco.MjSpec()
    both.option = mujoco.MjSpec.from_file(str(mjcf)).option
    for name, y in (("before", half), ("after", -half)):
        frame = both.worldbody.add_frame(pos=[0.0, y, 0.0])
        both.attach(mujoco.MjSpec.from_file(str(mjcf)), prefix=f"{name}/", frame=frame)
    with warnings.catch_warnings():  # about settings that matter only in a simulation
        warnings.simplefilter("ignore", UserWarning)
        model = both.compile()
    return model, model.qpos0 - np.tile(one.qpos0, 2)


@contextlib.contextmanager
def _window(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Any]:
    """MuJoCo's viewer.

    Its thread closes the window.  A program that ends before that has a segmentation fault
    (google-deepmind/mujoco#1265), so the thread is joined.
    """
    import mujoco.viewer

    others = set(threading.enumerate())
    try:
        with mujoco.viewer.launch_passive(model, data) as window:
            yield window
    finally:
        for thread in set(threading.enumerate()) - others:
            thread.join(timeout=10.0)


def _opens() -> bool:
    """Whether a window can be opened; if not, MuJoCo's viewer would end the program."""
    if not sys.platform.startswith("linux"):
        return True
    import glfw

    with warnings.catch_warnings():  # glfw warns if it cannot
        warnings.simplefilter("ignore")
        opens = bool(glfw.init())
    glfw.terminate()
    return opens
