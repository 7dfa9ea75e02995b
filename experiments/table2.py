"""Table II of the paper: three ways to choose the doors that a policy is trained on, tested on the synthetic robot.

    python experiments/table2.py [--quick] [--out DIR] [--settings paper] [--seeds 5] [--trials 100]

For each setting, the synthetic robot is recorded and fitted once.  Policies are then trained on draws of the prior, on
the fitted mean and on draws of the fitted Gaussian, with all else equal, and tried in simulation and on the synthetic
robot.  Every policy is one JSON file under DIR/table2_cases and is not trained again, nor is one that another
experiment has trained (DIR/trained_cases).  A stopped experiment can be continued, and several processes can share the
work.  DIR/table2.json summarises all existing policies, with intervals by bootstrap over policies.  table2.md is laid
out as in the paper; table2.png and table2.pdf are its histogram.  Where hidden_effect_policy.json exists in DIR, it is
the last part of the table.  Pilots use another robot and other seeds (--robot 100 --first 100).
docs/history/policy-experiments.md lists what was fixed before the runs.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
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
from droid_jax.door.environment import DoorEnv  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_nuisances, door_space  # noqa: E402
from droid_jax.door.task import Task  # noqa: E402
from droid_jax.identify.gaussian import prior  # noqa: E402
from droid_jax.storage import write_json, write_text  # noqa: E402
from experiments.policies.cases import TIMESTEP, Case, Options, finish, found_of, made_by, run_all, tried  # noqa: E402
from experiments.policies.figure import as_text, histograms  # noqa: E402
from experiments.policies.robots import fitted, robots_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting, setting_of  # noqa: E402
from experiments.policies.store import Doors  # noqa: E402
from experiments.policies.table import METHODS, summed_up  # noqa: E402

Method = Literal["prior", "mean", "fitted"]


@dataclass(frozen=True)
class Arguments(Options):
    """Options of the experiment."""

    settings: tuple[str, ...] = tuple(SETTINGS)
    """Settings of Table II."""
    methods: tuple[Method, ...] = METHODS
    """Methods to train."""


def case(method: Method, seed: int, setting: Setting, arguments: Options, code: Mapping[str, Any]) -> dict[str, Any]:
    """One policy of one method; methods differ only in the doors of the training."""
    budget = arguments.budget
    env = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), budget.task(Task(**setting.task)))
    space = door_space(env.scene) + door_nuisances(env.scene)  # those of the fit
    gaussian = prior(space) if method == "prior" else fitted(setting, arguments, code)
    return tried(arguments, env, Doors(gaussian, method), robots_of(setting, env, budget.trials), seed, code)


def planned_case(method: Method, seed: int, name: str, arguments: Arguments, code: Mapping[str, Any]) -> Case:
    """A policy of a method in a setting, and the content that its file must have."""
    setting, folder, budget = setting_of(name, arguments.robot), arguments.cases("table2") / name, arguments.budget
    task = asdict(budget.task(Task(**setting.task)))
    of = {"setting": asdict(setting), "task": task, "method": method, "seed": seed, "budget": budget.to_json()}
    make = functools.partial(case, method, seed, setting, arguments, code)
    return Case(folder / f"{method}_{seed}.json", make, of, f"{name}, {'prior' if method == 'prior' else 'fit'}")


def seeds(name: str, arguments: Options) -> range:
    """Of the policies of each method in a setting."""
    return range(
        arguments.first, arguments.first + len(arguments.policies) * (1 if arguments.quick else SETTINGS[name].times)
    )


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    unknown = [name for name in arguments.settings if name not in SETTINGS]
    if unknown:
        raise SystemExit(f"error: unknown setting {unknown[0]!r}; valid: {', '.join(SETTINGS)}")
    settings = list(arguments.settings[:1]) if arguments.quick else list(SETTINGS)
    asked = {(s, m) for s in arguments.settings for m in arguments.methods}
    planned = [
        planned_case(method, seed, name, arguments, code)
        for name in settings
        for seed, method in itertools.product(seeds(name, arguments), METHODS)
    ]
    now = [c for c in planned if (c.of["setting"]["name"], c.of["method"]) in asked]
    failed = run_all(now, arguments.at_most, code)
    found = found_of(planned)
    summary, hidden = summed_up(found, settings), arguments.summary("hidden_effect_policy")
    if hidden.is_file():
        summary["hidden_effect"] = json.loads(hidden.read_text())
    write_json(arguments.summary("table2"), {**summary, **made_by(found), **code})
    write_text(arguments.summary("table2", ".md"), as_text(summary))
    arguments.draw("table2", histograms(found, settings))
    print(json.dumps(summary["line"]))
    finish(failed)


if __name__ == "__main__":
    main()
