"""Compares this program with mujoco.sysid and CMA-ES in plain C: same data, parameters, bounds and machine.

    pip install -c constraints.txt -e ".[peers]"
    python benchmarks/peers.py [--data DIR] [--problems spring arm door ...] [--quick] [--out DIR]

spring, arm: the models of mujoco.sysid's own tests, with data at 0.01 ms, tested on another motion.  door: Table I's
with one spring, of the synthetic robot, 43 parameters, tested on held-out repeats.  go2, xl330, so101: real logs of
positions (DIR holds the folders go2_leg, bam_xl330 and so101 of the data), tested on logs that were not fitted, without
effects of the library.

Every fit is a separate process, and the programs run in turn.  `seconds` includes the start of the process,
`fit_seconds` does not.  mujoco.sysid's own models are fitted without importing this program.  The held-out error is
computed in plain C MuJoCo: of the door at half a millisecond, of all others at the steps of each program's fit.  A
program that has run is not run again.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402
import shutil  # noqa: E402
import subprocess  # noqa: E402
import time  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from dataclasses import dataclass, replace  # noqa: E402
from typing import Any, Literal  # noqa: E402

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from identify_suite import recordings  # noqa: E402
from real_so101 import FIT, JUDGED, JUDGES, scene_of, so101_log  # noqa: E402
from xl330_logs import GAINS, MOTIONS, xl330_log  # noqa: E402

from benchmarks.common import publish, stem  # noqa: E402
from benchmarks.peer_problems import doors, springs, sysid_models  # noqa: E402
from benchmarks.peer_problems.programs import DOOR, PROBLEM, PROGRAMS, problem  # noqa: E402
from droid_jax.cost.residuals import CompareConfig  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.identify.evaluation import evaluate_on  # noqa: E402
from droid_jax.identify.holdout import split_repeats  # noqa: E402
from droid_jax.recordings.formats import load_recording, save_recording  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402
from droid_jax.runtime import git_commit  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from droid_jax.synthetic.robot import synthetic_truth  # noqa: E402

HERE = ROOT / "experiments"
STEP = 0.002  # s, of the fits of spring and arm
JUDGING_GAIN = 400  # of the XL330
SYNTHETIC, REAL = ("spring", "arm", "door"), ("go2", "xl330", "so101")
BUDGET = {"population": 30, "generations": 20, "samples": 64, "cma_generations": 200, "iterations": 200}
QUICK = {"population": 8, "generations": 2, "samples": 16, "cma_generations": 3, "iterations": 3}


@dataclass(frozen=True)
class Arguments:
    """Options."""

    data: Path | None = None
    """Folder with bam_xl330, go2_leg and so101; without it the real logs are left out."""
    problems: tuple[str, ...] = ()
    """Only these problems; default: all with data."""
    programs: tuple[Literal["ours", "sysid", "cma_es"], ...] = ("ours", "sysid", "cma_es")
    """Only these programs; ours and sysid must be among them.  CMA-ES takes an hour on the SO-101."""
    quick: bool = False
    """The spring, and two seconds of the leg if its data exist; its numbers are not to be reported."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of peers.json, and of the runs."""


@dataclass(frozen=True)
class Logs:
    """Recordings to fit, test recordings, and the further input of the programs."""

    fit: list[Recording]
    judge: list[Recording]
    asked: dict[str, Any]
    files: dict[str, Path | str]
    rows: dict[str, Any] | None = None  # what is fitted, for a program that reads no recording


def own_model(name: str) -> Logs:
    """One of mujoco.sysid's tests."""
    spec = sysid_models.spec_of(name)
    spec.option.timestep = STEP
    model = spec.compile()
    joints = [model.joint(i).name for i in range(model.njnt)]
    rows: list[dict[str, Any]] = [sysid_models.log_of(name, judge, sysid_models.FINE, STEP) for judge in (False, True)]
    fit, judge = (springs.driven_log(role, joints, of) for role, of in zip(("fit", "judge"), rows, strict=True))
    entries = [
        {**entry, **({"element": joints, "each": True} if entry["element"] == "*" else {})}
        for entry in sysid_models.PARAMETERS[name]
    ]
    files = {"scene.xml": spec.to_xml(), "parameters.json": json.dumps(entries)}
    asked = {"joints": joints, "channels": ["position"], "refinement_only": True}
    return Logs([fit], [judge], asked, files, rows[0])


def real_logs(name: str, data: Path, quick: bool) -> Logs:
    """One of REAL."""
    if name == "go2":
        whole = load_recording(data / "go2_leg" / "go2_first_12s.npz", columns=HERE / "go2.toml", name="go2")
        first, last = (2.0, 8.0) if quick else (6.0, 11.995)
        fit = [replace(whole.window(0.0, first), name="first_half")]
        judge = [replace(whole.window(6.0, last), name="second_half")]
        scene, parameters = HERE / "go2_leg.xml", HERE / "go2.json"
    elif name == "xl330":
        logs = {(m, g): xl330_log(data / "bam_xl330", m, g) for m in MOTIONS for g in GAINS}
        fit = [log for (_, gain), log in logs.items() if gain != JUDGING_GAIN]
        judge = [log for (_, gain), log in logs.items() if gain == JUDGING_GAIN]
        scene, parameters = HERE / "xl330.xml", HERE / "xl330.json"
    else:
        fit, judge = ([so101_log(data / "so101", m, 1e9) for m in motions] for motions in (FIT, JUDGES))
        scene, parameters = scene_of(data / "so101"), HERE / "so101.json"
    entries = [e for e in json.loads(parameters.read_text()) if "inertia" not in e]  # which PACE does not fit
    joints = list(JUDGED) if name == "so101" else list(fit[0].channel("position").columns)
    asked = {"joints": joints, "channels": ["position"], "refinement_only": False}
    return Logs(fit, judge, asked, {"scene.xml": scene, "parameters.json": json.dumps(entries)})


def door_logs() -> Logs:
    """Table I's door with one spring; the last repeats of demonstrations A and C are the test data."""
    scene = door_scene(timestep=doors.OURS)
    logs = recordings(scene, synthetic_truth(scene, 1, 1), "AC", 1)
    fit, judge, _ = zip(*(split_repeats(r, 0.3) for r in logs), strict=True)
    asked = {"scene": DOOR, "channels": ["torque"], "refinement_only": False}
    return Logs(list(fit), list(judge), asked, {})


def prepared(name: str, arguments: Arguments, folder: Path) -> None:
    """Folder of a problem, with the input of every program."""
    if (folder / PROBLEM).is_file():
        return
    if name in REAL:
        if arguments.data is None:
            raise SystemExit(f"error: {name} needs --data, the folder that holds its logs")
        logs = real_logs(name, arguments.data, arguments.quick)
    else:
        logs = door_logs() if name == DOOR else own_model(name)
    folder.mkdir(parents=True, exist_ok=True)
    for role, some in (("fit", logs.fit), ("judge", logs.judge)):
        for number, recording in enumerate(some):
            save_recording(recording, folder / f"{role}_{number}.npz")
    for file, content in logs.files.items():
        shutil.copy(content, folder / file) if isinstance(content, Path) else (folder / file).write_text(content)
    if logs.rows is not None:
        np.savez(folder / "fit.npz", **logs.rows)
    asked = {"scene": "scene.xml", "parameters": "parameters.json", **(QUICK if arguments.quick else BUDGET)}
    names = {role: [f"{role}_{k}" for k in range(len(some))] for role, some in
             (("fit", logs.fit), ("judge", logs.judge))}  # fmt: skip
    write_json(folder / PROBLEM, {**asked, **logs.asked, **names})


def fitted(name: str, program: str, folder: Path) -> dict[str, Any]:
    """Result of a program, with the seconds of its process."""
    path, alone = folder / f"{program}.json", name in sysid_models.PARAMETERS and program == "sysid"
    if not path.is_file() or "seconds" not in json.loads(path.read_text()):
        module = "sysid_models" if alone else "programs"
        command = [sys.executable, "-m", f"benchmarks.peer_problems.{module}", str(folder.resolve())]
        began = time.monotonic()
        subprocess.run([*command, *([] if alone else [program])], cwd=ROOT, check=True)
        seconds = time.monotonic() - began
        write_json(path, {**json.loads(path.read_text()), "seconds": round(seconds, 2)})
    return json.loads(path.read_text())


def heldout(name: str, folder: Path, found: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Error of each program on the test data: mean absolute position error, or for the door equation 1 in N m.

    "truth" is the error of the true parameters, which is due to noise."""
    task = problem(folder, "ours")
    judge = [load_recording(folder / f"{file}.npz") for file in task.asked["judge"]]
    values = {program: np.asarray(one["values"]) for program, one in found.items()}
    if name == DOOR:
        truth = synthetic_truth(task.scene, 1, 1)
        values["truth"] = np.array([truth[n] for n in task.full.names])
        left = doors.distances_on(task.full, judge, values)
        return {program: float(np.mean(list(of.values()))) for program, of in left.items()}
    out = dict[str, float]()
    for program, best in values.items():
        config = CompareConfig(mj_step=program != "ours")  # as it stepped when it was fitted
        replays = evaluate_on(
            task.scene, task.full, judge, before=task.full.mean, after=best, engine="mujoco", config=config
        )
        out[program] = float(np.mean([np.mean(r.errors["position"].mae_after) for r in replays]))
    return out


def figures(name: str, folder: Path, programs: Sequence[str]) -> dict[str, Any]:
    """These programs on one problem."""
    found = {program: fitted(name, program, folder) for program in programs}
    left = heldout(name, folder, found)
    out: dict[str, Any] = {
        program: {
            "heldout": left[program],
            **{key: one[key] for key in ("seconds", "fit_seconds", "engine") if key in one},
            **({"inside_90": _inside(folder, one)} if name == DOOR and "interval" in one else {}),
        }
        for program, one in found.items()
    }
    for key, ratio in {"seconds": "time_ratio_to_sysid", "fit_seconds": "fit_time_ratio_to_sysid"}.items():
        out[ratio] = found["ours"][key] / found["sysid"][key]
    return {**out, **({"heldout_of_truth": left["truth"]} if "truth" in left else {})}


def _inside(folder: Path, one: dict[str, Any]) -> list[int]:
    """How many truths of Table I's parameters lie inside the 90 % intervals, and of how many."""
    task, (low, high) = problem(folder, "ours"), np.asarray(one["interval"])
    truth = synthetic_truth(task.scene, 1, 1)
    at = [task.full.index(n) for n in task.space.names]
    inside = [low[k] <= truth[task.full.names[k]] <= high[k] for k in at]
    return [int(np.sum(inside)), len(inside)]


def main(arguments: Arguments) -> None:
    """All programs on all problems; other problems in peers.json are kept."""
    every = (*SYNTHETIC, *REAL)
    if missing := {"ours", "sysid"} - {*arguments.programs}:
        raise SystemExit(f"error: --programs lacks {', '.join(sorted(missing))}, whose times are compared")
    if unknown := [p for p in arguments.problems if p not in every]:
        raise SystemExit(f"error: no problem {', '.join(unknown)}; there are {', '.join(every)}")
    usual = ("spring", "go2") if arguments.quick else every
    runs = arguments.out / stem("peers_runs", arguments.quick)
    path = arguments.out / f"{stem('peers', arguments.quick)}.json"
    there = json.loads(path.read_text()) if path.is_file() else {}
    known = {name: there[name] for name in every if name in there}
    for name in arguments.problems or [p for p in usual if p in SYNTHETIC or arguments.data is not None]:
        print(f"{name} ...", flush=True)
        prepared(name, arguments, runs / name)
        known[name] = {"commit": git_commit(ROOT), **figures(name, runs / name, arguments.programs)}
        print(json.dumps(known[name]), flush=True)
    publish(arguments.out, "peers", arguments.quick, 0, {"programs": list(PROGRAMS), **known})


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
