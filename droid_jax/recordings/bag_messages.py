"""Reads one ROS message of a state or a command: the names of joints, and their numbers by field.

Message types are recognised by their fields, so that their package and version do not matter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from droid_jax.errors import named

# channel -> field of sensor_msgs/JointState
FIELDS = {"torque": "effort", "position": "position", "velocity": "velocity"}
GAINS = ("kp", "kd")  # fields that only commands of unitree's motors have
STATES = (
    "JointState, JointTrajectoryControllerState, DynamicJointState, FrankaState, FrankaRobotState or unitree's LowState"
)
COMMANDS = (
    "JointState, JointTrajectory, JointTrajectoryPoint, Float64MultiArray, JointTrajectoryControllerState, "
    "DynamicJointState, FrankaState, FrankaRobotState or unitree's LowCmd"
)
# Field -> attribute of messages that hold one number per joint in its own attribute.
_FRANKA: dict[str, dict[str, str]] = {
    "state": {"position": "q", "velocity": "dq", "effort": "tau_J"},
    "command": {"position": "q_d", "velocity": "dq_d", "effort": "tau_J_d"},
}
_MOTOR: dict[str, dict[str, str]] = {
    "state": {"position": "q", "velocity": "dq", "effort": "tau_est"},
    "command": {"position": "q", "velocity": "dq", "effort": "tau", "kp": "kp", "kd": "kd"},
}


@dataclass(frozen=True)
class Wanted:
    """What is read from a topic.

    topic: name of the topic.
    joints: names of the joints, in the order wanted.
    needed: the field whose numbers must all be finite.
    role: whether state or command is read from messages that hold both.
    motors: positions of the joints, counted from 0, in messages without names that hold more numbers than joints.
    shared: whether state and command are read from the same topic.
    """

    topic: str
    joints: tuple[str, ...]
    needed: str
    role: Literal["state", "command"]
    motors: tuple[int, ...] | None = None
    shared: bool = False


Sample = tuple[int, tuple[str, ...], dict[str, np.ndarray]]  # offset in ns, joint names, field -> numbers


def samples(message: Any, wanted: Wanted, kind: str, where: str) -> list[Sample]:
    """The sample in one message, or the several samples of a trajectory.

    Args:
        message: as rosbags reads it.
        wanted: what is read from its topic.
        kind: type of the message.
        where: the message's place in the bag, for error messages.

    Raises:
        ValueError: messages of this type are not read, or the message has another number of joints.
    """
    if hasattr(message, "name") and hasattr(message, "position"):  # JointState
        if wanted.shared:
            raise ValueError(
                f"{where}: commands and joint states must come from two topics, not both from {wanted.topic!r}"
            )
        return [(0, tuple(message.name), _joint_state(message))]
    if hasattr(message, "measured_joint_state"):  # FrankaRobotState, of franka_ros2
        inner = message.measured_joint_state if wanted.role == "state" else message.desired_joint_state
        return [(0, tuple(inner.name), _joint_state(inner))]
    if hasattr(message, "joint_names") and hasattr(message, "interface_values"):  # DynamicJointState
        return [(0, tuple(message.joint_names), _interfaces(message))]
    if hasattr(message, "joint_names") and hasattr(message, "points") and wanted.role == "command":  # JointTrajectory
        names = tuple(message.joint_names)
        return [(in_nanoseconds(p.time_from_start), names, setpoints(p)) for p in message.points]
    if hasattr(message, "joint_names") and (point := _controller_point(message, wanted.role)) is not None:
        return [(0, tuple(message.joint_names), setpoints(point))]
    if hasattr(message, "tau_J") and hasattr(message, "q_d"):  # FrankaState, of franka_ros
        return _unnamed(_attributes(message, _FRANKA[wanted.role]), wanted, where)
    motors = getattr(message, "motor_state" if wanted.role == "state" else "motor_cmd", None)
    if motors is not None:  # LowState and LowCmd of unitree
        fields = _MOTOR[wanted.role]
        return _unnamed({f: np.array([getattr(m, a) for m in motors]) for f, a in fields.items()}, wanted, where)
    if wanted.role == "command" and hasattr(message, "positions"):  # JointTrajectoryPoint
        return _unnamed(setpoints(message), wanted, where)
    if wanted.role == "command" and hasattr(message, "data") and np.ndim(message.data) == 1:  # Float64MultiArray
        return _unnamed({"position": np.asarray(message.data, np.float64)}, wanted, where)
    expected = STATES if wanted.role == "state" else COMMANDS
    raise ValueError(f"{where}: cannot read {named([kind])} as a {wanted.role}; expected {expected}")


def in_nanoseconds(duration: Any) -> int:
    """Nanoseconds of a ROS time or duration."""
    return duration.sec * 10**9 + duration.nanosec


def setpoints(point: Any) -> dict[str, np.ndarray]:
    """Field -> numbers of a trajectory point: positions, and velocities and efforts where there are as many."""
    found = {"position": np.asarray(getattr(point, "positions", ()), dtype=np.float64)}
    for field, of_point in {"velocity": "velocities", "effort": "effort"}.items():
        numbers = np.asarray(getattr(point, of_point, ()), dtype=np.float64)
        if len(numbers) == len(found["position"]):
            found[field] = numbers
    return found


def _joint_state(message: Any) -> dict[str, np.ndarray]:
    return _attributes(message, {field: field for field in FIELDS.values()})


def _attributes(message: Any, of: Mapping[str, str]) -> dict[str, np.ndarray]:
    return {field: np.asarray(getattr(message, name), dtype=np.float64) for field, name in of.items()}


def _controller_point(message: Any, role: str) -> Any:
    """The trajectory point of a JointTrajectoryControllerState; older versions use other names for its fields."""
    for name in ("reference", "desired") if role == "command" else ("feedback", "actual"):
        if hasattr(message, name):
            return getattr(message, name)
    return None


def _interfaces(message: Any) -> dict[str, np.ndarray]:
    """Field -> numbers of a DynamicJointState; NaN where a joint has no such interface."""
    found = {field: np.full(len(message.joint_names), np.nan) for field in FIELDS.values()}
    for joint, interfaces in enumerate(message.interface_values[: len(message.joint_names)]):
        for name, value in zip(interfaces.interface_names, interfaces.values, strict=False):
            if name in found:
                found[name][joint] = value
    return {field: numbers for field, numbers in found.items() if not np.isnan(numbers).all()}


def _unnamed(fields: Mapping[str, np.ndarray], wanted: Wanted, where: str) -> list[Sample]:
    """The joints' numbers in a message without names."""
    joints, count = wanted.joints, len(next(iter(fields.values())))
    if wanted.motors is None and count != len(joints):
        raise ValueError(
            f"{where}: expected {len(joints)} numbers ({', '.join(joints)}), got {count}; where a message holds more, "
            "say which are the joints' with --motors, counted from 0"
        )
    places = _places(wanted.motors or range(count), joints, count, where)
    return [(0, joints, {field: np.asarray(n, np.float64)[places] for field, n in fields.items() if len(n) == count})]


def _places(motors: Sequence[int], joints: Sequence[str], count: int, where: str) -> list[int]:
    if len(motors) != len(joints) or len(set(motors)) < len(motors):
        raise ValueError(f"{where}: --motors must be {len(joints)} different numbers, one for each joint")
    if max(motors) >= count or min(motors) < 0:
        raise ValueError(f"{where}: --motors are counted from 0 to {count - 1} there, got {max(motors)}")
    return list(motors)
