"""A film of a scene: an animated WebP, which a page shows without a player."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from droid_jax.report.render import frames
from droid_jax.storage import write_bytes

if TYPE_CHECKING:
    import mujoco

RATE = 12.5  # pictures per second
SIZE = (270, 360)  # height, width
QUALITY = 60  # of WebP
LAST = 1.5  # s for which the last picture stays


def film(path: Path, model: mujoco.MjModel, qpos: np.ndarray, period: float, camera: str = "front") -> None:
    """Write states qpos [T, nq], `period` s apart, as PATH (webp), in the time they took.

    Raises NoOpenGL where nothing can draw, ValueError for states that do not fit the model.
    """
    from PIL import Image

    every = max(1, round(1.0 / (RATE * period)))
    images = frames(model, qpos, range(0, len(qpos), every), camera, SIZE)
    pictures = [Image.fromarray(image) for image in images]
    shown = [round(1e3 * every * period)] * (len(pictures) - 1) + [round(1e3 * LAST)]
    with io.BytesIO() as buffer:
        pictures[0].save(
            buffer, format="WEBP", save_all=True, append_images=pictures[1:], duration=shown, loop=0, quality=QUALITY
        )
        write_bytes(path, buffer.getvalue())
