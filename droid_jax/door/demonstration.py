"""Demonstrations of opening the door: inverse kinematics along the knob's circle, smooth timing.

They stand for the human's kinaesthetic demonstration of the paper (section III-A): a command
q_d [T, 9] that the robot can repeat.  A and B open the door with two different arm poses, as in
the paper's section IV-C; C opens in two speeds, holds, and closes.  The shipped recordings in
`mjcf/demonstrations/` were made by `python -m droid_jax.door.demonstration`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from droid_jax.door.scene import ARM, FINGERS, door_scene, mjcf_dir
from droid_jax.model.scene import Scene
from droid_jax.recordings.checks import validate
from droid_jax.recordings.recording import (
    Channel,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
    TorqueSide,
)
from droid_jax.simulate.hand_path import minimum_jerk, solve_pose

OPEN, CLOSED = 0.04, 0.0  # m, finger command
RATE = 500.0  # Hz, command clock


@dataclass(frozen=True)
class Segment:
    """One stretch of a demonstration: the door's angle [rad] and the finger command [m] at its end."""

    phase: str
    seconds: float
    angle: float
    finger: float


@dataclass(frozen=True)
class Plan:
    """A demonstration in words: arm pose at the closed door, hand roll, and segments."""

    name: str
    pose: tuple[float, ...]
    roll: int  # +1 or -1: which side of the hand is up
    segments: tuple[Segment, ...]


def _opening(angle: float) -> tuple[Segment, ...]:
    return (
        Segment("approach", 1.6, 0.0, OPEN),
        Segment("grasp", 0.8, 0.0, CLOSED),
        Segment("opening", 4.8, angle, CLOSED),
        Segment("hold", 0.5, angle, CLOSED),
    )


POSE_A = (0.70, -0.47, -0.67, -2.01, -2.35, 3.02, -0.29)
POSE_B = (1.39, -1.06, -0.96, -2.17, -2.19, 2.49, 2.12)
_DEG = np.pi / 180

PLANS = {
    "A": Plan("A", POSE_A, -1, _opening(50 * _DEG)),
    "B": Plan("B", POSE_B, 1, _opening(50 * _DEG)),
    "C": Plan(
        "C",
        POSE_A,
        -1,
        (
            Segment("approach", 1.2, 0.0, OPEN),
            Segment("grasp", 0.8, 0.0, CLOSED),
            Segment("opening", 2.4, 15 * _DEG, CLOSED),
            Segment("opening", 3.6, 50 * _DEG, CLOSED),
            Segment("hold", 0.4, 50 * _DEG, CLOSED),
            Segment("closing", 3.2, 15 * _DEG, CLOSED),
            Segment("closing", 1.6, 6 * _DEG, CLOSED),
            Segment("rest", 0.4, 6 * _DEG, CLOSED),
        ),
    ),
}
# Table I's servo damping (100 N m s/rad, and 12 N m at joint 5) allows 0.12 rad/s there: the same
# opening as A, slower and to 30 degrees.
PAPER_PLANS = {
    "A": Plan(
        "A",
        POSE_A,
        -1,
        (
            Segment("approach", 4.0, 0.0, OPEN),
            Segment("grasp", 0.8, 0.0, CLOSED),
            Segment("opening", 14.0, 30 * _DEG, CLOSED),
            Segment("hold", 0.5, 30 * _DEG, CLOSED),
        ),
    )
}
START_STANDOFF = 0.08  # m, hand in front of the knob at the beginning


def grasp_pose(scene: Scene, angle: float, standoff: float, roll: int) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] m and rotation [3,3] of the pinch point that holds the knob with the door at `angle`.

    The hand looks along the door's inward normal; its fingers close horizontally.
    """
    data = mujoco.MjData(scene.model)
    data.qpos[scene.qpos(str(scene.object_joint))] = angle
    mujoco.mj_kinematics(scene.model, data)
    knob = data.site("knob")
    forward = knob.xmat.reshape(3, 3)[:, 0]
    up = np.array([0.0, 0.0, float(roll)])
    return knob.xpos - standoff * forward, np.stack([up, np.cross(forward, up), forward], axis=1)


def joint_path(scene: Scene, plan: Plan, angles: np.ndarray, standoffs: np.ndarray) -> np.ndarray:
    """[T, 7] joint positions that hold the knob at each door angle and stand-off (smallest motion)."""
    q = solve_pose(scene, np.array(plan.pose), *grasp_pose(scene, 0.0, 0.0, plan.roll))
    for standoff in np.linspace(0.0, standoffs[0], 20):
        q = solve_pose(scene, q, *grasp_pose(scene, angles[0], standoff, plan.roll))
    path = np.empty((len(angles), 7))
    for i, (angle, standoff) in enumerate(zip(angles, standoffs, strict=True)):
        path[i] = q = solve_pose(scene, q, *grasp_pose(scene, angle, standoff, plan.roll))
    return path


def demonstrate(scene: Scene, plan: Plan) -> Recording:
    """The command of a plan as a recording: clock, command [T, 9], phases, the servo gains in use.

    The command leads the path by damping / stiffness times the velocity, so that a servo without
    a velocity reference ends up on the path.  Raises ValueError where a joint comes within 0.05
    rad of its range or would need more than 90 % of its torque limit for its damping alone.
    """
    clock, angle, standoff, finger, phases = _timing(plan)
    path = joint_path(scene, plan, angle, standoff)
    velocity = np.gradient(path, clock, axis=0)
    stiffness = scene.model.actuator_gainprm[:, 0].copy()
    damping = scene.model.dof_damping[[scene.dof(j) for j in scene.command_names]].copy()
    _check_path(scene, plan, path, velocity, damping)
    command = np.concatenate([path + damping[:7] / stiffness[:7] * velocity, finger[:, None], finger[:, None]], axis=1)
    columns = [scene.command_names.index(j) for j in (*ARM, *FINGERS)]
    position = Channel("position", "rad", ARM, clock, path[None], np.ones((1, *path.shape), bool))
    return validate(
        Recording(
            name=plan.name,
            time=clock,
            command=command,
            command_names=(*ARM, *FINGERS),
            channels={"position": position},
            torque=TorqueConvention(TorqueSide.MOTOR, gravity=False),
            qpos0={**dict(zip(ARM, path[0].tolist(), strict=True)), **dict.fromkeys(FINGERS, OPEN)},
            gains=ServoGains(stiffness[columns], damping[columns]),
            phases=phases,
            meta={"source": "inverse kinematics and minimum-jerk timing"},
        )
    )


def _timing(plan: Plan) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[Phase, ...]]:
    """Clock [T] and, on it, door angle, stand-off, finger command; phases of the same name that touch merge.

    The hand reaches the knob in the first segment and stays there.
    """
    ends = np.cumsum([s.seconds for s in plan.segments])
    clock = np.arange(round(ends[-1] * RATE) + 1) / RATE
    standoff = START_STANDOFF - START_STANDOFF * minimum_jerk(clock / plan.segments[0].seconds)
    now = Segment("start", 0.0, 0.0, OPEN)
    tracks = {k: np.full(len(clock), getattr(now, k), dtype=float) for k in ("angle", "finger")}
    phases: list[Phase] = []
    for segment, end in zip(plan.segments, ends, strict=True):
        begin = end - segment.seconds
        shape = minimum_jerk((clock - begin) / segment.seconds)
        for key, track in tracks.items():
            track += shape * (getattr(segment, key) - getattr(now, key))
        if phases and phases[-1].name == segment.phase:
            phases[-1] = Phase(segment.phase, phases[-1].start, float(end))
        else:
            phases.append(Phase(segment.phase, float(begin), float(end)))
        now = segment
    return clock, tracks["angle"], standoff, tracks["finger"], tuple(phases)


def _check_path(scene: Scene, plan: Plan, path: np.ndarray, velocity: np.ndarray, damping: np.ndarray) -> None:
    ids = [scene.id("joint", j) for j in scene.joints]
    low, high = scene.model.jnt_range[ids].T
    limit = scene.model.jnt_actfrcrange[ids, 1]
    for k, joint in enumerate(scene.joints):
        margin = min(np.min(path[:, k] - low[k]), np.min(high[k] - path[:, k]))
        need = np.max(np.abs(velocity[:, k])) * damping[k] / limit[k]
        if margin < 0.05:
            raise ValueError(f"demonstration {plan.name}: {joint} comes within {margin:.3f} rad of its range")
        if need > 0.9:
            raise ValueError(f"demonstration {plan.name}: {joint} needs {need:.0%} of its torque limit for its damping")


def demonstration_path(name: str, gains: str = "impedance") -> Path:
    """File of a shipped demonstration; an unknown one raises and lists what there is."""
    folder = mjcf_dir() / "demonstrations"
    path = folder / f"{name}_{gains}_knob0.npz"
    if not path.is_file():
        there = ", ".join(sorted(p.stem for p in folder.glob("*.npz"))) or "none"
        raise ValueError(f"no demonstration {name!r} for {gains!r} gains; shipped: {there}")
    return path


def write_demonstrations() -> None:
    """Write the shipped demonstrations."""
    from droid_jax.recordings.formats import save_recording

    folder = mjcf_dir() / "demonstrations"
    folder.mkdir(exist_ok=True)
    for gains, plans in (("impedance", PLANS), ("paper", PAPER_PLANS)):
        scene = door_scene(gains=gains)
        for name, plan in plans.items():
            recording = demonstrate(scene, plan)
            save_recording(recording, folder / f"{name}_{gains}_knob0.npz")
            print(f"{name}, {gains} gains: {recording.time[-1]:.1f} s, {len(recording.time)} commands")


if __name__ == "__main__":
    write_demonstrations()
