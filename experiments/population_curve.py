"""Large populations against the paper's 30 samples: held-out cost over wall time.

    python experiments/population_curve.py [--quick] [--out DIR] [--minutes 2] [--populations 30 512]

The one-spring door, demonstration A, with all parameters of Table I.  Every population searches for the same wall time,
from the same prior, with several seeds.  After the search, the cost of each generation's mean is computed on held-out
repeats.  Compilation is not included in the time.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from benchmarks.common import commits, origin, publish, stem  # noqa: E402
from benchmarks.sharing import kept  # noqa: E402
from droid_jax.cost.cost import Cost, make_cost  # noqa: E402
from droid_jax.door.demonstration import demonstration_path  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_space  # noqa: E402
from droid_jax.identify.holdout import split_repeats  # noqa: E402
from droid_jax.identify.search import CmaConfig, cma_search  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.storage import write_bytes  # noqa: E402
from droid_jax.synthetic.robot import record, synthetic_truth  # noqa: E402

COLOURS = ("#2b6cb0", "#c05621", "#2f855a", "#6b46c1")


@dataclass(frozen=True)
class Arguments:
    """Options of the comparison."""

    quick: bool = False
    """Three seconds a search, one seed, two populations: shows that it runs."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of population_curve.json and .png, and of the searches, which are not run again."""
    minutes: float = 2.0
    """Wall time of every search."""
    populations: tuple[int, ...] = (30, 128, 512)
    """Samples per generation."""
    seeds: int = 3
    """Searches of each population."""


def prepare() -> tuple[Cost, Cost]:
    """Cost of the fitted repeats, and of the held-out ones."""
    scene = door_scene(timestep=0.004)
    truth = synthetic_truth(scene, 1, 1)
    recording = record(scene, load_recording(demonstration_path("A")), truth, seed=100, name="A")
    fitted, held, _ = split_repeats(recording, 0.3)
    cost = make_cost(scene, door_space(scene), [fitted])
    return cost, cost.against([held])


def curve(cost: Cost, held: Cost, population: int, seconds: float, seed: int) -> dict[str, Any]:
    """One search: seconds at the end of each generation and the held-out cost of its mean, N m.

    A generation of another search runs first, so that compilation is not timed.
    """
    config = CmaConfig(
        population=population, parents=None, generations=100_000, tol_cost=0, tol_sigma=1e-5,
        max_seconds=seconds, seed=seed,
    )  # fmt: skip
    cma_search(cost, cost.space, replace(config, generations=1))
    found = cma_search(cost, cost.space, config)
    history = found.history
    rows = _rows(len(history.mean))
    return {
        "population": population,
        "seed": seed,
        "stop": found.stop,
        "generations": len(history.sigma),
        "evaluations": found.evaluations,
        "seconds": np.round(np.cumsum(history.seconds), 2).tolist(),
        "held_out": np.round(held(history.mean[rows]), 4).tolist(),
        "rows": rows.tolist(),
    }


def _rows(generations: int, most: int = 64) -> np.ndarray:
    """Generations whose held-out cost is computed: all, or about `most` of them."""
    return np.unique(np.linspace(0, generations - 1, min(generations, most)).astype(int))


def at(run: dict[str, Any], seconds: float) -> float | None:
    """Held-out cost of the latest generation finished by then; None before the first."""
    done = [c for row, c in zip(run["rows"], run["held_out"], strict=True) if run["seconds"][row] <= seconds]
    return done[-1] if done else None


def one_device(runs: Sequence[Mapping[str, Any]]) -> str:
    """The device on which all ran; ends the program where devices differ, since the figure compares wall times."""
    found = sorted({run["origin"]["device"] for run in runs})
    if len(found) > 1:
        raise SystemExit(f"error: searches of several devices: {'; '.join(found)}: choose another --out")
    return found[0]


def figure(runs: list[dict[str, Any]]) -> Figure:
    """Held-out cost over wall time: one line per seed, one colour per population."""
    drawn = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = drawn.subplots()
    populations = sorted({r["population"] for r in runs})
    for run in runs:
        colour = COLOURS[populations.index(run["population"]) % len(COLOURS)]
        label = f"{run['population']} samples" if run["seed"] == 0 else None
        seconds = np.array(run["seconds"])[run["rows"]]
        axes.plot(seconds, run["held_out"], color=colour, linewidth=1.3, label=label)
    axes.set(xlabel="Wall time [s]", ylabel="Cost on held-out repeats [N m]", yscale="log")
    axes.legend(frameon=False)
    return drawn


def main() -> None:
    from droid_jax.report.style import png_bytes

    arguments = tyro.cli(Arguments, description=__doc__)
    seconds = 3.0 if arguments.quick else 60.0 * arguments.minutes
    populations = arguments.populations[:2] if arguments.quick else arguments.populations
    cost, held = prepare()
    for compiled in (cost, held):
        compiled(np.tile(cost.space.mean, (max(populations), 1)))
    folder = arguments.out / stem("population_curve_runs", arguments.quick)
    planned = {
        (seed, population): folder / f"{population}_samples_{seconds:g}_s_{seed}.json"
        for seed in range(1 if arguments.quick else arguments.seeds)
        for population in populations
    }
    there = [json.loads(path.read_text()) for path in planned.values() if path.is_file()]
    here = [{"origin": origin(0)}] if len(there) < len(planned) else []
    runs, searched_on = [], one_device([*there, *here])  # refused before a search is made
    for (seed, population), path in planned.items():
        runs.append(kept(path, lambda p=population, s=seed: {**curve(cost, held, p, seconds, s), "origin": origin(s)}))
        print(f"{population} samples, seed {seed}: held-out {runs[-1]['held_out'][-1]:.4f} N m", flush=True)
    shares = (0.25, 0.5, 1.0)
    table = {
        str(p): {f"{s * seconds:g} s": [at(r, s * seconds) for r in runs if r["population"] == p] for s in shares}
        for p in populations
    }
    summary = {"seconds": seconds, "searched_on": searched_on, "searches_from_commits": commits(runs)}
    summary |= {"held_out_by_population_and_time": table}
    write_bytes(arguments.out / f"{stem('population_curve', arguments.quick)}.png", png_bytes(figure(runs)))
    publish(arguments.out, "population_curve", arguments.quick, 0, {**summary, "runs": runs}, summary)


if __name__ == "__main__":
    main()
