"""Three demonstrations at the built-in door: each opens and closes, at two speeds, in about 9 s.

The shipped demonstrations A and B only open, and C takes 13.6 s: a case costs what its motions last.  Faster
than 0.42 rad/s the door would take joint 5 beyond its torque limit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from droid_jax.door.demonstration import CLOSED, OPEN, POSE_A, POSE_B, Plan, Segment, demonstrate
from droid_jax.door.scene import door_scene
from droid_jax.recordings.formats import load_recording, save_recording
from droid_jax.recordings.recording import Recording

_DEG = np.pi / 180
POSE_BETWEEN = (1.24, -0.87, -0.94, -2.14, -2.17, 2.65, -0.87)  # rad, the arm near B's, the hand as in A


def _plan(name: str, pose: tuple[float, ...], roll: int, moves: tuple[tuple[str, float, float], ...]) -> Plan:
    """Approach, grasp, then (phase, seconds, degrees of the door at its end)."""
    reach = (Segment("approach", 0.8, 0.0, OPEN), Segment("grasp", 0.5, 0.0, CLOSED))
    return Plan(name, pose, roll, (*reach, *(Segment(p, s, a * _DEG, CLOSED) for p, s, a in moves)))


PLANS = (
    _plan("train", POSE_A, -1, (
        ("opening", 1.2, 8), ("opening", 2.9, 44), ("hold", 0.1, 44), ("closing", 2.3, 16), ("closing", 1.3, 6),
        ("rest", 0.15, 6),
    )),
    _plan("validation", POSE_B, 1, (
        ("opening", 2.4, 30), ("opening", 1.5, 44), ("hold", 0.1, 44), ("closing", 1.4, 33), ("closing", 2.2, 6),
        ("rest", 0.15, 6),
    )),
    _plan("test", POSE_BETWEEN, -1, (
        ("opening", 3.4, 42), ("hold", 0.1, 42), ("closing", 1.4, 26), ("opening again", 1.0, 34),
        ("closing again", 2.4, 6), ("rest", 0.15, 6),
    )),
)  # fmt: skip


def door_demonstrations(cache: Path | None = None) -> dict[str, Recording]:
    """Role -> demonstration, from the folder `cache` or made (inverse kinematics: some 10 s) and kept there."""
    made = {}
    for plan in PLANS:
        path = cache / f"{plan.name}.npz" if cache else None
        found = load_recording(path) if path and path.is_file() else demonstrate(door_scene(), plan)
        if path and not path.is_file():
            save_recording(found, path)
        made[plan.name] = found
    return made
