"""ROS bags, written here with the rosbags writers, against the motion they were made from."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from droid_jax.commands.options import recording_at
from droid_jax.recordings import rosbag
from droid_jax.recordings.formats import load_recording, save_recording
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.recordings.rosbag import Stamps, read_bags
from droid_jax.run import main

JOINTS = ("j1", "j2")
TORQUE = TorqueConvention(TorqueSide.LINK, gravity=True)
EPOCH = 1_700_000_000 * 10**9  # ns
KINDS = ("ros1", "sqlite3", "mcap")
CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"


def position(t: np.ndarray) -> np.ndarray:
    return np.stack([0.1 + 0.2 * t, 1.0 - 0.3 * t], axis=-1)


def torque(t: np.ndarray) -> np.ndarray:
    return np.stack([3.0 * t - 1.0, 5.0 - 2.0 * t], axis=-1)


class Bag:
    """Collects messages and writes them as one bag of any kind.

    delay: ns between a header's stamp and the recorder's; header 0 where there is no stamp.
    slow: the recorder's seconds per second of a simulation, whose header stamps begin at 0; 0 where there is none.
    """

    def __init__(
        self, folder: Path, kind: str, stem: str = "run", delay: int = 0, headers: bool = True, slow: float = 0.0
    ) -> None:
        self.kind, self.delay, self.headers, self.slow = kind, delay, headers, slow
        self.path = folder / (f"{stem}.bag" if kind == "ros1" else stem)
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        self.messages: list[tuple[str, str, int, object]] = []

    def add(self, topic: str, kind: str, t: float, **fields) -> None:
        types = self.store.types
        nanoseconds = round(t * 1e9) if self.slow else EPOCH + round(t * 1e9)
        if kind in ("sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory", CONTROLLER):
            sec, nano = divmod(nanoseconds, 10**9) if self.headers else (0, 0)
            stamp = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nano)
            seq = {"seq": 0} if self.kind == "ros1" else {}
            fields["header"] = types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **seq)
        if self.slow:
            nanoseconds = EPOCH + round(self.slow * t * 1e9)
        self.messages.append((topic, kind, nanoseconds + self.delay, types[kind](**fields)))

    def state(self, t: float, topic: str = "/joint_states", names: tuple[str, ...] = JOINTS, **changes) -> None:
        one = np.array([t])
        fields = {"position": position(one)[0], "velocity": np.array([0.2, -0.3]), "effort": torque(one)[0]}
        fields |= changes
        self.add(topic, "sensor_msgs/msg/JointState", t, name=list(names), **fields)

    def write(self) -> Path:
        if self.kind == "ros1":
            writer, serialize = Writer1(self.path), self.store.serialize_ros1
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer, serialize = Writer2(self.path, version=9, storage_plugin=plugin), self.store.serialize_cdr
        with writer:
            connections = {}
            for topic, kind, nanoseconds, message in sorted(self.messages, key=lambda m: m[2]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], nanoseconds, serialize(message, kind))
        return self.path


def grid(start: float, end: float, rate: float = 100.0) -> np.ndarray:
    return start + np.arange(round((end - start) * rate) + 1) / rate


def joint_state(bag: Bag, t: float, q: np.ndarray) -> None:
    empty = np.zeros(0)
    bag.add(
        "/command",
        "sensor_msgs/msg/JointState",
        t,
        name=["j2", "j1"],
        position=q[::-1].copy(),
        velocity=empty,
        effort=empty,
    )


def point_fields(bag: Bag, q: np.ndarray, t: float) -> dict:
    empty = np.zeros(0)
    since = bag.store.types["builtin_interfaces/msg/Duration"](sec=int(t), nanosec=round((t % 1) * 1e9))
    return {
        "positions": q,
        "velocities": empty,
        "accelerations": empty,
        "effort": empty,
        "time_from_start": since,
    }


def point(bag: Bag, t: float, q: np.ndarray) -> None:
    bag.add("/command", "trajectory_msgs/msg/JointTrajectoryPoint", t, **point_fields(bag, q, 0.0))


def multi_array(bag: Bag, t: float, q: np.ndarray) -> None:
    layout = bag.store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    bag.add("/command", "std_msgs/msg/Float64MultiArray", t, layout=layout, data=q)


def controller_state(
    bag: Bag, t: float, q: np.ndarray, names: tuple[str, str] = ("reference", "feedback"), **changes: np.ndarray
) -> None:
    """What ros2_control publishes; its position lags behind its command."""
    if CONTROLLER not in bag.store.types:
        points = "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in names)
        bag.store.register(get_types_from_msg(f"std_msgs/Header header\nstring[] joint_names\n{points}", CONTROLLER))
    make = bag.store.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    command, measured = (make(**{**point_fields(bag, x, 0.0), **changes}) for x in (q[::-1].copy(), q[::-1] - 0.1))
    bag.add("/command", CONTROLLER, t, joint_names=["j2", "j1"], **dict(zip(names, (command, measured), strict=True)))


def older_state(bag: Bag, t: float, q: np.ndarray) -> None:
    controller_state(bag, t, q, ("desired", "actual"))


def pulled(
    folder: Path,
    kind: str,
    stem: str = "run",
    command: Callable[[Bag, float, np.ndarray], None] = joint_state,
    lead: float = 0.5,
) -> Path:
    """States at 100 Hz from 0 s; a command ramp at 50 Hz that begins after `lead` s."""
    bag = Bag(folder, kind, stem)
    for t in grid(0.0, lead + 1.0):
        bag.state(t)
    for t in grid(lead, lead + 1.0, 50.0):
        command(bag, t, np.array([t - lead, 2.0 * (t - lead)]))
    return bag.write()


def fails(paths: list[Path], *parts: str, **options) -> None:
    with pytest.raises(ValueError) as caught:
        read_bags(paths, **{"joints": JOINTS, "torque": TORQUE, **options})
    for part in parts:
        assert part in str(caught.value), f"{part!r} is not in {str(caught.value)!r}"


@pytest.mark.parametrize("kind", KINDS)
def test_states_and_commands_come_back(tmp_path: Path, kind: str) -> None:
    leads = (0.5, 0.503)  # the second repeat's states miss the common clock by 3 ms
    paths = [pulled(tmp_path, kind, f"run{i}", lead=lead) for i, lead in enumerate(leads)]
    recording = read_bags(paths, joints=JOINTS, torque=TORQUE, command_topic="/command")
    t = recording.time
    np.testing.assert_allclose(np.diff(t), 0.01, atol=1e-8)
    assert t[0] == 0.0 and t[-1] >= 0.99
    np.testing.assert_allclose(recording.command, np.stack([t, 2 * t], axis=-1), atol=1e-7)
    for r, lead in enumerate(leads):
        np.testing.assert_allclose(recording.channel("torque").values[r], torque(t + lead), atol=1e-7)
        np.testing.assert_allclose(recording.channel("position").values[r], position(t + lead), atol=1e-7)
    assert recording.channel("torque").mask.all()
    assert recording.qpos0 == pytest.approx(dict(zip(JOINTS, position(np.array([0.5015]))[0], strict=True)))
    assert recording.torque == TORQUE
    assert recording.meta["stamps"] == "header"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("command", [joint_state, point, multi_array, controller_state, older_state])
def test_command_messages(tmp_path: Path, kind: str, command: Callable) -> None:
    recording = read_bags(
        [pulled(tmp_path, kind, command=command)], joints=JOINTS, torque=TORQUE, command_topic="/command"
    )
    t = recording.time
    np.testing.assert_allclose(recording.command, np.stack([t, 2 * t], axis=-1), atol=1e-7)


def test_a_message_that_the_bag_does_not_define(tmp_path: Path) -> None:
    """As bags of ROS 2 before Iron in sqlite3 are."""
    path = pulled(tmp_path, "sqlite3", command=controller_state)
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        database.execute("delete from message_definitions")
        database.commit()
    fails([path], "topic '/command': the bag does not define control_msgs", command_topic="/command")
    assert read_bags([path], joints=JOINTS, torque=TORQUE).repeats == 1


@pytest.mark.parametrize(
    ("slides", "units"),
    [
        ((), ("N m", "rad", "rad/s")),
        (JOINTS, ("N", "m", "m/s")),
        (JOINTS[:1], ("N or N m", "m or rad", "m/s or rad/s")),
    ],
)
def test_units_follow_the_slides(tmp_path: Path, slides: tuple[str, ...], units: tuple[str, ...]) -> None:
    out, option = tmp_path / "axis.npz", ["--slides", *slides] if slides else []
    said = ["--joints", *JOINTS, "--torque", "motor", "--command-topic", "/command", *option]
    assert convert(pulled(tmp_path, "sqlite3"), *said, "--out", out) == 0
    assert tuple(load_recording(out).channel(name).unit for name in ("torque", "position", "velocity")) == units


def test_phases_are_stated_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "axis.npz"
    said = ["--joints", *JOINTS, "--torque", "motor", "--command-topic", "/command", "--out", out]
    bag = pulled(tmp_path, "sqlite3")
    assert convert(bag, *said, "--phases", "approach=0:0.5", "grasp=0.5:1") == 0
    assert [(p.name, p.start, p.end) for p in load_recording(out).phases] == [
        ("approach", 0.0, 0.5),
        ("grasp", 0.5, 1.0),
    ]
    assert convert(bag, *said, "--phases", "grasp=0.5") == 2
    assert "--phases takes NAME=START:END in seconds, e.g. grasp=1.5:2, got 'grasp=0.5'" in capsys.readouterr().err


def test_slides_are_joints(tmp_path: Path) -> None:
    fails([pulled(tmp_path, "sqlite3")], "slides must be among the joints j1, j2, got j3", slides=["j3"])


def test_a_whole_trajectory_in_one_message(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "sqlite3")
    for t in grid(0.0, 2.5):
        bag.state(t)
    make = bag.store.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    points = [make(**point_fields(bag, np.array([t, -t]), t)) for t in (0.0, 0.5, 1.0, 1.5)]
    bag.add("/plan", "trajectory_msgs/msg/JointTrajectory", 0.5, joint_names=list(JOINTS), points=points)
    recording = read_bags([bag.write()], joints=JOINTS, torque=TORQUE, command_topic="/plan", allow_jitter=True)
    held = np.minimum(recording.time, 1.5)  # the controller holds the last command
    assert recording.time[-1] == pytest.approx(2.0)
    np.testing.assert_allclose(recording.command, np.stack([held, -held], axis=-1), atol=1e-7)


def test_a_trajectory_that_replaces_one_is_not_the_command(tmp_path: Path) -> None:
    """The topic does not show what the controller followed in between."""
    bag = Bag(tmp_path, "sqlite3")
    for t in grid(0.0, 2.5):
        bag.state(t)
    make = bag.store.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    for start in (0.5, 1.0):
        points = [make(**point_fields(bag, np.array([t, -t]), t)) for t in (0.0, 0.5, 1.0)]
        bag.add("/plan", "trajectory_msgs/msg/JointTrajectory", start, joint_names=list(JOINTS), points=points)
    said = "message 1: begins before the trajectory of message 0 has ended"
    fails([bag.write()], said, "controller_state", command_topic="/plan")


def test_trajectories_may_be_sent_ahead(tmp_path: Path) -> None:
    """Their start in the header counts, not the time of arrival."""
    bag = Bag(tmp_path, "mcap")
    for t in grid(0.0, 4.0):
        bag.state(t)
    make = bag.store.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    for start, ahead in ((1.0, 800_000_000), (2.5, 1_800_000_000)):
        points = [make(**point_fields(bag, np.array([start + t, -t]), t)) for t in (0.0, 0.5, 1.0)]
        bag.delay = -ahead
        bag.add("/plan", "trajectory_msgs/msg/JointTrajectory", start, joint_names=list(JOINTS), points=points)
    recording = read_bags([bag.write()], joints=JOINTS, torque=TORQUE, command_topic="/plan")
    assert recording.meta["stamps"] == "header"
    np.testing.assert_allclose(recording.command[[0, 50, 100], 0], [1.0, 1.5, 2.0], atol=1e-7)


def test_waypoints_may_be_seconds_apart(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "sqlite3")
    for t in grid(0.0, 6.0):
        bag.state(t)
    for t in (0.0, 2.0, 4.0, 6.0):
        point(bag, t, np.array([t, -t]))
    recording = read_bags([bag.write()], joints=JOINTS, torque=TORQUE, command_topic="/command")
    np.testing.assert_allclose(recording.command, np.stack([recording.time, -recording.time], axis=-1), atol=1e-7)


def loaded(folder: Path, name: str, start: float) -> Path:
    """A bag from `start` s on, whose first effort is `start` N m."""
    bag = Bag(folder, "ros1", name)
    for t in grid(start, start + 1.0):
        bag.state(t, effort=np.full(2, start))
    return bag.write()


def test_repeats_are_in_the_order_of_recording(tmp_path: Path) -> None:
    """The shell hands over run_1, run_10, run_2."""
    paths = sorted(loaded(tmp_path, f"run_{i}", 2.0 * i) for i in range(1, 11))
    assert [path.stem for path in paths[:3]] == ["run_1", "run_10", "run_2"]
    recording = read_bags(paths, joints=JOINTS, torque=TORQUE)
    np.testing.assert_array_equal(recording.channel("torque").values[:, 0, 0], 2.0 * np.arange(1, 11))
    assert recording.meta["bags"].startswith("run_1.bag, run_2.bag")


def test_bags_that_overlap_keep_their_order(tmp_path: Path) -> None:
    """Simulations that each begin at zero: their order differs by rounding only."""
    paths = [loaded(tmp_path, f"run_{i}", 0.001 * (11 - i)) for i in range(1, 11)]
    expected = 0.001 * (11 - np.arange(1, 11))
    for recording in (
        read_bags(paths, joints=JOINTS, torque=TORQUE),
        load_recording(tmp_path, joints=JOINTS, torque=TORQUE),  # a folder: run_2 before run_10
    ):
        np.testing.assert_array_equal(recording.channel("torque").values[:, 0, 0], expected)


def test_without_commands(tmp_path: Path) -> None:
    recording = read_bags([pulled(tmp_path, "mcap")], joints=["j2"], torque=TORQUE, rate=50.0)
    assert recording.command.shape == (0, 0)
    channel = recording.channel("torque")
    assert channel.columns == ("j2",)
    np.testing.assert_allclose(channel.time, grid(0.0, 1.5, 50.0), atol=1e-9)
    np.testing.assert_allclose(channel.values[0, :, 0], torque(channel.time)[:, 1], atol=1e-6)


def test_header_and_bag_stamps(tmp_path: Path) -> None:
    """States arrive 40 ms late, the command (no header) at once: only one clock is used."""
    bag = Bag(tmp_path, "sqlite3", delay=40_000_000)
    for t in grid(0.0, 1.0):
        bag.state(t)
    bag.delay = 0
    for t in grid(0.2, 1.0):
        multi_array(bag, t, np.array([t, t]))
    path = bag.write()
    options = {"joints": JOINTS, "torque": TORQUE, "command_topic": "/command"}
    recording = read_bags([path], **options)
    assert recording.meta["stamps"] == "bag"
    np.testing.assert_allclose(recording.channel("torque").values[0], torque(recording.time + 0.16), atol=1e-6)
    fails(
        [path], "topic '/command'", "no header stamp; use --stamps bag", stamps=Stamps.HEADER, command_topic="/command"
    )
    alone = read_bags([path], joints=JOINTS, torque=TORQUE, stamps=Stamps.BAG)
    assert alone.meta["stamps"] == "bag"


def test_zero_header_stamps_are_not_used(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "ros1", headers=False)
    for t in grid(0.0, 1.0):
        bag.state(t)
    recording = read_bags([bag.write()], joints=JOINTS, torque=TORQUE)
    assert recording.meta["stamps"] == "bag"
    assert recording.duration == pytest.approx(1.0)


@pytest.mark.parametrize("stamps", [Stamps.AUTO, Stamps.HEADER])
def test_a_simulation_begins_at_zero(tmp_path: Path, stamps: Stamps) -> None:
    """At half its speed, so that the recorder's clock would double every time."""
    bag = Bag(tmp_path, "mcap", slow=2.0)
    for t in grid(0.0, 1.0):
        bag.state(t)
    recording = read_bags([bag.write()], joints=JOINTS, torque=TORQUE, stamps=stamps)
    assert recording.meta["stamps"] == "header"
    assert recording.duration == pytest.approx(1.0)


def test_a_first_message_without_a_stamp_is_no_simulation(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap", headers=False)
    bag.state(0.0)
    bag.headers = True
    for t in grid(0.01, 1.0):
        bag.state(t)
    assert read_bags([bag.write()], joints=JOINTS, torque=TORQUE).meta["stamps"] == "bag"


def test_one_bag_is_one_repeat(tmp_path: Path) -> None:
    """A copy among the repeats would make the noise of their mean too small."""
    path = pulled(tmp_path, "mcap", "run0")
    fails([path, tmp_path / "." / path.name], "run0: given twice")


def test_a_velocity_that_one_bag_did_not_measure_is_left_away(tmp_path: Path) -> None:
    paths = []
    for stem, velocity in (("run0", 0.2), ("run1", np.nan)):
        bag = Bag(tmp_path, "mcap", stem)
        for t in grid(0.0, 1.0):
            bag.state(t, velocity=np.full(2, velocity))
        paths.append(bag.write())
    assert set(read_bags(paths, joints=JOINTS, torque=TORQUE).channels) == {"torque", "position"}


def test_what_one_message_leaves_empty_was_not_measured_there(tmp_path: Path) -> None:
    """An effort must be in every message, as it must be finite."""
    bag, effortless = Bag(tmp_path, "mcap", "position"), Bag(tmp_path, "mcap", "effort")
    for i, t in enumerate(grid(0.0, 1.0)):
        bag.state(t, **({"position": np.zeros(0)} if i == 50 else {}))
        effortless.state(t, **({"effort": np.zeros(0)} if i == 50 else {}))
    seen = read_bags([bag.write()], joints=JOINTS, torque=TORQUE).channel("position").mask
    assert {50} <= set(np.flatnonzero(~seen[0].all(axis=1)).tolist()) <= {49, 50, 51}
    fails([effortless.write()], "message 50: holds no effort")


def test_clocks_of_two_machines_are_told(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    for t in grid(0.0, 1.0):
        bag.state(t)
        joint_state(bag, t + 100.0, np.array([t, t]))
    fails([bag.write()], "from -100.000 to -99.000 s of it", "--stamps bag", command_topic="/command")


def test_messages_of_another_publisher_are_passed_over(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "sqlite3")
    for t in grid(0.0, 1.0):
        bag.state(t)
        bag.state(t + 0.005, names=("finger",), position=np.ones(1), velocity=np.ones(1), effort=np.full(1, np.nan))
    recording = read_bags([bag.write()], joints=JOINTS, torque=TORQUE)
    assert recording.channel("torque").time.shape == (101,)


def test_gaps_are_masked_not_filled(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    for t in grid(0.0, 1.0):
        if not 0.405 < t < 0.595:
            bag.state(t)
    path = bag.write()
    fails([path], "irregular rate", "allow_jitter=True", "message 41")
    mask = read_bags([path], joints=JOINTS, torque=TORQUE, allow_jitter=True).channel("torque").mask
    np.testing.assert_array_equal(np.flatnonzero(~mask[0, :, 0]), np.arange(41, 60))


def test_topic_errors(tmp_path: Path) -> None:
    path = pulled(tmp_path, "ros1")
    fails([path], "run.bag", "no topic '/joints'", "the bag has: /command, /joint_states", state_topic="/joints")
    fails([path], "no topic '/cmd'", "/command, /joint_states", command_topic="/cmd")
    fails([path], "must come from two topics", command_topic="/joint_states")
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(tmp_path / "silent", version=9) as writer:
        writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
    fails([tmp_path / "silent"], "silent, topic '/joint_states': no messages")
    bag = Bag(tmp_path, "sqlite3", "text")
    bag.add("/joint_states", "std_msgs/msg/String", 0.0, data="hello")
    fails([bag.write()], "cannot read std_msgs/msg/String", "expected JointState")


@pytest.mark.parametrize("kind", KINDS)
def test_joint_errors(tmp_path: Path, kind: str) -> None:
    path = pulled(tmp_path, kind, command=multi_array)
    fails([path], "message 0: no joint elbow", "the message has: j1, j2", joints=("j1", "elbow"))
    fails([path], "no joint of elbow, wrist", "it has: j1, j2", joints=("elbow", "wrist"))
    fails([path], "expected 1 numbers (j1), got 2", command_topic="/command", command_joints=["j1"])


def test_joints_that_messages_call_otherwise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Regression: names with a prefix could not be matched to those of the MJCF."""
    bag = Bag(tmp_path, "ros1")
    for t in grid(0.0, 1.0):
        for topic, prefix in {"/joint_states": "fr3_", "/goal": "fr3_", "/plain": "", "/plain_goal": ""}.items():
            bag.state(t, topic=topic, names=tuple(f"{prefix}{joint}" for joint in JOINTS))
    path = bag.write()
    advice = "give both names of each joint: --joints NAME=fr3_j1, where NAME is its name in"
    fails([path], f"if 'j1' is called 'fr3_j1' there, {advice}")
    fails([path], "no joint j2; ", "--joints NAME=fr3_j2", joints=("fr3_j1", "j2"))
    found = read_bags([path], joints=["j1", "j2"], torque=TORQUE, state_topic="/plain", command_topic="/plain_goal")
    said = ["--torque", "link", "--gravity", "--command-topic", "/goal", "--out", tmp_path / "door.npz"]
    assert convert(path, "--joints", "j1=fr3_j1", "j2=fr3_j2", *said) == 0
    assert load_recording(tmp_path / "door.npz").sha256 == found.sha256
    other = ["--state-topic", "/plain", "--command-joints", "j2=fr3_j2", "j1=fr3_j1"]
    assert convert(path, "--joints", *JOINTS, *other, *said) == 0
    assert load_recording(tmp_path / "door.npz").command_names == ("j2", "j1")
    assert convert(path, "--joints", "j1=fr3_j1", "j2=", *said) == 2
    assert "expected joints as NAME or NAME=NAME_IN_THE_MESSAGES" in capsys.readouterr().err


@pytest.mark.parametrize("kind", KINDS)
def test_effort_errors(tmp_path: Path, kind: str) -> None:
    bag = Bag(tmp_path, kind, "nan")
    for i, t in enumerate(grid(0.0, 0.2)):
        bag.state(t, **({"effort": np.array([1.0, np.nan])} if i == 7 else {}))
    fails([bag.write()], "nan", "message 7: effort of joint 'j2' is nan")
    bag = Bag(tmp_path, kind, "without")
    for t in grid(0.0, 0.2):
        bag.state(t, effort=np.zeros(0))
    fails([bag.write()], "without", "hold no effort")
    bag = Bag(tmp_path, kind, "short")
    bag.state(0.0, effort=np.ones(1))
    fails([bag.write()], "message 0: expected 2 numbers in 'effort', got 1")


def test_repeats_must_replay_one_motion(tmp_path: Path) -> None:
    one = pulled(tmp_path, "ros1", "one")
    other = pulled(tmp_path, "ros1", "other", command=lambda b, t, q: joint_state(b, t, q * 1.1))
    fails(
        [one, other],
        "other.bag",
        "one.bag",
        "joint 'j2' differs by 0.2 at 1.000 s; ",
        "--command-tolerance 0.005",
        command_topic="/command",
    )
    kept = read_bags([one, other], joints=JOINTS, torque=TORQUE, command_topic="/command", command_tolerance=0.3)
    assert kept.repeats == 2


def test_a_repeat_that_was_cut_off(tmp_path: Path) -> None:
    one = pulled(tmp_path, "ros1", "one")
    bag = Bag(tmp_path, "ros1", "short")
    for t in grid(0.0, 0.3):
        bag.state(t)
    fails([one, bag.write()], "short.bag", "lasts 0.300 s", "1.500 s")


def test_stamps_must_increase(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "sqlite3")
    for t in (0.0, 0.01, 0.02, 0.02, 0.03):
        bag.state(t)
    path = bag.write()
    fails([path], "message 3", "header stamps", "time must increase, it repeats", "; --stamps bag (Stamps.BAG) takes")
    with pytest.raises(ValueError, match=r"it repeats 0\.02 s after 0\.02 s$"):  # which nothing mends
        read_bags([path], joints=JOINTS, torque=TORQUE, stamps=Stamps.BAG)


@pytest.mark.parametrize("kind", KINDS)
def test_files_that_are_no_bags(tmp_path: Path, kind: str) -> None:
    with pytest.raises(FileNotFoundError, match="no ROS bag at"):
        read_bags([tmp_path / "gone.bag"], joints=JOINTS, torque=TORQUE)
    with pytest.raises(ValueError, match="one ROS bag per repeat, got none"):
        read_bags([], joints=JOINTS, torque=TORQUE)
    path = pulled(tmp_path, kind)
    file = path if kind == "ros1" else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    whole = file.read_bytes()
    for content in (b"", b"not a bag at all", whole[: len(whole) // 2]):
        file.write_bytes(content)
        fails([path], str(path), "not a readable ROS bag")
        fails([file], str(file), "not a readable ROS bag")


@pytest.mark.parametrize("kind", KINDS)
def test_load_finds_bags(tmp_path: Path, kind: str) -> None:
    (tmp_path / "runs").mkdir()
    paths = [pulled(tmp_path / "runs", kind, f"run{i}") for i in range(2)]
    options = {"joints": JOINTS, "torque": TORQUE, "command_topic": "/command"}
    expected = read_bags(paths, **options)
    both = load_recording(tmp_path / "runs", name="door", **options)
    assert both.repeats == 2
    assert both.name == "door"
    assert both.sha256 == expected.sha256
    assert load_recording(paths[0], **options).repeats == 1
    file = paths[0] if kind == "ros1" else next(p for p in paths[0].iterdir() if p.suffix != ".yaml")
    assert load_recording(file, **options).repeats == 1
    assert load_recording(save_recording(both, tmp_path / "door.npz")).sha256 == both.sha256


# ----- on the command line


def convert(*arguments: str | Path) -> int:
    return main(["convert", *map(str, arguments)])


def test_convert_turns_bags_into_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [pulled(tmp_path, "ros1", f"run{i}") for i in range(3)]
    said = ["--joints", *JOINTS, "--torque", "link", "--gravity", "--command-topic", "/command"]
    out = tmp_path / "door.npz"
    assert convert(*paths, *said, "--stiffness", "80", "40", "--damping", "2", "1", "--out", out) == 0
    assert "3 repeats of" in capsys.readouterr().out
    recording = load_recording(out)
    assert recording.torque == TorqueConvention(TorqueSide.LINK, gravity=True)
    assert recording.gains is not None
    np.testing.assert_array_equal(recording.gains.stiffness, [80.0, 40.0])
    expected = read_bags(paths, joints=JOINTS, torque=recording.torque, command_topic="/command", gains=recording.gains)
    assert recording.sha256 == expected.sha256
    assert convert(out, "--start", "0.2", "--end", "0.6", "--out", tmp_path / "part") == 0
    part = load_recording(tmp_path / "part")
    assert (part.span, part.repeats) == (pytest.approx((0.2, 0.6)), 3)


def test_set_points_beside_positions_are_told(tmp_path: Path) -> None:
    """A controller that follows velocities too lags less than a servo of positions."""

    def moving(bag: Bag, t: float, q: np.ndarray) -> None:
        controller_state(bag, t, q, ("reference", "feedback"), velocities=np.array([0.3, 0.1]))

    paths = [pulled(tmp_path, "mcap", "run0", command=moving)]
    with pytest.warns(UserWarning, match="on /command have set-points of velocity beside the positions"):
        found = read_bags(paths, joints=JOINTS, torque=TORQUE, command_topic="/command")
    assert found.meta["unused_setpoints"] == "velocity"
    still = [pulled(tmp_path, "mcap", "run1", command=controller_state)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read_bags(still, joints=JOINTS, torque=TORQUE, command_topic="/command")
    assert "unused_setpoints" not in found.meta


def test_a_rate_that_the_stamps_do_not_have_is_told(tmp_path: Path) -> None:
    paths = [pulled(tmp_path, "ros1", "run0")]
    with pytest.warns(UserWarning, match=r"the stamps are at .* Hz, not at the 97 Hz of --rate; they are used"):
        read_bags(paths, joints=JOINTS, torque=TORQUE, rate=97.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_bags(paths, joints=JOINTS, torque=TORQUE, rate=50.0)


def test_efforts_that_are_amperes(tmp_path: Path, refused: Callable[..., str]) -> None:
    paths = [pulled(tmp_path, "ros1", f"run{i}") for i in range(2)]
    said = ["--joints", *JOINTS, "--torque", "motor"]
    assert convert(*paths, *said, "--out", tmp_path / "plain.npz") == 0
    assert convert(*paths, *said, "--torque-constant", "8", "-12", "--out", tmp_path / "scaled.npz") == 0
    plain, scaled = (load_recording(tmp_path / f"{name}.npz") for name in ("plain", "scaled"))
    torque = plain.channels["torque"].values
    np.testing.assert_allclose(scaled.channels["torque"].values, torque * [8.0, -12.0])
    assert scaled.meta["torque_constants"] == "8 -12"
    assert convert(tmp_path / "plain.npz", "--torque-constant", "2", "--out", tmp_path / "one") == 0
    np.testing.assert_allclose(load_recording(tmp_path / "one").channels["torque"].values, 2.0 * torque)
    for wrong, what in ((("1", "2", "3"), "got 3 torque constants"), (("0",), "other than 0, got 0")):
        assert what in refused("convert", tmp_path / "plain.npz", "--torque-constant", *wrong, "--out", tmp_path / "no")


def test_convert_takes_several_folders_of_bags(tmp_path: Path) -> None:
    for day in ("day1", "day2"):
        (tmp_path / day).mkdir()
        for i in range(2):
            pulled(tmp_path / day, "ros1", f"run{i}")
    said = ["--joints", *JOINTS, "--torque", "link", "--out", tmp_path / "door.npz"]
    assert convert(tmp_path / "day1", tmp_path / "day2", *said) == 0
    assert load_recording(tmp_path / "door.npz").repeats == 4


def test_a_converted_motion_is_called_as_its_file_unless_told_otherwise(tmp_path: Path) -> None:
    """Bags of every motion have the same name, and a fit distinguishes motions by their names."""
    paths = [pulled(tmp_path, "ros1", f"repeat_{i:02d}") for i in range(2)]
    said = ["--joints", *JOINTS, "--torque", "link"]
    for bags in (paths, paths[:1]):
        assert convert(*bags, *said, "--out", tmp_path / "door.npz") == 0
        assert load_recording(tmp_path / "door.npz").name == "door"
    assert convert(*paths, *said, "--name", "slow", "--out", tmp_path / "door.npz") == 0
    assert load_recording(tmp_path / "door.npz").name == "slow"
    assert convert(tmp_path / "door.npz", "--out", tmp_path / "csv") == 0  # a name that it has stays
    assert load_recording(tmp_path / "csv").name == "slow"


@pytest.mark.parametrize("field", ["velocity", "position"])
def test_what_a_driver_does_not_measure_is_masked_and_efforts_must_be_there(tmp_path: Path, field: str) -> None:
    """joint_state_broadcaster sends NaN for missing interfaces."""
    bag = Bag(tmp_path, "ros1", "run")
    for k, t in enumerate(grid(0.0, 1.0)):
        bag.state(t, **{field: np.full(2, np.nan) if field == "velocity" or k == 3 else position(np.array([t]))[0]})
    found = read_bags([bag.write()], joints=JOINTS, torque=TORQUE)
    if field == "velocity":
        assert "velocity" not in found.channels and "position" in found.channels
    else:
        assert 0 < (~found.channels["position"].mask).sum() <= 6
    assert found.channels["torque"].mask.all()
    bad = Bag(tmp_path, "ros1", "bad")
    for t in grid(0.0, 1.0):
        bad.state(t, effort=np.array([np.nan, 1.0]))
    fails([bad.write()], "effort of joint", "not finite")


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_bag_is_one_sentence_with_its_name(tmp_path: Path, kind: str) -> None:
    path = pulled(tmp_path, kind)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    for _ in range(30):
        broken = bytearray(whole)
        at = int(rng.integers(len(whole)))
        broken[at : at + 64] = rng.bytes(64)
        file.write_bytes(bytes(broken[: int(rng.integers(len(whole) // 2, len(whole) + 64))]))
        try:
            read_bags([path], joints=JOINTS, torque=TORQUE)
        except ValueError as error:  # nothing else may come out; some damage is none
            assert str(path) in str(error) or "clock" in str(error) or "repeats" in str(error), error


def test_options_that_would_change_nothing_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, out = pulled(tmp_path, "ros1", "run0"), tmp_path / "door.npz"
    assert convert(bag, "--joints", *JOINTS, "--torque", "link", "--out", out) == 0
    refused = {
        (out, "--torque", "link"): f"--torque is for ROS bags and logs with a column map, and {out} is none",
        (out, "--command-topic", "/command"): f"--command-topic is for ROS bags, and {out} is none",
        (bag, "--joints", *JOINTS, "--torque", "link", "--resample"): "--resample is for CSV folders",
        (tmp_path / "nowhere", "--torque", "link"): "there is no such file or folder",
    }
    for words, said in refused.items():
        assert convert(*words, "--out", tmp_path / "again.npz") == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "again.npz").exists()


def test_convert_hands_on_what_the_reader_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [pulled(tmp_path, "ros1", f"run{i}") for i in range(2)]
    said = ["--joints", *JOINTS, "--torque", "link", "--command-topic", "/command", "--rate", "50", "--stamps", "bag"]
    more = ["--command-joints", *JOINTS, "--command-tolerance", "0.5", "--allow-jitter"]
    assert convert(*paths, *said, *more, "--out", tmp_path / "door.npz") == 0
    found = load_recording(tmp_path / "door.npz")
    assert np.diff(found.time) == pytest.approx(0.02) and found.meta["stamps"] == "bag"
    given = {}
    monkeypatch.setattr(rosbag, "read_bags", lambda paths, **options: given.update(options) or found)
    assert convert(*paths, *said, *more, "--out", tmp_path / "again.npz") == 0
    assert given["command_tolerance"] == 0.5 and given["allow_jitter"] and given["command_joints"] == JOINTS


def test_convert_resamples_tables_with_clocks_of_their_own(tmp_path: Path) -> None:
    paths = [pulled(tmp_path, "ros1", f"run{i}") for i in range(2)]
    assert convert(*paths, "--joints", *JOINTS, "--torque", "link", "--out", tmp_path / "csv") == 0
    table = tmp_path / "csv" / "torque_01.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-3]))
    assert convert(tmp_path / "csv", "--out", tmp_path / "door.npz") == 2
    assert convert(tmp_path / "csv", "--resample", "--out", tmp_path / "door.npz") == 0
    assert load_recording(tmp_path / "door.npz").repeats == 2


def test_convert_says_what_a_bag_lacks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [pulled(tmp_path, "ros1", f"run{i}") for i in range(2)]
    out = tmp_path / "door.npz"
    (tmp_path / "log.npz").write_bytes(b"")
    named = ["--joints", *JOINTS, "--torque", "motor"]
    for arguments, expected in [
        (paths, "give --joints, --torque"),
        (paths[:1], "give --joints, --torque"),
        ([*paths, *named, "--damping", "2", "1"], "got 0 --stiffness and 2 --damping"),
        ([*paths, *named, "--command-topic", "/nothing"], "/nothing"),
        ([], "needs the files or folders to read"),
        ([paths[0], tmp_path / "gone.npz"], "gone.npz does not exist"),
        ([tmp_path / "log.npz", tmp_path / "log.npz"], "log.npz is no ROS bag: several sources must all be"),
    ]:
        assert convert(*arguments, "--out", out) == 2
        said = capsys.readouterr().err
        assert said.startswith("error: ") and said.count("\n") == 1 and expected in said
    assert not out.exists()


def test_bags_beside_the_tables_of_a_recording_are_passed_over(tmp_path: Path) -> None:
    """A folder with recording.json is a recording, also where its raw logs lie in it."""
    bag = pulled(tmp_path, "ros1")
    assert convert(bag, "--joints", *JOINTS, "--torque", "link", "--out", tmp_path / "csv") == 0
    bag.rename(tmp_path / "csv" / "raw.bag")
    assert recording_at(tmp_path / "csv").repeats == 1  # as identify and gap read it
    assert convert(tmp_path / "csv", "--out", tmp_path / "door.npz") == 0


def test_a_damaged_metadata_file_is_told_in_one_line(tmp_path: Path) -> None:
    bag = Bag(tmp_path, "mcap")
    bag.state(0.0)
    path = bag.write()
    (path / "metadata.yaml").write_text("a: b: c\n")
    with pytest.raises(ValueError, match="not a readable ROS bag") as refused:
        read_bags([path], joints=JOINTS, torque=TORQUE)
    assert len(str(refused.value).splitlines()) == 1
