"""A demonstration and its measured repeats: `Recording`, and the checks it must pass.

One motion is commanded once per repeat; the command is the same each time, the measurements
differ.  Every channel keeps its own clock, so a door angle filmed at 30 Hz can stand beside
torques at 1 kHz.  What was not measured is masked, never filled in.

`validate` is called once, on the host, by whoever made the recording (a file reader, a
simulated robot); everything behind it may rely on what it checks.
"""

from __future__ import annotations

import enum
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

JOINT_CHANNELS = ("torque", "position", "velocity")  # channels whose columns are robot joints
POSITION_CHANNELS = ("position", "object_angle")  # channels that say where a joint is

_DAY = 86400.0  # s
_JITTER = 0.5  # largest deviation of a clock's step from its median, as a fraction
_SLACK = 1e-6  # s, two instants closer than this are the same


class TorqueSide(enum.Enum):
    """Where a torque was measured: armature, damping and motor friction lie in between."""

    MOTOR = "motor"  # what the motor produces (MuJoCo's qfrc_actuator, a motor current)
    LINK = "link"  # what arrives behind the gear (a joint torque sensor, a Panda's tau_J)


@dataclass(frozen=True)
class TorqueConvention:
    """What the torque channel holds.

    side:    motor or link side of the gear.
    gravity: True when the measured torque contains the torque that carries the arm's weight.
    """

    side: TorqueSide
    gravity: bool


@dataclass(frozen=True, eq=False)
class Channel:
    """One measured quantity over all repeats.

    name:    "torque", "position", "velocity", "object_angle" or another identifier.
    unit:    "N m", "rad", "rad/s", ...
    columns: C joint names.
    time:    [Tc] s, the channel's own clock, strictly increasing.
    values:  [N, Tc, C] in `unit`.
    mask:    [N, Tc, C] bool, True = measured; values that are masked out may be NaN.
    """

    name: str
    unit: str
    columns: tuple[str, ...]
    time: np.ndarray
    values: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class Phase:
    """A named part of the motion (approach, grasp, opening, ...) from start to end, in s."""

    name: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class ServoGains:
    """The position servo's gains, one per command column.

    stiffness: [U] N m/rad (N/m for slides); damping: [U] N m s/rad (N s/m for slides).
    """

    stiffness: np.ndarray
    damping: np.ndarray


@dataclass(frozen=True, eq=False)
class ObjectPose:
    """Where the object stands in the robot's base frame, and how well that is known.

    position: [3] m; quaternion: [4] unit, w x y z; covariance: [6, 6] in m and rad.
    """

    position: np.ndarray
    quaternion: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """One demonstration and its N repeats.

    name:          for tables and file names; not part of the content hash.
    time:          [T] s, the command clock, strictly increasing.
    command:       [T, U] position command, rad or m; T = U = 0 for a log without commands.
    command_names: U joint names.
    channels:      name -> Channel; all share N.
    torque:        what the torque channel holds.
    qpos0:         joint name -> position at the start, rad or m.
    gains:         servo gains, when known.
    phases:        named parts of the motion.
    object_pose:   pose of the manipulated object, when known.
    meta:          free notes; not part of the content hash.
    """

    name: str
    time: np.ndarray
    command: np.ndarray
    command_names: tuple[str, ...]
    channels: Mapping[str, Channel]
    torque: TorqueConvention
    qpos0: Mapping[str, float]
    gains: ServoGains | None = None
    phases: tuple[Phase, ...] = ()
    object_pose: ObjectPose | None = None
    meta: Mapping[str, str] = field(default_factory=dict)

    @property
    def repeats(self) -> int:
        """N, how often the motion was measured."""
        return next(iter(self.channels.values())).values.shape[0]

    @property
    def span(self) -> tuple[float, float]:
        """First and last instant of any clock, s."""
        clocks = [t for t in (self.time, *(c.time for c in self.channels.values())) if len(t)]
        return min(float(t[0]) for t in clocks), max(float(t[-1]) for t in clocks)

    @property
    def duration(self) -> float:
        """Seconds from first to last command, or of all channels in a log without commands."""
        if len(self.time):
            return float(self.time[-1] - self.time[0])
        first, last = self.span
        return last - first

    @property
    def sha256(self) -> str:
        """Hash of arrays, names, units and conventions, the same from every file format.

        Numbers enter as float64 and masked-out values as zero, so neither the stored
        precision nor what stands in an unmeasured cell changes it.
        """
        head, arrays = _content(self)
        digest = hashlib.sha256(json.dumps(head, sort_keys=True).encode())
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def channel(self, name: str) -> Channel:
        """The channel of that name; ValueError lists the valid names."""
        try:
            return self.channels[name]
        except KeyError:
            have = ", ".join(sorted(self.channels))
            raise ValueError(f"unknown channel {name!r}; recording {self.name!r} has: {have}") from None

    def repeats_subset(self, indices: Sequence[int]) -> Recording:
        """A copy that holds these repeats only (training against held-out repeats).

        Raises ValueError when no index is given or one lies outside 0 .. N - 1.
        """
        chosen = [int(i) for i in indices]
        bad = [i for i in chosen if not 0 <= i < self.repeats]
        if not chosen or bad:
            raise ValueError(f"repeats must be out of 0 .. {self.repeats - 1}, got {bad if bad else 'none'}")
        channels = {key: replace(c, values=c.values[chosen], mask=c.mask[chosen]) for key, c in self.channels.items()}
        return replace(self, channels=channels)

    def window(self, start: float, end: float, *, qpos0: Mapping[str, float] | None = None) -> Recording:
        """The part from start to end (s, both included); clocks keep their numbers.

        A window that begins later than the recording needs new initial positions: those given
        as qpos0 first, then the measured ones (mean over repeats).  Raises ValueError when the
        window is empty for the command or a channel, or a joint's position at its beginning is
        neither given nor measured.
        """
        if not start < end:
            raise ValueError(f"a window needs start < end, got {start} and {end} s")
        rows = _rows(self.time, start, end)
        if len(self.time) and rows.sum() < 2:
            raise ValueError(_outside("the command", self.time, start, end))
        channels = {}
        for key, c in self.channels.items():
            keep = _rows(c.time, start, end)
            if not keep.any():
                raise ValueError(_outside(f"channel {key!r}", c.time, start, end))
            channels[key] = replace(c, time=c.time[keep], values=c.values[:, keep], mask=c.mask[:, keep])
        phases = tuple(
            replace(p, start=max(p.start, start), end=min(p.end, end))
            for p in self.phases
            if p.start < end and p.end > start
        )
        return replace(
            self,
            time=self.time[rows],
            command=self.command[rows],
            channels=channels,
            phases=phases,
            qpos0=_positions_at(self, start, qpos0 or {}),
        )


def _rows(time: np.ndarray, start: float, end: float) -> np.ndarray:
    """[T] bool, which instants lie in the window."""
    return (time >= start - _SLACK) & (time <= end + _SLACK)


def _outside(what: str, time: np.ndarray, start: float, end: float) -> str:
    return f"window {start} .. {end} s holds too little of {what}, which runs {time[0]:g} .. {time[-1]:g} s"


def _positions_at(recording: Recording, start: float, given: Mapping[str, float]) -> dict[str, float]:
    """Joint positions at an instant, for the joints of qpos0 and those given."""
    first = float(recording.time[0]) if len(recording.time) else recording.span[0]
    if start <= first + _SLACK:
        return {**recording.qpos0, **given}
    measured: dict[str, float] = {}
    for channel in (recording.channels[k] for k in POSITION_CHANNELS if k in recording.channels):
        for c, joint in enumerate(channel.columns):
            found = [_interpolate(channel, r, c, start) for r in range(recording.repeats)]
            found = [v for v in found if v is not None]
            if found:
                measured[joint] = float(np.mean(found))
    positions = {**{j: measured[j] for j in recording.qpos0 if j in measured}, **given}
    lacking = [j for j in recording.qpos0 if j not in positions]
    if lacking:
        raise ValueError(
            f"a window from {start} s needs initial positions that were not measured: "
            f"give qpos0 for {', '.join(lacking)}"
        )
    return positions


def _interpolate(channel: Channel, repeat: int, column: int, at: float) -> float | None:
    """One column's value at an instant, or None outside what was measured."""
    seen = channel.mask[repeat, :, column]
    time = channel.time[seen]
    if not len(time) or not time[0] - _SLACK <= at <= time[-1] + _SLACK:
        return None
    return float(np.interp(at, time, channel.values[repeat, seen, column]))


def _content(recording: Recording) -> tuple[dict[str, Any], Iterator[np.ndarray]]:
    """What the hash covers: a JSON head, and little-endian arrays in a fixed order."""
    pose, gains = recording.object_pose, recording.gains
    names = sorted(recording.channels)
    head = {
        "format": "droid_jax recording 1",
        "command": [list(recording.command.shape), list(recording.command_names)],
        "channels": [
            [k, c.unit, list(c.columns), list(c.values.shape)] for k, c in ((k, recording.channels[k]) for k in names)
        ],
        "torque": [recording.torque.side.value, bool(recording.torque.gravity)],
        "qpos0": {joint: float(q) for joint, q in recording.qpos0.items()},
        "gains": None if gains is None else [_numbers(gains.stiffness), _numbers(gains.damping)],
        "phases": [[p.name, float(p.start), float(p.end)] for p in recording.phases],
        "object_pose": None
        if pose is None
        else [_numbers(a) for a in (pose.position, pose.quaternion, pose.covariance)],
    }

    def arrays() -> Iterator[np.ndarray]:
        yield recording.time.astype("<f8")
        yield recording.command.astype("<f8")
        for c in (recording.channels[k] for k in names):
            yield c.time.astype("<f8")
            yield np.where(c.mask, c.values, 0.0).astype("<f8")
            yield c.mask.astype("u1")

    return head, arrays()


def _numbers(array: np.ndarray) -> list[Any]:
    return np.asarray(array, dtype=np.float64).tolist()


def validate(recording: Recording, *, source: str = "", allow_jitter: bool = False) -> Recording:
    """The recording itself, or ValueError that says what is wrong and where.

    source:       file or folder the recording came from, for the message; its name otherwise.
    allow_jitter: accept clocks whose steps differ from their median by more than half of it.
    Rows and repeats in messages count from 0, as numpy does.
    """
    where = source or f"recording {recording.name!r}"
    _check_command(recording, where, allow_jitter)
    if not recording.channels:
        raise ValueError(f"{where}: empty, expected at least one measured channel")
    for key, channel in recording.channels.items():
        _check_channel(channel, key, where, allow_jitter)
    _check_repeats(recording, where)
    _check_clocks_meet(recording, where)
    for joint, q in recording.qpos0.items():
        if not np.isfinite(q):
            raise ValueError(f"{where}: qpos0 of joint {joint!r} must be a finite number, got {q}")
    _check_phases(recording, where)
    if recording.gains is not None:
        _check_gains(recording.gains, recording.command_names, where)
    if recording.object_pose is not None:
        _check_pose(recording.object_pose, where)
    return recording


def check_clock(
    time: np.ndarray,
    where: str,
    *,
    allow_jitter: bool = False,
    label: Callable[[int], str] = lambda i: f"row {i}",
) -> None:
    """ValueError unless time [T] is finite, in seconds, strictly increasing and regular.

    where: what the clock belongs to; label: row index -> how the message calls that row.
    """
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise ValueError(f"{where}, {label(int(bad[0]))}: time must be finite, got {time[bad[0]]}")
    steps = np.diff(time.astype(np.float64))
    bad = np.flatnonzero(steps <= 0)
    if bad.size:
        i = int(bad[0]) + 1
        what = "repeats" if steps[i - 1] == 0 else "goes backwards:"
        raise ValueError(
            f"{where}, {label(i)}: time must increase, it {what} {float(time[i])!r} s after {float(time[i - 1])!r} s"
        )
    _check_seconds(time, steps, where)
    if steps.size and not allow_jitter:
        typical = float(np.median(steps))
        i = int(np.argmax(np.abs(steps - typical)))
        if abs(steps[i] - typical) > _JITTER * typical:
            raise ValueError(
                f"{where}, {label(i + 1)}: irregular rate, a step of {steps[i]:.6g} s where "
                f"{typical:.6g} s is usual; resample the log or pass allow_jitter=True"
            )


def _check_seconds(time: np.ndarray, steps: np.ndarray, where: str) -> None:
    """ValueError when the numbers of a clock can hardly be seconds since the start."""
    hint = "time must be in seconds; is it in milliseconds, microseconds or nanoseconds?"
    if not steps.size:
        return
    duration, typical = float(time[-1] - time[0]), float(np.median(steps))
    if duration > _DAY:
        raise ValueError(f"{where}: the clock runs over {duration:.6g} s, more than a day; {hint}")
    # At or above, not only above: a 1 kHz log in milliseconds has steps of exactly 1.
    if typical >= 1.0 - _SLACK:
        raise ValueError(f"{where}: the clock's usual step is {typical:.6g} s, 1 s or more; {hint}")
    if typical < 1e-5:
        raise ValueError(f"{where}: the clock's usual step is {typical:.3g} s, below 1e-5 s; {hint}")
    if abs(float(time[0])) > _DAY:
        raise ValueError(
            f"{where}: the clock starts at {float(time[0]):.6g} s, more than a day from 0; "
            "subtract the time of the first command from every clock"
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
    twice = sorted({str(n) for n in names if list(names).count(n) > 1})
    if twice:
        raise ValueError(f"{where}: {what} must be unique, repeated: {', '.join(twice)}")
    if not all(isinstance(n, str) and n for n in names):
        raise ValueError(f"{where}: {what} must be non-empty names, got {list(names)}")


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
    if channel.name != key or not re.fullmatch(r"[A-Za-z]\w*", key):
        raise ValueError(f"{here}: a channel's name must be an identifier and equal its key, got {channel.name!r}")
    if not channel.unit or channel.unit.startswith("deg"):
        raise ValueError(f"{here}: expected an SI unit such as 'N m', 'rad' or 'm', got {channel.unit!r}")
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
        if not p.start < p.end:
            raise ValueError(f"{where}: phase {p.name!r} must start before it ends, got {p.start} .. {p.end} s")
        if p.start < first - _SLACK or p.end > last + _SLACK:
            raise ValueError(
                f"{where}: phase {p.name!r} ({p.start:g} .. {p.end:g} s) lies outside the "
                f"recording ({first:g} .. {last:g} s)"
            )


def _check_gains(gains: ServoGains, names: Sequence[str], where: str) -> None:
    for what, array in (("stiffness", gains.stiffness), ("damping", gains.damping)):
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


def check_joints(recording: Recording, joints: Sequence[str]) -> None:
    """ValueError unless the recording speaks of exactly these robot joints, in any order.

    The command must have a column for each of them; in a log without commands the torque,
    position and velocity channels together must.  No such column may bear another name; other
    channels (a door's angle) are not looked at.
    """
    where = f"recording {recording.name!r}"
    known = {k: recording.channels[k].columns for k in JOINT_CHANNELS if k in recording.channels}
    if recording.command_names:
        parts = {"command": recording.command_names}
        have = recording.command_names
    else:
        parts = {}
        have = tuple(dict.fromkeys(j for columns in known.values() for j in columns))
    missing = [j for j in joints if j not in have]
    unknown = [j for j in have if j not in joints]
    if missing or unknown:
        what = "command" if parts else "its channels"
        raise ValueError(
            f"{where}, {what}: expected {len(joints)} joints, got {len(have)}; "
            f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}; "
            f"valid names: {', '.join(joints)}"
        )
    for key, columns in known.items():
        unknown = [j for j in columns if j not in joints]
        if unknown:
            raise ValueError(
                f"{where}, channel {key!r}: unknown joints {', '.join(unknown)}; valid names: {', '.join(joints)}"
            )
