"""`view`: a fit's replay in MuJoCo's viewer, before and after side by side."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from droid_jax.commands.folder import stage_folder
from droid_jax.files import FITTED, REPLAY

if TYPE_CHECKING:
    import mujoco
    import numpy as np

APART = 1.6  # times the scene's extent between the two


@dataclass(frozen=True)
class View:
    """Watch the replay in MuJoCo's viewer: before the fit on the left, after it on the right. Needs a screen."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of `identify` or of `all`. Default: runs/identify where it holds a replay, else runs/all."""
    speed: float = 1.0
    """Times real time."""


def run(command: View) -> None:
    """Play the states of replay.npz over and over until the window is closed."""
    if not command.speed > 0:
        raise ValueError(f"--speed must be above 0, got {command.speed:g}")
    folder = stage_folder(command.run, "identify", REPLAY)
    if not (folder / REPLAY).is_file():
        raise ValueError(
            f"{folder} holds no {REPLAY}: `python -m droid_jax.run identify` writes one for recordings that hold "
            "commands"
        )
    if not _opens():
        raise ValueError(f"no window can be opened here; the same replay is a film in {folder / 'report.html'}")
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


def replay_of(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times [K] s, and the states before and after the fit beside each other [K, 2 nq].

    Raises ValueError where the file cannot be read.
    """
    import numpy as np

    from droid_jax.report.reading import Reader, read_replay

    time, before, after = read_replay(folder / REPLAY, Reader("identify", "--again"))
    return time, np.concatenate([before, after], axis=1)


def side_by_side(mjcf: Path) -> tuple[mujoco.MjModel, np.ndarray]:
    """A model of two copies of an MJCF, the first on the left; its positions are theirs, one after the other.

    With it [2 nq], to be added to these positions: those of free bodies are the world's, and both would lie in one
    place.
    """
    import mujoco
    import numpy as np

    one = mujoco.MjModel.from_xml_path(str(mjcf))
    half = 0.5 * APART * float(one.stat.extent)
    both = mujoco.MjSpec()
    both.option = mujoco.MjSpec.from_file(str(mjcf)).option
    for name, y in (("before", half), ("after", -half)):
        frame = both.worldbody.add_frame(pos=[0.0, y, 0.0])
        both.attach(mujoco.MjSpec.from_file(str(mjcf)), prefix=f"{name}/", frame=frame)
    with warnings.catch_warnings():  # of settings that only matter where something is simulated
        warnings.simplefilter("ignore", UserWarning)
        model = both.compile()
    return model, model.qpos0 - np.tile(one.qpos0, 2)


@contextlib.contextmanager
def _window(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Any]:
    """MuJoCo's viewer.

    Its own thread takes the window down; a program that ends meanwhile ends in a segmentation fault
    (google-deepmind/mujoco#1265), so it is waited for.
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
    """Whether a window can be opened: where none can, MuJoCo's viewer ends the program."""
    if not sys.platform.startswith("linux"):
        return True
    import glfw

    with warnings.catch_warnings():  # glfw says so in a warning
        warnings.simplefilter("ignore")
        opens = bool(glfw.init())
    glfw.terminate()
    return opens
