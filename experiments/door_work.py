"""What share of the arm's work goes into the door?  A small share is why Table II cannot distinguish its methods.

    python experiments/door_work.py [--quick] [--out DIR] [--policies DIR]

For the synthetic robot of each setting of Table II: the work of the arm's servos (actuator torque times joint motion,
summed over the joints) and the work done on the door.  In demonstrations A and C the door's work is what the hinge's
friction loss and damping dissipate over the whole motion.  In the first trials of every policy of Table II it is what
the pads do to the knob about the hinge until the door is open, its kinetic energy included.  Nothing is trained or
fitted.  Writes DIR/door_work.json: for every motion and policy door_j, servo_j and share.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import publish  # noqa: E402
from droid_jax.door.demonstration import demonstration_path  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.files import POLICY  # noqa: E402
from droid_jax.policy.control import load_policy  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.simulate.c_engine import simulate  # noqa: E402
from droid_jax.synthetic.policy_trials import watched  # noqa: E402
from droid_jax.synthetic.robot import SyntheticRobotConfig, set_up  # noqa: E402
from experiments.pad_friction import REPORTED, WATCHED, Opening, made, robots  # noqa: E402
from experiments.pad_friction import Arguments as PadArguments  # noqa: E402
from experiments.policies.cases import RESULTS  # noqa: E402
from experiments.policies.robots import truth_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting  # noqa: E402


@dataclass(frozen=True)
class Arguments:
    """Options of the experiment."""

    policies: Path = REPORTED
    """Folder of the policies of table2.py; default: the reported ones in benchmarks/results/archive."""
    quick: bool = False
    """One setting, one motion, one short trial of one policy of each method: shows that it runs."""
    out: Path = RESULTS
    """Folder of the result."""


def of_demonstration(setting: Setting, name: str) -> dict[str, float]:
    """Work [J] on the door and of the servos over one repeat of a demonstration, without sensor noise."""
    truth, config = truth_of(setting), SyntheticRobotConfig(repeats=1)
    robot = set_up(
        door_scene(), load_recording(demonstration_path(name)), truth, seed=100 * setting.robot, config=config
    )
    trace = simulate(robot.scene, robot.models, robot.qpos0, robot.control[None])
    angle = np.asarray(trace.object_angle, float).reshape(-1)
    servo = float(np.sum(np.asarray(trace.torque, float) * np.asarray(trace.velocity, float)) * config.timestep)
    speed = np.gradient(angle, config.timestep)
    friction = truth["hinge_frictionloss"] * float(np.abs(np.diff(angle)).sum())
    damping = truth["hinge_damping"] * float(np.sum(speed**2)) * config.timestep
    return _share(friction + damping, servo)


def of_policies(setting: Setting, arguments: Arguments) -> Iterator[tuple[str, dict[str, float]]]:
    """Each policy of Table II: mean J of door and servos over those of its first trials that opened the door."""
    options = PadArguments(setting=setting.name, frictions=(), policies=arguments.policies, quick=arguments.quick)
    robot = robots(setting, options)["own"]
    for case in made(options):
        policy = load_policy(arguments.policies / "trained_cases" / case["trained"] / POLICY)
        each = [Opening(robot) for _ in range(1 if arguments.quick else WATCHED)]
        for number, opening in enumerate(each):
            watched(policy, robot, number, opening)
        done = [o for o in each if o.opened]
        if done:
            found = _share(*(float(np.mean(j)) for j in ([o.work.sum() for o in done], [o.servo for o in done])))
            print(f"{setting.name}, {case['method']} {case['seed']}: {found}", file=sys.stderr, flush=True)
            yield f"{case['method']} {case['seed']}", found


def _share(door: float, servo: float) -> dict[str, float]:
    return {"door_j": round(door, 4), "servo_j": round(servo, 3), "share": round(door / servo, 6)}


def span(found: dict[str, dict[str, float]]) -> list[float] | None:
    """Smallest and largest share; None where nothing opened the door."""
    shares = [one["share"] for one in found.values()]
    return [min(shares), max(shares)] if shares else None


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    result: dict[str, Any] = {}
    for setting in list(SETTINGS.values())[: 1 if arguments.quick else None]:
        motions = {name: of_demonstration(setting, name) for name in ("A" if arguments.quick else "AC")}
        policies = dict(of_policies(setting, arguments))
        result[setting.name] = {"demonstrations": motions, "policies": policies}
    line = {name: {kind: span(of) for kind, of in found.items()} for name, found in result.items()}
    publish(arguments.out, "door_work", arguments.quick, 0, {"shares": line, **result}, line)


if __name__ == "__main__":
    main()
