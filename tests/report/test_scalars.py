"""Scalars for TensorBoard: read back out of the file that was written."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from droid_jax.identify.multistart import RefineProgress
from droid_jax.policy.train import TrainProgress
from droid_jax.report.progress import numbers_of, scalars

pytest.importorskip("tensorboardX")


def written(folder: Path) -> dict[str, dict[int, float]]:
    """Tag -> step -> value, out of the event files: records of (length, its checksum, data, its checksum)."""
    from tensorboardX.proto import event_pb2

    found: dict[str, dict[int, float]] = {}
    for path in folder.glob("events*"):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event = event_pb2.Event.FromString(data[12 : 12 + length])
            for value in event.summary.value:
                found.setdefault(value.tag, {})[event.step] = value.simple_value
            data = data[16 + length :]
    return found


def test_every_number_of_a_stage_is_a_scalar(tmp_path: Path):
    with scalars(tmp_path) as write:
        write("refine", RefineProgress(3, 30, 1.5))
        write("train", TrainProgress(1000, 4000, 12.0, 250.0, 80.0, 0.5))
        write("judge", None)
        write("look", "latch at door_hinge")
    found = written(tmp_path)
    assert found["refine/mean_square"] == {3: 1.5}
    assert found["train/success"] == {1000: 0.5} and found["train/reward"] == {1000: 80.0}
    names = ("seconds", "rate", "reward", "success", "blown_up")
    assert set(found) == {"refine/mean_square", *(f"train/{n}" for n in names)}


def test_limits_are_no_scalars():
    assert numbers_of(RefineProgress(3, 30, 1.5)) == (3, {"mean_square": 1.5})


def test_nothing_is_written_unless_asked(tmp_path: Path):
    with scalars(None) as write:
        write("refine", RefineProgress(3, 30, 1.5))
    assert not list(tmp_path.iterdir())
