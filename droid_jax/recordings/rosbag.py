"""Recordings from ROS bags: one bag per repeat, ROS 1 or ROS 2.

The joint state topic gives torque (effort), position and velocity; an optional command topic gives the position
command.  Every bag starts at its first command, or without a command topic at its first joint state.  All bags are
interpolated onto one uniform clock.  Repeats are in the order in which they were recorded.  Samples that fall into a
gap of the log are masked.
"""

from __future__ import annotations

import enum
import itertools
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from droid_jax.recordings.alignment import common_clock, one_command, start_positions, warn_of_rate
from droid_jax.recordings.bag_messages import FIELDS, GAINS, Wanted
from droid_jax.recordings.bag_topics import Track, read_bag
from droid_jax.recordings.checks import UNITS, validate
from droid_jax.recordings.clocks import check_clock, in_gap, interpolate
from droid_jax.recordings.recording import Channel, Phase, Recording, ServoGains, TorqueConvention, TorqueSide


class Stamps(enum.Enum):
    """Which time stamp of a message is used."""

    AUTO = "auto"  # header stamps where all messages used have one, else BAG
    HEADER = "header"  # when the message was made
    BAG = "bag"  # when the recorder received it


STATE, COMMAND = "state", "command"  # keys of the two topics that are read from a bag
UNUSED_SETPOINTS = (
    "unused_setpoints"  # in `meta`: kinds of set-points that the commands hold and the recording does not
)
_Timed = tuple[np.ndarray, dict[str, np.ndarray]]  # stamps [M] s, and values [M, J] by field


def read_bags(
    paths: Sequence[str | os.PathLike[str]],
    *,
    joints: Sequence[str] | Mapping[str, str],
    slides: Sequence[str] = (),
    torque: TorqueConvention | None,
    state_topic: str = "/joint_states",
    command_topic: str | None = None,
    command_joints: Sequence[str] | Mapping[str, str] | None = None,
    motors: Sequence[int] | None = None,
    velocity_actuators: Sequence[str] = (),
    effort_actuators: Sequence[str] = (),
    rate: float | None = None,
    stamps: Stamps = Stamps.AUTO,
    command_tolerance: float = 5e-3,
    name: str | None = None,
    qpos0: Mapping[str, float] | None = None,
    gains: ServoGains | None = None,
    phases: Sequence[Phase] = (),
    allow_jitter: bool = False,
) -> Recording:
    """Reads one bag per repeat into a Recording.

    The repeats are in the order of recording, or in that of `paths` where the bags' times overlap.

    Args:
        paths: the bags.
        joints: measured joints, in the order wanted; a mapping gives each joint's name in the messages.
        slides: those of the joints that slide, which a bag does not state.
        torque: convention of the efforts, which a bag does not state; None: efforts are not read.
        state_topic: its messages are of a type in `bag_messages.STATES`.
        command_topic: its messages are of a type in `bag_messages.COMMANDS`.  From the state of a controller, the
            reference is read.  None for a log without commands.  It may be the state topic, where messages hold both.
        command_joints: commanded joints, in the order of the numbers in messages without names; a mapping gives names
            in the messages.  `joints` by default.
        motors: positions of the joints, from 0, in messages without names that hold more numbers than joints.
        velocity_actuators, effort_actuators: names in the MJCF of the actuators, one per commanded joint, that take
            the commands' set-points of velocity and effort.
        rate: Hz of the common clock; by default that of the median step of the first bag's joint states.
        stamps: which time stamps are used.
        command_tolerance: rad or m by which the repeats' commands may differ (jitter of arrival).
        name: of the recording; by default that of the first bag's file.
        qpos0: initial positions, rad or m, that replace the measured ones.
        gains: servo gains of the recording; by default those that the commands themselves state.
        phases: named parts of the motion, s from each bag's start.
        allow_jitter: accept stamps at an irregular rate.

    Raises:
        FileNotFoundError: a bag does not exist.
        ValueError: a topic or joint is missing, a topic has no messages, efforts are not finite, stamps do not
            increase, commands differ between repeats, or the bags have no common part.  The message names the bag.
    """
    bags = _bags(paths)
    sent = joints if command_joints is None else command_joints
    asked = _asked(joints, slides, torque is not None, state_topic, command_topic, sent, motors)
    joints, command_joints = tuple(joints), tuple(sent)
    extra = {"velocity": tuple(velocity_actuators), "effort": tuple(effort_actuators)}
    _check_actuators(extra, command_joints, command_topic)
    tracks = [read_bag(bag, asked) for bag in bags]
    order = _as_recorded([track[STATE].received for track in tracks])
    bags, tracks = [bags[i] for i in order], [tracks[i] for i in order]
    use_header = _use_header(tracks, stamps, bags)

    timed = [_timed(track, asked, use_header, bag, allow_jitter) for track, bag in zip(tracks, bags, strict=True)]
    states = [topics[STATE] for topics in timed]
    commands = [] if command_topic is None else [topics[COMMAND] for topics in timed]
    clock = _clock(states, rate, bags)

    channels = _channels(states, clock, joints, slides, torque is not None, bags)
    command, command_names = np.zeros((0, 0)), ()
    warn_of_rate(states[0][0], rate, bags[0])
    unused = _unused(commands, command_topic, extra)
    if commands:
        command = _command(commands, clock, command_joints, command_tolerance, bags)
        command_names = (*command_joints, *extra["velocity"], *extra["effort"])
        more = [_setpoints(commands[0], clock, field, bags[0]) for field, names in extra.items() if names]
        command = np.concatenate([command, *more], axis=1)
        gains = _sent_gains(commands, extra, bags) if gains is None else _of_all(gains, command_joints, command_names)
    recording = Recording(
        name=name or bags[0].stem,
        time=clock if commands else np.zeros(0),
        command=command,
        command_names=command_names,
        channels=channels,
        torque=torque or TorqueConvention(TorqueSide.MOTOR, gravity=True),
        qpos0={**start_positions(channels), **(qpos0 or {})},
        gains=gains,
        phases=tuple(phases),
        meta={
            "bags": ", ".join(bag.name for bag in bags),
            "stamps": "header" if use_header else "bag",
            "state_topic": state_topic,
            "command_topic": command_topic or "",
            **({UNUSED_SETPOINTS: ", ".join(unused)} if unused else {}),
        },
    )
    return validate(recording, source=", ".join(str(bag) for bag in bags))


def _check_actuators(
    extra: Mapping[str, tuple[str, ...]], command_joints: Sequence[str], command_topic: str | None
) -> None:
    """ValueError where actuators are named without a command topic, or not one for each commanded joint."""
    for field, names in extra.items():
        if names and command_topic is None:
            raise ValueError(f"{field}_actuators take set-points of commands: give --command-topic too")
        if names and len(names) != len(command_joints):
            raise ValueError(
                f"{field}_actuators must be {len(command_joints)}, one for each of {', '.join(command_joints)}, got "
                f"{', '.join(names)}"
            )


def _setpoints(command: _Timed, clock: np.ndarray, field: str, bag: Path) -> np.ndarray:
    """Set-points [T, U] of velocity or effort at instants [T] s; ValueError where the commands hold none."""
    time, fields = command
    if field not in fields or not np.isfinite(fields[field]).all():
        raise ValueError(f"{bag}: the command messages hold no {field} for the {field} actuators, or not throughout")
    return interpolate(clock, time, fields[field])


def _of_all(gains: ServoGains, joints: Sequence[str], actuators: Sequence[str]) -> ServoGains:
    """Gains of the commanded joints, with 0 for the actuators behind them that are no servos; unchanged if of all."""
    if len(gains.stiffness) != len(joints):
        return gains
    more = np.zeros(len(actuators) - len(joints))
    damping = None if gains.damping is None else np.r_[gains.damping, more]
    return ServoGains(np.r_[gains.stiffness, more], damping)


def _sent_gains(
    commands: Sequence[_Timed], extra: Mapping[str, tuple[str, ...]], bags: Sequence[Path]
) -> ServoGains | None:
    """Gains that the commands themselves state, as unitree's do, for all actuators; None where they state none.

    A robot that adds kp (q_d - q), kd (v_d - v) and a torque is a <position>, a <velocity> and a <motor> at the joint.
    """
    if not all(gain in fields for _, fields in commands for gain in GAINS):
        return None
    first = {gain: commands[0][1][gain][0] for gain in GAINS}
    for bag, (_, fields) in zip(bags, commands, strict=True):
        if any(np.any(fields[gain] != first[gain]) for gain in GAINS):
            warnings.warn(
                f"{bag}: the commands change their gains kp or kd on the way: the recording states none, and a replay "
                "uses those of the scene; cut the log to a part with constant gains",
                stacklevel=3,
            )
            return None
    count, velocity, effort = len(first["kp"]), len(extra["velocity"]), len(extra["effort"])
    stiffness = [*first["kp"], *(first["kd"][:velocity]), *np.ones(effort)]
    damping = [*(np.zeros(count) if velocity else first["kd"]), *np.zeros(velocity + effort)]
    return ServoGains(np.array(stiffness), np.array(damping))


def _unused(commands: Sequence[_Timed], topic: str | None, extra: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Kinds of set-points that the command messages hold and the recording does not; warns where there are some."""
    found = [
        field
        for field in ("velocity", "effort")
        if not extra[field] and any(np.any(np.nan_to_num(fields[field])) for _, fields in commands if field in fields)
    ]
    if found:
        warnings.warn(
            f"the commands on {topic} have set-points of {' and '.join(found)} beside the positions, and these are "
            "not used: the servo follows them and lags less than its replay, which looks like damping or a delay; name "
            "the actuators of the MJCF that take them, --velocity-actuators, --effort-actuators",
            stacklevel=3,
        )
    return found


def _bags(paths: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """The bags, or ValueError where there is none or one is there twice."""
    bags = [Path(p) for p in paths]
    if not bags:
        raise ValueError("expected one ROS bag per repeat, got none")
    if twice := [bag for i, bag in enumerate(bags) if bag.resolve() in [other.resolve() for other in bags[:i]]]:
        raise ValueError(f"{twice[0]}: given twice; every bag must be another repeat")
    return bags


def _asked(
    joints: Sequence[str] | Mapping[str, str],
    slides: Sequence[str],
    torque: bool,
    state_topic: str,
    command_topic: str | None,
    command_joints: Sequence[str] | Mapping[str, str],
    motors: Sequence[int] | None,
) -> dict[str, Wanted]:
    """The arguments of `read_bag`: what to read from each topic.

    torque: whether efforts are read.  ValueError where slides or motors do not belong to the joints.
    """
    if strange := [slide for slide in slides if slide not in joints]:
        raise ValueError(f"slides must be among the joints {', '.join(joints)}, got {', '.join(strange)}")
    if motors is not None and len(motors) != len(joints):
        raise ValueError(f"motors must be {len(joints)} numbers, one for each joint, got {len(motors)}")
    place = None if motors is None else dict(zip(joints, motors, strict=True))
    shared = state_topic == command_topic
    needed = "effort" if torque else "position"
    own = None if place is None else tuple(place.values())
    asked = {STATE: Wanted(state_topic, _in_messages(joints), needed, "state", own, shared)}
    if command_topic is None:
        return asked
    if place is not None and (unknown := [joint for joint in command_joints if joint not in place]):
        raise ValueError(
            f"motors must name the commanded joints too, but {', '.join(unknown)} are not among the measured ones"
        )
    sent = None if place is None else tuple(place[joint] for joint in command_joints)
    return {**asked, COMMAND: Wanted(command_topic, _in_messages(command_joints), "position", "command", sent, shared)}


def _in_messages(joints: Sequence[str] | Mapping[str, str]) -> tuple[str, ...]:
    """Names of joints in the messages."""
    return tuple(joints.values()) if isinstance(joints, Mapping) else tuple(joints)


def _as_recorded(received: Sequence[np.ndarray]) -> list[int]:
    """Order of the bags by time of recording, from their recorder's stamps [M] ns.

    Where the times of bags overlap, the given order is returned: their clocks cannot be compared, as in simulations
    that each begin at zero.
    """
    order = sorted(range(len(received)), key=lambda i: received[i][0])
    apart = all(received[i][-1] < received[j][0] for i, j in itertools.pairwise(order))
    return order if apart else list(range(len(received)))


def _use_header(tracks: Sequence[Mapping[str, Track]], stamps: Stamps, bags: Sequence[Path]) -> bool:
    """Whether header stamps are used, for all topics alike: two clocks would shift the topics."""
    bare = [(bag, t[key].topic) for bag, t in zip(bags, tracks, strict=True) for key in t if t[key].stamped is None]
    if stamps is Stamps.HEADER and bare:
        raise ValueError(
            f"{bare[0][0]}, topic {bare[0][1]!r}: messages have no header stamp; use --stamps bag (Stamps.BAG)"
        )
    return stamps is not Stamps.BAG and not bare


def _timed(
    tracks: Mapping[str, Track], asked: Mapping[str, Wanted], use_header: bool, bag: Path, allow_jitter: bool
) -> dict[str, _Timed]:
    """Per topic the checked stamps [M] s and the fields; time 0 is the first command, or without it the first state."""

    def stamps(track: Track) -> np.ndarray:
        return track.stamped if use_header and track.stamped is not None else track.received

    start = stamps(tracks[COMMAND if COMMAND in tracks else STATE])[0]
    timed = {}
    for key, track in tracks.items():
        time = 1e-9 * (stamps(track) - start)
        where = f"{bag}, topic {asked[key].topic!r} ({'header' if use_header else 'bag'} stamps)"
        _check_trajectories(time, track.numbers, where)
        # Commands may pause while the robot holds still, or be waypoints seconds apart: their rate is not checked.
        state = key == STATE
        jitter = allow_jitter or not state
        check_clock(
            time,
            where,
            allow_jitter=jitter,
            seconds=state,
            label=lambda i, n=track.numbers: f"message {n[i]}",
            remedy="--stamps bag (Stamps.BAG) takes the recorder's" if use_header else "",
        )
        timed[key] = (time, track.fields)
    return timed


def _check_trajectories(time: np.ndarray, numbers: Sequence[int], where: str) -> None:
    """ValueError where a message begins before the trajectory of the previous one ends.

    time: instants [M] s of the points.  numbers: message of each point.
    """
    for row in range(2, len(numbers)):
        several = numbers[row - 1] == numbers[row - 2]
        if several and numbers[row] != numbers[row - 1] and time[row] <= time[row - 1]:
            raise ValueError(
                f"{where}, message {numbers[row]}: begins before the trajectory of message {numbers[row - 1]} has "
                "ended, and this topic does not show how the controller combined them: read its state, "
                "--command-topic .../controller_state (JointTrajectoryControllerState)"
            )


def _clock(states: Sequence[_Timed], rate: float | None, bags: Sequence[Path]) -> np.ndarray:
    """Uniform instants [T] s, multiples of one step, over the part from 0 on that all repeats cover."""
    for bag, (time, _) in zip(bags, states, strict=True):
        if len(time) < 2 or time[-1] <= 0:
            raise ValueError(
                f"{bag}: needs two joint states or more after the first command; there are {len(time)}, from "
                f"{time[0]:.3f} to {time[-1]:.3f} s of it (are the header stamps of two clocks? then --stamps bag)"
            )
    return common_clock([time for time, _ in states], rate, bags)


def _channels(
    states: Sequence[_Timed],
    clock: np.ndarray,
    joints: tuple[str, ...],
    slides: Sequence[str],
    torque: bool,
    bags: Sequence[Path],
) -> dict[str, Channel]:
    """Those channels of torque, position and velocity that all bags hold, on the common clock.

    torque: whether it is read; ValueError where a bag then has none.
    """
    lacking = [bag for bag, (_, fields) in zip(bags, states, strict=True) if "effort" not in fields]
    if lacking and torque:
        raise ValueError(
            f"{lacking[0]}: the joint states hold no effort, so there is no torque to compare (--torque none reads "
            "positions alone)"
        )
    channels = {}
    for name, field in FIELDS.items():
        if not all(field in fields for _, fields in states) or (name == "torque" and not torque):
            continue
        values = np.stack([interpolate(clock, t, fields[field]) for t, fields in states])
        seen = np.stack([~in_gap(clock, t) for t, _ in states])
        mask = seen[:, :, None] & np.isfinite(values)
        if not mask.any(axis=(1, 2)).all():  # a driver that does not measure a field sends NaN
            continue
        hinge, slide = UNITS[name]
        unit = " or ".join(dict.fromkeys(slide if joint in slides else hinge for joint in joints))
        channels[name] = Channel(name, unit, joints, clock, values, mask)
    return channels


def _command(
    commands: Sequence[_Timed],
    clock: np.ndarray,
    joints: tuple[str, ...],
    tolerance: float,
    bags: Sequence[Path],
) -> np.ndarray:
    """The first bag's command [T, U]; ValueError when another bag's differs by more than the tolerance."""
    for bag, (_, fields) in zip(bags, commands, strict=True):
        if "position" not in fields:
            raise ValueError(f"{bag}: the command messages hold no positions")
    every = [interpolate(clock, t, fields["position"]) for t, fields in commands]
    return one_command(every, clock, joints, tolerance, bags)
