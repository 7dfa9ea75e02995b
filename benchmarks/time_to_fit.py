"""Time of a fit on this machine with compilation: of the paper's size, and of the command's quick preset.

    python benchmarks/time_to_fit.py [--quick] [--out DIR]

Paper's size: 30 samples, 100 generations, one opening of 3,850 steps of 2 ms (demonstration A).  Quick
preset: `python -m droid_jax.run identify` in a process of its own.  Both start with an empty compilation cache.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import json  # noqa: E402

import tyro  # noqa: E402

from benchmarks.common import empty_cache, publish  # noqa: E402
from droid_jax.files import FIT  # noqa: E402

POPULATION, GENERATIONS, TIMESTEP = 30, 100, 0.002


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Three generations and not the command: shows that it runs."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of time_to_fit.json."""
    part: str = "all"
    """all; fit is used by the script itself, in a separate process."""


def fit(generations: int, most: float | None = None) -> dict[str, Any]:
    """The search alone: s of the whole, and of its first generation, which compiles.

    most: s after which no further generation begins.
    """
    import tuned  # noqa: F401  (before jax starts)

    from droid_jax.cost.cost import make_cost
    from droid_jax.door.demonstration import demonstration_path
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_space
    from droid_jax.identify.search import CmaConfig, cma_search
    from droid_jax.recordings.formats import load_recording
    from droid_jax.synthetic.robot import record, synthetic_truth

    scene = door_scene(timestep=TIMESTEP)
    recording = record(scene, load_recording(demonstration_path("A")), synthetic_truth(scene, 1, 1), seed=1, name="A")
    began = time.perf_counter()
    cost = make_cost(scene, door_space(scene), [recording])
    config = CmaConfig(
        population=POPULATION, parents=5, generations=generations, tol_cost=0, tol_sigma=0, max_seconds=most
    )
    found = cma_search(cost, cost.space, config)
    return {
        "seconds": time.perf_counter() - began,
        "first_generation_s": float(found.history.seconds[0]),
        "generations": len(found.history.seconds),
        "population": POPULATION,
        "steps": len(cost.drives[0].time),
        "cost_before": float(cost(cost.space.mean[None])[0]),
        "cost_after": found.best_cost,
    }


def identify_command() -> dict[str, Any]:
    """s of `python -m droid_jax.run identify`, from the command to the finished page."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        command = [sys.executable, "-m", "droid_jax.run", "identify", "--out", f"{folder}/run"]
        subprocess.run(command, check=True, cwd=ROOT, env=empty_cache(folder), stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - began
        stages = json.loads((Path(folder) / "run" / FIT).read_text())["seconds"]
    return {"seconds": seconds, "stages": stages}


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    if arguments.part == "fit":
        print(json.dumps(fit(3 if arguments.quick else GENERATIONS)))
        return
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--part", "fit", *(["--quick"] if arguments.quick else [])]
        done = subprocess.run(command, check=True, env=empty_cache(folder), stdout=subprocess.PIPE, text=True)
    result: dict[str, Any] = {"paper_size_fit": json.loads(done.stdout.splitlines()[-1])}
    if not arguments.quick:
        result["identify_quick"] = identify_command()
    import tuned  # noqa: F401  (before jax starts: the fits had all cores)

    publish(arguments.out, "time_to_fit", arguments.quick, 0, result, result)


if __name__ == "__main__":
    main()
