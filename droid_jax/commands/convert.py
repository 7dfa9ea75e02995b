"""`convert`: logs of any format into a recording."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from collections.abc import Callable

    from droid_jax.recordings.recording import Phase, Recording

SHARED = (
    "joints", "slides", "torque", "gravity", "stiffness", "damping", "command_tolerance", "rate", "phases"
)  # fmt: skip
OF_BAGS = (
    *SHARED, "state_topic", "command_topic", "command_joints", "motors", "velocity_actuators", "effort_actuators",
    "stamps",
)  # fmt: skip
OF_LOGS = (*SHARED, "map", "columns", "units", "episodes")


@dataclass(frozen=True)
class Convert:
    """Read a log, check it, and write a recording for the other commands.

    Logs are ROS bags, tables (CSV, parquet), npz and HDF5 files, .pt files of torch.save, LeRobot datasets, and CSV
    folders.  Most state neither the meaning of their columns and torques nor the servo gains: state them here or in a
    map.
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Bags, tables or other logs, one per repeat (or folders of bags); a CSV folder; or an npz file."""
    out: Path = Path("runs/recording.npz")
    """File (npz) or folder (CSV) to write."""
    name: str | None = None
    """Name of the recording in runs and pages. Default: the stored name, or for bags and logs that of --out."""
    map: Path | None = None
    """Tables, npz, HDF5, .pt, LeRobot: a column map, a TOML file (docs/file-formats.md), or a known layout by its name:
    droid, robomimic, pace. Default: the map of an earlier log beside --out, or a layout that matches."""
    columns: tuple[str, ...] = ()
    """Entries of a map, or changes of the given one, as CHANNEL=COLUMN: time, command, position, velocity, torque,
    object_angle. E.g. position=q{n}, which takes q1, q2, ..., or position=state[0:6]. powered=COLUMN: 0 where the
    motors are off."""
    units: tuple[str, ...] = ()
    """Units of those columns as KIND=UNIT, e.g. angle=deg time=ms torque=mA length=mm force=N."""
    episodes: tuple[str, ...] = ()
    """LeRobot: numbers of the episodes; HDF5: groups, e.g. data/demo_0. Each is one repeat."""
    joints: tuple[str, ...] = ()
    """Measured joints, in the order wanted. Of bags also as NAME=NAME_IN_THE_MESSAGES, e.g. joint1=panda_joint1."""
    slides: tuple[str, ...] = ()
    """Prismatic joints among --joints: N, m and m/s instead of N m, rad and rad/s."""
    torque: Literal["motor", "link", "none"] | None = None
    """Where the torque was measured: motor (current, actuator force) or link (a sensor behind the gear, a Panda's
    tau_J). none: the torque is not read."""
    gravity: bool = False
    """The torque includes gravity compensation of the arm. If a map states this, the option cannot revoke it: edit the
    map."""
    torque_constant: tuple[float, ...] = ()
    """Torque at the joint, N m (N), per unit of the logged torque, for each torque or one for all, if the log has
    amperes or per cent. With --units torque=mA (or force=mA): per A. A negative constant inverts the sign."""
    state_topic: str = "/joint_states"
    """Bags: topic of JointState, or of the state of a controller, of a Franka arm or of unitree's motors."""
    command_topic: str | None = None
    """Bags: topic of the position commands, or of a ros2_control controller's state; without one the log is replayed by
    inverse dynamics."""
    stiffness: tuple[float, ...] = ()
    """Servo gains of the commanded joints, N m/rad (N/m for slides)."""
    damping: tuple[float, ...] = ()
    """Servo damping of the commanded joints, N m s/rad (N s/m for slides); default: the scene's."""
    known: tuple[str, ...] = ()
    """Parameters with a known value in this recording, PARAMETER=VALUE in the parameter's unit, e.g. payload=0.5; or
    the parameter that replaces it in this recording, e.g. payload=tool."""
    variant: Path | None = None
    """MJCF of this recording alone: that of --scene with other numbers (another mounting, a payload). The recording
    keeps the numbers that differ, in place of earlier ones, and its replays have them."""
    scene: Path | None = None
    """MJCF that fits will be made with, for --variant."""
    base_pose: tuple[str, float, float, float, float, float, float, float] | None = None
    """A body of the MJCF and its pose in its parent in this recording alone: x y z in m, and the quaternion w x y z."""
    command_joints: tuple[str, ...] = ()
    """Bags: commanded joints, in the order of commands that carry no names, also as NAME=NAME_IN_THE_MESSAGES; default:
    --joints."""
    motors: tuple[int, ...] = ()
    """Bags: indices of --joints in messages without names that have more joints (unitree's), counted from 0."""
    velocity_actuators: tuple[str, ...] = ()
    """Bags: <velocity> actuators in the MJCF, one per commanded joint, that take the commands' velocities."""
    effort_actuators: tuple[str, ...] = ()
    """Bags: <motor> actuators in the MJCF, one per commanded joint, that take the commands' efforts."""
    command_tolerance: float = 5e-3
    """How far the repeats' commands may differ, rad or m."""
    rate: float | None = None
    """Rate of the common clock, Hz. Default: for bags the median rate of the first bag's joint states, for other logs
    their own clocks. For a log without a column of time: the rate of its rows."""
    stamps: Literal["auto", "header", "bag"] = "auto"
    """Bags: time stamps that are used: header, those of the recorder (bag), or header if all messages have one
    (auto)."""
    phases: tuple[str, ...] = ()
    """Parts of the motion as NAME=START:END, in s from where the log begins, e.g. approach=0:1.5 grasp=1.5:2.
    Pages show the discrepancy by phase. With a phase named grasp, a replay that loses the grip counts as failed."""
    allow_jitter: bool = False
    """Accept clocks of an irregular rate."""
    resample: bool = False
    """CSV folders: interpolate repeats with different clocks onto the clock of the first one."""
    start: float | None = None
    """Keep the part from here, s. A replay of commands begins at rest: cut where the robot stands still."""
    end: float | None = None
    """Keep the part up to here, s."""


def run(command: Convert) -> None:
    """Load the log, validate it, cut it, and save the recording."""
    from droid_jax.recordings.formats import bags_at, check_target, load_recording, rosbag_reader, save_recording
    from droid_jax.recordings.log_files import is_log
    from droid_jax.recordings.units import with_torque_constants

    check_target(command.out)  # before logs are read, which may take long
    if not command.source:
        raise ValueError("convert needs the files or folders to read")
    path, *others = command.source
    if command.map is not None or all(p.exists() and not bags_at(p) and is_log(p) for p in command.source):
        _needs_effect(command, "a log", OF_LOGS)
        recording, keep = _from_log(command)
    else:
        keep = None
        bags = [bags_at(p) for p in command.source]
        strange = [p for p, found in zip(command.source, bags, strict=True) if not found]
        if others and strange:
            what = "is no ROS bag" if strange[0].exists() else "does not exist"
            raise ValueError(
                f"{strange[0]} {what}: several sources must all be bags or folders of bags, or all be logs of one "
                "kind; convert others one by one"
            )
        _needs_effect(command, "" if strange else "ROS bags", () if strange else OF_BAGS)
        if others:
            recording = rosbag_reader().read_bags([bag for found in bags for bag in found], **_bag_options(command))
        else:
            usual = {"name": command.name, "allow_jitter": command.allow_jitter}
            options = usual if strange else _bag_options(command)
            recording = load_recording(path, resample=command.resample, **options)
        if command.torque_constant:
            recording = with_torque_constants(recording, command.torque_constant)
    if command.start is not None or command.end is not None:
        first, last = recording.span
        start, end = command.start, command.end
        recording = recording.window(first if start is None else start, last if end is None else end)
    if command.known:
        recording = replace(recording, known={**recording.known, **_known(command.known)})
    recording = replace(recording, variant=_variant(command, recording))
    path = save_recording(recording, command.out)
    channels = ", ".join(f"{n} ({len(c.columns)} x {len(c.time)})" for n, c in recording.channels.items())
    repeats = "1 repeat" if recording.repeats == 1 else f"{recording.repeats} repeats"
    print(f"{repeats} of {recording.duration:.1f} s, channels {channels}: {path}")
    if keep is not None:
        keep()


def _from_log(command: Convert) -> tuple[Recording, Callable[[], None]]:
    """The recording in logs with a column map, and a function that stores the map for the next log."""
    import msgspec

    from droid_jax.recordings.column_map import check_map_target, map_beside, write_map
    from droid_jax.recordings.log_files import read_log

    if any("=" in joint for joint in command.joints):
        raise ValueError("--joints NAME=NAME_IN_THE_MESSAGES is for ROS bags; of logs --columns names the columns")
    beside = map_beside(command.out)
    check_map_target(beside)
    recording, columns, origin = read_log(
        command.source,
        command.map,
        episodes=command.episodes,
        channels=_pairs(command.columns, "--columns CHANNEL=COLUMN, e.g. position=q{n}"),
        units=_pairs(command.units, "--units KIND=UNIT, e.g. angle=deg"),
        beside=command.out.parent,
        name=command.name or command.out.stem,
        command_tolerance=command.command_tolerance,
        phases=[_phase(words) for words in command.phases],
        allow_jitter=command.allow_jitter,
        joints=command.joints,
        slides=command.slides,
        side=command.torque,
        gravity=command.gravity or None,
        unstated={"gravity": False} if command.torque in ("motor", "link") else {},
        stiffness=command.stiffness,
        damping=command.damping,
        rate=command.rate,
        torque_constant=command.torque_constant,
    )
    print(f"columns as in {origin}")

    def keep() -> None:
        if command.map is not None and command.map.resolve() == beside.resolve():
            return  # the user's own
        write_map(msgspec.structs.replace(columns, stiffness=[], damping=[]), beside)  # gains differ between logs
        print(f"the next log of this kind needs no options while {beside} is there")
        if columns.stiffness:
            print("except --stiffness and --damping: servo gains belong to one log, and the map does not store them")
        torque = columns.channel("torque")
        if command.torque_constant and torque is not None and torque.torque_constant is None:
            print("except --torque-constant: the map stores it only for torques in A, mA, V and %")

    return recording, keep


def _pairs(words: tuple[str, ...], usage: str) -> dict[str, str]:
    """Mapping of texts "a=b"; ValueError for other texts."""
    out: dict[str, str] = {}
    for word in words:
        key, sign, value = word.partition("=")
        if not key or not sign or not value or key in out:
            raise ValueError(f"expected {usage}, each once, got {word!r}")
        out[key] = value
    return out


def _joints(words: tuple[str, ...]) -> tuple[str, ...] | dict[str, str]:
    """Names of joints; a mapping if their names in the messages are given too."""
    if not any("=" in word for word in words):
        return words
    same = tuple(word if "=" in word else f"{word}={word}" for word in words)
    return _pairs(same, "joints as NAME or NAME=NAME_IN_THE_MESSAGES")


def _known(words: tuple[str, ...]) -> dict[str, float | str]:
    """--known as values and names."""
    out: dict[str, float | str] = {}
    for parameter, value in _pairs(words, "--known PARAMETER=VALUE, e.g. payload=0.5").items():
        try:
            out[parameter] = float(value)
        except ValueError:
            out[parameter] = value
    return out


def _variant(command: Convert, recording: Recording) -> dict[str, dict[str, Any]]:
    """What the recording states already, or --variant, and --base-pose: numbers by field and element."""
    from droid_jax.arguments import lists_of_numbers

    before: dict[str, dict[str, Any]] = dict(lists_of_numbers(recording.variant))
    numbers = {field: dict(of) for field, of in before.items()}
    if (command.variant is None) != (command.scene is None):
        raise ValueError("--variant and --scene go together: the MJCF of this recording, and that of the fit")
    if command.variant is not None and command.scene is not None:
        from droid_jax.model.scene import load_scene
        from droid_jax.model.variant import numbers_that_differ

        scene, variant = (load_scene(path, engine="mujoco") for path in (command.scene, command.variant))
        numbers = numbers_that_differ(scene, variant)
    if command.base_pose is not None:
        body, *pose = command.base_pose
        if body == "world":
            raise ValueError("--base-pose world: the world does not move: name the robot's first body")
        if not any(pose[3:]):
            raise ValueError("--base-pose: the quaternion w x y z has length 0; 1 0 0 0 turns nothing")
        for field, value in (("body_pos", pose[:3]), ("body_quat", pose[3:])):
            numbers.setdefault(field, {})[body] = value
    if command.variant is not None or command.base_pose is not None:
        from droid_jax.model.variant import variant_text

        print(f"numbers of this recording alone: {variant_text(numbers) or 'none'}")
        dropped = {f: {n: v for n, v in of.items() if numbers.get(f, {}).get(n) != v} for f, of in before.items()}
        if text := variant_text(dropped):
            print(f"numbers that it stated earlier, which are dropped: {text}")
    return numbers


def _needs_effect(command: Convert, what: str, known: tuple[str, ...]) -> None:
    """ValueError for options without an effect on this kind of source; a missing path is reported elsewhere.

    what: the kind of source, "" for a recording.  known: options that it takes.
    """
    source = command.source[0]
    if command.resample and (what or source.is_file()):
        why = {
            "ROS bags": "; the repeats of ROS bags have one clock already (--rate)",
            "a log": f"; {source} takes --rate",
            "": f", and the repeats of {source} have one clock already",
        }
        raise ValueError(f"--resample is for CSV folders{why[what]}")
    of_kinds = {**dict.fromkeys(OF_LOGS, "logs with a column map"), **dict.fromkeys(OF_BAGS, "ROS bags")}
    of_kinds |= dict.fromkeys(SHARED, "ROS bags and logs with a column map")
    given = [f.name for f in fields(Convert) if f.name in of_kinds and getattr(command, f.name) != f.default]
    if (strange := [name for name in given if name not in known]) and source.exists():
        raise ValueError(f"--{strange[0].replace('_', '-')} is for {of_kinds[strange[0]]}, and {source} is none")


def _bag_options(command: Convert) -> dict[str, Any]:
    """Options that bags need; ValueError for missing ones."""
    import numpy as np

    from droid_jax.recordings.recording import ServoGains, TorqueConvention, TorqueSide

    if not command.joints or command.torque is None:
        raise ValueError("a ROS bag does not say which joints to read or what its efforts are: give --joints, --torque")
    if command.damping and len(command.stiffness) != len(command.damping):
        raise ValueError(f"got {len(command.stiffness)} --stiffness and {len(command.damping)} --damping")
    damping = np.array(command.damping) if command.damping else None
    gains = ServoGains(np.array(command.stiffness), damping) if command.stiffness else None
    options = {
        "name": command.name or command.out.stem,
        "allow_jitter": command.allow_jitter,
        "joints": _joints(command.joints),
        "slides": command.slides,
        "torque": None if command.torque == "none" else TorqueConvention(TorqueSide(command.torque), command.gravity),
        "state_topic": command.state_topic,
        "command_topic": command.command_topic,
        "gains": gains,
        "command_joints": _joints(command.command_joints) or None,
        "motors": command.motors or None,
        "velocity_actuators": command.velocity_actuators,
        "effort_actuators": command.effort_actuators,
        "command_tolerance": command.command_tolerance,
        "rate": command.rate,
        "phases": [_phase(words) for words in command.phases],
    }
    if command.stamps != "auto":
        from droid_jax.recordings.formats import rosbag_reader

        options["stamps"] = rosbag_reader().Stamps(command.stamps)
    return options


def _phase(words: str) -> Phase:
    """The phase in a text such as "grasp=1.5:2"; ValueError for other texts."""
    from droid_jax.recordings.recording import Phase

    name, _, span = words.partition("=")
    start, _, end = span.partition(":")
    try:
        return Phase(name, float(start), float(end))
    except ValueError:
        raise ValueError(f"--phases takes NAME=START:END in seconds, e.g. grasp=1.5:2, got {words!r}") from None
