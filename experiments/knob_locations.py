"""Four knob places, one fit: section IV-E of the paper.

    python experiments/knob_locations.py [--quick] [--out DIR] [--seeds 3] [--trials 100]

The door is demonstrated and fitted with the knob in its first place.  For each of the four places, 5 cm apart along the
lever, policies are trained on doors drawn from that one Gaussian and tried on the stand-in robot with the knob there.
Every policy is one JSON file under DIR/knob_cases and is not trained again.  DIR/knob_locations.json sums them up.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import functools  # noqa: E402
import itertools  # noqa: E402
import json  # noqa: E402

import tyro  # noqa: E402

from benchmarks.common import origin  # noqa: E402
from droid_jax.model.door_scene import LEVERS, door_scene  # noqa: E402
from droid_jax.policy.door_env import DoorEnv  # noqa: E402
from droid_jax.policy.randomise import randomised  # noqa: E402
from droid_jax.policy.task import Task  # noqa: E402
from droid_jax.policy.transfer import TransferConfig, stand_in  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.policies.cases import QUICK_STEPS, TIMESTEP, Budget, run_all, tried  # noqa: E402
from experiments.policies.robots import GAUSSIAN, fitted, truth_of  # noqa: E402
from experiments.policies.settings import SETTINGS  # noqa: E402
from experiments.policies.table import PLACES, column  # noqa: E402


@dataclass(frozen=True)
class Arguments:
    """Options of the experiment."""

    quick: bool = False
    """One small policy for the last knob: shows that it runs, says nothing about quality."""
    out: Path = ROOT / "experiments" / "results"
    """Folder of knob_locations.json and of the cases."""
    knobs: tuple[int, ...] = (0, 1, 2, 3)
    """Which places."""
    seeds: int = 3
    """Policies for each place."""
    first: int = 0
    """Seed of the first policy: pilots use others than the runs that are reported."""
    trials: int = 100
    """Trials of each policy on the stand-in robot, and episodes in simulation."""
    steps: int | None = None
    """Actions of each training; default: the preset's."""
    preset: Literal["quick", "paper", "gpu"] = "quick"
    """Of training."""
    at_most: int = 1_000_000
    """Stop after so many policies."""


def case(knob: int, seed: int, folder: Path, budget: Budget) -> dict[str, Any]:
    """One policy for one place of the knob."""
    setting = SETTINGS["paper"]
    scene, task = door_scene(timestep=TIMESTEP, limits=True, knob=knob), Task()
    env = DoorEnv(scene, replace(task, steps=QUICK_STEPS) if budget.quick else task)
    config = TransferConfig(trials=budget.trials, seed=setting.robot)
    robot = stand_in(door_scene(limits=True, knob=knob), env.start, truth_of(setting), (), env.task, config)
    randomise = randomised(scene, fitted(setting, folder, budget.quick))
    doors_of = repr((knob, (folder / GAUSSIAN).read_text()))
    return {"knob": knob, **tried(folder / f"knob{knob}_{seed}", env, randomise, robot, seed, budget, doors_of)}


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    cases = arguments.out / ("knob_cases_quick" if arguments.quick else "knob_cases")
    budget = Budget.of(arguments.preset, arguments.steps, arguments.trials, arguments.quick)
    if arguments.quick:
        arguments = replace(arguments, seeds=1, knobs=arguments.knobs[-1:])
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    planned = {
        cases / f"knob{knob}_{seed}.json": functools.partial(case, knob, seed, cases, budget)
        for seed, knob in itertools.product(seeds, arguments.knobs)
    }
    found = run_all(planned, budget, arguments.at_most)
    table = {}
    for knob in sorted({c["knob"] for c in found}):
        own = [c for c in found if c["knob"] == knob]
        table[f"{LEVERS[knob]:.2f} m"] = {place: column(own, place) for place in PLACES}
    line = {lever: {p: round(c[p]["success_rate"], 3) for p in PLACES} for lever, c in table.items()}
    name = "knob_locations_quick.json" if arguments.quick else "knob_locations.json"
    write_json(arguments.out / name, {"levers": table, **origin(0)})
    print(json.dumps(line))


if __name__ == "__main__":
    main()
