"""What both formats store beside the arrays of a recording, as JSON: the text of a recording.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.errors import faults
from droid_jax.measure.recording import (
    Channel,
    ObjectPose,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
    TorqueSide,
)

FORMAT = "droid_jax recording 1"


@dataclass(frozen=True)
class Metadata:
    """What both formats store beside the arrays of command and channels."""

    name: str
    commands: bool
    command_names: tuple[str, ...]
    units: dict[str, str]
    columns: dict[str, tuple[str, ...]]
    torque: TorqueConvention
    qpos0: dict[str, float]
    gains: ServoGains | None
    phases: tuple[Phase, ...]
    object_pose: ObjectPose | None
    meta: dict[str, str]


_VALID = {  # kind of JSON object -> keys it may have; those it must have
    "recording": (
        (
            *("format", "name", "commands", "command_names", "channels", "torque"),
            *("qpos0", "gains", "phases", "object_pose", "meta"),
        ),
        ("channels", "torque"),
    ),
    "torque": (("side", "gravity"),) * 2,
    "gains": (("stiffness", "damping"),) * 2,
    "object_pose": (("position", "quaternion", "covariance"),) * 2,
    "phase": (("name", "start", "end"),) * 2,
    "channel": (("unit", "columns"), ("unit",)),
}


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
        meta["gains"] = {"stiffness": _floats(gains.stiffness), "damping": _floats(gains.damping)}
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

    where: what the text belongs to.  ValueError names the key that is unknown, missing or of the wrong kind.
    """
    try:
        raw = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{where}: not valid JSON, line {error.lineno}: {error.msg}") from None
    raw = _keys(raw, "recording", where)
    if raw.get("format", FORMAT) != FORMAT:
        raise ValueError(f"{where}: expected format {FORMAT!r}, got {raw['format']!r}")
    commands = raw.get("commands", True)
    if not isinstance(commands, bool):
        raise ValueError(f"{where}: 'commands' must be true or false, got {commands!r}")
    channels = {k: _keys(c, "channel", f"{where}, channel {k!r}") for k, c in _object(raw, "channels", where)}
    return Metadata(
        name=str(raw.get("name", "")),
        commands=commands,
        command_names=_names(raw.get("command_names", []), f"{where}, command_names"),
        units={k: str(c["unit"]) for k, c in channels.items()},
        columns={k: _names(c.get("columns", []), f"{where}, channel {k!r}") for k, c in channels.items()},
        torque=_torque(_keys(raw["torque"], "torque", f"{where}, torque"), where),
        qpos0={joint: _float(q, f"{where}, qpos0, joint {joint!r}") for joint, q in _object(raw, "qpos0", where)},
        gains=_arrays(raw, "gains", ServoGains, where),
        phases=_phases(raw.get("phases", []), f"{where}, phases"),
        object_pose=_arrays(raw, "object_pose", ObjectPose, where),
        meta={k: str(v) for k, v in _object(raw, "meta", where)},
    )


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
        phases=meta.phases,
        object_pose=meta.object_pose,
        meta=meta.meta,
    )


def _keys(raw: Any, kind: str, where: str) -> dict[str, Any]:
    """A JSON object with the keys of its kind, none unknown and none of the required missing."""
    valid, required = _VALID[kind]
    if not isinstance(raw, dict):
        raise ValueError(f"{where}: expected an object with {', '.join(valid)}, got {raw!r}")
    unknown = sorted(set(raw) - set(valid))
    missing = [key for key in required if key not in raw]
    if wrong := faults({"unknown keys:": unknown, "missing keys:": missing}):
        raise ValueError(f"{where}: {wrong}; valid keys: {', '.join(valid)}")
    return raw


def _object(raw: Mapping[str, Any], key: str, where: str) -> list[tuple[str, Any]]:
    value = raw.get(key, {})
    if not isinstance(value, dict):
        raise ValueError(f"{where}: {key!r} must be an object, got {value!r}")
    return list(value.items())


def _names(raw: Any, where: str) -> tuple[str, ...]:
    if not isinstance(raw, list) or not all(isinstance(n, str) for n in raw):
        raise ValueError(f"{where}: expected a list of joint names, got {raw!r}")
    return tuple(raw)


def _float(raw: Any, where: str) -> float:
    if isinstance(raw, bool) or not isinstance(raw, (int, float)):
        raise ValueError(f"{where}: expected a number, got {raw!r}")
    return float(raw)


def _phases(raw: Any, where: str) -> tuple[Phase, ...]:
    if not isinstance(raw, list):
        raise ValueError(f"{where}: expected a list of objects with name, start and end, got {raw!r}")
    phases = [_keys(p, "phase", where) for p in raw]
    return tuple(Phase(str(p["name"]), _float(p["start"], where), _float(p["end"], where)) for p in phases)


def _torque(raw: Mapping[str, Any], where: str) -> TorqueConvention:
    sides = [side.value for side in TorqueSide]
    if raw["side"] not in sides:
        raise ValueError(f"{where}: torque side must be one of {', '.join(sides)}, got {raw['side']!r}")
    if not isinstance(raw["gravity"], bool):
        raise ValueError(f"{where}: torque gravity must be true or false, got {raw['gravity']!r}")
    return TorqueConvention(TorqueSide(raw["side"]), raw["gravity"])


def _arrays(raw: Mapping[str, Any], key: str, make: Any, where: str) -> Any:
    """ServoGains or ObjectPose from lists of numbers, or None where the key is not given."""
    if raw.get(key) is None:
        return None
    lists = _keys(raw[key], key, f"{where}, {key}")
    try:
        return make(**{k: np.array(v, dtype=np.float64) for k, v in lists.items()})
    except (TypeError, ValueError):
        raise ValueError(f"{where}, {key}: expected lists of numbers, got {lists}") from None
