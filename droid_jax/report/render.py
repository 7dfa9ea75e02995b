"""Pictures and films of a scene, drawn by MuJoCo with software OpenGL: no display, no graphics card.

MuJoCo chooses its OpenGL library once, when it is first imported, from the environment
variable MUJOCO_GL, and a broken library can end the process instead of raising.  So the
pictures are made in a child process: this one may have imported mujoco in any state, a crash
costs only the pictures, and the caller's environment stays as it is.  Which library works is
found out once per process, also that none does, by trying: MUJOCO_GL as it is set, then EGL,
then OSMesa.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import mujoco

RATE = 12.5  # pictures per second
LONGEST = 150  # pictures
SIZE = (270, 360)  # height, width
QUALITY = 60  # of WebP
LAST_SECONDS = 1.5  # for which the last picture stays
LOOPS = 3  # times a film is played, since a page without scripts has no button that stops it (WCAG 2.2.2)
_OFF = ("disable", "disabled", "off", "false", "0")
_PROBE_SECONDS = 60.0


class NoOpenGL(RuntimeError):
    """No OpenGL library on this machine can draw without a display."""


def rendered_frames(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    indices: Sequence[int],
    camera: str | None = "front",
    size: tuple[int, int] = (480, 640),
) -> list[np.ndarray]:
    """Pictures of the states qpos[i] for i in indices, each uint8 [height, width, 3].

    model: compiled scene.  qpos: [T, nq], m and rad.  indices: rows of qpos, negative ones
    count from the end.  camera: name of a fixed camera of the model, None for one that sees all of it.
    size: (height, width) in pixels, at most the model's offscreen buffer.
    Raises ValueError for an argument that does not fit the model, NoOpenGL where nothing can draw.
    """
    states = _states(model, qpos, indices)
    _check_view(model, camera, size)
    if not len(states):
        return []
    backend = working_backend()
    with tempfile.TemporaryDirectory(prefix="droid_jax_frames_") as folder:
        _save_job(Path(folder), model, states, camera, size)
        limit = _PROBE_SECONDS + 5.0 * len(states)
        error = _child(backend, folder, limit)
        if error:
            raise NoOpenGL(f"drawing {len(states)} frames with MUJOCO_GL={backend!r} failed: {error}")
        return list(np.load(Path(folder) / "frames.npy"))


def save_frames(
    folder: Path,
    images: Sequence[np.ndarray],
    times: Sequence[float],
    prefix: str = "before",
) -> list[Path]:
    """Write images [H, W, 3] uint8 as folder/prefix_00_0.0s.png and so on; returns the paths.

    times: s, one per image.  Raises ValueError when their numbers differ.
    """
    if len(images) != len(times):
        raise ValueError(f"save_frames: {len(images)} images but {len(times)} times, one each is needed")
    paths = [folder / f"{prefix}_{i:02d}_{t:.1f}s.png" for i, t in enumerate(times)]
    for path, image in zip(paths, images, strict=True):
        save_image(path, image)
    return paths


def save_image(path: Path, image: np.ndarray) -> None:
    """Write one image [H, W, 3] uint8 as PNG, in one step."""
    from PIL import Image

    from droid_jax.storage import write_bytes

    with io.BytesIO() as buffer:
        Image.fromarray(image).save(buffer, format="PNG", optimize=True)
        write_bytes(path, buffer.getvalue())


def film(
    path: Path, model: mujoco.MjModel, sides: Sequence[np.ndarray], period: float, camera: str | None = "front"
) -> list[np.ndarray]:
    """Write states [T, nq], `period` s apart, as a film in PATH (webp) in real time, several sides beside each other.

    sides: each [T, nq].  camera: see `frames`.
    Returns its pictures, uint8 [height, width of all sides, 3] each.
    Raises NoOpenGL where nothing can draw, ValueError for states that do not fit the model or each other.
    """
    from PIL import Image

    from droid_jax.storage import write_bytes

    length = len(sides[0])
    if any(len(states) != length for states in sides):
        raise ValueError(f"film: all sides must be as long as each other, got {[len(s) for s in sides]} states")
    every = _every(length, period)
    drawn = rendered_frames(model, np.concatenate(sides), _rows(length, every, len(sides)), camera, SIZE)
    images = np.concatenate(np.array_split(np.array(drawn), len(sides)), axis=2)
    pictures = [Image.fromarray(image) for image in images]
    shown = [round(1e3 * every * period)] * (len(pictures) - 1) + [round(1e3 * LAST_SECONDS)]
    with io.BytesIO() as buffer:
        timing: dict[str, Any] = {"duration": shown, "loop": LOOPS}
        pictures[0].save(buffer, format="WEBP", save_all=True, append_images=pictures[1:], quality=QUALITY, **timing)
        write_bytes(path, buffer.getvalue())
    return list(images)


def picture_rows(time: np.ndarray) -> list[int]:
    """Rows of states at regular times [T] s for the pictures of `film`."""
    return _rows(len(time), _every(len(time), float(time[1] - time[0]) if len(time) > 1 else 1.0), 1)


def _every(length: int, period: float) -> int:
    """Number of states from one picture of a film to the next."""
    return max(1, round(1.0 / (RATE * period)), -(-length // LONGEST))


def _rows(length: int, every: int, sides: int) -> list[int]:
    """Rows to draw of all sides one after the other."""
    return [side * length + row for side in range(sides) for row in range(0, length, every)]


def working_backend() -> str:
    """The value of MUJOCO_GL that works on this machine, found once by drawing an empty scene.

    Raises NoOpenGL, which says what was tried and what to install.
    """
    backend, tried = _first_to_draw(tuple(_candidates(os.environ.get("MUJOCO_GL", ""), sys.platform)))
    if backend is None:
        raise NoOpenGL(
            f"no OpenGL library could draw; tried {'; '.join(tried)}. On Debian or Ubuntu: "
            "apt-get install libegl1 libgl1-mesa-dri  (or libosmesa6)"
        )
    return backend


@cache
def _first_to_draw(backends: tuple[str, ...]) -> tuple[str | None, list[str]]:
    """The first backend that draws, or None, and the failures with their reasons; cached, as each may take a minute."""
    tried = []
    for backend in backends:
        error = _child(backend, None, _PROBE_SECONDS)
        if not error:
            return backend, tried
        tried.append(f"{backend or 'default'} ({error})")
    return None, tried


def _candidates(wish: str, platform: str) -> list[str]:
    """Values of MUJOCO_GL worth trying, best first."""
    wish = wish.strip().lower()
    if wish in _OFF:
        raise NoOpenGL(f"MUJOCO_GL={wish!r} turns drawing off; unset it to get pictures")
    if not platform.startswith("linux"):
        return list(dict.fromkeys([wish, ""]))  # the default there draws without a window
    return list(dict.fromkeys([w for w in (wish, "egl", "osmesa") if w]))


def _child(backend: str, folder: str | None, seconds: float) -> str:
    """Run this file's `_draw` under a backend; "" when it worked, else one line that says why not."""
    environment = {**os.environ, "MUJOCO_GL": backend}
    environment.pop("PYOPENGL_PLATFORM", None)  # set by an earlier import, it would contradict MUJOCO_GL
    # -P: without it this file's folder comes first on the path, where its modules could hide others.
    command = [sys.executable, "-P", __file__, *([folder] if folder else [])]
    try:
        done = subprocess.run(
            command, env=environment, timeout=seconds, capture_output=True, text=True, errors="replace"
        )
    except subprocess.TimeoutExpired:
        return f"no answer within {seconds:.0f} s"
    if done.returncode == 0:
        return ""
    if done.returncode < 0:
        return f"the process died with signal {-done.returncode}"
    lines = [line for line in done.stderr.splitlines() if line.strip() and not line.startswith(" ")]
    return lines[-1][:200] if lines else f"exit code {done.returncode}"


def _states(model: mujoco.MjModel, qpos: np.ndarray, indices: Sequence[int]) -> np.ndarray:
    """The chosen rows [n, nq], checked."""
    qpos = np.asarray(qpos, dtype=np.float64)
    if qpos.ndim != 2 or qpos.shape[1] != model.nq:
        raise ValueError(f"frames: qpos must be [T, {model.nq}] for this model, got shape {qpos.shape}")
    index = np.asarray(list(indices), dtype=int)
    outside = index[(index < -len(qpos)) | (index >= len(qpos))]
    if outside.size:
        raise ValueError(f"frames: index {outside[0]} is outside qpos, which has {len(qpos)} rows")
    states = qpos[index]
    bad = np.flatnonzero(~np.isfinite(states).all(axis=1))
    if bad.size:
        raise ValueError(f"frames: qpos row {index[bad[0]]} is not finite, the replay failed there")
    return states


def _check_view(model: mujoco.MjModel, camera: str | None, size: tuple[int, int]) -> None:
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if camera is not None and camera not in cameras:
        raise ValueError(f"frames: no camera {camera!r}; this model has: {', '.join(cameras) or 'none'}")
    limit = (model.vis.global_.offheight, model.vis.global_.offwidth)
    if not all(0 < s <= most for s, most in zip(size, limit, strict=True)):
        raise ValueError(f"frames: size (height, width) must be within (1, 1) and {limit}, got {size}")


def _save_job(
    folder: Path, model: mujoco.MjModel, states: np.ndarray, camera: str | None, size: tuple[int, int]
) -> None:
    """Write the input of the child process: the compiled model, the states and the view."""
    import mujoco

    mujoco.mj_saveModel(model, str(folder / "model.mjb"), None)
    np.save(folder / "states.npy", states)
    (folder / "view.json").write_text(json.dumps({"camera": camera, "size": list(size)}))


def _draw(folder: Path | None) -> None:
    """Run in the child process: draw the job in `folder`, or without a folder an empty scene as a probe."""
    import mujoco

    if folder is None:
        model = mujoco.MjModel.from_xml_string("<mujoco/>")
        with mujoco.Renderer(model, 16, 16) as renderer:
            renderer.update_scene(mujoco.MjData(model))
            renderer.render()
        return
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    view = json.loads((folder / "view.json").read_text())
    data, option, images = mujoco.MjData(model), mujoco.MjvOption(), []
    if not (model.geom_bodyid > 0).any():  # a model without geoms: draw joints, and inertias as boxes
        option.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = option.flags[mujoco.mjtVisFlag.mjVIS_JOINT] = True
        option.flags[mujoco.mjtVisFlag.mjVIS_COM] = True
        model.vis.rgba.inertia, model.vis.headlight.ambient = (0.75, 0.8, 0.9, 1.0), (0.5, 0.5, 0.5)
        _seen_whole(model, data)
    with mujoco.Renderer(model, *view["size"]) as renderer:
        for state in np.load(folder / "states.npy"):
            data.qpos[:] = state
            mujoco.mj_forward(model, data)
            camera = {"camera": view["camera"]} if view["camera"] else {}
            renderer.update_scene(data, scene_option=option, **camera)
            images.append(renderer.render())
    np.save(folder / "frames.npy", np.stack(images))


def _seen_whole(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set camera and marks by joints and centres of mass; MuJoCo's extent is too large for some models."""
    import mujoco

    mujoco.mj_forward(model, data)
    points = np.concatenate([data.xanchor, data.xipos[1:]])
    low, high = points.min(axis=0), points.max(axis=0)
    extent = 2.0 * max(float(np.linalg.norm(high - low)), 0.05)  # to both sides of a pendulum
    if extent < model.stat.extent:
        model.stat.center, model.stat.extent, model.stat.meansize = 0.5 * (low + high), extent, 0.1 * extent


if __name__ == "__main__":
    _draw(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
