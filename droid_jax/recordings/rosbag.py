"""Recordings from ROS bags: one bag per repeat, ROS 1 or ROS 2.

The joint state topic gives torque (effort), position and velocity; an optional command topic
gives the position command.  Every bag starts at its first command (at its first joint state
when there is no command topic), and all are interpolated onto one uniform clock.  Repeats are in
the order in which they were recorded.  Nothing is invented: samples that fall into a gap of the
log are masked out.
"""

from __future__ import annotations

import enum
import itertools
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from droid_jax.recordings.alignment import common_clock, one_command, start_positions
from droid_jax.recordings.bag_messages import FIELDS, GAINS, Wanted
from droid_jax.recordings.bag_topics import Track, read_bag
from droid_jax.recordings.checks import UNITS, validate
from droid_jax.recordings.clocks import check_clock, in_gap, interpolate
from droid_jax.recordings.recording import Channel, Phase, Recording, ServoGains, TorqueConvention, TorqueSide


class Stamps(enum.Enum):
    """Which time stamp of a message counts."""

    AUTO = "auto"  # header stamps where all messages used have one, else BAG
    HEADER = "header"  # when the message was made
    BAG = "bag"  # when the recorder received it


STATE, COMMAND = "state", "command"  # keys of what is read of a bag
UNUSED = "unused_setpoints"  # in `meta`: what the commands held beside positions
DRIFT = 0.03  # s by which a log at its nominal rate may be off at its end unremarked
NEAR = 0.05  # relative deviation within which a stated rate is meant to be that of the stamps
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

    joints:            measured joints, in the order wanted; a mapping gives each one's name in the messages.
    slides:            those of them that slide; a bag does not say.
    torque:            what the efforts are; a bag does not say.  None: they are not read.
    state_topic:       of a type in `bag_messages.STATES`.
    command_topic:     of a type in `bag_messages.COMMANDS`; of a controller's state, the reference
                       counts.  None reads a log without commands.  It may be the state topic, where
                       a message holds both.
    command_joints:    commanded joints, and the order of numbers in messages without names;
                       `joints` by default.  A mapping as there.
    motors:            places of the joints in messages without names that hold more of them, from 0.
    velocity_actuators, effort_actuators: names in the MJCF of the actuators, one per commanded joint,
                       that take the commands' set-points of velocity and effort.
    rate:              Hz of the common clock; the usual rate of the first bag's joint states
                       by default.
    stamps:            which time stamps count.
    command_tolerance: rad or m by which the repeats' commands may differ (jitter of arrival).
    qpos0:             initial positions to add to, or put in place of, the measured ones.
    gains, phases:     passed on; phases count from each bag's start.
    allow_jitter:      accept stamps at an irregular rate.

    Raises FileNotFoundError for a missing bag and ValueError, naming the bag, for a missing
    topic or joint, a topic without messages, efforts that are not finite, stamps that do not
    increase, commands that differ between repeats, or bags without a common part.
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
    _warn_of_rate(states[0][0], rate, bags[0])
    unused = _unused(commands, command_topic, extra)
    if commands:
        command = _command(commands, clock, command_joints, command_tolerance, bags)
        command_names = (*command_joints, *extra["velocity"], *extra["effort"])
        more = [_setpoints(commands[0], clock, field, bags[0]) for field, names in extra.items() if names]
        command = np.concatenate([command, *more], axis=1)
        gains = gains or _sent_gains(commands, extra, bags)
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
            **({UNUSED: ", ".join(unused)} if unused else {}),
        },
    )
    return validate(recording, source=", ".join(str(bag) for bag in bags))


def _check_actuators(
    extra: Mapping[str, tuple[str, ...]], command_joints: Sequence[str], command_topic: str | None
) -> None:
    """ValueError where actuators are named for set-points that no command has."""
    for field, names in extra.items():
        if names and command_topic is None:
            raise ValueError(f"{field}_actuators take set-points of commands: give --command-topic too")
        if names and len(names) != len(command_joints):
            raise ValueError(
                f"{field}_actuators must be {len(command_joints)}, one for each of {', '.join(command_joints)}, got "
                f"{', '.join(names)}"
            )


def _setpoints(command: _Timed, clock: np.ndarray, field: str, bag: Path) -> np.ndarray:
    """[T, U] set-points of velocity or effort on a clock [T] s; ValueError where the commands hold none."""
    time, fields = command
    if field not in fields or not np.isfinite(fields[field]).all():
        raise ValueError(f"{bag}: the command messages hold no {field} for the {field} actuators, or not throughout")
    return interpolate(clock, time, fields[field])


def _sent_gains(
    commands: Sequence[_Timed], extra: Mapping[str, tuple[str, ...]], bags: Sequence[Path]
) -> ServoGains | None:
    """Gains that the commands themselves state, as unitree's do, with those of the actuators that take the rest.

    A robot that adds kp (q_d - q), kd (v_d - v) and a torque is a <position>, a <velocity> and a <motor> at the joint.
    """
    if not all(gain in fields for _, fields in commands for gain in GAINS):
        return None
    first = {gain: commands[0][1][gain][0] for gain in GAINS}
    for bag, (_, fields) in zip(bags, commands, strict=True):
        if any(np.any(fields[gain] != first[gain]) for gain in GAINS):
            warnings.warn(
                f"{bag}: the commands change their gains kp or kd on the way: the recording states none, and a replay "
                "has those of the scene throughout; cut it where they stay the same",
                stacklevel=3,
            )
            return None
    count, velocity, effort = len(first["kp"]), len(extra["velocity"]), len(extra["effort"])
    stiffness = [*first["kp"], *(first["kd"][:velocity]), *np.ones(effort)]
    damping = [*(np.zeros(count) if velocity else first["kd"]), *np.zeros(velocity + effort)]
    return ServoGains(np.array(stiffness), np.array(damping))


def _unused(commands: Sequence[_Timed], topic: str | None, extra: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Set-points other than positions that the command messages hold and the recording does not; they are warned of."""
    found = [
        field
        for field in ("velocity", "effort")
        if not extra[field] and any(np.any(np.nan_to_num(fields[field])) for _, fields in commands if field in fields)
    ]
    if found:
        warnings.warn(
            f"the commands on {topic} have set-points of {' and '.join(found)} beside the positions, and these are "
            "not used: a servo that follows them lags less than its replay, which looks like damping or a delay; name "
            "the actuators of the MJCF that take them, --velocity-actuators, --effort-actuators",
            stacklevel=3,
        )
    return found


def _warn_of_rate(stamps: np.ndarray, rate: float | None, bag: Path) -> None:
    """Warn of a stated rate that is nearly that of the stamps [M] s: who states it may take it for theirs."""
    if not rate or len(stamps) < 3:
        return
    own = (len(stamps) - 1) / float(stamps[-1] - stamps[0])
    late = abs((len(stamps) - 1) / rate - float(stamps[-1] - stamps[0]))
    if late > DRIFT and abs(own / rate - 1.0) < NEAR:
        warnings.warn(
            f"{bag}: the stamps are at {own:.5g} Hz, not at the {rate:g} Hz of --rate; they are used and the log is "
            f"resampled (by its number of samples it would be {late:.2g} s off at the end)",
            stacklevel=3,
        )


def _bags(paths: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """The bags, or ValueError where there is none or one is there twice."""
    bags = [Path(p) for p in paths]
    if not bags:
        raise ValueError("expected one ROS bag per repeat, got none")
    if twice := [bag for i, bag in enumerate(bags) if bag.resolve() in [other.resolve() for other in bags[:i]]]:
        raise ValueError(f"{twice[0]}: given twice; every bag is one repeat of its own")
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
    """What `read_bag` is asked for; torque: whether efforts are.  ValueError where slides are no joints."""
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
        raise ValueError(f"motors say nothing of the commanded joints {', '.join(unknown)}, which are not measured")
    sent = None if place is None else tuple(place[joint] for joint in command_joints)
    return {**asked, COMMAND: Wanted(command_topic, _in_messages(command_joints), "position", "command", sent, shared)}


def _in_messages(joints: Sequence[str] | Mapping[str, str]) -> tuple[str, ...]:
    """Names of joints in the messages."""
    return tuple(joints.values()) if isinstance(joints, Mapping) else tuple(joints)


def _as_recorded(received: Sequence[np.ndarray]) -> list[int]:
    """The bags with these recorder's stamps [M] ns in order of time, or as they are.

    Bags whose times overlap have clocks that do not compare, as simulations that each begin at zero.
    """
    order = sorted(range(len(received)), key=lambda i: received[i][0])
    apart = all(received[i][-1] < received[j][0] for i, j in itertools.pairwise(order))
    return order if apart else list(range(len(received)))


def _use_header(tracks: Sequence[Mapping[str, Track]], stamps: Stamps, bags: Sequence[Path]) -> bool:
    """Whether header stamps count: one choice for all, two clocks would shift the topics."""
    bare = [(bag, t[key].topic) for bag, t in zip(bags, tracks, strict=True) for key in t if t[key].stamped is None]
    if stamps is Stamps.HEADER and bare:
        raise ValueError(
            f"{bare[0][0]}, topic {bare[0][1]!r}: messages have no header stamp; use --stamps bag (Stamps.BAG)"
        )
    return stamps is not Stamps.BAG and not bare


def _timed(
    tracks: Mapping[str, Track], asked: Mapping[str, Wanted], use_header: bool, bag: Path, allow_jitter: bool
) -> dict[str, _Timed]:
    """Checked stamps [M] s since the first command, or without commands the first state, and the fields."""

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
    """ValueError where a message of several points, at times [M] s, was still running when the next one began."""
    for row in range(2, len(numbers)):
        several = numbers[row - 1] == numbers[row - 2]
        if several and numbers[row] != numbers[row - 1] and time[row] <= time[row - 1]:
            raise ValueError(
                f"{where}, message {numbers[row]}: begins before the trajectory of message {numbers[row - 1]} has "
                "ended, and what the controller made of both is not in this topic: read its state, "
                "--command-topic .../controller_state (JointTrajectoryControllerState)"
            )


def _clock(states: Sequence[_Timed], rate: float | None, bags: Sequence[Path]) -> np.ndarray:
    """[T] s, uniform, a multiple of its step, over the part that all repeats cover from 0 on."""
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
    """torque, position and velocity on the common clock, those of them that all bags hold and measured.

    torque: whether it is read, and must be there.
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
        if not mask.any(axis=(1, 2)).all():  # a driver that does not measure it says NaN
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
    """[T, U] the first bag's command; ValueError when another bag's differs by more than tolerance."""
    for bag, (_, fields) in zip(bags, commands, strict=True):
        if "position" not in fields:
            raise ValueError(f"{bag}: the command messages hold no positions")
    every = [interpolate(clock, t, fields["position"]) for t, fields in commands]
    return one_command(every, clock, joints, tolerance, bags)
