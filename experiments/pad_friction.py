"""Do the policies of Table II need their grip?  Each is tried on the stand-in robot with pads that hold less and less.

    python experiments/pad_friction.py [--quick] [--out DIR] [--setting paper] [--frictions 0.05 0.005]

Two fingers of about 36 N pull with 72 N times the pads' friction at a lever of 0.3 m: 1.1 N m at 0.05, 0.1 at 0.005.  A
policy that still opens a door which takes more than that hooks or pushes it.  Which of the two forces of the pads opens
the door with the robot's own pads, the pull of friction or the push across the pads, is measured as work.

Writes DIR/pad_friction_SETTING.json: success of every policy that has been made, by friction, beside its success with
the robot's own pads, which is Table II's; and the work in J until the door is open.
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

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402

from benchmarks.common import origin, stem  # noqa: E402
from droid_jax.model.door_scene import door_scene  # noqa: E402
from droid_jax.policy.control import Policy, load  # noqa: E402
from droid_jax.policy.door_env import DoorEnv  # noqa: E402
from droid_jax.policy.task import Task  # noqa: E402
from droid_jax.policy.transfer import StandIn, TransferConfig, stand_in, transfer, watched  # noqa: E402
from droid_jax.report.files import POLICY  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.policies.cases import QUICK_STEPS, RESULTS, TIMESTEP  # noqa: E402
from experiments.policies.robots import pads_of, truth_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting  # noqa: E402
from experiments.policies.table import METHODS  # noqa: E402

WATCHED = 5  # trials of each policy with the robot's own pads


@dataclass(frozen=True)
class Arguments:
    """Options of the experiment."""

    setting: str = "paper"
    """Of Table II."""
    frictions: tuple[float, ...] = (0.05, 0.005)
    """Sliding frictions of both pads."""
    trials: int = 20
    """Trials of each policy at each friction."""
    policies: Path = RESULTS
    """Where table2.py has left its policies."""
    quick: bool = False
    """One policy of each method, one short trial: shows that it runs."""
    out: Path = RESULTS
    """Folder of the result."""


def robots(setting: Setting, arguments: Arguments) -> tuple[StandIn, dict[float, StandIn]]:
    """The setting's robot, and the same with pads of each friction; it hears the same noise with all."""
    task = Task(**{**setting.task, **({"steps": QUICK_STEPS} if arguments.quick else {})})
    start = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), task).start
    config = TransferConfig(trials=1 if arguments.quick else arguments.trials, seed=setting.robot)
    scene, truth = door_scene(limits=True), truth_of(setting)

    def robot(pads: Mapping[str, float]) -> StandIn:
        return stand_in(scene, start, {**truth, **pads}, (), task, config)

    return robot({}), {mu: robot(pads_of(mu)) for mu in arguments.frictions}


def hinge_torques(model: mujoco.MjModel, data: mujoco.MjData, knob: int, hinge: int) -> np.ndarray:
    """[2] N m on the hinge, of what presses the knob: across its surfaces, and along them (friction)."""
    found, wrench = np.zeros(2), np.zeros(6)
    for index, contact in enumerate(data.contact):
        if knob not in (contact.geom1, contact.geom2):
            continue
        mujoco.mj_contactForce(model, data, index, wrench)
        axes = contact.frame.reshape(3, 3) * (1.0 if contact.geom2 == knob else -1.0)
        lever, axis = contact.pos - data.xanchor[hinge], data.xaxis[hinge]
        found += [np.cross(lever, wrench[part] @ axes[part]) @ axis for part in (slice(0, 1), slice(1, 3))]
    return found


def work(policy: Policy, robot: StandIn, number: int) -> np.ndarray:
    """[2] J that both forces of the pads do on the hinge in a trial, until the door is open."""
    model = robot.scene.model
    knob, hinge = robot.scene.id("geom", "knob"), robot.scene.id("joint", str(robot.scene.object_joint))
    seen: list[np.ndarray] = []

    def watch(data: mujoco.MjData) -> None:
        seen.append(np.append(hinge_torques(model, data, knob, hinge), data.qpos[model.jnt_qposadr[hinge]]))

    watched(policy, robot, number, watch)
    path = np.array(seen)
    opened = np.argmax(path[:, 2] > robot.task.opened) or len(path)
    return (path[1:opened, :2] * np.diff(path[:opened, 2:], axis=0)).sum(axis=0)


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
    """Success, share of actions with the grip on and largest angle of each policy, by friction; work of own pads."""
    own, by_friction = robots(SETTINGS[arguments.setting], arguments)
    for case in track(made(arguments), "policies", console=Console(stderr=True)):
        policy = load(arguments.policies / "trained_cases" / case["trained"] / POLICY)
        tried = {mu: transfer(policy, robot) for mu, robot in by_friction.items()}
        joule = np.array([work(policy, own, number) for number in range(1 if arguments.quick else WATCHED)])
        yield {
            "method": case["method"],
            "seed": case["seed"],
            "trained": case["trained"],
            "own_pads": case["stand_in"]["success_rate"],
            "work_j": {"across": joule[:, 0].round(4).tolist(), "friction": joule[:, 1].round(4).tolist()},
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
