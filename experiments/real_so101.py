"""The SO-101 arm, positions alone: fitted to two of its motions, judged on four others, through the commands alone.

    python experiments/real_so101.py --data DIR

`identify` fits `chirp_sweep` and `friction_gravity` of six STS3215 servos (`so101.json`: a gain, damping and dry
friction of each of the first five joints, one armature that they share, and a delay), with the library's limit of the
acceleration of each servo's own goal: an STS3215 draws ramps between its goals, and LeRobot sets their steepest, 254
times 100 counts/s^2 or 39 rad/s^2.  `so101.toml` says which columns
of a log are what.  `evaluate-fit` replays the other motions open loop, over their whole length.

Data: isaac-sim2real/sage (Apache 2.0), `output/real/so101/custom`.  DIR holds a folder for each motion, with
control.csv.gz and state_motor.csv.gz, and the arm without meshes, so101_air.xml.  They are not part of this repository.
Dry friction is made hard (`solimpfriction`): MuJoCo's own default creeps, and the arm stands still.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from commanded_fit import HERE, evaluated, fitted, kept, parameters_of
from inverse_fit import RESULTS, run

from benchmarks import common
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Recording

JUDGED = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll")
FIT = ("chirp_sweep", "friction_gravity")
JUDGES = ("multisine", "velocity_ramp", "step_response", "trapezoidal_profile")
SOURCE = (
    "Logs of isaac-sim2real/sage of an SO-101: a folder for each motion with control.csv.gz and state_motor.csv.gz."
)
SECONDS = 120.0
EFFECTS = ("profile_acceleration",)
HARD = "0.9999 0.9999 0.001 0.5 2"  # solimpfriction


@dataclass(frozen=True)
class RealSo101:
    """Fit the SO-101 arm to positions of two motions, judge it on four others.

    data: folder with the motions.
    quick: the first seconds of a motion to fit and one to judge, and a short search; its numbers are not for keeping.
    seconds: of each motion, from its start.
    out: folder for real_so101.json, and for the runs below `real_so101_runs`.
    seed: of the search.
    """

    data: Path
    quick: bool = False
    seconds: float = SECONDS
    out: Path = RESULTS
    seed: int = 0


def so101_log(folder: Path, motion: str, seconds: float) -> Recording:
    """One motion's first seconds on a regular clock, by the stamps of both tables."""
    if not (folder / motion).is_dir():
        raise FileNotFoundError(f"no folder {folder / motion}; --data is the folder that holds the motions. {SOURCE}")
    recording = load_recording(folder / motion, columns=HERE / "so101.toml", name=motion)
    return recording.window(0.0, seconds) if seconds < recording.duration else recording


def hard_scene(folder: Path, out: Path) -> Path:
    """The arm's MJCF with hard dry friction, as a file of its own."""
    source = folder / "so101_air.xml"
    if not source.is_file():
        raise FileNotFoundError(f"no file {source}; --data is the folder that holds the arm's MJCF. {SOURCE}")
    text, count = re.subn(r'(<joint type="hinge")', rf'\1 solimpfriction="{HARD}"', source.read_text(), count=1)
    if count != 1:
        raise ValueError(f"{source}: expected a default joint of type hinge")
    out.mkdir(parents=True, exist_ok=True)
    path = out / "so101_hard.xml"
    path.write_text(text)
    return path


def main(config: RealSo101) -> None:
    """One fit, four judges, one line of JSON."""
    seconds = 4.0 if config.quick else config.seconds
    fit, judges = (FIT[:1], JUDGES[:1]) if config.quick else (FIT, JUDGES)
    logs = [so101_log(config.data, motion, seconds) for motion in (*fit, *judges)]
    runs = config.out / ("real_so101_quick_runs" if config.quick else "real_so101_runs")
    paths = kept(logs, runs / "logs")
    options = [
        "--joints",
        *JUDGED,
        "--effects",
        *EFFECTS,
        "--seed",
        str(config.seed),
        *(["--generations", "3"] if config.quick else []),
    ]
    judge_on = [paths[name] for name in judges]
    scene = hard_scene(config.data, runs)
    found, took = fitted(scene, HERE / "so101.json", [paths[n] for n in fit], judge_on, runs / "identify", options)
    errors = evaluated(runs / "identify", [paths[name] for name in (*fit, *judges)], runs / "evaluation")["errors"]
    mae = {
        when: {name: round(1e3 * float(np.mean(of["position"][f"mae_{when}"])), 3) for name, of in errors.items()}
        for when in ("before", "after")
    }
    result = {
        "experiment": "real_so101",
        "source": SOURCE,
        "recordings": {r.name: r.sha256 for r in logs},
        "seconds_of_each_motion": seconds,
        "mean_judged_mrad": round(float(np.mean([mae["after"][name] for name in judges])), 3),
        "mean_judged_mrad_before": round(float(np.mean([mae["before"][name] for name in judges])), 3),
        "mae_mrad": mae["after"],
        "mae_mrad_before": mae["before"],
        "effects": list(EFFECTS),
        "tied": [],
        "parameters": parameters_of(found),
        "seconds": round(took, 1),
    }
    common.publish(config.out, "real_so101", config.quick, config.seed, result)


if __name__ == "__main__":
    run(lambda: main(tyro.cli(RealSo101, description=__doc__)))
