"""The pictures of a fit: those of an earlier one in the same folder never stand beside a new one's numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from droid_jax.commands.pictures import draw
from droid_jax.measure.recording import Recording


def test_a_log_without_commands_leaves_no_pictures_of_an_earlier_fit(tmp_path: Path):
    old = ("frames/after_00_0.0s.png", "films/replay.webp", "replay.npz")
    for name in old:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"old")
    log = Recording("log", np.zeros(0), np.zeros((0, 0)), (), {}, None, {})  # type: ignore[arg-type]
    draw(tmp_path, None, log)  # type: ignore[arg-type]
    assert [name for name in old if (tmp_path / name).exists()] == []
