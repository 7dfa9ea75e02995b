"""One identification in 1, 2 and 4 processes on this machine: equality of fits, time, and loss of a process.

    python benchmarks/distributed.py [--quick] [--out DIR]

`python -m droid_jax.run identify` of the tutorial's arm, its processes joined by jax.distributed, one CPU device each;
and once in one process with four virtual devices.  All numbers of the fit are compared with those of one process.
Fewer rows at once on a device change the rounding: for the four devices the shift of the values is reported, in
deviations of the fitted Gaussian.  Then a worker is killed in the middle of a search, and the run is continued in one
process.  In another run a worker is stopped, like a host that no longer answers.  On a machine with fewer cores than
processes the times show the cost of the processes, not their gain.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

# ruff: noqa: E402  (the checkout first)
import tyro

from benchmarks.common import publish
from droid_jax import distributed, runtime
from droid_jax.files import FIT, GAUSSIAN

ARM = ROOT / "docs" / "tutorial"
SEARCH = (
    "identify", "--scene", str(ARM / "arm.xml"), "--parameters", str(ARM / "parameters.json"),
    "--recording", str(ARM / "data" / "validation"), "--restarts", "1",
)  # fmt: skip
LONGEST = 1800.0  # s that a run may take
NOT_COMPARED = ("seconds",)  # in fit.json


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """One and two processes, a short search: shows that it runs."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of distributed.json."""
    population: int = 128
    """Samples of a generation."""
    generations: int = 30
    """Generations of the search."""


def start(
    count: int, words: Sequence[str], place: Path, devices: int = 1, log: str = "log"
) -> list[subprocess.Popen[bytes]]:
    """A command in so many processes, process 0 first; what each writes goes to PLACE/LOG.NUMBER.

    Args:
        count: processes.
        words: the command line behind `python -m droid_jax.run`.
        place: folder of the cache of compiled programs and of the logs.
        devices: virtual CPU devices of each process.
        log: name of the logs.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    left = ("XLA_FLAGS", "TF_CPP_MIN_LOG_LEVEL", "JAX_COMPILATION_CACHE_DIR")
    given = {name: value for name, value in os.environ.items() if name not in left}
    given |= {"PYTHONPATH": str(ROOT), runtime.CACHE_VARIABLE: str(place / "cache"), "MUJOCO_GL": "disable"}
    given |= {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(devices)}
    if count > 1:
        given |= {distributed.VARIABLE: "1", distributed.COORDINATOR: f"localhost:{port}"}
        given[distributed.COUNT] = str(count)
    processes = []
    for number in range(count):
        with (place / f"{log}.{number}").open("wb") as said:
            processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", "droid_jax.run", *words],
                    env={**given, distributed.INDEX: str(number)},
                    stdout=said,
                    stderr=subprocess.STDOUT,
                )
            )
    return processes


@contextlib.contextmanager
def running(processes: list[subprocess.Popen[bytes]]) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Context in which processes run; all of them are ended when the block ends."""
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def finish(count: int, words: Sequence[str], place: Path, devices: int = 1) -> float:
    """Run a command in so many processes to its end: s.  RuntimeError with a log's end where one of them fails."""
    began = time.monotonic()
    with running(start(count, words, place, devices)) as processes:
        codes = [process.wait(LONGEST) for process in processes]
    if any(codes):
        said = "\n".join((place / f"log.{n}").read_text(errors="replace")[-1500:] for n in range(count))
        raise RuntimeError(f"{count} processes ended with {codes}:\n{said}")
    return time.monotonic() - began


def largest_difference(one: Path, other: Path) -> float:
    """Of all numbers of two fits and their Gaussians, relative where they are above 1; infinite where else differs."""
    return max(_apart(_read(one / name), _read(other / name)) for name in (FIT, GAUSSIAN))


def largest_shift(one: Path, other: Path) -> float:
    """Of all parameters' best values, in deviations of the first fit's Gaussian."""
    both = [json.loads((run / FIT).read_text())["parameters"] for run in (one, other)]
    return max(abs(a["best"] - b["best"]) / a["std"] for a, b in zip(*both, strict=True))


def _read(path: Path) -> Any:
    found = json.loads(path.read_text())
    return {name: value for name, value in found.items() if name not in NOT_COMPARED}


def _apart(one: Any, other: Any) -> float:
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return max((_apart(one[key], other[key]) for key in one), default=0.0)
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return max((_apart(a, b) for a, b in zip(one, other, strict=True)), default=0.0)
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) / max(1.0, abs(one))
    return 0.0 if one == other else float("inf")


def stage_seconds(run: Path) -> dict[str, float]:
    """s of each stage as process 0 counted them, compilation included."""
    return json.loads((run / FIT).read_text())["seconds"]


def lose(words: Sequence[str], out: Path, place: Path, number: int, by: signal.Signals) -> dict[str, Any]:
    """Send a signal to the last of two processes once the search has a checkpoint.

    Returns:
        s until process 0 ended, its exit code, and the last line that it said.
    """
    with running(start(2, words, place, log=f"lost{number}")) as processes:
        began = time.monotonic()
        while not any(path.name.isdecimal() for path in (out / "checkpoints").glob("*")):
            if processes[0].poll() is not None or time.monotonic() - began > LONGEST:
                raise RuntimeError(f"no checkpoint: {(place / f'lost{number}.0').read_text(errors='replace')[-1500:]}")
            time.sleep(0.02)
        processes[1].send_signal(by)
        began = time.monotonic()
        code = processes[0].wait(LONGEST)
        seconds = time.monotonic() - began
    time.sleep(1.0)  # its guard prints the last line
    said = (place / f"lost{number}.0").read_text(errors="replace").strip().splitlines()
    return {"seconds": seconds, "code": code, "said": next((x for x in reversed(said) if x.startswith("error")), "")}


def measured(place: Path, counts: Sequence[int], words: Sequence[str]) -> dict[str, Any]:
    """All figures."""
    runs = {count: place / f"run{count}" for count in counts}
    finish(1, [*words, "--out", str(place / "first")], place)  # compiles
    seconds = {str(count): finish(count, [*words, "--out", str(out)], place) for count, out in runs.items()}
    print(f"s with so many processes: {seconds}", file=sys.stderr, flush=True)
    devices = place / "devices"
    seconds["4 devices"] = finish(1, [*words, "--out", str(devices)], place, devices=4)
    apart = {str(count): largest_difference(runs[1], out) for count, out in runs.items() if count > 1}
    killed, stopped = place / "killed", place / "stopped"
    after_kill = lose([*words, "--out", str(killed)], killed, place, 0, signal.SIGKILL)
    after_stop = lose([*words, "--out", str(stopped)], stopped, place, 1, signal.SIGSTOP)
    print(f"differences {apart}; killed: {after_kill}; stopped: {after_stop}", file=sys.stderr, flush=True)
    finish(1, [*words, "--out", str(killed)], place)
    return {
        "largest_difference": max(apart.values()),
        "seconds_to_end_after_kill": after_kill["seconds"],
        "seconds_to_end_after_stop": after_stop["seconds"],
        "resumed_largest_difference": largest_difference(runs[1], killed),
        "seconds": seconds,
        "stage_seconds": {str(count): stage_seconds(out) for count, out in runs.items()},
        "differences": apart,
        "devices_shift_deviations": largest_shift(runs[1], devices),
        "killed": after_kill,
        "stopped": after_stop,
    }


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    counts = (1, 2) if arguments.quick else (1, 2, 4)
    population, generations = (16, 12) if arguments.quick else (arguments.population, arguments.generations)
    words = [*SEARCH, "--population", str(population), "--generations", str(generations)]
    place = Path(tempfile.mkdtemp(prefix="distributed_"))
    try:
        result = measured(place, counts, words)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    result |= {"population": population, "generations": generations, "quick": arguments.quick}
    publish(arguments.out, "distributed", arguments.quick, 0, result, result)


if __name__ == "__main__":
    main()
