"""What the topics of one ROS bag hold: time stamps, and numbers by field, of the joints that are asked for.

Joint states, trajectories, arrays of numbers and states of a controller become the same thing, a `Track`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from droid_jax.arguments import said
from droid_jax.errors import named

_DAY = 86400 * 10**9  # ns

# channel -> field of sensor_msgs/JointState
FIELDS = {"torque": "effort", "position": "position", "velocity": "velocity"}


@dataclass(frozen=True, eq=False)
class Track:
    """One topic of one bag: bag and header stamps [M] ns, and values [M, J] by field.

    A field that all messages leave empty is absent; where some do, their rows are NaN.  Header stamps are None without
    headers.
    Stamps stay integers: nanoseconds since 1970 do not fit a float64.
    numbers: [M] which message of the topic each row is of; a trajectory has several.
    """

    received: np.ndarray
    stamped: np.ndarray | None
    fields: dict[str, np.ndarray]
    numbers: tuple[int, ...]


def read_bag(bag: Path, topics: Mapping[str, tuple[tuple[str, ...], str]]) -> dict[str, Track]:
    """topic -> track of one bag.  topics: of each its joints, and the field whose numbers must all be finite."""
    if not bag.exists():
        raise FileNotFoundError(f"no ROS bag at {bag}: there is no such file or folder")
    try:
        # Bags of ROS 2 before Iron in sqlite3 hold no message definitions of their own.
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            return {topic: _read_topic(reader, bag, topic, *wanted) for topic, wanted in topics.items()}
    except Exception as error:  # damaged bags fail in many ways: AssertionError, OverflowError, UnicodeDecodeError, ...
        if isinstance(error, ValueError) and str(error).startswith(str(bag)):
            raise
        what = f"{type(error).__name__}: {said(error)}"
        raise ValueError(f"{bag}: not a readable ROS bag, or one that was cut off ({what})") from error


def _read_topic(reader: AnyReader, bag: Path, topic: str, joints: tuple[str, ...], needed: str) -> Track:
    connections = [c for c in reader.connections if c.topic == topic]
    if not connections:
        have = named(sorted({c.topic for c in reader.connections})) or "none"
        raise ValueError(f"{bag}: no topic {topic!r}; the bag has: {have}")
    for kind in {c.msgtype for c in connections} - set(reader.typestore.fielddefs):
        raise ValueError(
            f"{bag}, topic {topic!r}: the bag does not define {named([kind])}, as bags in sqlite3 of ROS 2 before Iron "
            "do not; `ros2 bag convert` makes an mcap of it that does"
        )
    received, stamped, rows, numbers = [], [], [], []
    seen: set[str] = set()
    for number, (connection, nanoseconds, data) in enumerate(reader.messages(connections)):
        message = reader.deserialize(data, connection.msgtype)
        where = f"{bag}, topic {topic!r}, message {number}"
        for offset, names, fields in _samples(message, joints, connection.msgtype, where):
            seen.update(names)
            picked = _pick(fields, names, joints, needed, where)
            if picked is None:
                continue
            rows.append(picked)
            numbers.append(number)
            received.append(nanoseconds + offset)
            stamped.append(_header_stamp(message, offset))
    if not rows and seen:
        raise ValueError(f"{bag}, topic {topic!r}: no joint of {', '.join(joints)}; it has: {named(sorted(seen))}")
    if not rows:
        raise ValueError(f"{bag}, topic {topic!r}: no messages")
    without = [number for number, row in zip(numbers, rows, strict=True) if needed not in row]
    if without and len(without) < len(rows):
        raise ValueError(f"{bag}, topic {topic!r}, message {without[0]}: holds no {needed}, as others of the topic do")
    bare = np.full(len(joints), np.nan)  # a field that only some messages leave empty was not measured there
    fields = {key: np.array([row.get(key, bare) for row in rows]) for key in {k: None for row in rows for k in row}}
    return Track(np.array(received, dtype=np.int64), _header_stamps(stamped), fields, tuple(numbers))


def _header_stamp(message: Any, offset: int) -> int | None:
    """Nanoseconds of the header's stamp plus offset; None when there is none, or a trajectory's is zero ("now")."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or (hasattr(message, "points") and not _nanoseconds(stamp)):
        return None
    return _nanoseconds(stamp) + offset


def _header_stamps(stamped: Sequence[int | None]) -> np.ndarray | None:
    """[M] ns, or None where a message has none: a zero is a time only of a simulation's first message."""
    first, others = stamped[0], stamped[1:]
    if None in stamped or 0 in others or (first == 0 and not any(n and n < _DAY for n in others[:1])):
        return None
    return np.array(stamped, dtype=np.int64)


def _samples(
    message: Any, joints: tuple[str, ...], kind: str, where: str
) -> list[tuple[int, tuple[str, ...], dict[str, np.ndarray]]]:
    """The (offset in ns, joint names, field -> numbers) that one message holds."""
    if hasattr(message, "name") and hasattr(message, "position"):  # JointState
        fields = {field: np.asarray(getattr(message, field), dtype=np.float64) for field in FIELDS.values()}
        return [(0, tuple(message.name), fields)]
    if hasattr(message, "joint_names") and hasattr(message, "points"):  # JointTrajectory
        names = tuple(message.joint_names)
        return [(_nanoseconds(p.time_from_start), names, _setpoints(p)) for p in message.points]
    if hasattr(message, "joint_names") and (hasattr(message, "reference") or hasattr(message, "desired")):
        # JointTrajectoryControllerState, in older versions with the second name
        point = message.reference if hasattr(message, "reference") else message.desired
        return [(0, tuple(message.joint_names), _setpoints(point))]
    if hasattr(message, "positions"):  # JointTrajectoryPoint
        numbers = np.asarray(message.positions, dtype=np.float64)
    elif hasattr(message, "data") and np.ndim(message.data) == 1:  # Float64MultiArray
        numbers = np.asarray(message.data, dtype=np.float64)
    else:
        raise ValueError(
            f"{where}: cannot read {named([kind])}; expected JointState, JointTrajectory, JointTrajectoryPoint, "
            "Float64MultiArray or JointTrajectoryControllerState"
        )
    if len(numbers) != len(joints):
        raise ValueError(f"{where}: expected {len(joints)} numbers ({', '.join(joints)}), got {len(numbers)}")
    return [(0, joints, {**_setpoints(message), "position": numbers})]


def _setpoints(point: Any) -> dict[str, np.ndarray]:
    """field -> numbers of a trajectory point, or of a message without names: positions, and what stands beside them."""
    found = {"position": np.asarray(getattr(point, "positions", ()), dtype=np.float64)}
    for field, of_point in {"velocity": "velocities", "effort": "effort"}.items():
        numbers = np.asarray(getattr(point, of_point, ()), dtype=np.float64)
        if len(numbers) == len(found["position"]):
            found[field] = numbers
    return found


def _nanoseconds(duration: Any) -> int:
    return duration.sec * 10**9 + duration.nanosec


def _pick(
    fields: Mapping[str, np.ndarray], names: tuple[str, ...], joints: tuple[str, ...], needed: str, where: str
) -> dict[str, np.ndarray] | None:
    """field -> [J] numbers of the joints wanted, without empty fields; finite in the field `needed`.

    None when the message has none of them: arm and gripper often share a topic.
    """
    missing = [j for j in joints if j not in names]
    if len(missing) == len(joints):
        return None
    if missing:
        raise ValueError(f"{where}: no joint {', '.join(missing)}; the message has: {named(names)}")
    order = [names.index(j) for j in joints]
    picked = {}
    for field, numbers in fields.items():
        if not len(numbers):
            continue
        if len(numbers) != len(names):
            raise ValueError(f"{where}: expected {len(names)} numbers in {field!r}, got {len(numbers)}")
        bad = [j for j, i in zip(joints, order, strict=True) if not np.isfinite(numbers[i])]
        if bad and field == needed:
            raise ValueError(f"{where}: {field} of joint {bad[0]!r} is {numbers[names.index(bad[0])]}, not finite")
        picked[field] = numbers[order]
    return picked
