"""Functions of the benchmark scripts: fair timing, separate processes, and the origin of a result."""

from __future__ import annotations

import datetime
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from droid_jax import runtime
from droid_jax.storage import write_json

ROOT = Path(__file__).resolve().parents[1]


# When the program started: what it imported then makes all its results, whatever is committed meanwhile.
CODE = runtime.versions()


def origin(seed: int) -> dict[str, Any]:
    """Origin of a result: commit and versions when the program started, device, cores, seed, date.

    Starts jax's backend.
    """
    import jax

    return {
        "commit": CODE.get("git"),
        "versions": {name: version for name, version in CODE.items() if name != "git"},
        "device": runtime.device(),
        "platform": jax.default_backend(),
        "jax_devices": jax.local_device_count(),
        "cores": runtime.cores(),
        "seed": seed,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def commits(cases: Iterable[Mapping[str, Any]]) -> list[str]:
    """The commits that made some kept cases: {"origin": {"commit": ...}, ...} each."""
    return sorted({str(case["origin"]["commit"]) for case in cases})


def stem(name: str, quick: bool) -> str:
    """Name of a result; results of --quick have another name, so that they never replace others."""
    return f"{name}_quick" if quick else name


def publish(
    folder: Path, name: str, quick: bool, seed: int, result: Mapping[str, Any], line: Mapping[str, Any] | None = None
) -> None:
    """Write FOLDER/NAME.json, beginning with its origin, and print one last line of JSON.

    line: the printed content; by default all of the file.  Starts jax's backend, as `origin` does.
    """
    whole = {**origin(seed), **result}
    write_json(folder / f"{stem(name, quick)}.json", whole, indent=2)
    print(json.dumps(whole if line is None else line))


def empty_cache(folder: str) -> dict[str, str]:
    """Environment variables for a separate process with an empty compilation cache.

    The log level that an imported jax sets is removed: with it, XLA prints more than in a fresh terminal.
    """
    given = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    path = os.pathsep.join(filter(None, (str(ROOT), given.get("PYTHONPATH"))))
    return {**given, runtime.CACHE_VARIABLE: f"{folder}/cache", "PYTHONPATH": path}


def interleave(
    runs: Mapping[str, Callable[[], Any]],
    repeats: int,
    done: Callable[[], Any] = lambda: None,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[dict[str, float], dict[str, float]]:
    """Time several things in turn, so that a machine that slows down slows all of them.

    Every run is called once to warm up and then `repeats` times: a b c, a b c, ...  Each must only
    return when its work is done.  done: called after every single call, for a progress bar.
    Returns (s of the first call, median s of the later ones), each by name.
    Raises ValueError for repeats < 1.
    """
    if repeats < 1:
        raise ValueError(f"repeats: expected at least 1 timed call, got {repeats}")
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            start = clock()
            run()
            seconds[name].append(clock() - start)
            done()
    first = {name: taken[0] for name, taken in seconds.items()}
    return first, {name: statistics.median(taken[1:]) for name, taken in seconds.items()}


def peak_memory_gib() -> float:
    """Most memory that this process held at once, GiB: on the accelerator where jax uses one, else resident.

    From /proc where there is one: getrusage's figure is handed down from the process that started
    this one.
    """
    import jax

    if jax.default_backend() != "cpu":
        stats = [device.memory_stats() or {} for device in jax.local_devices()]
        return sum(s.get("peak_bytes_in_use", 0) for s in stats) / 2**30
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(x for x in status.read_text().splitlines() if x.startswith("VmHWM:"))
        return int(line.split()[1]) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def in_process(
    script: str | Path, arguments: Sequence[str], timeout: float, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Run a benchmark script in a process of its own and return the JSON object on its last line.

    timeout: s.  environment: replaces this process's own.
    A failure is a result too: {"error": ...} states that the process took too long, or its error.
    """
    command = [sys.executable, str(script), *arguments]
    where = dict(os.environ if environment is None else environment)
    where["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), where.get("PYTHONPATH")]))
    try:
        run = subprocess.run(command, env=where, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return {"error": f"not done after {timeout:g} s"}
    if run.returncode != 0:
        lines = run.stderr.strip().splitlines() or ["no message"]
        return {"error": f"exit status {run.returncode}: {lines[-1]}"}
    return json.loads(run.stdout.splitlines()[-1])
