"""Recordings as files: npz, a folder of CSV files, ROS bags."""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
from kinds import Kind, use

from droid_jax.recordings.formats import load_recording, save_recording
from droid_jax.recordings.recording import (
    Channel,
    ObjectPose,
    Phase,
    Recording,
    ServoGains,
    TorqueConvention,
    TorqueSide,
)

JOINTS = ("shoulder", "elbow", "door")  # of model_kinds.SCENE


def recording(*, commands: bool = True) -> Recording:
    rng, time = np.random.default_rng(0), np.arange(20) * 0.01
    shape = (2, 20, 3)
    channels = {
        name: Channel(name, unit, JOINTS, time, np.abs(rng.normal(0.0, 0.1, shape)), np.ones(shape, bool))
        for name, unit in (("torque", "N m"), ("position", "rad"))
    }
    angle = rng.normal(0.0, 0.1, (2, 10, 1))
    channels["object_angle"] = Channel("object_angle", "rad", ("door",), time[::2], angle, angle > -0.1)
    return Recording(
        "wave",
        time if commands else np.zeros(0),
        0.1 * np.sin(time[:, None] * [1.0, 2.0, 3.0]) if commands else np.zeros((0, 0)),
        JOINTS if commands else (),
        channels,
        TorqueConvention(TorqueSide.MOTOR, gravity=True),
        qpos0={"shoulder": 0.0, "elbow": 0.0, "door": 0.0},
        gains=ServoGains(np.array([80.0, 40.0, 60.0]), np.array([1.0, 2.0, 0.0])) if commands else None,
        phases=(Phase("grasp", 0.0, 0.05), Phase("release", 0.1, 0.19)),
        object_pose=ObjectPose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 1e-6 * np.eye(6)),
        meta={"robot": "1", "springs": "2"},
    )


def use_recording(path: Path, **options: Any) -> None:
    """Load, look into it, write it as npz and read it back as the same."""
    found = load_recording(path, **options)
    use(found.repeats, found.duration, found.grip_window, found.span, found.measured_start(), found.repeats_subset([0]))
    again = save_recording(found, path.parent / "again.npz")
    if load_recording(again).sha256 != found.sha256:
        raise RuntimeError("a recording changed by being saved")


def make_npz(folder: Path) -> None:
    save_recording(recording(), folder / "wave.npz")


def make_log(folder: Path) -> None:
    save_recording(recording(commands=False), folder / "log.npz")


def make_csv(folder: Path) -> None:
    save_recording(recording(), folder / "wave")


_MCAP, _SQLITE, _ROS1 = "mcap", "sqlite3", "ros1"


def make_bag(storage: str, folder: Path) -> None:
    """Twenty joint states and commands in a bag."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    old = storage == _ROS1
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    types, kind = store.types, "sensor_msgs/msg/JointState"
    plugin = StoragePlugin.SQLITE3 if storage == _SQLITE else StoragePlugin.MCAP
    writer = Writer1(folder / "run.bag") if old else Writer2(folder / "run", version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if old else store.serialize_cdr
    with writer:
        topics = {t: writer.add_connection(t, kind, typestore=store) for t in ("/joint_states", "/command")}
        for k in range(20):
            now = 10**18 + k * 10**7
            stamp = types["builtin_interfaces/msg/Time"](sec=now // 10**9, nanosec=now % 10**9)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **({"seq": 0} if old else {}))
            q = np.array([0.01 * k, 0.02 * k])
            for topic, connection in topics.items():
                effort = np.ones(2) if topic == "/joint_states" else np.zeros(0)
                message = types[kind](header=header, name=["j1", "j2"], position=q, velocity=np.zeros(2), effort=effort)
                writer.write(connection, now, serialize(message, kind))


def use_bag(path: Path) -> None:
    convention = TorqueConvention(TorqueSide.LINK, gravity=True)
    use_recording(path, joints=("j1", "j2"), torque=convention, command_topic="/command")


_npz = functools.partial(Kind, make=make_npz, read=lambda f: use_recording(f / "wave.npz"))
_csv = functools.partial(Kind, make=make_csv, read=lambda f: use_recording(f / "wave"))
_mcap = functools.partial(Kind, make=functools.partial(make_bag, _MCAP), read=lambda f: use_bag(f / "run"))
_sqlite = functools.partial(Kind, make=functools.partial(make_bag, _SQLITE), read=lambda f: use_bag(f / "run"))
KINDS = (
    _npz("recording.npz", "wave.npz", weight=6),
    _npz(
        "recording.npz, irregular clocks accepted", "wave.npz", weight=2,
        read=lambda f: use_recording(f / "wave.npz", allow_jitter=True),
    ),
    Kind("log.npz, without commands", "log.npz", make_log, lambda f: use_recording(f / "log.npz"), 3),
    _csv("recording.json", "wave/recording.json", weight=5),
    _csv("recording's CSV files", "wave/*.csv", weight=5),
    _csv(
        "recording's CSV files, resampled", "wave/*.csv", weight=2,
        read=lambda f: use_recording(f / "wave", resample=True),
    ),
)  # fmt: skip
BAGS = (
    Kind("ROS 1 bag", "run.bag", functools.partial(make_bag, _ROS1), lambda f: use_bag(f / "run.bag"), 2),
    _mcap("ROS 2 bag, mcap", "run/*.mcap", weight=2),
    _mcap("ROS 2 bag, metadata.yaml", "run/metadata.yaml", weight=1),
    _sqlite("ROS 2 bag, sqlite3", "run/*.db3", weight=2),
)
if importlib.util.find_spec("rosbags"):
    KINDS = (*KINDS, *BAGS)
