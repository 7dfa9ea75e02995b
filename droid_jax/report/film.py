"""A film of a scene: an animated WebP, which a page shows without a player."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from droid_jax.report.render import frames
from droid_jax.storage import write_bytes

if TYPE_CHECKING:
    import mujoco

RATE = 12.5  # pictures per second
LONGEST = 150  # pictures
SIZE = (270, 360)  # height, width
QUALITY = 60  # of WebP
LAST = 1.5  # s for which the last picture stays
LOOPS = 3  # then it rests on the last picture: a page without scripts has no button that stops it (WCAG 2.2.2)


def film(
    path: Path, model: mujoco.MjModel, sides: Sequence[np.ndarray], period: float, camera: str | None = "front"
) -> None:
    """Write states [T, nq], `period` s apart, as PATH (webp), in the time they took; several side by side.

    sides: each [T, nq].  camera: see `frames`.
    Raises NoOpenGL where nothing can draw, ValueError for states that do not fit the model or each other.
    """
    from PIL import Image

    length = len(sides[0])
    if any(len(states) != length for states in sides):
        raise ValueError(f"film: all sides must be as long as each other, got {[len(s) for s in sides]} states")
    every = max(1, round(1.0 / (RATE * period)), -(-length // LONGEST))
    drawn = frames(model, np.concatenate(sides), _rows(length, every, len(sides)), camera, SIZE)
    images = np.concatenate(np.array_split(np.array(drawn), len(sides)), axis=2)
    pictures = [Image.fromarray(image) for image in images]
    shown = [round(1e3 * every * period)] * (len(pictures) - 1) + [round(1e3 * LAST)]
    with io.BytesIO() as buffer:
        timing: dict[str, Any] = {"duration": shown, "loop": LOOPS}
        pictures[0].save(buffer, format="WEBP", save_all=True, append_images=pictures[1:], quality=QUALITY, **timing)
        write_bytes(path, buffer.getvalue())


def _rows(length: int, every: int, sides: int) -> list[int]:
    """Rows to draw of all sides one after the other."""
    return [side * length + row for side in range(sides) for row in range(0, length, every)]
