"""Table II of the paper: three ways to choose the doors that a policy is trained on, judged on a robot it never saw.

    python experiments/table2.py [--quick] [--out DIR] [--settings paper] [--seeds 5] [--trials 100]

For each setting: the stand-in robot is recorded and fitted once; then policies are trained on draws of the prior, on
the fitted mean alone and on draws of the fitted Gaussian, alike in everything else, and tried in simulation and on the
stand-in robot.  Every policy is one JSON file under DIR/table2_cases and is not trained again: the experiment can be
stopped and goes on where it was.  DIR/table2.json sums them up, with intervals by bootstrap over policies.
docs/paper.md says what was fixed before the runs.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
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
from droid_jax.identify.gaussian import prior  # noqa: E402
from droid_jax.model.door import door_space  # noqa: E402
from droid_jax.model.door_scene import door_scene  # noqa: E402
from droid_jax.policy.door_env import DoorEnv  # noqa: E402
from droid_jax.policy.randomise import Randomise, fixed, randomised  # noqa: E402
from droid_jax.policy.task import Task  # noqa: E402
from droid_jax.policy.transfer import TransferConfig, stand_in  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.policies.cases import TIMESTEP, Budget, Options, run_all, tried  # noqa: E402
from experiments.policies.robots import GAUSSIAN, fitted, truth_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting  # noqa: E402
from experiments.policies.table import summed_up  # noqa: E402

METHODS = ("prior", "mean", "fitted")
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
    scene = env.scene
    if method == "prior":
        return randomised(scene, prior(door_space(scene)))
    gaussian = fitted(setting, folder, quick)
    return fixed(scene, gaussian.space, gaussian.physical_mean) if method == "mean" else randomised(scene, gaussian)


def case(method: Method, seed: int, setting: Setting, folder: Path, budget: Budget) -> dict[str, Any]:
    """One policy of one method."""
    env = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), budget.task(Task(**setting.task)))
    config = TransferConfig(trials=budget.trials, seed=setting.robot)
    robot = stand_in(door_scene(limits=True), env.start, truth_of(setting), (), env.task, config)
    randomise = doors(method, setting, folder, budget.quick, env)
    doors_of = repr((setting, (folder / GAUSSIAN).read_text() if method != "prior" else "prior"))
    found = tried(folder / f"{method}_{seed}", env, randomise, robot, seed, budget, doors_of)
    return {"setting": setting.name, "method": method, **found}


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    unknown = [name for name in arguments.settings if name not in SETTINGS]
    if unknown:
        raise SystemExit(f"error: unknown setting {unknown[0]!r}; valid: {', '.join(SETTINGS)}")
    settings = {name: SETTINGS[name] for name in arguments.settings[: 1 if arguments.quick else None]}
    cases, budget = arguments.cases("table2"), arguments.budget
    planned = {
        cases / name / f"{method}_{seed}.json": functools.partial(case, method, seed, setting, cases / name, budget)
        for (name, setting), seed, method in itertools.product(settings.items(), arguments.policies, arguments.methods)
    }
    summary = summed_up(run_all(planned, budget, arguments.at_most), settings)
    write_json(arguments.summary("table2"), {**summary, **origin(0)})
    print(json.dumps(summary["line"]))


if __name__ == "__main__":
    main()
