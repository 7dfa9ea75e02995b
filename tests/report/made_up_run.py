"""Made-up folders of an identification, of train and evaluate, and of all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from made_up_gap import make_gap
from PIL import Image

from droid_jax.door.task import Task
from droid_jax.policy.trials import Trials
from droid_jax.report import render

JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
# Everything the demonstration tells, off its bounds, unless SPECIAL says otherwise.
KEYS = ("name", "unit", "group", "initial_mean", "initial_std", "low", "high", "best", "mean", "std", "truth")
ROWS = [
    ("hinge_stiffness", "N m/rad", "Door", 0.8, 0.4, 0.0, 5.0, 1.049, 1.052, 0.0213, 1.06),
    ("hinge_damping", "N m s/rad", "Door", 2.0, 1.0, 0.0, 9.0, 1.402, 1.41, 0.0731, 1.35),
    ("hinge_friction_loss", "N m", "Door", 0.05, 0.02, 0.0, 4.0, 0.0, 0.004, 0.0061, 0.0),
    ("door_mass", "kg", "Door", 1.144, 0.5, 0.1, 9.0, 1.2, 1.21, 0.49, 2.0),
    ("joint_damping_1", "N m s/rad", "Robot", 40.0, 10.0, 0.0, 200.0, 52.3, 52.31, 0.83, 51.9),
    ("joint_damping_4", "N m s/rad", "Robot", 40.0, 10.0, 0.0, 200.0, 47.1, 47.0, 1.1, 44.0),
    ("pad_friction", "", "Gripper", 1.0, 0.5, 0.05, 3.0, 1.3, 1.34, 0.21, 1.2),
    ("torsional_friction", "m", "Gripper", 0.005, 0.0025, 0.0001, 0.05, 0.0091, 0.0093, 0.0012, 0.0089),
    ("door_x", "m", "Nuisance", 0.0, 0.002, -0.01, 0.01, -0.00131, -0.0013, 0.00021, None),
    ("time_offset", "s", "Nuisance", 0.0, 0.001, -0.005, 0.005, 0.00099, 0.001, 0.00008, None),
]
SPECIAL = {
    "hinge_friction_loss": {"on_bound": True},
    "door_mass": {
        "identifiable": False,
        "reason": "the robot's torques change by less than their noise",
        "partners": [{"name": "hinge_damping", "correlation": -0.93}],
    },
}


CHANGE = {
    "element": "joint", "name": "hinge", "attribute": "stiffness", "index": 0, "before": 0.8, "after": 1.049,
    "interval": [1.017, 1.087], "unit": "N m/rad", "file": "door.xml", "line": 12, "origin": "default class 'soft'",
}  # fmt: skip
NEUTRAL = {
    "format": "droid_jax fitted", "version": 1,
    "mjcf": {"file": "fitted.xml", "error": "", "in_place": True, "reason": "", "changes": [CHANGE]},
    "laws": [
        {"effect": "latch", "description": "a latch", "acts": "force", "joint": "hinge", "unit": "N m", "error": 1e-4,
         "axes": [{"name": "latch_width", "unit": "rad", "nodes": [0.04]},
                  {"name": "position", "unit": "rad", "nodes": [0.0, 0.1]}], "terms": []}
    ],
    "not_in_mjcf": [{"parameter": "time_offset", "why": "it belongs to the <recording>"}],
    "engines": {"open_close": {"channel": "torque", "unit": "N m", "parity_rms": 0.01, "parity_largest": 0.04,
                               "parity_angle": 2e-4}},
}  # fmt: skip
PATCH = (
    '--- a/door.xml\n+++ b/door.xml\n@@ -12 +12 @@\n-<joint name="hinge"/>\n+<joint name="hinge" stiffness="1.049"/>\n'
)


def parameters() -> list[dict]:
    """The synthetic fit's parameters, as fit.json holds them."""
    out = []
    for row in ROWS:
        p = dict(zip(KEYS, row, strict=True))
        p |= {"nuisance": p["group"] == "Nuisance", "identifiable": True, "reason": "", "on_bound": False}
        p |= {"interval": [p["mean"] - 1.645 * p["std"], p["mean"] + 1.645 * p["std"]], "partners": []}
        p |= SPECIAL.get(p["name"], {})
        out.append(p)
    return out


def make_run(folder: Path, synthetic_robot: bool = True, recordings: tuple[str, ...] = ("open_close",)) -> Path:
    """A run's folder with every file of the schema, filled with plausible made-up numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    ps = parameters()
    gap = {
        name: {
            "before": 1.2234, "after": 0.1187, "noise_floor": 0.1012, "closed": 0.98440,
            "per_joint_before": [1.9, 2.1, 0.9, 0.8, 0.4, 0.3, 0.1],
            "per_joint_after": [0.2, 0.18, 0.12, 0.1, 0.06, 0.05, 0.04],
        }
        for name in recordings
    }  # fmt: skip
    config = {
        "command": "identify", "preset": "quick", "scene": "panda_door", "engine": "mjx", "seed": 7,
        "recordings": [
            {"name": n, "sha256": "ab12" * 16, "repeats": 10, "heldout": [7, 8, 9], "duration": 7.68}
            for n in recordings
        ],
        "versions": {"mujoco": "3.17.0", "jax": "0.9.2"}, "device": "2 CPU cores",
        "started": "2026-11-21T06:00:00Z", "synthetic_robot": synthetic_robot,
    }  # fmt: skip
    fit = {
        "format": "droid_jax fit", "version": 3,
        "parameters": ps, "cost": {"initial": 1.22, "best": 0.119, "noise_floor": 0.101},
        "heldout_distances": gap,
        "stop": "the cost did not change for 20 generations", "generations": 80, "evaluations": 2560,
        "seconds": {"search": 61.2, "refine": 12.5, "total": 90.1},
        "rule": "Gauss-Newton, widened to the held-out gap", "notes": ["the robot was cold <1 h"],
    }  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "fit.json").write_text(json.dumps(fit))
    (folder / "gaussian.json").write_text("{}")
    (folder / "fitted.json").write_text(json.dumps(NEUTRAL))
    (folder / "fitted.patch").write_text(PATCH)
    _write_history(folder, ps, rng)
    _write_traces(folder, recordings, rng)
    names = [p["name"] for p in ps]
    mixed = rng.normal(size=(len(ps), 14))
    np.savez(folder / "correlation.npz", names=names, correlation=np.corrcoef(mixed))
    initial, fitted = np.exp(rng.normal(0.3, 0.6, 200)), np.exp(rng.normal(-2.1, 0.1, 200))
    initial[:3] = 100.0
    np.savez(folder / "distribution.npz", initial_cost=initial, fitted_cost=fitted, names=names)
    (folder / "frames").mkdir(exist_ok=True)
    for i, (kind, grey) in enumerate((("before", 90), ("after", 160))):
        picture = np.full((48, 64, 3), grey, dtype=np.uint8)
        render.save_frames(folder / "frames", [picture, picture + 20], [0.0, 3.5 + i], kind)
    return folder


def _write_history(folder: Path, ps: list[dict], rng: np.random.Generator) -> None:
    generation = np.arange(80)
    decay = np.exp(-generation / 18)[:, None]
    start, end = (np.array([p[k] for p in ps]) for k in ("initial_mean", "mean"))
    wide, narrow = (np.array([p[k] for p in ps]) for k in ("initial_std", "std"))
    best = 0.119 + 0.9 * np.exp(-generation / 12)
    np.savez(
        folder / "history.npz",
        names=[p["name"] for p in ps],
        generation=generation,
        mean=end + (start - end) * decay + 0.03 * wide * rng.normal(size=(80, len(ps))) * decay,
        std=narrow + wide * decay,
        best_cost=best,
        median_cost=best * (1.15 + np.exp(-generation / 9)),
        sigma=np.exp(-generation / 25),
    )


def _write_traces(folder: Path, recordings: tuple[str, ...], rng: np.random.Generator) -> None:
    arrays: dict[str, np.ndarray] = {}
    time = np.arange(3840) * 0.002
    spans = (("reach", 0, 1.5), ("grasp", 1.5, 2.5), ("open", 2.5, 5.0), ("close", 5.0, 7.68))
    phases = [{"name": name, "start": start, "end": end} for name, start, end in spans]
    for r in recordings:
        j = np.arange(7)
        mean = (6 - 0.7 * j) * np.sin(2 * np.pi * time[:, None] / (4 + 0.4 * j)) * (time[:, None] > 1.0)
        arrays |= {
            f"{r}/time": time, f"{r}/measured_mean": mean, f"{r}/measured_low": mean - 0.3,
            f"{r}/measured_high": mean + 0.3, f"{r}/before": 1.25 * mean + 0.4,
            f"{r}/after": mean + 0.08 * rng.normal(size=mean.shape), f"{r}/joints": np.array(JOINTS),
            f"{r}/phases": np.array(json.dumps(phases)),
        }  # fmt: skip
    np.savez(folder / "traces.npz", **arrays)


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


def make_whole(folder: Path) -> None:
    """Every stage in its folder, with a policy to export; no page yet."""
    make_run(folder / "identify")
    make_gap(folder / "gap")
    make_policy(folder / "train")
    (folder / "train" / "policy.npz").write_bytes(b"")
