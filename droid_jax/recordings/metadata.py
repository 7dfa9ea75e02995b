"""A recording without its arrays, as JSON: the text of a recording.json, which both formats store."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from droid_jax.arguments import lists_of_numbers, shown
from droid_jax.read_json import parse_json, typed
from droid_jax.recordings.recording import (
    Channel,
    ObjectPose,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
    TorqueSide,
    known_values,
)

FORMAT = "droid_jax recording 1"


@dataclass(frozen=True)
class Metadata:
    """The fields of a recording without the arrays of command and channels."""

    name: str
    commands: bool
    command_names: tuple[str, ...]
    units: dict[str, str]
    columns: dict[str, tuple[str, ...]]
    torque: TorqueConvention
    qpos0: dict[str, float]
    gains: ServoGains | None
    known: dict[str, float | str]
    variant: dict[str, dict[str, float | list[float]]]
    phases: tuple[Phase, ...]
    object_pose: ObjectPose | None
    meta: dict[str, str]


class _Torque(msgspec.Struct, forbid_unknown_fields=True):
    side: TorqueSide
    gravity: bool


class _Gains(msgspec.Struct, forbid_unknown_fields=True):
    stiffness: list[float]
    damping: list[float] | None = None


class _Pose(msgspec.Struct, forbid_unknown_fields=True):
    position: list[float]
    quaternion: list[float]
    covariance: list[list[float]]


class _Phase(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    start: float
    end: float


class _Channel(msgspec.Struct, forbid_unknown_fields=True):
    unit: str
    columns: list[str] = []


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The content of a recording.json."""

    channels: dict[str, _Channel]
    torque: _Torque
    format: str = FORMAT
    name: str = ""
    commands: bool = True
    command_names: list[str] = []
    qpos0: dict[str, float] = {}
    gains: _Gains | None = None
    known: dict[str, float | str] = {}
    variant: dict[str, dict[str, float | list[float]]] = {}
    phases: list[_Phase] = []
    object_pose: _Pose | None = None
    meta: dict[str, str | float | bool | None] = {}


def metadata_to_json(recording: Recording) -> str:
    """The text of a recording.json."""
    gains, pose = recording.gains, recording.object_pose
    meta: dict[str, Any] = {
        "format": FORMAT,
        "name": recording.name,
        "commands": bool(recording.command_names),
        "command_names": list(recording.command_names),
        "torque": {"side": recording.torque.side.value, "gravity": bool(recording.torque.gravity)},
        "channels": {k: {"unit": c.unit, "columns": list(c.columns)} for k, c in recording.channels.items()},
        "qpos0": {joint: float(q) for joint, q in recording.qpos0.items()},
        "phases": [{"name": p.name, "start": float(p.start), "end": float(p.end)} for p in recording.phases],
        "meta": dict(recording.meta),
    }
    if gains is not None:
        meta["gains"] = {"stiffness": _floats(gains.stiffness)}
        if gains.damping is not None:
            meta["gains"]["damping"] = _floats(gains.damping)
    if recording.known:
        meta["known"] = known_values(recording)
    if recording.variant:
        meta["variant"] = lists_of_numbers(recording.variant)
    if pose is not None:
        meta["object_pose"] = {
            "position": _floats(pose.position),
            "quaternion": _floats(pose.quaternion),
            "covariance": _floats(pose.covariance),
        }
    return json.dumps(meta, indent=2, allow_nan=False)


def _floats(array: np.ndarray) -> list[Any]:
    return array.astype(np.float64).tolist()


def metadata_from_json(text: str, where: str) -> Metadata:
    """The metadata in the text of a recording.json.

    Args:
        text: content of the file.
        where: the file, for messages.

    Raises:
        ValueError: a key is unknown, missing or of the wrong kind; the message names it.
    """
    raw = parse_json(text, where)
    if isinstance(raw, dict) and raw.get("format", FORMAT) != FORMAT:
        raise ValueError(f"{where}: expected format {FORMAT!r}, got {shown(raw['format'])}")
    file = typed(raw, _File, where)
    return Metadata(
        name=file.name,
        commands=file.commands,
        command_names=tuple(file.command_names),
        units={key: c.unit for key, c in file.channels.items()},
        columns={key: tuple(c.columns) for key, c in file.channels.items()},
        torque=TorqueConvention(file.torque.side, file.torque.gravity),
        qpos0=file.qpos0,
        gains=None if file.gains is None else _gains(file.gains),
        known=file.known,
        variant=file.variant,
        phases=tuple(Phase(p.name, p.start, p.end) for p in file.phases),
        object_pose=None if file.object_pose is None else _pose(file.object_pose, where),
        meta={key: str(value) for key, value in file.meta.items()},
    )


def _array(numbers: Any) -> np.ndarray:
    return np.array(numbers, dtype=np.float64)


def _gains(gains: _Gains) -> ServoGains:
    return ServoGains(_array(gains.stiffness), None if gains.damping is None else _array(gains.damping))


def _pose(pose: _Pose, where: str) -> ObjectPose:
    if len({len(row) for row in pose.covariance}) > 1:
        raise ValueError(f"{where}, 'object_pose', 'covariance' must have rows of one length")
    return ObjectPose(_array(pose.position), _array(pose.quaternion), _array(pose.covariance))


def recording_of(
    meta: Metadata,
    path: Path,
    time: np.ndarray,
    command: np.ndarray,
    command_names: tuple[str, ...],
    channels: dict[str, Channel],
) -> Recording:
    """The recording of this metadata and these arrays, named after its path where it has no name."""
    return Recording(
        name=meta.name or path.stem,
        time=time,
        command=command,
        command_names=command_names,
        channels=channels,
        torque=meta.torque,
        qpos0=meta.qpos0,
        gains=meta.gains,
        known=meta.known,
        variant=meta.variant,
        phases=meta.phases,
        object_pose=meta.object_pose,
        meta=meta.meta,
    )
