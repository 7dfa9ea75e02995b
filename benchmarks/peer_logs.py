"""Real logs of positions through three programs: this one, mujoco.sysid, and PACE's method, in turns on one machine.

    pip install -c constraints.txt -e ".[peers]"
    python benchmarks/peer_logs.py --data DIR [--quick] [--out DIR]

A quadruped's leg (fitted to one half of a log, judged on the other) and a servo with a pendulum (fitted to the eight
logs of two gains, judged on the third).  All programs fit the same parameters within the same bounds: armature,
damping, dry friction, encoder zeros and a delay, of the servo its gain and its torque limit too.  Each runs in a
process of its own, and its time holds the start of it.  The judge is the mean absolute position error of whole
replays, each by the engine that the program itself fits with.

PACE's method (L. Bjelonic et al., https://arxiv.org/abs/2509.06342; its repository's optim/cma_es.py): CMA-ES of the
package `cmaes` over bounds scaled to [-1, 1], from their middle, with a deviation of 0.5; the score is the mean squared
position error; the answer is the mean of the last distribution.  It simulates 4,096 robots at once in Isaac Lab on a
GPU.  Here are fewer, in plain C MuJoCo on all cores.  DIR holds the folders bam_xl330 and go2_leg of the data.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402
import subprocess  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Sequence  # noqa: E402
from dataclasses import dataclass, replace  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from commanded_fit import HERE, evaluated, fitted, kept  # noqa: E402
from xl330_logs import GAINS, MOTIONS, xl330_log  # noqa: E402

from benchmarks.common import publish, stem  # noqa: E402
from benchmarks.peers import sysid  # noqa: E402
from droid_jax.cost.residuals import CompareConfig  # noqa: E402
from droid_jax.identify.evaluation import evaluate_on, evaluation_json  # noqa: E402
from droid_jax.model.effect_interface import Rollout  # noqa: E402
from droid_jax.model.parameter_file import friction_joints, load_parameters  # noqa: E402
from droid_jax.model.parameters import Space  # noqa: E402
from droid_jax.model.scene import Scene, load_scene  # noqa: E402
from droid_jax.recordings.clocks import interpolate  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402
from droid_jax.simulate.c_reference import c_replay  # noqa: E402
from droid_jax.simulate.replay import make_drive  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402

PROGRAMS = ("ours", "pace", "sysid")
PROBLEMS = ("go2", "xl330")
JUDGE = 400  # the gain that judges


@dataclass(frozen=True)
class Arguments:
    """Options."""

    data: Path
    """Folder with bam_xl330 and go2_leg."""
    quick: bool = False
    """The leg alone, two seconds of each half and few generations; its numbers are not for keeping."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of peer_logs.json, and of the runs."""
    population: int = 64
    """Samples of a generation of PACE's method."""
    generations: int = 200
    """Of PACE's method at most; it ends before where a generation's scores differ by less than a hundredth."""
    only: str = ""
    """PROBLEM/PROGRAM: this one alone, in this process."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A robot, what is fitted of it, and its logs."""

    scene: Scene
    space: Space
    files: tuple[Path, Path]
    fit: list[Recording]
    judge: list[Recording]


def problem(name: str, arguments: Arguments, folder: Path) -> Problem:
    """Of a name out of PROBLEMS."""
    if name == "go2":
        files = HERE / "go2_leg.xml", HERE / "go2.json"
        whole = load_recording(arguments.data / "go2_leg" / "go2_first_12s.npz", columns=HERE / "go2.toml", name="go2")
        first, last = (2.0, 8.0) if arguments.quick else (6.0, 11.995)
        fit = [replace(whole.window(0.0, first), name="first_half")]
        judge = [replace(whole.window(6.0, last), name="second_half")]
    else:
        files = HERE / "xl330.xml", HERE / "xl330.json"
        logs = {(m, g): xl330_log(arguments.data / "bam_xl330", m, g) for m in MOTIONS for g in GAINS}
        fit = [log for (_, gain), log in logs.items() if gain != JUDGE]
        judge = [log for (_, gain), log in logs.items() if gain == JUDGE]
    entries = [e for e in json.loads(files[1].read_text()) if "inertia" not in e]  # which PACE does not fit
    asked = folder / f"{name}_parameters.json"
    write_json(asked, entries)
    scene = load_scene(files[0], joints=fit[0].channel("position").columns, friction_joints=friction_joints(asked))
    return Problem(scene, load_parameters(asked, scene), (files[0], asked), fit, judge)


def pace(task: Problem, arguments: Arguments) -> np.ndarray:
    """[D] by CMA-ES on the positions."""
    import cmaes

    low, high = task.space.low, task.space.high
    replays = list[tuple[Callable[[np.ndarray], Rollout], np.ndarray]]()  # with what was measured on their clocks
    for recording in task.fit:
        drive, channel = make_drive(task.scene, recording), recording.channel("position")
        measured = interpolate(drive.time, channel.time - recording.time[0], channel.values[0])
        replays.append((c_replay(task.scene, task.space, drive, late=0.0), measured))
    instants = sum(len(measured) for _, measured in replays)
    search = cmaes.CMA(
        mean=np.zeros(len(low)), sigma=0.5, bounds=np.tile([-1.0, 1.0], (len(low), 1)), seed=0,
        population_size=arguments.population,
    )  # fmt: skip
    for _ in range(5 if arguments.quick else arguments.generations):
        rows = np.stack([search.ask() for _ in range(arguments.population)])
        scores = np.zeros(len(rows))
        for replay, measured in replays:
            simulated = replay(low + 0.5 * (rows + 1.0) * (high - low)).position
            scores += np.sum((simulated - measured) ** 2, axis=(1, 2)) / instants
        scores = np.where(np.isfinite(scores), scores, 1e6)
        search.tell(list(zip(rows, scores.tolist(), strict=True)))
        if np.ptp(scores) < 0.01 * scores.min():
            break
    return low + 0.5 * (search.mean + 1.0) * (high - low)


def one(name: str, program: str, arguments: Arguments, folder: Path) -> dict[str, Any]:
    """What a program makes of a problem."""
    task, began = problem(name, arguments, folder), time.monotonic()
    if program == "ours":
        runs = folder / f"{name}_ours"
        paths = kept([*task.fit, *task.judge], folder / f"{name}_logs")
        fit, judge = ([paths[r.name] for r in logs] for logs in (task.fit, task.judge))
        options = ["--generations", "3"] if arguments.quick else []
        found, seconds = fitted(*task.files, fit, judge, runs / "identify", options)
        errors = evaluated(runs / "identify", judge, runs / "evaluation")["mean_mae"]["position"]["after"]
        values = {p["name"]: p["best"] for p in found["parameters"]}
    else:
        best = pace(task, arguments) if program == "pace" else _sysid(task, arguments)
        seconds = time.monotonic() - began
        config = CompareConfig(mj_step=True)  # as they step
        judged = evaluate_on(
            task.scene, task.space, task.judge, before=task.space.mean, after=best, engine="mujoco", config=config
        )
        errors = evaluation_json(judged)["mean_mae"]["position"]["after"]
        values = dict(zip(task.space.names, best.tolist(), strict=True))
    return {"heldout_mae": errors, "fit_seconds": round(seconds, 1), "values": values}


def _sysid(task: Problem, arguments: Arguments) -> np.ndarray:
    most = 3 if arguments.quick else 200  # 200: its own
    return sysid.fit(task.scene, task.space, task.fit, channel="position", off_bounds=True, max_iters=most).values


def apart(name: str, program: str, arguments: Arguments, folder: Path) -> dict[str, Any]:
    """The same in a process of its own, with the seconds of that."""
    path = folder / f"{name}_{program}.json"
    if not path.is_file():
        began = time.monotonic()
        command = [sys.executable, __file__, *sys.argv[1:], "--only", f"{name}/{program}"]
        subprocess.run(command, check=True)
        write_json(path, {**json.loads(path.read_text()), "seconds": round(time.monotonic() - began, 1)})
    return json.loads(path.read_text())


def main(arguments: Arguments) -> None:
    """All programs on all problems; one that is there already is not run again."""
    folder = arguments.out / stem("peer_logs_runs", arguments.quick)
    if arguments.only:
        name, program = arguments.only.split("/")
        write_json(folder / f"{name}_{program}.json", one(name, program, arguments, folder))
        return
    problems: Sequence[str] = PROBLEMS[:1] if arguments.quick else PROBLEMS
    found = {name: {program: apart(name, program, arguments, folder) for program in PROGRAMS} for name in problems}
    publish(arguments.out, "peer_logs", arguments.quick, 0, {"population": arguments.population, "problems": found})


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
