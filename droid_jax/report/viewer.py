"""viewer.html: measured and simulated motion side by side, one slider for time, the residuals of every joint below.

A separate page, because it has a script, which the report has not.  It loads no other files.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from droid_jax.files import REPLAY, VIEWER
from droid_jax.report.identify_folder import has_run, read_run
from droid_jax.report.reading import Reader, read_measured, read_replay
from droid_jax.report.render import QUALITY, SIZE, picture_rows, rendered_frames
from droid_jax.report.style import data_uri
from droid_jax.report.text import html, label, unit_text
from droid_jax.storage import write_text

POINTS = 3000  # of a line; a fast motion in a long log needs them, or its residual is aliased
DIGITS = 5  # of its numbers
SIDES = {"measured": "Measured", "before": "Before the fit", "after": "After the fit"}
_JOINT_UNIT = {mujoco.mjtJoint.mjJNT_HINGE: "rad", mujoco.mjtJoint.mjJNT_SLIDE: "m"}


def write_viewer(
    folder: Path, model: mujoco.MjModel, camera: str | None = None, drawn: Sequence[np.ndarray] | None = None
) -> Path:
    """Write FOLDER/viewer.html from the files of an identification.

    Args:
        folder: of the results; holds replay.npz.
        model: that is drawn, with the visual geoms.
        camera: name of a fixed camera of the model; None for one that sees all of it.
        drawn: pictures of `before` and `after` beside each other, as `render.film` returns them; None: they are drawn.

    Returns:
        Path of the page.

    Raises:
        NoOpenGL: nothing can draw here.
        ValueError: a file of the folder is missing or broken, or its states do not fit the model.
    """
    read = Reader("identify", "--again")
    time, before, after = read_replay(folder / REPLAY, read)
    name, start, measured, joints = read_measured(folder / REPLAY, read)
    rows = picture_rows(time)
    states = {"measured": measured} if joints else {}
    if drawn is None:
        states |= {"before": before, "after": after}
    pictures = {side: rendered_frames(model, qpos, rows, camera, SIZE) for side, qpos in states.items()}
    if drawn is not None:
        halves = [np.array_split(image, 2, axis=1) for image in drawn]
        pictures |= {side: [half[k] for half in halves] for k, side in enumerate(("before", "after"))}
    of_replay = list(_positions(model, time, {"measured": measured, "before": before, "after": after}, joints))
    traces = list(_traces(folder, name, start))
    compared = {series["channel"] for series in traces}
    data = {
        "time": _numbers(time[rows]),
        "pictures": {side: [data_uri(_webp(image), "webp") for image in images] for side, images in pictures.items()},
        "series": [*(series for series in of_replay if series["channel"] not in compared), *traces],
    }
    text = html("viewer.html.jinja", data=data, sides=SIDES, name=name, measured=bool(joints))
    write_text(folder / VIEWER, text)
    return folder / VIEWER


def _positions(
    model: mujoco.MjModel, time: np.ndarray, states: dict[str, np.ndarray], joints: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """The measured joints' positions in the replay."""
    for joint in joints:
        number = model.joint(joint).id
        column, unit = model.jnt_qposadr[number], _JOINT_UNIT.get(mujoco.mjtJoint(int(model.jnt_type[number])), "")
        lines = {side: qpos[:, column] for side, qpos in states.items()}
        yield _series("position", joint, unit, time, lines)


def _traces(folder: Path, name: str, start: float) -> Iterator[dict[str, Any]]:
    """The channels that the fit compared in the replayed recording, if that recording has test data."""
    run = read_run(folder) if has_run(folder) else None
    distance = run.fit.heldout_distances.get(name) if run else None
    if run is None or distance is None:
        return
    for channel in distance.channels:
        traces = run.traces[name if channel == distance.leading else f"{name}/{channel}"]
        unit = distance.errors[channel].unit if channel in distance.errors else ""
        for j, joint in enumerate(traces["joints"]):
            keys = {"measured": "measured_mean", "before": "before", "after": "after"}
            lines = {side: traces[key][:, j] for side, key in keys.items()}
            yield _series(channel, str(joint), unit, np.asarray(traces["time"]) - start, lines)


def _series(channel: str, joint: str, unit: str, time: np.ndarray, lines: dict[str, np.ndarray]) -> dict[str, Any]:
    """A joint's lines over time, thinned out."""
    every = slice(None, None, max(1, -(-len(time) // POINTS)))
    title = f"{label(joint)}: {channel.replace('_', ' ')}"
    values = {side: _numbers(np.asarray(line)[every]) for side, line in lines.items()}
    return {"channel": channel, "title": title, "unit": unit_text(unit), "time": _numbers(time[every]), **values}


def _numbers(line: np.ndarray) -> list[float | None]:
    """Rounded for the page; None for what is not finite."""
    return [float(f"{x:.{DIGITS}g}") if np.isfinite(x) else None for x in line.tolist()]


def _webp(image: np.ndarray) -> bytes:
    from PIL import Image

    with io.BytesIO() as buffer:
        Image.fromarray(image).save(buffer, format="WEBP", quality=QUALITY)
        return buffer.getvalue()
