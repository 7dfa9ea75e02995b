"""Table II of the paper: three ways to choose the doors that a policy is trained on, judged on a robot it never saw.

    python experiments/table2.py [--quick] [--out DIR] [--settings paper] [--seeds 5] [--trials 100]

For each setting: the stand-in robot is recorded and fitted once; then policies are trained on draws of the prior, on
the fitted mean alone and on draws of the fitted Gaussian, alike in everything else, and tried in simulation and on the
stand-in robot.  Every policy is one JSON file under DIR/table2_cases and is not trained again: the experiment can be
stopped and goes on where it was.  DIR/table2.json sums up all that are there, with intervals by bootstrap over
policies; table2.md is laid out as in the paper, table2.png is its histogram.
docs/paper.md says what was fixed before the runs.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
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
from droid_jax.commands.train import randomise  # noqa: E402
from droid_jax.identify.gaussian import prior  # noqa: E402
from droid_jax.model.door import door_space  # noqa: E402
from droid_jax.model.door_scene import door_scene  # noqa: E402
from droid_jax.policy.door_env import DoorEnv  # noqa: E402
from droid_jax.policy.randomise import Randomise  # noqa: E402
from droid_jax.policy.task import Task  # noqa: E402
from droid_jax.policy.transfer import TransferConfig, stand_in  # noqa: E402
from droid_jax.report.export import png_bytes  # noqa: E402
from droid_jax.storage import write_bytes, write_json, write_text  # noqa: E402
from experiments.policies.cases import TIMESTEP, Budget, Case, Options, found_of, run_all, tried  # noqa: E402
from experiments.policies.figure import as_text, histograms  # noqa: E402
from experiments.policies.robots import GAUSSIAN, fitted, truth_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting  # noqa: E402
from experiments.policies.table import METHODS, summed_up  # noqa: E402

Method = Literal["prior", "mean", "fitted"]


@dataclass(frozen=True)
class Arguments(Options):
    """Options of the experiment."""

    settings: tuple[str, ...] = tuple(SETTINGS)
    """Which doors."""
    methods: tuple[Method, ...] = METHODS
    """Which methods."""


def doors(method: Method, setting: Setting, folder: Path, quick: bool, env: DoorEnv) -> Randomise:
    """What a method trains on: the one thing in which methods differ."""
    gaussian = prior(door_space(env.scene)) if method == "prior" else fitted(setting, folder, quick)
    return randomise(method, env.scene, gaussian)


def case(method: Method, seed: int, setting: Setting, folder: Path, budget: Budget) -> dict[str, Any]:
    """One policy of one method."""
    env = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), budget.task(Task(**setting.task)))
    config = TransferConfig(trials=budget.trials, seed=setting.robot)
    robot = stand_in(door_scene(limits=True), env.start, truth_of(setting), (), env.task, config)
    drawn = doors(method, setting, folder, budget.quick, env)
    doors_of = repr((setting, (folder / GAUSSIAN).read_text() if method != "prior" else "prior"))
    return tried(folder / f"{method}_{seed}", env, drawn, robot, seed, budget, doors_of)


def planned_case(method: Method, seed: int, setting: Setting, arguments: Arguments) -> Case:
    """A policy of a method in a setting, and what its file must say."""
    folder, budget = arguments.cases("table2") / setting.name, arguments.budget
    of = {"setting": asdict(setting), "method": method, "seed": seed, "budget": budget.to_json()}
    make = functools.partial(case, method, seed, setting, folder, budget)
    return Case(folder / f"{method}_{seed}.json", make, of)


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    unknown = [name for name in arguments.settings if name not in SETTINGS]
    if unknown:
        raise SystemExit(f"error: unknown setting {unknown[0]!r}; valid: {', '.join(SETTINGS)}")
    settings = list(SETTINGS)[:1] if arguments.quick else list(SETTINGS)
    asked = {(s, m) for s in arguments.settings for m in arguments.methods}
    planned = [
        planned_case(method, seed, SETTINGS[name], arguments)
        for name, seed, method in itertools.product(settings, arguments.policies, METHODS)
    ]
    now = [c for c in planned if (c.of["setting"]["name"], c.of["method"]) in asked]
    run_all(now, arguments.at_most)
    found = found_of(planned)
    summary = summed_up(found, settings)
    write_json(arguments.summary("table2"), {**summary, **origin(0)})
    write_text(arguments.summary("table2", ".md"), as_text(summary))
    write_bytes(arguments.summary("table2", ".png"), png_bytes(histograms(found, settings)))
    print(json.dumps(summary["line"]))


if __name__ == "__main__":
    main()
