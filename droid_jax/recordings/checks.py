"""Checks that a recording is valid (`validate`) and that its joints are those of a robot (`check_joints`).

`validate` is called once, by the code that made the recording (a file reader, a simulated robot).  All code that
receives the recording may rely on it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from droid_jax.arguments import instance, instances, is_list, name, note, number, shown
from droid_jax.errors import faults
from droid_jax.recordings.clocks import SLACK, check_clock
from droid_jax.recordings.recording import (
    JITTER,
    JOINT_CHANNELS,
    Channel,
    ObjectPose,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
)

# Units of the channels that a replay has, for hinges and for slides; a channel of both says "N m or N".
UNITS = {
    "torque": ("N m", "N"),
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "object_angle": ("rad", "m"),
}


def validate(recording: Recording, *, source: str = "", allow_jitter: bool = False) -> Recording:
    """The recording itself, if it is valid.

    Args:
        recording: what is checked.
        source: file or folder the recording came from, for the message; by default the recording's name is given.
        allow_jitter: accept clocks whose steps differ from their median by more than half of it.

    Raises:
        ValueError: the message says what is wrong and where; rows and repeats count from 0, as numpy does.
    """
    instance(recording, "a recording", Recording)
    where = source or f"recording {shown(recording.name)}"
    name(recording.name, f"{where}: its name", file=True)
    _check_types(recording, where)
    _check_texts(recording, where)
    _check_command(recording, where, allow_jitter)
    if not recording.channels:
        raise ValueError(f"{where}: empty, expected at least one measured channel")
    for key, channel in recording.channels.items():
        _check_channel(channel, key, where, allow_jitter)
    _check_repeats(recording, where)
    _check_clocks_meet(recording, where)
    for joint, q in recording.qpos0.items():
        number(q, f"{where}: qpos0 of joint {joint!r}")
    for parameter, value in recording.known.items():
        if not isinstance(value, str):
            number(value, f"{where}: known value of {parameter!r}")
    _check_variant(recording, where)
    _check_phases(recording, where)
    if recording.gains is not None:
        _check_gains(recording.gains, recording.command_names, where)
    if recording.object_pose is not None:
        _check_pose(recording.object_pose, where)
    return recording


def accept(recording: Recording, source: str, allow_jitter: bool) -> Recording:
    """The recording, validated; irregular clocks are accepted on request, and `meta` then says so.

    Args:
        recording: as it was read.
        source: file or folder it came from, for messages.
        allow_jitter: whether to accept irregular clocks; a recording that was accepted before is so again.

    Raises:
        ValueError: it is not valid.
    """
    if not allow_jitter:
        return validate(recording, source=source, allow_jitter=JITTER in recording.meta)
    with contextlib.suppress(ValueError):
        return validate(recording, source=source)
    accepted = replace(recording, meta={**recording.meta, JITTER: "accepted when it was read"})
    return validate(accepted, source=source, allow_jitter=True)


def _check_types(recording: Recording, where: str) -> None:
    """ValueError for a part of another class than it must be of."""
    if not isinstance(recording.torque, TorqueConvention):
        raise ValueError(
            f"{where}: torque must be a TorqueConvention, which says the side, got {shown(recording.torque)}"
        )
    for what, mapping, mapped in (
        ("channels", recording.channels, "names to channels"),
        ("qpos0", recording.qpos0, "joint names to positions"),
        ("known", recording.known, "parameter names to values or names"),
        ("variant", recording.variant, "fields of the model to elements and their numbers"),
        ("meta", recording.meta, "texts to texts"),
    ):
        if not isinstance(mapping, Mapping):
            raise ValueError(f"{where}: {what} must map {mapped}, got {shown(mapping)}")
    for key, channel in recording.channels.items():
        instance(channel, f"{where}: channel {shown(key)}", Channel)
    instances(recording.phases, f"{where}: phases", Phase)
    if recording.gains is not None:
        instance(recording.gains, f"{where}: gains", ServoGains)
    if recording.object_pose is not None:
        instance(recording.object_pose, f"{where}: object_pose", ObjectPose)


def _check_texts(recording: Recording, where: str) -> None:
    """ValueError for a text that cannot be printed or is too long: the page and the tables show all of them."""
    for joint in recording.qpos0:
        name(joint, f"{where}: a joint of qpos0")
    for parameter, value in recording.known.items():
        name(parameter, f"{where}: a parameter of known")
        if isinstance(value, str):
            name(value, f"{where}: the parameter named for {parameter!r}")
    for key, channel in recording.channels.items():
        name(key, f"{where}: a channel's name")
        name(channel.unit, f"{where}, channel {key!r}: unit", empty=True)
    for phase in recording.phases:
        name(phase.name, f"{where}: a phase's name")
    for key, text in recording.meta.items():
        note(text, f"{where}: meta {name(key, f'{where}: a key of meta')!r}")


def _check_variant(recording: Recording, where: str) -> None:
    for key, of in recording.variant.items():
        name(key, f"{where}: a field of variant")
        if not isinstance(of, Mapping):
            raise ValueError(f"{where}: variant, {key!r} must map elements to their numbers, got {shown(of)}")
        for element, value in of.items():
            what = f"{where}: variant, {key} of {shown(element)}"
            name(element, what)
            for one in value if is_list(value) else [value]:
                number(one, what)


def check_joints(recording: Recording, joints: Sequence[str], also: Sequence[str] = ()) -> None:
    """ValueError unless the recording has exactly these robot joints, in any order.

    The command must have a column for each joint.  In a log without commands, the torque, position and velocity
    channels together must.  Other channels (a door's angle) are not checked.

    Args:
        recording: what is checked.
        joints: names that must be there.
        also: names that may be there besides.
    """
    where = f"recording {recording.name!r}"
    known = {k: recording.channels[k].columns for k in JOINT_CHANNELS if k in recording.channels}
    if recording.command_names:
        parts = {"command": recording.command_names}
        have = recording.command_names
    else:
        parts = {}
        have = tuple(dict.fromkeys(j for columns in known.values() for j in columns))
    valid = tuple(dict.fromkeys((*joints, *also)))
    wrong = faults({"missing:": [j for j in joints if j not in have], "unknown:": [j for j in have if j not in valid]})
    if wrong:
        what = "command" if parts else "its channels"
        raise ValueError(
            f"{where}, {what}: expected {len(joints)} joints, got {len(have)}; {wrong}; valid names: {', '.join(valid)}"
        )
    for key, columns in known.items():
        unknown = [j for j in columns if j not in valid]
        if unknown:
            raise ValueError(
                f"{where}, channel {key!r}: unknown joints {', '.join(unknown)}; valid names: {', '.join(valid)}"
            )


def _check_array(array: Any, shape: tuple[int | None, ...], kind: str, where: str, what: str) -> None:
    """ValueError unless it is a numpy array of that shape (None: any) and dtype kind."""
    names = {"f": "float", "b": "bool"}
    if not isinstance(array, np.ndarray) or array.dtype.kind != kind:
        got = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{where}: {what} must be a numpy array of {names[kind]}, got {got}")
    fits = len(array.shape) == len(shape) and all(w in (None, g) for w, g in zip(shape, array.shape, strict=True))
    if not fits:
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{where}: {what} must have shape [{expected}], got {list(array.shape)}")


def _check_names(names: Sequence[str], where: str, what: str) -> None:
    """ValueError unless all names are non-empty strings and none is given twice."""
    if not isinstance(names, (tuple, list)) or not all(isinstance(n, str) and n for n in names):
        raise ValueError(f"{where}: {what} must be non-empty names, got {shown(names)}")
    for one in names:
        name(one, f"{where}: one of the {what}")
    twice = sorted({n for n in names if list(names).count(n) > 1})
    if twice:
        raise ValueError(f"{where}: {what} must be unique, repeated: {', '.join(twice)}")


def _check_command(recording: Recording, where: str, allow_jitter: bool) -> None:
    names = recording.command_names
    _check_names(names, f"{where}, command", "joint names")
    _check_array(recording.time, (None,), "f", f"{where}, command", "time [T]")
    _check_array(recording.command, (None, None), "f", where, "command [T, U]")
    t, u = recording.command.shape
    if u != len(names):
        raise ValueError(
            f"{where}, command: wrong joint count, expected {len(names)} columns ({', '.join(names)}), got {u}"
        )
    if t != len(recording.time):
        raise ValueError(f"{where}, command: expected {len(recording.time)} rows, as many as times, got {t}")
    if t == 0 and u == 0:
        return
    if t < 2 or u == 0:
        raise ValueError(
            f"{where}, command: empty, expected two rows and one joint or more, got {t} rows and {u} joints "
            "(a log without commands has neither rows nor joints)"
        )
    check_clock(recording.time, f"{where}, command", allow_jitter=allow_jitter)
    bad = np.argwhere(~np.isfinite(recording.command))
    if bad.size:
        i, c = bad[0]
        raise ValueError(
            f"{where}, command, row {i}, column {names[c]!r}: expected a finite number, got {recording.command[i, c]}"
        )


def _check_channel(channel: Channel, key: str, where: str, allow_jitter: bool) -> None:
    here = f"{where}, channel {key!r}"
    if not isinstance(channel.name, str) or channel.name != key or not re.fullmatch(r"[A-Za-z]\w*", key):
        raise ValueError(f"{here}: a channel's name must be an identifier and equal its key, got {shown(channel.name)}")
    valid = UNITS.get(key, ())
    if not channel.unit or (valid and not set(channel.unit.split(" or ")) <= set(valid)):
        raise ValueError(
            f"{here}: expected the unit {' or '.join(map(repr, valid)) or 'of SI'}, got {shown(channel.unit)}"
        )
    _check_names(channel.columns, here, "column names")
    n_columns = len(channel.columns)
    _check_array(channel.time, (None,), "f", here, "time [Tc]")
    _check_array(channel.values, (None, None, None), "f", here, "values [N, Tc, C]")
    n, t, c = channel.values.shape
    if c != n_columns:
        raise ValueError(
            f"{here}: wrong joint count, expected {n_columns} columns ({', '.join(channel.columns)}), got {c}"
        )
    if 0 in (n, t, c):
        raise ValueError(f"{here}: empty, values [N, Tc, C] have shape [{n}, {t}, {c}]")
    _check_array(channel.values, (n, len(channel.time), c), "f", here, "values [N, Tc, C]")
    _check_array(channel.mask, (n, t, c), "b", here, "mask [N, Tc, C]")
    check_clock(channel.time, here, allow_jitter=allow_jitter)
    bad = np.argwhere(channel.mask & ~np.isfinite(channel.values))
    if bad.size:
        r, i, j = bad[0]
        raise ValueError(
            f"{here}, repeat {r}, row {i}, column {channel.columns[j]!r}: expected a finite number, "
            f"got {channel.values[r, i, j]}; mask out what was not measured"
        )
    unseen = np.flatnonzero(~channel.mask.any(axis=(1, 2)))
    if unseen.size:
        raise ValueError(f"{here}, repeat {unseen[0]}: empty, everything is masked out")


def _check_repeats(recording: Recording, where: str) -> None:
    counts = {key: c.values.shape[0] for key, c in recording.channels.items()}
    if len(set(counts.values())) > 1:
        got = ", ".join(f"{key} {n}" for key, n in counts.items())
        raise ValueError(f"{where}: all channels must have the same number of repeats, got {got}")


def _check_clocks_meet(recording: Recording, where: str) -> None:
    """ValueError when a channel was measured at another time than the command was sent."""
    if not len(recording.time):
        return
    first, last = float(recording.time[0]), float(recording.time[-1])
    for key, c in recording.channels.items():
        if c.time[0] > last or c.time[-1] < first:
            raise ValueError(
                f"{where}, channel {key!r}: its clock {c.time[0]:g} .. {c.time[-1]:g} s does not meet "
                f"the command's {first:g} .. {last:g} s"
            )


def _check_phases(recording: Recording, where: str) -> None:
    first, last = recording.span
    _check_names([p.name for p in recording.phases], where, "phase names")
    for p in recording.phases:
        for what, instant in (("start", p.start), ("end", p.end)):
            number(instant, f"{where}: {what} of phase {p.name!r}")
        if not p.start < p.end:
            raise ValueError(f"{where}: phase {p.name!r} must start before it ends, got {p.start} .. {p.end} s")
        if p.start < first - SLACK or p.end > last + SLACK:
            raise ValueError(
                f"{where}: phase {p.name!r} ({p.start:g} .. {p.end:g} s) lies outside the "
                f"recording ({first:g} .. {last:g} s)"
            )


def _check_gains(gains: ServoGains, names: Sequence[str], where: str) -> None:
    stated: dict[str, Any] = {"stiffness": gains.stiffness}
    if gains.damping is not None:
        stated["damping"] = gains.damping
    for what, array in stated.items():
        _check_array(array, (len(names),), "f", f"{where}, gains", f"{what} (one number per command joint)")
        bad = np.flatnonzero(~(np.isfinite(array) & (array >= 0)))
        if bad.size:
            raise ValueError(
                f"{where}, gains: {what} of joint {names[bad[0]]!r} must be 0 or more, got {array[bad[0]]}"
            )


def _check_pose(pose: ObjectPose, where: str) -> None:
    here = f"{where}, object pose"
    for what, array, shape in (
        ("position [3]", pose.position, (3,)),
        ("quaternion [4]", pose.quaternion, (4,)),
        ("covariance [6, 6]", pose.covariance, (6, 6)),
    ):
        _check_array(array, shape, "f", here, what)
        if not np.isfinite(array).all():
            raise ValueError(f"{here}: {what} must be finite, got {array.tolist()}")
    norm = float(np.linalg.norm(pose.quaternion))
    if abs(norm - 1) > 1e-3:
        raise ValueError(f"{here}: the quaternion (w x y z) must have length 1, got {norm:.6g}")
    cov = pose.covariance.astype(np.float64)
    scale = float(np.abs(cov).max())
    # Numbers stored as float32 are symmetric and non-negative to about 1e-7 of the largest.
    if np.abs(cov - cov.T).max() > 1e-6 * scale:
        i, j = np.unravel_index(int(np.argmax(np.abs(cov - cov.T))), cov.shape)
        raise ValueError(
            f"{here}: the covariance must be symmetric, got {cov[i, j]:g} at [{i}, {j}] and {cov[j, i]:g} at [{j}, {i}]"
        )
    lowest = float(np.linalg.eigvalsh((cov + cov.T) / 2)[0])
    if lowest < -1e-6 * scale:
        raise ValueError(
            f"{here}: the covariance must be positive semi-definite, its smallest eigenvalue is {lowest:.3g}"
        )
