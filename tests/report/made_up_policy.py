"""A folder of `train` and `evaluate` with made-up numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from droid_jax.door.task import Task
from droid_jax.policy.trials import Trials


def trials(successes: int, angle: float, count: int = 40) -> dict[str, Any]:
    """Some that succeeded, the rest left at half the angle."""
    won = np.arange(count) < successes
    reached = np.deg2rad(np.where(won, angle, angle / 2) + 0.1 * np.arange(count))
    return Trials(won, reached, np.where(won, 150, 512), np.where(won, 0.7, 0.1), np.full(count, "")).to_json()


def training_json(**changes: Any) -> dict[str, Any]:
    history = [
        {"step": k * 500_000, "of": 2_000_000, "seconds": 60.0 + 90 * k, "rate": 9000.0 * (k > 0), "reward": 300.0 * k,
         "success": 0.24 * k}
        for k in range(5)
    ]  # fmt: skip
    task = {f: getattr(Task(), f) for f in Task.__dataclass_fields__}
    setup = {"method": "fitted", "preset": "quick", "knob": 0, "seed": 3, "fit": "runs/identify"}
    of = {"setup": setup, "task": task, "scene": "door (knob 0, impedance gains)", "effects": []}
    of |= {"synthetic_robot": {"springs": 1, "seed": 0}, "config": {}, "versions": {}, "device": "cpu"}
    return {**of, "history": history, **changes}


def make_policy(folder: Path, successes: int | None = 38, **changes: Any) -> Path:
    """training.json and, where successes on the synthetic robot are given, transfer.json and two films."""
    (folder / "films").mkdir(parents=True)
    (folder / "training.json").write_text(json.dumps(training_json(**changes)))
    if successes is not None:
        found = {"simulation": trials(39, 33.0), "synthetic_robot": trials(successes, 32.0)}
        robot = {"truth": {}, "hidden": [{"name": "closer", "amplitude": 2.0, "joint": ""}]}
        (folder / "transfer.json").write_text(json.dumps({**found, "robot": robot}))
        for name in ("good", "bad"):
            Image.new("RGB", (36, 27), "grey").save(folder / "films" / f"{name}.webp")
    return folder
