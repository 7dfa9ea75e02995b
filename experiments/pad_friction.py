"""Do the policies of Table II need their grip?  Each is tried with pads of less and less friction.

    python experiments/pad_friction.py [--quick] [--out DIR] [--setting paper] [--frictions 0.05 0.005]

The work that opens the door is measured at every step of the simulation: the torque about the hinge of the forces
between pads and knob, over the hinge's motion until the door is open.  Its four parts add up to the work of all
contacts:

- across: normal forces perpendicular to the knob's axis, which push the knob sideways;
- along: normal forces along that axis, on the knob's round ends;
- sliding: friction, the pull of a grip;
- torsional: the couple of friction about the normals, a twist.

Writes DIR/pad_friction_SETTING.json, for every trained policy and every kind of pads ("own": those of the setting, with
the trials of Table II; else by sliding friction).  It holds success_rate, largest_angle_deg, and grip_time_share, the
share of a trial's time with the grip on.  Of the first few trials it holds how many opened the door, and for each of
these work_j by part and grip_way_share, the share of the door's path with the grip on.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import copy  # noqa: E402
import json  # noqa: E402

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402

from benchmarks import archive  # noqa: E402
from benchmarks.common import origin, stem  # noqa: E402
from droid_jax.door.environment import DoorEnv  # noqa: E402
from droid_jax.door.hand import finger_forces_c, hand_of, looked  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.task import Task, gripped  # noqa: E402
from droid_jax.files import POLICY  # noqa: E402
from droid_jax.policy.control import Policy, load_policy  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from droid_jax.synthetic.policy_trials import PolicyRobot, TransferConfig, synthetic_robot, transfer, watched  # noqa: E402
from experiments.policies.cases import QUICK_STEPS, RESULTS, TIMESTEP, made_by  # noqa: E402
from experiments.policies.robots import pads_of, truth_of  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting  # noqa: E402
from experiments.policies.table import METHODS  # noqa: E402

REPORTED = ROOT / "runs" / "policies"  # where the archive of that name is unpacked
PARTS = ("across", "along", "sliding", "torsional")
WATCHED = 5  # trials of each policy with each kind of pads
NEEDED = 0.2  # a policy that succeeds more often without friction does not need its grip


@dataclass(frozen=True)
class Arguments:
    """Options of the experiment."""

    setting: str = "paper"
    """Setting of Table II."""
    frictions: tuple[float, ...] = (0.05, 0.005)
    """Sliding frictions of both pads."""
    trials: int = 20
    """Trials of each policy at each friction."""
    policies: Path = REPORTED
    """Folder of the policies of table2.py; default: the reported ones in benchmarks/results/archive."""
    quick: bool = False
    """One policy of each method, one short trial: shows that it runs."""
    out: Path = RESULTS
    """Folder of the result."""


def robots(setting: Setting, arguments: Arguments) -> dict[str, PolicyRobot]:
    """The setting's robot ("own") and the same robot with pads of each friction, all with the same noise."""
    task = Task(**{**setting.task, **({"steps": QUICK_STEPS} if arguments.quick else {})})
    start = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), task).start
    config = TransferConfig(trials=1 if arguments.quick else arguments.trials, seed=setting.robot)
    scene, truth = door_scene(limits=True), truth_of(setting)
    pads: dict[str, Mapping[str, float]] = {"own": {}, **{f"{mu:g}": pads_of(mu) for mu in arguments.frictions}}
    return {name: synthetic_robot(scene, start, {**truth, **of}, (), task, config) for name, of in pads.items()}


def hinge_torques(model: mujoco.MjModel, data: mujoco.MjData, knob: int, hinge: int) -> np.ndarray:
    """Torque about the hinge [4] N m of the pads' contact forces in MuJoCo's last step, by PARTS."""
    found, wrench, stem_axis = np.zeros(4), np.zeros(6), data.geom_xmat[knob].reshape(3, 3)[:, 2]
    for index, contact in enumerate(data.contact):
        if knob not in (contact.geom1, contact.geom2):
            continue
        mujoco.mj_contactForce(model, data, index, wrench)
        axes = contact.frame.reshape(3, 3) * (1.0 if contact.geom2 == knob else -1.0)
        normal, sliding, couple = wrench[0] * axes[0], wrench[1:3] @ axes[1:], wrench[3:] @ axes
        along = (normal @ stem_axis) * stem_axis
        turning = np.cross(data.xaxis[hinge], contact.pos - data.xanchor[hinge])  # m of the contact's path per rad
        found += [(normal - along) @ turning, along @ turning, sliding @ turning, couple @ data.xaxis[hinge]]
    return found


class Opening:
    """Watches a trial until the door is open, step by step on a copy that takes the same actions.

    opened: whether the door is open.
    way: rad that the door has moved since it was shut.
    held: rad of `way` with the grip on.
    work: [4] J by PARTS.
    servo: J of the arm's actuators in this time, summed over the joints.
    """

    def __init__(self, robot: PolicyRobot):
        self.robot, self.hand = robot, hand_of(robot.scene)
        self.knob, self.hinge = robot.scene.id("geom", "knob"), robot.scene.id("joint", str(robot.scene.object_joint))
        self.opened, self.way, self.held, self.work, self.servo = False, 0.0, 0.0, np.zeros(4), 0.0
        self.copy: mujoco.MjData | None = None

    def __call__(self, data: mujoco.MjData) -> None:
        """Called by `watched` before each action and at the end."""
        if self.copy is None:
            self.copy = copy.copy(data)
        elif not self.opened:
            self.copy.ctrl[:] = data.ctrl
            self._step(self.robot.scene.model, self.copy)
            if not self.opened and not np.array_equal(self.copy.qpos, data.qpos):
                raise RuntimeError(f"the copy has left the trial at {data.time:g} s")

    def _step(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Simulate one action; of the last one, only the part until the door is open."""
        task, before, scene = self.robot.task, self.way, self.robot.scene
        for _ in range(round(task.control / self.robot.config.timestep)):
            angle, arm = data.qpos[self.hand.hinge], data.qpos[scene.joint_qpos]
            mujoco.mj_step(model, data)
            moved = data.qpos[self.hand.hinge] - angle
            self.work += moved * hinge_torques(model, data, self.knob, self.hinge)
            self.servo += float(data.qfrc_actuator[scene.joint_dofs] @ (data.qpos[scene.joint_qpos] - arm))
            self.way = max(self.way, angle + moved)
            self.opened = angle + moved >= task.opened
            if self.opened:
                break
        mujoco.mj_kinematics(model, data)  # mj_step leaves places as they were before its last step
        forces = finger_forces_c(self.hand, model, data)
        seen = looked(self.hand, data, forces, np.zeros((2, 3)), task.control, np)
        self.held += (self.way - before) * bool(gripped(task, seen))


def openings(policy: Policy, robot: PolicyRobot, trials: int) -> dict[str, Any]:
    """Work that opens the door in a policy's first trials, by part."""
    each = [Opening(robot) for _ in range(trials)]
    for number, opening in enumerate(each):
        watched(policy, robot, number, opening)
    done = [opening for opening in each if opening.opened]
    joule = np.array([opening.work for opening in done]).reshape(-1, len(PARTS)).round(4)
    return {
        "opened": len(done),
        "grip_way_share": [round(opening.held / opening.way, 3) for opening in done],
        "work_j": {part: joule[:, k].tolist() for k, part in enumerate(PARTS)},
    }


def made(arguments: Arguments) -> list[dict[str, Any]]:
    """The existing cases of Table II, method by method.  Ends the program where they are of another robot."""
    folder = arguments.policies / "table2_cases" / arguments.setting
    if arguments.policies == REPORTED and not folder.is_dir():
        archive.unpack("policies", REPORTED)
    found = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    if not found:
        raise SystemExit(f"error: no policies in {folder}; run experiments/table2.py first")
    wanted = json.loads(json.dumps(asdict(SETTINGS[arguments.setting])))
    other = [f"{case['method']} {case['seed']}" for case in found if case["setting"] != wanted]
    if other:
        raise SystemExit(f"error: in {folder} are policies of another setting than {wanted}: {', '.join(other)}")
    by_method = sorted(found, key=lambda case: (METHODS.index(case["method"]), case["seed"]))
    first = {case["method"]: case for case in reversed(by_method)}
    return list(first.values()) if arguments.quick else by_method


def rows(cases: Sequence[dict[str, Any]], arguments: Arguments) -> Iterator[dict[str, Any]]:
    """Each policy, by pads."""
    by_pads, few = robots(SETTINGS[arguments.setting], arguments), 1 if arguments.quick else WATCHED
    for case in track(cases, "policies", console=Console(stderr=True)):
        policy = load_policy(arguments.policies / "trained_cases" / case["trained"] / POLICY)
        row = {"policy": f"{case['method']} {case['seed']}", "trained": case["trained"], "pads": {}}
        for name, robot in by_pads.items():
            tried = case["synthetic_robot"] if name == "own" else transfer(policy, robot).to_json()
            row["pads"][name] = {
                "success_rate": tried["success_rate"],
                "grip_time_share": tried["grip"]["mean"],
                "largest_angle_deg": tried["angle_deg"]["mean"],
                **openings(policy, robot, few),
            }
        yield row


def needless(tried: Mapping[str, Any]) -> bool:
    """Whether a policy succeeds with such pads without a grip; False where all its trials blew up."""
    return (tried["success_rate"] or 0.0) >= NEEDED


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    if arguments.setting not in SETTINGS:
        raise SystemExit(f"error: unknown setting {arguments.setting!r}; valid: {', '.join(SETTINGS)}")
    cases = made(arguments)
    found = list(rows(cases, arguments))
    by_friction = (f"{mu:g}" for mu in arguments.frictions)
    free = {mu: [row["policy"] for row in found if needless(row["pads"][mu])] for mu in by_friction}
    summary = {"setting": arguments.setting, "policies": len(found), "do_not_need_their_grip": free}
    counts = {"trials": 1 if arguments.quick else arguments.trials, "watched": 1 if arguments.quick else WATCHED}
    path = arguments.out / f"{stem('pad_friction', arguments.quick)}_{arguments.setting}.json"
    write_json(path, {**summary, **counts, "rows": found, **made_by(cases), **code})
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
