"""Four knob places, one fit: section IV-E of the paper.

    python experiments/knob_locations.py [--quick] [--out DIR] [--seeds 5] [--trials 100]

The door is demonstrated and fitted with the knob in its first place.  For each of the four places, 5 cm apart along the
lever, policies are trained on doors drawn from that Gaussian and tried on the synthetic robot with the knob there.
Every policy is one JSON file under DIR/knob_cases and is not trained again; the fit, and the policies of the first
place, are those of table2.py's setting "paper".  DIR/knob_locations.json summarises them; knob_locations.md is the
table, knob_locations.png and .pdf are histograms of the angles.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

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
from droid_jax.door.scene import LEVERS, door_scene  # noqa: E402
from droid_jax.door.task import Task  # noqa: E402
from droid_jax.storage import write_json, write_text  # noqa: E402
from droid_jax.synthetic.policy_trials import TransferConfig, synthetic_robot  # noqa: E402
from experiments.policies.cases import TIMESTEP, Case, Options, finish, found_of, made_by, run_all, tried  # noqa: E402
from experiments.policies.figure import knob_histograms, knobs_as_text  # noqa: E402
from experiments.policies.robots import fitted, truth_of  # noqa: E402
from experiments.policies.settings import Setting, setting_of  # noqa: E402
from experiments.policies.store import Doors  # noqa: E402
from experiments.policies.table import columns, line_of  # noqa: E402


@dataclass(frozen=True)
class Arguments(Options):
    """Options of the experiment."""

    knobs: tuple[int, ...] = (0, 1, 2, 3)
    """Places of the knob."""


def case(knob: int, seed: int, setting: Setting, arguments: Arguments, code: Mapping[str, Any]) -> dict[str, Any]:
    """One policy for one place of the knob."""
    budget = arguments.budget
    env = DoorEnv(door_scene(timestep=TIMESTEP, limits=True, knob=knob), budget.task(Task()))
    config = TransferConfig(trials=budget.trials, seed=setting.robot)
    robot = synthetic_robot(door_scene(limits=True, knob=knob), env.start, truth_of(setting), (), env.task, config)
    return tried(arguments, env, Doors(fitted(setting, arguments, code)), {"synthetic_robot": robot}, seed, code)


def planned_case(knob: int, seed: int, arguments: Arguments, code: Mapping[str, Any]) -> Case:
    """A policy of a place, and the content that its file must have."""
    folder, budget, setting = arguments.cases("knob"), arguments.budget, setting_of("paper", arguments.robot)
    of = {
        "knob": knob,
        "seed": seed,
        "setting": asdict(setting),
        "task": asdict(budget.task(Task())),
        "budget": budget.to_json(),
    }
    make = functools.partial(case, knob, seed, setting, arguments, code)
    return Case(folder / f"knob{knob}_{seed}.json", make, of, "fit")


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    knobs = arguments.knobs[-1:] if arguments.quick else arguments.knobs
    places = knobs if arguments.quick else range(len(LEVERS))
    planned = [
        planned_case(knob, seed, arguments, code) for seed, knob in itertools.product(arguments.policies, places)
    ]
    failed = run_all([c for c in planned if c.of["knob"] in knobs], arguments.at_most, code)
    found = found_of(planned)
    of = {f"{LEVERS[k]:.2f} m": [c for c in found if c["knob"] == k] for k in sorted({c["knob"] for c in found})}
    table = columns(of)
    summary = {"levers": table, **made_by(found), **code}
    write_json(arguments.summary("knob_locations"), summary)
    write_text(arguments.summary("knob_locations", ".md"), knobs_as_text(table))
    arguments.draw("knob_locations", knob_histograms(of))
    print(json.dumps(line_of(table)))
    finish(failed)


if __name__ == "__main__":
    main()
