"""Does the program work with MuJoCo 4, and which numbers differ?

    python benchmarks/mujoco4.py --python PATH/TO/VENV/bin/python

The venv holds this package with MuJoCo 4; this script itself runs with MuJoCo 3.17.  It runs the quick tests of model,
replay and identification there (`passed`, `failed`), and compares numbers of both versions (`differences`): arrays of
compiled models, plain C rollouts and replays in MJX.  Finished parts are kept in OUT/mujoco4_runs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import numpy as np
import tyro

HERE = Path(__file__).resolve().parent
# Folders, and how many groups of files each is run in, so that a run that is stopped goes on.
TESTS = {"tests/model": 6, "tests/identify": 5, "tests/simulate": 8, "tests/model/effects": 3}
QUICK = {"tests/model": 8}
SCENES = {"bench": HERE.parent / "experiments" / "bench.xml", "hinge": HERE.parent / "experiments" / "hinge.xml"}
SECONDS = 3.0


@dataclass(frozen=True)
class Mujoco4:
    """Compare this MuJoCo with the one of another interpreter."""

    python: Path = Path(sys.executable)
    """Interpreter of the other environment."""
    numbers: Path | None = None
    """Only compute the numbers with this interpreter, into this npz file."""
    tests: bool = True
    """Run the tests there."""
    minutes: float = 60.0
    """No group of test files is begun after this time; groups that were not run are listed."""
    processes: int = 1
    """Processes of pytest."""
    seed: int = 0
    """Seed of the disturbed values."""
    out: Path = HERE / "results"
    """Folder for mujoco4.json."""
    quick: bool = False
    """Only some tests of model/; writes mujoco4_quick.json."""


def compute(path: Path, seed: int) -> None:
    """Numbers of both engines with this interpreter's MuJoCo."""
    import mujoco

    from droid_jax import runtime
    from droid_jax.door.demonstration import demonstration_path
    from droid_jax.door.scene import door_scene
    from droid_jax.model.scene import load_scene
    from droid_jax.recordings.formats import load_recording

    runtime.start()
    scenes = {name: load_scene(file) for name, file in SCENES.items()} | {"door": door_scene()}
    out: dict[str, Any] = {"version": np.array(mujoco.__version__)}
    for name, scene in scenes.items():
        model = scene.model
        for field in dir(model):
            value = getattr(model, field, None)
            if (
                isinstance(value, np.ndarray)
                and value.dtype.kind == "f"
                and not field.startswith(("mesh", "tex", "vis"))
            ):
                out[f"{name}/model/{field}"] = value
        out[f"{name}/c/qpos"] = free_motion(model, seed)
    scene = scenes["door"]
    recording = load_recording(demonstration_path("A"))
    out |= {f"door/mjx/{key}": value for key, value in replayed(scene, recording).items()}
    out |= {f"door/replay in C/{key}": value for key, value in replayed_in_c(scene, recording).items()}
    np.savez(path, **out)


def free_motion(model: Any, seed: int) -> np.ndarray:
    """[T, nq] of a plain C rollout from a disturbed start, controls at a sine."""
    import mujoco

    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    mujoco.mj_integratePos(model, data.qpos, rng.uniform(-0.1, 0.1, model.nv), 1.0)
    start, out = data.qpos.copy(), []
    for _ in range(round(SECONDS / model.opt.timestep)):
        out.append(data.qpos.copy())
        for u in range(model.nu):
            joint = model.actuator_trnid[u, 0]
            at = start[model.jnt_qposadr[joint]] if model.actuator_trntype[u] == 0 else 0.0
            data.ctrl[u] = at + 0.1 * np.sin(2.0 * data.time + u)
        mujoco.mj_step(model, data)
    return np.array(out)


def replayed(scene: Any, recording: Any) -> dict[str, np.ndarray]:
    """The replay in MJX at the scene's own values."""
    import jax

    from droid_jax import runtime
    from droid_jax.model.physics import Physics
    from droid_jax.simulate.replay import make_drive, servo_replay

    replay = servo_replay(scene, make_drive(scene, recording, weigh=False))
    run = jax.jit(lambda: replay(Physics(scene.mjx, {})), compiler_options=runtime.compiler_options())
    out = jax.tree.map(np.asarray, run())
    return {key: getattr(out, key) for key in ("position", "torque", "object_angle")}


def replayed_in_c(scene: Any, recording: Any) -> dict[str, np.ndarray]:
    """The same commands stepped by plain C."""
    from droid_jax.simulate.c_engine import instrument, simulate
    from droid_jax.simulate.c_reference import control_of
    from droid_jax.simulate.replay import make_drive

    drive = make_drive(scene, recording, weigh=False)
    trace = simulate(scene, [instrument(scene)], drive.qpos0[None], control_of(drive)[None])
    return {key: getattr(trace, key)[0] for key in ("position", "torque", "object_angle")}


def differences(three: Path, four: Path) -> dict[str, Any]:
    """Numbers that differ between two files of `compute`."""
    one, two = np.load(three), np.load(four)
    out: dict[str, Any] = {"versions": [str(one["version"]), str(two["version"])], "numbers": {}}
    out["only_in_first"] = sorted({k.split("/", 1)[1] for k in {*one.files} - {*two.files}})
    out["only_in_second"] = sorted({k.split("/", 1)[1] for k in {*two.files} - {*one.files}})
    for key in sorted({*one.files} & {*two.files} - {"version"}):
        if one[key].shape != two[key].shape:
            out["numbers"][key] = {"shapes": [list(one[key].shape), list(two[key].shape)]}
        elif one[key].size and (apart := float(np.nanmax(np.abs(one[key] - two[key])))) > 0:
            out["numbers"][key] = {"largest": apart, "of": float(np.nanmax(np.abs(one[key])))}
    return out


def groups(tests: Mapping[str, int]) -> dict[str, list[str]]:
    """Files of each group, by a name for its report."""
    out: dict[str, list[str]] = {}
    for folder, count in tests.items():
        files = sorted(str(p.relative_to(common.ROOT)) for p in (common.ROOT / folder).glob("test_*.py"))
        out |= {f"{folder.replace('/', '_')}_{k}": files[k::count] for k in range(count)}
    return out


def tested(python: Path, processes: int, asked: Mapping[str, list[str]], runs: Path, minutes: float) -> dict[str, Any]:
    """Number of tests that pass with an interpreter, and those that fail; existing reports are read."""
    cases: list[ElementTree.Element] = []
    end, left = time.monotonic() + 60.0 * minutes, list[str]()
    for name, files in asked.items():
        report = runs / f"{name}.xml"
        if not report.is_file() and time.monotonic() > end:
            left += files
            continue
        if not report.is_file():
            many = ["-n", str(processes), "--dist", "worksteal"] if processes > 1 else []
            command = [python, "-m", "pytest", "-q", "-p", "no:randomly", *many, f"--junit-xml={report}", *files]
            environment = {**os.environ, "PYTHONPATH": str(common.ROOT)}
            subprocess.run(command, cwd=common.ROOT, env=environment, check=False)
        cases += ElementTree.parse(report).getroot().iter("testcase")
    bad = [c for c in cases if c.find("failure") is not None or c.find("error") is not None]
    skipped = sum(c.find("skipped") is not None for c in cases)
    names = sorted(f"{c.get('classname')}::{c.get('name')}" for c in bad)
    return {"passed": len(cases) - len(bad) - skipped, "failed": len(bad), "skipped": skipped, "failures": names,
            "not_run": sorted(left)}  # fmt: skip


def main(config: Mujoco4) -> None:
    if config.numbers is not None:
        compute(config.numbers, config.seed)
        return
    runs = config.out / f"{common.stem('mujoco4', config.quick)}_runs"
    runs.mkdir(parents=True, exist_ok=True)
    asked = groups(QUICK if config.quick else TESTS)
    asked = dict(list(asked.items())[:1]) if config.quick else asked
    both = {"three": Path(sys.executable), "four": config.python}
    for name, python in both.items():
        if not (runs / f"{name}.npz").is_file():
            command = [python, __file__, "--numbers", runs / f"{name}.npz", "--seed", str(config.seed)]
            subprocess.run(command, env={**os.environ, "PYTHONPATH": str(common.ROOT)}, check=True)
    result = {
        "benchmark": "mujoco4",
        "tests": sorted({file for files in asked.values() for file in files}),
        **(tested(config.python, config.processes, asked, runs, config.minutes) if config.tests else {}),
        "differences": differences(runs / "three.npz", runs / "four.npz"),
    }
    common.publish(config.out, "mujoco4", config.quick, config.seed, result)


if __name__ == "__main__":
    main(tyro.cli(Mujoco4, description=__doc__))
