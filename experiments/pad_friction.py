"""Do the policies of Table II need their grip?  Each is tried on the stand-in robot with pads that hold less and less.

    python experiments/pad_friction.py [--quick] [--out DIR] [--setting paper] [--frictions 0.05 0.02 0.005]

Two fingers of about 36 N pull with 72 N times the pads' friction at a lever of 0.3 m: 1.1 N m at 0.05, 0.4 at 0.02 and
0.1 at 0.005.  A policy that still opens a door which takes more than that does so by a hook or a push, and its grip is
for show.  Writes DIR/pad_friction_SETTING.json: success of every policy that has been made, by friction, beside its success
with the robot's own pads, which is Table II's.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402

from benchmarks.common import origin, stem  # noqa: E402
from droid_jax.model.door_scene import door_scene  # noqa: E402
from droid_jax.policy.control import load  # noqa: E402
from droid_jax.policy.door_env import DoorEnv  # noqa: E402
from droid_jax.policy.task import Task  # noqa: E402
from droid_jax.policy.transfer import StandIn, TransferConfig, stand_in, transfer  # noqa: E402
from droid_jax.report.files import POLICY  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.policies.cases import QUICK_STEPS, RESULTS, TIMESTEP  # noqa: E402
from experiments.policies.robots import pads_of, truth_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting  # noqa: E402
from experiments.policies.table import METHODS  # noqa: E402


@dataclass(frozen=True)
class Arguments:
    """Options of the experiment."""

    setting: str = "paper"
    """Of Table II."""
    frictions: tuple[float, ...] = (0.05, 0.02, 0.005)
    """Sliding frictions of both pads."""
    trials: int = 20
    """Trials of each policy at each friction."""
    policies: Path = RESULTS
    """Where table2.py has left its policies."""
    quick: bool = False
    """One policy of each method, one short trial: shows that it runs."""
    out: Path = RESULTS
    """Folder of the result."""


def robots(setting: Setting, arguments: Arguments) -> dict[float, StandIn]:
    """The setting's robot with each friction; it hears the same noise with each, and with its own pads."""
    task = Task(**{**setting.task, **({"steps": QUICK_STEPS} if arguments.quick else {})})
    start = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), task).start
    config = TransferConfig(trials=1 if arguments.quick else arguments.trials, seed=setting.robot)
    scene, truth = door_scene(limits=True), truth_of(setting)
    return {mu: stand_in(scene, start, {**truth, **pads_of(mu)}, (), task, config) for mu in arguments.frictions}


def made(arguments: Arguments) -> list[dict[str, Any]]:
    """The cases of Table II that are there, method by method."""
    folder = arguments.policies / "table2_cases" / arguments.setting
    found = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    if not found:
        raise SystemExit(f"error: no policies in {folder}; run experiments/table2.py first")
    by_method = sorted(found, key=lambda case: (METHODS.index(case["method"]), case["seed"]))
    first = {case["method"]: case for case in reversed(by_method)}
    return list(first.values()) if arguments.quick else by_method


def rows(arguments: Arguments) -> Iterator[Mapping[str, Any]]:
    """Success, share of actions with the grip on and largest angle of each policy, by friction."""
    by_friction = robots(SETTINGS[arguments.setting], arguments)
    for case in track(made(arguments), "policies", console=Console(stderr=True)):
        policy = load(arguments.policies / "trained_cases" / case["trained"] / POLICY)
        tried = {mu: transfer(policy, robot) for mu, robot in by_friction.items()}
        yield {
            "method": case["method"],
            "seed": case["seed"],
            "trained": case["trained"],
            "own_pads": case["stand_in"]["success_rate"],
            "success_rate": {f"{mu:g}": trials.rate for mu, trials in tried.items()},
            "grip": {f"{mu:g}": float(trials.grip.mean()) for mu, trials in tried.items()},
            "angle_deg": {f"{mu:g}": trials.to_json()["angle_deg"]["mean"] for mu, trials in tried.items()},
        }


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    if arguments.setting not in SETTINGS:
        raise SystemExit(f"error: unknown setting {arguments.setting!r}; valid: {', '.join(SETTINGS)}")
    found = list(rows(arguments))
    most = {f"{mu:g}": max(row["success_rate"][f"{mu:g}"] for row in found) for mu in arguments.frictions}
    summary = {"setting": arguments.setting, "policies": len(found), "most_successful": most}
    path = arguments.out / f"{stem('pad_friction', arguments.quick)}_{arguments.setting}.json"
    write_json(path, {**summary, "trials": 1 if arguments.quick else arguments.trials, "rows": found, **code})
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
