"""Table II of the paper: three ways to choose the doors that a policy is trained on, judged on a robot it never saw.

    python experiments/table2.py [--quick] [--out DIR] [--settings paper] [--seeds 5] [--trials 100]

For each setting: the stand-in robot is recorded and fitted once; then policies are trained on draws of the prior, on
the fitted mean alone and on draws of the fitted Gaussian, alike in everything else, and tried in simulation and on the
stand-in robot.  Every policy is one JSON file under DIR/table2_cases and is not trained again: the experiment can be
stopped and goes on where it was.  DIR/table2.json sums up all that are there, with intervals by bootstrap over
policies; table2.md is laid out as in the paper, table2.png is its histogram.  Where hidden_effect_policy.json lies
beside them, it is the table's last part.  Pilots take another robot and other seeds (--robot 100 --first 100).
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

from benchmarks.common import commits, origin  # noqa: E402
from droid_jax.commands.train import randomise  # noqa: E402
from droid_jax.identify.gaussian import prior  # noqa: E402
from droid_jax.model.door import door_space  # noqa: E402
from droid_jax.model.door_scene import door_scene  # noqa: E402
from droid_jax.policy.door_env import DoorEnv  # noqa: E402
from droid_jax.policy.randomise import Randomise  # noqa: E402
from droid_jax.policy.task import Task  # noqa: E402
from droid_jax.report.export import png_bytes  # noqa: E402
from droid_jax.storage import write_bytes, write_json, write_text  # noqa: E402
from experiments.policies.cases import TIMESTEP, Budget, Case, Options, finish, found_of, run_all, tried  # noqa: E402
from experiments.policies.figure import as_text, histograms  # noqa: E402
from experiments.policies.robots import GAUSSIAN, fitted, robots_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting, setting_of  # noqa: E402
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
    drawn = doors(method, setting, folder, budget.quick, env)
    doors_of = repr((setting, (folder / GAUSSIAN).read_text() if method != "prior" else "prior"))
    robots = robots_of(setting, env, budget.trials)
    return tried(folder / f"{method}_{seed}", env, drawn, robots, seed, budget, doors_of)


def planned_case(method: Method, seed: int, name: str, arguments: Arguments) -> Case:
    """A policy of a method in a setting, and what its file must say."""
    setting, folder, budget = setting_of(name, arguments.robot), arguments.cases("table2") / name, arguments.budget
    task = asdict(budget.task(Task(**setting.task)))
    of = {"setting": asdict(setting), "task": task, "method": method, "seed": seed, "budget": budget.to_json()}
    make = functools.partial(case, method, seed, setting, folder, budget)
    return Case(folder / f"{method}_{seed}.json", make, of, f"{name}, {'prior' if method == 'prior' else 'fit'}")


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    unknown = [name for name in arguments.settings if name not in SETTINGS]
    if unknown:
        raise SystemExit(f"error: unknown setting {unknown[0]!r}; valid: {', '.join(SETTINGS)}")
    settings = list(arguments.settings[:1]) if arguments.quick else list(SETTINGS)
    asked = {(s, m) for s in arguments.settings for m in arguments.methods}
    planned = [
        planned_case(method, seed, name, arguments)
        for name, seed, method in itertools.product(settings, arguments.policies, METHODS)
    ]
    now = [c for c in planned if (c.of["setting"]["name"], c.of["method"]) in asked]
    failed = run_all(now, arguments.at_most, code)
    found = found_of(planned)
    summary, hidden = summed_up(found, settings), arguments.summary("hidden_effect_policy")
    if hidden.is_file():
        summary["hidden_effect"] = json.loads(hidden.read_text())
    write_json(arguments.summary("table2"), {**summary, "cases_from_commits": commits(found), **code})
    write_text(arguments.summary("table2", ".md"), as_text(summary))
    write_bytes(arguments.summary("table2", ".png"), png_bytes(histograms(found, settings)))
    print(json.dumps(summary["line"]))
    finish(failed)


if __name__ == "__main__":
    main()
