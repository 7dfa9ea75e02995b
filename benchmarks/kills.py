"""Do runs that are killed at random moments and resumed end with the result of an uninterrupted run?

    python benchmarks/kills.py [--quick] [--out DIR] [--only COMMAND ...]

`identify` and `gap` on a log of a lone hinge, `train` on the built-in door, each with a budget of seconds.  Each run is
killed with SIGKILL, once or twice, at a random moment within the duration of an uninterrupted run, and then started
again until it ends.  Every second training is killed just after its first or second checkpoint instead, because a small
training compiles for most of its time.  All numbers of a run's files are compared bit for bit with those of the
uninterrupted run, except moments and durations.

A resumed training continues from its last checkpoint, with new moments of Adam and newly drawn starts (`policy.train`),
so that its result differs from that of an uninterrupted one.  It is compared with an uninterrupted training
(`identical`) and with one that was stopped just after the same checkpoint (`as_stopped_there`).

A stopped script can be continued: its results so far are in DIR/kills.  At the end it writes DIR/kills.json, which
benchmarks/robustness.py reads, and prints one line of JSON.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

# ruff: noqa: E402  (what is imported lies in folders that are no packages)
import numpy as np
import tyro

from benchmarks.common import publish
from droid_jax.files import LAST_FILES
from droid_jax.storage import write_json

COMMANDS = ("identify", "gap", "train")
RUNS, QUICK = 20, 2  # of each command
LONGEST = 3600.0  # s that one process may take, on a machine with much else to do; longer counts as a hang
FROM, TO = 0.02, 0.98  # of an uninterrupted run's seconds, between which it is killed
JUST_BEHIND = 0.5  # s behind a checkpoint in which a training is killed that compiles for most of its time
AGAIN = 0.3  # share of runs that are killed a second time
# Keys of moments, durations, places and code versions, which are not results.
NOT_COMPARED = {"seconds", "started", "versions", "device", "rate", "left", "setup", "recordings", "seconds_total"}
HINGE = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="hinge" axis="0 0 1" damping="0.4"/>
<inertial pos="0.2 0 0" mass="2" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>"""
PARAMETERS = [
    {"field": "dof_damping", "element": "hinge", "unit": "N m s/rad", "std": 0.4, "high": 10.0},
    {"sensor": "torque_offset", "element": "hinge", "std": 0.3, "high": 3.0},
]
LOG = ("--scene", "hinge.xml", "--parameters", "parameters.json", "--joints", "hinge", "--recording", "log.npz")
ARGUMENTS = {
    "identify": ("identify", *LOG, "--population", "16", "--generations", "40", "--restarts", "1"),
    "gap": ("gap", *LOG, "--effects", "joint_coulomb", "torque_gain"),
    "train": ("train", "--method", "prior", "--steps", "384"),
}
# Three checkpoints, as many as are kept, so that a stopped run has the same checkpoints as one without a stop.
SMALL = {"envs": 8, "devices": 1, "hidden": (8,), "unroll": 4, "batch": 8, "minibatches": 1, "epochs": 1,
         "evaluations": 4, "eval_envs": 2}  # fmt: skip


@dataclass(frozen=True)
class Arguments:
    """Kill runs at random moments, resume them, and compare."""

    quick: bool = False
    """Two runs of each command instead of 20."""
    out: Path = Path("runs/robustness")
    """Folder of kills.json; finished runs are in its subfolder kills."""
    only: tuple[str, ...] = COMMANDS
    """Commands."""
    seed: int = 0
    """Seed of the moments."""


def main(arguments: Arguments) -> None:
    place = arguments.out.resolve() / "kills"
    place.mkdir(parents=True, exist_ok=True)
    write_inputs(place)
    done = _done(place / "done.jsonl")
    runs = QUICK if arguments.quick else RUNS
    asked = [(command, number) for number in range(runs) for command in arguments.only]
    for command, number in asked:
        if (command, number) in done:
            continue
        seconds = reference(place, command)
        found = killed(place, command, number, seconds, Random(f"{arguments.seed} {command} {number}"))
        done[command, number] = found
        with (place / "done.jsonl").open("a") as file:
            file.write(json.dumps({"command": command, "run": number, **found}) + "\n")
        print(f"{command} {number}: {found}", file=sys.stderr, flush=True)
    result = summary({case: done[case] for case in asked})
    line = {key: result[key] for key in ("kills", "kills_resumed_identical")}
    publish(arguments.out, "kills", arguments.quick or arguments.only != COMMANDS, arguments.seed, result, line)


def summary(done: Mapping[tuple[str, int], Mapping[str, Any]]) -> dict[str, Any]:
    """Counts over all runs and for each command."""
    by = {command: [found for (of, _), found in done.items() if of == command] for command in COMMANDS}
    return {
        "kills": len(done),
        "kills_resumed_identical": sum(found["identical"] for found in done.values()),
        "kills_resumed_to_an_end": sum(found["ended"] for found in done.values()),
        "by_command": {
            command: {
                "runs": len(of),
                "signals": sum(len(found["at"]) for found in of),
                "resumed_to_an_end": sum(found["ended"] for found in of),
                "identical": sum(found["identical"] for found in of),
                "as_stopped_there": sum(found["as_stopped_there"] for found in of),
                "where_not": sorted({name for found in of for name in found["differ"]}),
                "said": sorted({line for found in of for line in found["said"]}),
            }
            for command, of in by.items()
            if of
        },
        "why_not": {"train": "a training goes on with Adam's moments and starts drawn anew (policy.train)"},
    }


def write_inputs(place: Path) -> None:
    """Scene, parameters and a log of 24 s with dry friction that the scene lacks."""
    if (place / "log.npz").exists():
        return
    from droid_jax.recordings.formats import save_recording
    from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide

    time_, size, rate = np.arange(0.0, 24.0, 0.01), np.array([[0.5], [0.15]]), 2 * np.pi * np.array([[0.23], [0.51]])
    phase = rate * time_
    position, speed = (size * np.sin(phase)).sum(0), (size * rate * np.cos(phase)).sum(0)
    inertial = -0.09 * (size * rate**2 * np.sin(phase)).sum(0)  # 0.09 kg m^2 about the hinge
    noise = np.random.default_rng(3).normal(0.0, 0.06, len(time_) + 19)
    torque = (
        inertial + 0.6 * speed + 0.1 + 0.5 * np.tanh(speed / 0.01) + np.convolve(noise, np.full(20, 20**-0.5), "valid")
    )
    mask = np.ones((1, len(time_), 1), bool)
    channels = {
        "position": Channel("position", "rad", ("hinge",), time_, position[None, :, None], mask),
        "torque": Channel("torque", "N m", ("hinge",), time_, torque[None, :, None], mask),
    }
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    (place / "hinge.xml").write_text(HINGE)
    write_json(place / "parameters.json", PARAMETERS)
    save_recording(
        Recording("hinge", np.zeros(0), np.zeros((0, 0)), (), channels, convention, qpos0={}), place / "log.npz"
    )


def reference(place: Path, command: str) -> float:
    """Make the uninterrupted run twice, so that everything is compiled; returns the seconds of the second."""
    kept = place / f"{command}_seconds.json"
    if kept.exists():
        return json.loads(kept.read_text())
    for out in (f"{command}_first", f"{command}_reference"):
        shutil.rmtree(place / out, ignore_errors=True)
        began = time.monotonic()
        code, said = finish(place, command, out)
        if code:
            raise SystemExit(f"{command} without a kill ended with {code}: {said}")
    both = [numbers_of(place / f"{command}_{name}") for name in ("first", "reference")]
    if differing(*both):
        raise SystemExit(f"{command} without a kill differs from run to run: {differing(*both)}")
    write_json(kept, time.monotonic() - began)
    return json.loads(kept.read_text())


def killed(place: Path, command: str, number: int, seconds: float, random: Random) -> dict[str, Any]:
    """One run that is killed and restarted until it ends, compared with the reference."""
    out = f"{command}_{number:02d}"
    shutil.rmtree(place / out, ignore_errors=True)
    at, kept = [], 0
    awaited = 1 + number // 2 % 2 if command == "train" and number % 2 else 0  # checkpoints
    while not at or (len(at) < 2 and not awaited and random.random() < AGAIN):
        process, began = start(place, command, out), time.monotonic()
        _await_checkpoints(process, place / out, awaited)
        try:
            process.wait(random.uniform(0.0, JUST_BEHIND) if awaited else random.uniform(FROM, TO) * seconds)
            break  # it ended before the kill
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        at.append(round(time.monotonic() - began, 2))
        kept = _last_checkpoint(place / out)
    if not at:
        return killed(place, command, number, 0.9 * seconds, random)
    code, said = finish(place, command, out)
    differ = differing(numbers_of(place / out), numbers_of(place / f"{command}_reference")) if not code else []
    identical = not code and not differ
    there = identical or (command == "train" and not code and _as_stopped_there(place, out, kept, len(at)))
    if identical or there:
        shutil.rmtree(place / out)
    return {
        "at": at, "ended": code == 0, "identical": identical, "as_stopped_there": there, "kept": kept,
        "differ": differ, "said": said,
    }  # fmt: skip


def _await_checkpoints(process: subprocess.Popen[str], folder: Path, count: int) -> None:
    """Return once a run has written some checkpoints, or ended."""
    while process.poll() is None and sum(p.name.isdecimal() for p in folder.glob("checkpoints/*")) < count:
        time.sleep(0.01)


def _last_checkpoint(folder: Path) -> int:
    """Step of the newest checkpoint of a training; 0 where there is none."""
    return max((int(path.name) for path in folder.glob("checkpoints/*") if path.name.isdecimal()), default=0)


def _as_stopped_there(place: Path, out: str, step: int, kills: int) -> bool:
    """Whether a training's result is that of one that was stopped once, after the checkpoint of a step."""
    if kills > 1:  # it was resumed twice
        return False
    model = place / f"train_stopped_{step}"
    if not model.exists():
        shutil.copytree(place / "train_reference", model)
        for name in (LAST_FILES["train"], "policy.npz", "report.html"):
            (model / name).unlink()
        for path in (model / "checkpoints").iterdir():
            if path.name.isdecimal() and int(path.name) > step:
                shutil.rmtree(path)
        code, said = finish(place, "train", model.name)
        if code:
            raise SystemExit(f"train, stopped at {step}, ended with {code}: {said}")
    return not differing(numbers_of(place / out), numbers_of(model))


def start(place: Path, command: str, out: str, said: Any = subprocess.DEVNULL) -> subprocess.Popen[str]:
    """Start the command in a new process group."""
    given = {name: value for name, value in os.environ.items() if name not in ("TF_CPP_MIN_LOG_LEVEL", "XLA_FLAGS")}
    environment = {**given, "DROID_JAX_CACHE": str(place / "cache"), "PYTHONPATH": str(ROOT), "MUJOCO_GL": "disable"}
    words = [sys.executable, str(Path(__file__).resolve()), "--child", *ARGUMENTS[command], "--out", out]
    return subprocess.Popen(
        words, cwd=place, env=environment, stdout=subprocess.DEVNULL, stderr=said, text=True, start_new_session=True
    )


def finish(place: Path, command: str, out: str) -> tuple[int, list[str]]:
    """Run a command to its end; returns its exit code (124 if it hangs) and its standard error."""
    process = start(place, command, out, subprocess.PIPE)
    try:
        _, said = process.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return 124, ["it did not end"]
    return process.returncode, said.replace(str(place), "DIR").splitlines()[-5:]


def child(words: list[str]) -> int:
    """The command line with a small training, which stores every compiled program in the cache."""
    from dataclasses import replace

    from droid_jax import runtime
    from droid_jax.run import main as command_line

    runtime.start()
    import jax

    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if words[0] == "train":
        from droid_jax.policy import train

        train.PRESETS["quick"] = replace(train.PRESETS["quick"], **SMALL)
    return command_line(words)


def numbers_of(folder: Path) -> dict[str, bytes]:
    """Values of a run by file and key, without pictures, checkpoints, and the keys in NOT_COMPARED."""
    found: dict[str, bytes] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix == ".npz":
            with np.load(path) as file:
                found |= {f"{path.name}/{key}": _bytes(file[key]) for key in file.files}
        elif path.suffix == ".json" and path.name != "setup.json":
            found |= {f"{path.name}/{key}": value for key, value in _leaves(json.loads(path.read_text()))}
        elif path.suffix in (".csv", ".xml"):
            found[path.name] = path.read_bytes()
    return found


def _bytes(array: np.ndarray) -> bytes:
    return f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes()


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, bytes]]:
    """Every value of a JSON file with its place."""
    if isinstance(value, dict):
        for name, inner in value.items():
            if name not in NOT_COMPARED:
                yield from _leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _leaves(inner, f"{key}[{i}]")
    else:
        yield key, json.dumps(value).encode()


def differing(one: Mapping[str, bytes], other: Mapping[str, bytes]) -> list[str]:
    """Files in which two runs differ."""
    return sorted({key.split("/")[0] for key in {*one, *other} if one.get(key) != other.get(key)})


def _done(path: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """Runs that were made before; an incomplete line is left out."""
    found = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            one = json.loads(line)
        except ValueError:
            continue
        found[one.pop("command"), one.pop("run")] = one
    return found


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        sys.exit(child(sys.argv[2:]))
    main(tyro.cli(Arguments, description=__doc__))
