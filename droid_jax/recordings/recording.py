"""A demonstration and its measured repeats: `Recording`.

One motion is commanded once per repeat.  The command is the same in all repeats; the measurements differ.  Every
channel keeps its own clock, so that a recording can hold a door angle filmed at 30 Hz and torques at 1 kHz.  Values
that were not measured are masked, never filled in.  `recordings.checks` validates recordings.
"""

from __future__ import annotations

import enum
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from droid_jax.arguments import check_fields, choice, flag, is_list, lists_of_numbers, mapping, number, shown, whole
from droid_jax.recordings.clocks import SLACK

LATEST_START = 0.1  # s after the first command: the initial position is that of a channel which begins by then
JOINT_CHANNELS = ("torque", "position", "velocity")  # channels whose columns are robot joints
POSITION_CHANNELS = ("position", "object_angle")  # channels of joint positions


class TorqueSide(enum.Enum):
    """Where a torque was measured; armature, damping and motor friction act between the two sides."""

    MOTOR = "motor"  # what the motor produces (MuJoCo's qfrc_actuator, a motor current)
    LINK = "link"  # what arrives behind the gear (a joint torque sensor, a Panda's tau_J)


JITTER = "allow_jitter"  # in `meta` of a recording whose irregular clocks were accepted


@dataclass(frozen=True)
class TorqueConvention:
    """What the torque channel holds.

    side:    motor or link side of the gear; "motor" or "link" is converted.
    gravity: True when the measured torque contains the torque that carries the arm's weight.
    """

    side: TorqueSide
    gravity: bool

    def __post_init__(self) -> None:
        check_fields(self, side=partial(choice, kind=TorqueSide), gravity=flag)


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

    stiffness: [U] N m/rad (N/m for slides).
    damping: [U] N m s/rad (N s/m for slides); None where it is not known, so that a replay uses the scene's.
    """

    stiffness: np.ndarray
    damping: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ObjectPose:
    """Pose of the object in the robot's base frame, and its uncertainty.

    position: [3] m; quaternion: [4] unit, w x y z; covariance: [6, 6] in m and rad.
    """

    position: np.ndarray
    quaternion: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """One demonstration and its N repeats.

    Attributes:
        name: for tables and file names; not part of the content hash.
        time: [T] s, the command clock, strictly increasing.
        command: [T, U] position command, rad or m; T = U = 0 for a log without commands.
        command_names: U joint names.
        channels: name -> Channel; all share N.
        torque: what the torque channel holds.
        qpos0: joint name -> position at the start, rad or m. Joints not named start at their first measured
            position, else at their first command, else at the scene's position.
        gains: servo gains, when known.
        known: parameter name -> known value in this recording, in the parameter's unit (a payload that was weighed);
            or -> name of the parameter to use in its place. The replay uses it whatever is fitted.
        variant: field of MjModel -> element -> its number or numbers in this recording, where its MJCF has others than
            the one that is fitted: another pose of the base, another mass of a body (`model.variant`).
        phases: named parts of the motion.
        object_pose: pose of the manipulated object, when known.
        meta: free notes; not part of the content hash.
    """

    name: str
    time: np.ndarray
    command: np.ndarray
    command_names: tuple[str, ...]
    channels: Mapping[str, Channel]
    torque: TorqueConvention
    qpos0: Mapping[str, float] = field(default_factory=dict[str, float])
    gains: ServoGains | None = None
    known: Mapping[str, float | str] = field(default_factory=dict[str, float | str])
    variant: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])
    phases: tuple[Phase, ...] = ()
    object_pose: ObjectPose | None = None
    meta: Mapping[str, str] = field(default_factory=dict[str, str])

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

        Numbers enter as float64 and masked-out values as zero.  The stored precision and the numbers in unmeasured
        cells therefore do not change the hash.
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
        except (KeyError, TypeError):
            have = ", ".join(sorted(self.channels))
            raise ValueError(f"unknown channel {shown(name)}; recording {self.name!r} has: {have}") from None

    @property
    def grip_window(self) -> tuple[float, float] | None:
        """From the end of phase "grasp" to the beginning of "release" or the last command, s; None without a grasp."""
        named = {p.name: p for p in self.phases}
        if "grasp" not in named:
            return None
        end = named["release"].start if "release" in named else self.time[-1]
        return named["grasp"].end, float(end)

    def measured_start(self) -> dict[str, float]:
        """Joint -> measured position at the beginning of the motion, rad or m, mean over the repeats."""
        first = float(self.time[0]) if len(self.time) else self.span[0]
        return _measured_at(self, first, LATEST_START)

    def repeats_subset(self, indices: Sequence[int]) -> Recording:
        """A copy with these repeats only, as for training or held-out repeats.

        Raises:
            ValueError: no index is given, or one lies outside 0 .. N - 1.
        """
        if not is_list(indices):
            raise ValueError(f"repeats must be a list of whole numbers, got {shown(indices)}")
        chosen = [whole(i, "a repeat") for i in indices]
        bad = [i for i in chosen if not 0 <= i < self.repeats]
        if not chosen or bad:
            raise ValueError(f"repeats must be out of 0 .. {self.repeats - 1}, got {bad if bad else 'none'}")
        channels = {key: replace(c, values=c.values[chosen], mask=c.mask[chosen]) for key, c in self.channels.items()}
        return replace(self, channels=channels)

    def window(self, start: float, end: float, *, qpos0: Mapping[str, float] | None = None) -> Recording:
        """The part from start to end (s, both included); instants keep their values.

        Args:
            start, end: s.
            qpos0: initial positions of the window, rad or m.  Joints that are not named take the measured position
                at the start (mean over repeats).

        Raises:
            ValueError: the window is empty for the command or a channel, or a joint's position at its start is neither
                given nor measured.
        """
        start, end = number(start, "start of a window"), number(end, "end of a window")
        if qpos0 is not None:
            given = mapping(qpos0, "qpos0").items()
            qpos0 = {str(joint): number(q, f"qpos0, joint {shown(joint)}") for joint, q in given}
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
        begin = max(start, float(self.time[rows][0])) if len(self.time) else start  # where a replay begins
        cut = replace(
            self, time=self.time[rows], command=self.command[rows], channels=channels, phases=(),
            qpos0=_positions_at(self, begin, qpos0 or {}),
        )  # fmt: skip
        first, last = cut.span  # of the instants that are kept
        inside = (replace(p, start=max(p.start, start, first), end=min(p.end, end, last)) for p in self.phases)
        return replace(cut, phases=tuple(p for p in inside if p.start < p.end))


def recordings_of(given: Any) -> tuple[Recording, ...]:
    """One recording or several as a tuple; ValueError where there is none, or where file names are given instead."""
    if isinstance(given, Recording):
        return (given,)
    if not is_list(given):
        given = [given]
    out = tuple(given)
    if not out:
        raise ValueError("no recording to fit: give one, or several")
    for one in out:
        if not isinstance(one, Recording):
            raise ValueError(f"expected a Recording, got {shown(one)}; load_recording reads one from a file or folder")
    return out


def _rows(time: np.ndarray, start: float, end: float) -> np.ndarray:
    """Whether each instant lies in the window, [T] bool."""
    return (time >= start - SLACK) & (time <= end + SLACK)


def _outside(what: str, time: np.ndarray, start: float, end: float) -> str:
    return f"window {start} .. {end} s holds too little of {what}, which runs {time[0]:g} .. {time[-1]:g} s"


def _positions_at(recording: Recording, start: float, given: Mapping[str, float]) -> dict[str, float]:
    """Joint positions at an instant, for the joints of qpos0 and those given.

    In a log without commands, joints that were never measured are assumed to stand still.  Joints that were measured,
    but not at this instant, are left out.
    """
    first = float(recording.time[0]) if len(recording.time) else recording.span[0]
    if start <= first + SLACK:
        return {**recording.qpos0, **given}
    measured = _measured_at(recording, start)
    positions = {**{j: measured[j] for j in recording.qpos0 if j in measured}, **given}
    if not recording.command.size:
        seen = {j for k in POSITION_CHANNELS if k in recording.channels for j in recording.channels[k].columns}
        positions = {**{j: q for j, q in recording.qpos0.items() if j not in seen}, **positions}
    lacking = [j for j in recording.qpos0 if j not in positions]
    if lacking and recording.command.size:
        raise ValueError(
            f"a window from {start} s needs initial positions that were not measured: "
            f"{', '.join(lacking)}; begin it at the recording's start, or state them (window(..., qpos0=...))"
        )
    return positions


def _measured_at(recording: Recording, instant: float, slack: float = SLACK) -> dict[str, float]:
    """Joint -> measured position at an instant, mean over the repeats that were measured within `slack` s of it."""
    measured: dict[str, float] = {}
    for channel in (recording.channels[k] for k in POSITION_CHANNELS if k in recording.channels):
        for c, joint in enumerate(channel.columns):
            found = [_interpolate(channel, r, c, instant, slack) for r in range(recording.repeats)]
            found = [v for v in found if v is not None]
            if found and joint not in measured:  # prefers the joint's own sensor to a camera
                measured[joint] = float(np.mean(found))
    return measured


def _interpolate(channel: Channel, repeat: int, column: int, at: float, slack: float) -> float | None:
    """One column's value at an instant, or None more than `slack` s outside what was measured."""
    seen = channel.mask[repeat, :, column]
    time: np.ndarray = channel.time[seen]
    if not len(time) or not time[0] - slack <= at <= time[-1] + slack:
        return None
    values: np.ndarray = channel.values[repeat, seen, column]
    return float(np.interp(at, time, values))


def known_values(recording: Recording) -> dict[str, float | str]:
    """`Recording.known` as plain data."""
    return {of: value if isinstance(value, str) else float(value) for of, value in recording.known.items()}


def _content(recording: Recording) -> tuple[dict[str, Any], Iterator[np.ndarray]]:
    """The content that is hashed: a JSON head, and little-endian arrays in a fixed order."""
    pose, gains = recording.object_pose, recording.gains
    names = sorted(recording.channels)
    head: dict[str, Any] = {
        "format": "droid_jax recording 1",
        "command": [list(recording.command.shape), list(recording.command_names)],
        "channels": [
            [k, c.unit, list(c.columns), list(c.values.shape)] for k, c in ((k, recording.channels[k]) for k in names)
        ],
        "torque": [recording.torque.side.value, bool(recording.torque.gravity)],
        "qpos0": {joint: float(q) for joint, q in recording.qpos0.items()},
        "gains": None
        if gains is None
        else [_numbers(gains.stiffness), None if gains.damping is None else _numbers(gains.damping)],
        "phases": [[p.name, float(p.start), float(p.end)] for p in recording.phases],
        "object_pose": None
        if pose is None
        else [_numbers(a) for a in (pose.position, pose.quaternion, pose.covariance)],
    }
    if recording.known:  # left out when empty, so that hashes of older recordings stay the same
        head["known"] = known_values(recording)
    if recording.variant:
        head["variant"] = lists_of_numbers(recording.variant)

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
