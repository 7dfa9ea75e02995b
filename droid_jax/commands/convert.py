"""`convert`: whatever was logged into a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


@dataclass(frozen=True)
class Convert:
    """Read ROS bags or a CSV folder, check them, and write a recording that identify takes.

    Bags do not say what their efforts are, nor the servo's gains: say it here.
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """ROS 1 .bag or ROS 2 bags, one per repeat (or a folder of them), a CSV folder, or an npz file."""
    out: Path = Path("runs/recording.npz")
    """File (npz) or folder (CSV) to write."""
    joints: tuple[str, ...] = ()
    """Bags: measured joints, in the order wanted."""
    torque: Literal["motor", "link"] | None = None
    """Bags: motor (current, actuator force) or link (a sensor behind the gear, a Panda's tau_J)."""
    gravity: bool = False
    """Bags: the torque contains what carries the arm's weight."""
    state_topic: str = "/joint_states"
    """Bags: topic of sensor_msgs/JointState."""
    command_topic: str | None = None
    """Bags: topic of the position commands; without one the log is replayed by inverse dynamics."""
    stiffness: tuple[float, ...] = ()
    """Bags: servo gains of the commanded joints, N m/rad."""
    damping: tuple[float, ...] = ()
    """Bags: servo damping of the commanded joints, N m s/rad."""
    start: float | None = None
    """Keep the part from here, s."""
    end: float | None = None
    """Keep the part up to here, s."""


def run(command: Convert) -> None:
    """Load whatever it is, validate, cut, and save."""
    from droid_jax.measure.formats import load, save

    if not command.source:
        raise ValueError("convert needs the files or folders to read")
    path, *others = command.source
    if others:
        from droid_jax.measure.rosbag import read_bags

        recording = read_bags(command.source, **_bag_options(command))
    else:
        recording = load(path, **(_bag_options(command) if command.joints else {}))
    if command.start is not None or command.end is not None:
        first, last = recording.span
        start, end = command.start, command.end
        recording = recording.window(first if start is None else start, last if end is None else end)
    path = save(recording, command.out)
    channels = ", ".join(f"{n} ({len(c.columns)} x {len(c.time)})" for n, c in recording.channels.items())
    print(f"{recording.repeats} repeats of {recording.duration:.1f} s, channels {channels}: {path}")


def _bag_options(command: Convert) -> dict[str, Any]:
    """What bags do not say; ValueError names what is missing."""
    import numpy as np

    from droid_jax.measure.recording import ServoGains, TorqueConvention, TorqueSide

    if not command.joints or command.torque is None:
        raise ValueError("a ROS bag does not say which joints to read or what its efforts are: give --joints, --torque")
    if len(command.stiffness) != len(command.damping):
        raise ValueError(f"got {len(command.stiffness)} --stiffness and {len(command.damping)} --damping")
    gains = ServoGains(np.array(command.stiffness), np.array(command.damping)) if command.stiffness else None
    return {
        "joints": command.joints,
        "torque": TorqueConvention(TorqueSide(command.torque), command.gravity),
        "state_topic": command.state_topic,
        "command_topic": command.command_topic,
        "gains": gains,
    }
