"""Reads the topics of one ROS bag: time stamps, and numbers by field, of the joints that are asked for.

Joint states, trajectories, arrays of numbers and controller states all become a `Track`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from droid_jax.arguments import said
from droid_jax.errors import named
from droid_jax.recordings.bag_messages import Wanted, in_nanoseconds, samples

_DAY = 86400 * 10**9  # ns


@dataclass(frozen=True, eq=False)
class Track:
    """One topic of one bag.

    A field that all messages leave empty is absent.  Where only some messages leave it empty, their rows are NaN.
    Stamps are integers, because nanoseconds since 1970 do not fit a float64.

    received: the recorder's stamps [M] ns.
    stamped: header stamps [M] ns; None where messages have no headers.
    fields: name -> values [M, J].
    numbers: for each of the M rows, the number of its message in the topic; a trajectory has several rows.
    topic: name of the topic.
    """

    received: np.ndarray
    stamped: np.ndarray | None
    fields: dict[str, np.ndarray]
    numbers: tuple[int, ...]
    topic: str


def read_bag(bag: Path, asked: Mapping[str, Wanted]) -> dict[str, Track]:
    """The tracks of one bag, by the keys under which they are asked for."""
    if not bag.exists():
        raise FileNotFoundError(f"no ROS bag at {bag}: there is no such file or folder")
    try:
        # Bags of ROS 2 before Iron in sqlite3 hold no message definitions of their own.
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            return {key: _read_topic(reader, bag, wanted.topic, wanted) for key, wanted in asked.items()}
    except Exception as error:  # damaged bags fail in many ways: AssertionError, OverflowError, UnicodeDecodeError, ...
        if isinstance(error, ValueError) and str(error).startswith(str(bag)):
            raise
        what = f"{type(error).__name__}: {said(error)}"
        raise ValueError(f"{bag}: not a readable ROS bag, or one that was cut off ({what})") from error


def _read_topic(reader: AnyReader, bag: Path, topic: str, wanted: Wanted) -> Track:
    joints, needed = wanted.joints, wanted.needed
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
        for offset, names, fields in samples(message, wanted, connection.msgtype, where):
            seen.update(names)
            picked = _pick(fields, names, wanted, where)
            if picked is None:
                continue
            rows.append(picked)
            numbers.append(number)
            received.append(nanoseconds + offset)
            stamped.append(_header_stamp(message, offset))
    if not rows and seen:
        raise ValueError(
            f"{bag}, topic {topic!r}: no joint of {', '.join(joints)}; it has: {named(sorted(seen))}"
            f"{_remedy(joints, sorted(seen), wanted)}"
        )
    if not rows:
        raise ValueError(f"{bag}, topic {topic!r}: no messages")
    without = [number for number, row in zip(numbers, rows, strict=True) if needed not in row]
    if without and len(without) < len(rows):
        raise ValueError(f"{bag}, topic {topic!r}, message {without[0]}: holds no {needed}, as others of the topic do")
    bare = np.full(len(joints), np.nan)  # for messages that leave a field empty
    fields = {key: np.array([row.get(key, bare) for row in rows]) for key in {k: None for row in rows for k in row}}
    return Track(np.array(received, dtype=np.int64), _header_stamps(stamped), fields, tuple(numbers), topic)


def _header_stamp(message: Any, offset: int) -> int | None:
    """Nanoseconds of the header's stamp plus offset; None when there is none, or a trajectory's is zero ("now")."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or (hasattr(message, "points") and not in_nanoseconds(stamp)):
        return None
    return in_nanoseconds(stamp) + offset


def _header_stamps(stamped: Sequence[int | None]) -> np.ndarray | None:
    """[M] ns, or None where a message has none: a zero is a time only of a simulation's first message."""
    first, others = stamped[0], stamped[1:]
    if None in stamped or 0 in others or (first == 0 and not any(n and n < _DAY for n in others[:1])):
        return None
    return np.array(stamped, dtype=np.int64)


def _pick(
    fields: Mapping[str, np.ndarray], names: tuple[str, ...], wanted: Wanted, where: str
) -> dict[str, np.ndarray] | None:
    """Field -> numbers [J] of the joints wanted, without empty fields; finite in the field `needed`.

    None when the message has none of these joints: arm and gripper often share a topic.
    """
    joints = wanted.joints
    missing = [j for j in joints if j not in names]
    if len(missing) == len(joints):
        return None
    if missing:
        raise ValueError(
            f"{where}: no joint {', '.join(missing)}; the message has: {named(names)}{_remedy(missing, names, wanted)}"
        )
    order = [names.index(j) for j in joints]
    picked = {}
    for field, numbers in fields.items():
        if not len(numbers):
            continue
        if len(numbers) != len(names):
            raise ValueError(f"{where}: expected {len(names)} numbers in {field!r}, got {len(numbers)}")
        bad = [j for j, i in zip(joints, order, strict=True) if not np.isfinite(numbers[i])]
        if bad and field == wanted.needed:
            raise ValueError(f"{where}: {field} of joint {bad[0]!r} is {numbers[names.index(bad[0])]}, not finite")
        picked[field] = numbers[order]
    return picked


def _remedy(missing: Sequence[str], names: Sequence[str], wanted: Wanted) -> str:
    """Advice where messages name a missing joint with another prefix or suffix; empty where no name is similar."""
    option = "--joints" if wanted.role == "state" else "--command-joints"
    for joint in missing:
        for name in names:
            short, long = sorted((joint, name), key=len)
            if short and re.fullmatch(rf"(.*[\W_])?{re.escape(short)}([\W_].*)?", long):
                return (
                    f"; if {joint!r} is called {name!r} there, give both names of each joint: {option} NAME={name}, "
                    "where NAME is its name in the MJCF"
                )
    return ""
