"""A film: as many pictures as asked for, in the time they took, sides beside each other."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from droid_jax.report import render as module
from droid_jax.report.render import LONGEST, LOOPS, SIZE, film

MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint name='hinge'/><geom size='.1'/></body></worldbody></mujoco>"
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Pictures without OpenGL: the shade of each is its state."""
    states: list[np.ndarray] = []

    def frames(model, qpos, indices, camera, size) -> list[np.ndarray]:
        states.append(np.asarray(qpos)[list(indices)])
        return [np.full((*size, 3), int(200 * state[0]), np.uint8) for state in states[-1]]

    monkeypatch.setattr(module, "rendered_frames", frames)
    return states


def states(length: int, top: float = 1.0) -> np.ndarray:
    return np.linspace(0.0, top, length)[:, None]


def test_two_sides_move_together(drawn, tmp_path: Path):
    film(tmp_path / "film.webp", MODEL, (states(40), states(40, 0.5)), 0.04, None)
    with Image.open(tmp_path / "film.webp") as found:
        assert found.size == (2 * SIZE[1], SIZE[0]) and found.n_frames == 20  # type: ignore[attr-defined]
        assert found.info["loop"] == LOOPS > 0  # motion without end could not be stopped
        found.seek(19)
        last = np.asarray(found.convert("L"), float)
    left, right = last[:, : SIZE[1]].mean(), last[:, SIZE[1] :].mean()
    assert left == pytest.approx(2 * right, rel=0.05) and left > 150


def test_a_long_film_leaves_pictures_out(drawn, tmp_path: Path):
    film(tmp_path / "film.webp", MODEL, [states(1000)], 0.04)
    assert len(drawn[0]) <= LONGEST


def test_sides_of_different_length_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match=r"as long as each other, got \[4, 5\] states"):
        film(tmp_path / "film.webp", MODEL, (states(4), states(5)), 0.04)
