"""The search as the paper runs it: torques before and after, three parameters and the cost over the generations.

    python experiments/search_figure.py [--quick] [--out DIR]

Table I's distribution, 30 samples, the five best, linear coordinates, 100 generations on demonstration A of the door
without a spring.  It is the program's `identify --preset paper`, which continues a stopped run (docs/paper.md lists
differences from the paper).  Writes search_torques, search_parameters and search_cost (.png and .pdf) and
search_figure.json into DIR, the run into DIR/search_run.  The lines of the truth are the paper's fitted means;
search_figure.json also holds its deviations.
A fit of a minute or more on two cores (6.4 minutes at f42592d). Without --out it replaces the committed figures.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import msgspec  # noqa: E402
import tyro  # noqa: E402
from table1 import PAPER  # noqa: E402

from benchmarks.common import stem  # noqa: E402
from droid_jax.commands.identify import Identify, run  # noqa: E402
from droid_jax.report import identify_figures, torque_figures  # noqa: E402
from droid_jax.report.identify_folder import Run, read_run  # noqa: E402
from droid_jax.report.style import save  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402

SHOWN = ("hinge_damping", "hinge_frictionloss", "knob_mass")


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Three generations: shows that it runs."""
    out: Path = ROOT / "experiments" / "results"
    """Folder for the figures."""


def figures(found: Run) -> dict[str, Any]:
    """The paper's three panels, a figure each."""
    trace = next(iter(found.traces.values()))
    return {
        "search_torques": torque_figures.torque_traces(trace, trace["phases"]),
        "search_parameters": identify_figures.parameter_history(found.history, found.fit.parameters, SHOWN),
        "search_cost": identify_figures.cost_history(found.history, found.fit.cost),
    }


def made_by(found: Run) -> dict[str, Any]:
    """Origin of the run, as `origin` states it; a figure that is drawn again keeps the origin of its run."""
    config = found.config
    versions = {name: version for name, version in config.versions.items() if name != "git"}
    of = {"commit": config.versions.get("git"), "versions": versions, "device": config.device, "seed": config.seed}
    return {**of, "date": config.started}


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    folder = arguments.out / stem("search_run", arguments.quick)
    run(Identify(preset="paper", springs=0, generations=3 if arguments.quick else None, out=folder))
    found = read_run(folder)
    for name, figure in figures(found).items():
        save(figure, arguments.out, stem(name, arguments.quick))
    shown = {
        p.name: {k: getattr(p, k) for k in ("truth", "initial_mean", "mean", "std")}
        | {"paper": PAPER[p.name][1]}  # mean and deviation, of the door without a spring
        for p in found.fit.of_interest
    }
    result = {
        "cost": msgspec.structs.asdict(found.fit.cost),
        "gap": {
            n: {k: getattr(g, k) for k in ("before", "after", "noise_floor", "closed")}
            for n, g in found.fit.heldout_distances.items()
        },
        "generations": found.fit.generations,
        "seconds": found.fit.seconds,
        "parameters": shown,
    }
    write_json(arguments.out / f"{stem('search_figure', arguments.quick)}.json", {**made_by(found), **result}, indent=2)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
