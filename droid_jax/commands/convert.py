"""`convert`: whatever was logged into a recording."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from droid_jax.recordings.recording import Phase

OF_BAGS = (
    "joints", "slides", "torque", "gravity", "state_topic", "command_topic", "stiffness", "damping", "command_joints",
    "command_tolerance", "rate", "stamps", "phases",
)  # fmt: skip


@dataclass(frozen=True)
class Convert:
    """Read ROS bags or a CSV folder, check them, and write a recording that identify takes.

    Bags do not say what their efforts are, nor the servo's gains: say it here.
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """ROS 1 .bag or ROS 2 bags, one per repeat (or folders of them), a CSV folder, or an npz file."""
    out: Path = Path("runs/recording.npz")
    """File (npz) or folder (CSV) to write."""
    name: str | None = None
    """What runs and pages call the recording; default: of bags that of --out, otherwise the name that it has."""
    joints: tuple[str, ...] = ()
    """Bags: measured joints, in the order wanted."""
    slides: tuple[str, ...] = ()
    """Bags: those of --joints that slide: N, m and m/s instead of N m, rad and rad/s."""
    torque: Literal["motor", "link"] | None = None
    """Bags: motor (current, actuator force) or link (a sensor behind the gear, a Panda's tau_J)."""
    gravity: bool = False
    """Bags: the torque contains what carries the arm's weight."""
    torque_constant: tuple[float, ...] = ()
    """N m (N) that one unit of the logged torque is, for each torque or one for all: of efforts that are amperes or
    per cent. A negative one turns the sign."""
    state_topic: str = "/joint_states"
    """Bags: topic of sensor_msgs/JointState."""
    command_topic: str | None = None
    """Bags: topic of the position commands, or of a ros2_control controller's state; without one the log is replayed by
    inverse dynamics."""
    stiffness: tuple[float, ...] = ()
    """Bags: servo gains of the commanded joints, N m/rad (N/m for slides)."""
    damping: tuple[float, ...] = ()
    """Bags: servo damping of the commanded joints, N m s/rad (N s/m for slides)."""
    command_joints: tuple[str, ...] = ()
    """Bags: commanded joints, in the order of commands that carry no names; default: --joints."""
    command_tolerance: float = 5e-3
    """Bags: how far the repeats' commands may differ, rad or m."""
    rate: float | None = None
    """Bags: rate of the common clock, Hz; default: the usual rate of the first bag's joint states."""
    stamps: Literal["auto", "header", "bag"] = "auto"
    """Bags: stamps that count: header, of the recorder (bag), or header where all messages have one (auto)."""
    phases: tuple[str, ...] = ()
    """Bags: parts of the motion as NAME=START:END, in s from where the bags begin, e.g. approach=0:1.5 grasp=1.5:2.
    Pages tell the gap by them; with a phase grasp, one whose grip is lost in the replay counts as failed."""
    allow_jitter: bool = False
    """Accept clocks of an irregular rate."""
    resample: bool = False
    """CSV: repeats with clocks of their own are interpolated onto the first one's."""
    start: float | None = None
    """Keep the part from here, s. A replay of commands begins at rest: cut where the robot stands still."""
    end: float | None = None
    """Keep the part up to here, s."""


def run(command: Convert) -> None:
    """Load whatever it is, validate, cut, and save."""
    from droid_jax.recordings.formats import bags_at, check_target, load_recording, rosbag_reader, save_recording
    from droid_jax.recordings.torque_constants import with_torque_constants

    check_target(command.out)  # before bags are read, which may take long
    if not command.source:
        raise ValueError("convert needs the files or folders to read")
    path, *others = command.source
    bags = [bags_at(p) for p in command.source]
    strange = [p for p, found in zip(command.source, bags, strict=True) if not found]
    if others and strange:
        what = "is no ROS bag" if strange[0].exists() else "does not exist"
        raise ValueError(
            f"{strange[0]} {what}: of several sources each is a bag or a folder of bags; convert others alone"
        )
    _needs_effect(command, bags=not strange)
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
    path = save_recording(recording, command.out)
    channels = ", ".join(f"{n} ({len(c.columns)} x {len(c.time)})" for n, c in recording.channels.items())
    print(f"{recording.repeats} repeats of {recording.duration:.1f} s, channels {channels}: {path}")


def _needs_effect(command: Convert, bags: bool) -> None:
    """ValueError for options that would change nothing; a path that does not exist is told as such."""
    if bags and command.resample:
        raise ValueError("--resample is for CSV folders; the repeats of ROS bags have one clock already (--rate)")
    if command.resample and command.source[0].is_file():
        raise ValueError(
            f"--resample is for CSV folders, and the repeats of {command.source[0]} have one clock already"
        )
    given = [f.name for f in fields(Convert) if f.name in OF_BAGS and getattr(command, f.name) != f.default]
    if given and not bags and command.source[0].exists():
        raise ValueError(f"--{given[0].replace('_', '-')} is for ROS bags, and {command.source[0]} is none")


def _bag_options(command: Convert) -> dict[str, Any]:
    """What bags do not say; ValueError names what is missing."""
    import numpy as np

    from droid_jax.recordings.recording import ServoGains, TorqueConvention, TorqueSide

    if not command.joints or command.torque is None:
        raise ValueError("a ROS bag does not say which joints to read or what its efforts are: give --joints, --torque")
    if len(command.stiffness) != len(command.damping):
        raise ValueError(f"got {len(command.stiffness)} --stiffness and {len(command.damping)} --damping")
    gains = ServoGains(np.array(command.stiffness), np.array(command.damping)) if command.stiffness else None
    options = {
        "name": command.name or command.out.stem,
        "allow_jitter": command.allow_jitter,
        "joints": command.joints,
        "slides": command.slides,
        "torque": TorqueConvention(TorqueSide(command.torque), command.gravity),
        "state_topic": command.state_topic,
        "command_topic": command.command_topic,
        "gains": gains,
        "command_joints": command.command_joints or None,
        "command_tolerance": command.command_tolerance,
        "rate": command.rate,
        "phases": [_phase(words) for words in command.phases],
    }
    if command.stamps != "auto":
        from droid_jax.recordings.formats import rosbag_reader

        options["stamps"] = rosbag_reader().Stamps(command.stamps)
    return options


def _phase(words: str) -> Phase:
    """ "grasp=1.5:2" as a phase; ValueError for other words."""
    from droid_jax.recordings.recording import Phase

    name, _, span = words.partition("=")
    start, _, end = span.partition(":")
    try:
        return Phase(name, float(start), float(end))
    except ValueError:
        raise ValueError(f"--phases takes NAME=START:END in seconds, e.g. grasp=1.5:2, got {words!r}") from None
