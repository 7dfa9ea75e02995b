"""States and commands of robots' own ROS messages, in bags of rosbags and in MCAP of mcap-ros2-support."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.recordings.rosbag import read_bags
from droid_jax.run import main

TORQUE = TorqueConvention(TorqueSide.LINK, gravity=True)
EPOCH = 1_700_000_000 * 10**9  # ns
TIME = np.arange(101) * 0.01  # s
ARM = tuple(f"panda_joint{i}" for i in range(1, 8))
LEG = ("FL_hip", "FL_thigh", "FL_calf")
LEG_MOTORS = (3, 4, 5)  # of a Go2, whose front right leg comes first
KP, KD = 20.0, 1.5

# As published, without most of the fields that are not read.
FRANKA = """
std_msgs/Header header
float64[6] cartesian_collision
float64[7] q
float64[7] q_d
float64[7] dq
float64[7] dq_d
float64[7] theta
float64[7] tau_J
float64[7] tau_J_d
float64[16] O_T_EE
uint8 robot_mode
"""
FRANKA_2 = """
std_msgs/Header header
sensor_msgs/JointState measured_joint_state
sensor_msgs/JointState desired_joint_state
sensor_msgs/JointState measured_joint_motor_state
float64[7] ddq_d
"""
MOTOR_STATE = "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\nuint32 lost\n"
LOW_STATE = "uint8[2] head\nunitree_go/MotorState[20] motor_state\nuint32 tick\nuint32 crc\n"
MOTOR_CMD = "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\nuint32[3] reserve\n"
LOW_CMD = "uint8[2] head\nunitree_go/MotorCmd[20] motor_cmd\nuint32 crc\n"
INTERFACES = "string[] interface_names\nfloat64[] values\n"
DYNAMIC = "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values\n"
CONTROLLER = """
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
"""
TYPES = {
    "franka_msgs/msg/FrankaState": FRANKA,
    "franka_msgs/msg/FrankaRobotState": FRANKA_2,
    "unitree_go/msg/MotorState": MOTOR_STATE,
    "unitree_go/msg/LowState": LOW_STATE,
    "unitree_go/msg/MotorCmd": MOTOR_CMD,
    "unitree_go/msg/LowCmd": LOW_CMD,
    "control_msgs/msg/InterfaceValue": INTERFACES,
    "control_msgs/msg/DynamicJointState": DYNAMIC,
    "control_msgs/msg/JointTrajectoryControllerState": CONTROLLER,
}


def truth(t: float, count: int) -> dict[str, np.ndarray]:
    """Measured and commanded position, velocity and effort of some joints."""
    j = np.arange(1, count + 1)
    q, v = 0.1 * j + 0.2 * t * j, 0.2 * j
    return {"q": q, "v": v, "tau": j - 3.0 * t, "q_d": q + 0.01, "v_d": v + 0.02, "tau_d": 0.5 * j + t}


class Store:
    """A type store that knows TYPES, of ROS 1 or 2."""

    def __init__(self, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        for name, text in TYPES.items():
            self.store.register(get_types_from_msg(text, name))

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, t: float) -> Any:
        sec, nanosec = divmod(EPOCH + round(t * 1e9), 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="", **({"seq": 0} if self.ros1 else {}))

    def joint_state(self, t: float, names: tuple[str, ...], q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> Any:
        header = self.header(t)
        return self.make(
            "sensor_msgs/msg/JointState", header=header, name=list(names), position=q, velocity=v, effort=tau
        )

    def write(self, path: Path, topics: dict[str, tuple[str, Callable[[float], Any]]]) -> Path:
        """One message of each topic at every instant of TIME."""
        if self.ros1:
            writer, serialize = Writer1(path), self.store.serialize_ros1
        else:
            writer, serialize = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP), self.store.serialize_cdr
        with writer:
            opened = {
                topic: writer.add_connection(topic, kind, typestore=self.store) for topic, (kind, _) in topics.items()
            }
            for t in TIME:
                for topic, (kind, make) in topics.items():
                    writer.write(opened[topic], EPOCH + round(t * 1e9), serialize(make(t), kind))
        return path


def holds(recording: Any, count: int, joints: tuple[str, ...], tolerance: float = 1e-9, commands: bool = True) -> None:
    """Check that the recording holds the measured and commanded values of `truth`."""
    places = slice(0, count)
    for name, key in {"position": "q", "velocity": "v", "torque": "tau"}.items():
        expected = np.stack([truth(t, count)[key][places] for t in recording.channels[name].time])
        assert recording.channels[name].values[0] == pytest.approx(expected, abs=tolerance)
        assert recording.channels[name].columns == joints
    if commands:
        expected = np.stack([truth(t, count)["q_d"] for t in recording.time])
        assert recording.command[:, :count] == pytest.approx(expected, abs=tolerance)


def franka_1(store: Store) -> tuple[str, Callable[[float], Any]]:
    def make(t: float) -> Any:
        x, six = truth(t, 7), np.zeros(6)
        return store.make(
            "franka_msgs/msg/FrankaState", header=store.header(t), cartesian_collision=six, q=x["q"], q_d=x["q_d"],
            dq=x["v"], dq_d=0 * x["v"], theta=x["q"], tau_J=x["tau"], tau_J_d=0 * x["tau"], O_T_EE=np.zeros(16),
            robot_mode=2,
        )  # fmt: skip

    return "franka_msgs/msg/FrankaState", make


def franka_2(store: Store) -> tuple[str, Callable[[float], Any]]:
    def make(t: float) -> Any:
        x, zero = truth(t, 7), np.zeros(7)
        return store.make(
            "franka_msgs/msg/FrankaRobotState", header=store.header(t), ddq_d=zero,
            measured_joint_state=store.joint_state(t, ARM, x["q"], x["v"], x["tau"]),
            desired_joint_state=store.joint_state(t, ARM, x["q_d"], zero, zero),
            measured_joint_motor_state=store.joint_state(t, ARM, x["q"], x["v"], zero),
        )  # fmt: skip

    return "franka_msgs/msg/FrankaRobotState", make


@pytest.mark.parametrize(("ros1", "message"), [(True, franka_1), (False, franka_1), (False, franka_2)])
def test_one_topic_of_a_franka_arm_holds_state_and_command(tmp_path: Path, ros1: bool, message: Callable):
    store = Store(ros1)
    bag = store.write(tmp_path / ("a.bag" if ros1 else "a"), {"/franka": message(store)})
    found = read_bags([bag], joints=ARM, torque=TORQUE, state_topic="/franka", command_topic="/franka")
    holds(found, 7, ARM)
    assert found.meta["stamps"] == "header"


def low_state(store: Store) -> tuple[str, Callable[[float], Any]]:
    def make(t: float) -> Any:
        x = truth(t, 3)
        motors = []
        for i in range(20):
            k = LEG_MOTORS.index(i) if i in LEG_MOTORS else None
            q, dq, tau = (0.0, 0.0, 0.0) if k is None else (x["q"][k], x["v"][k], x["tau"][k])
            more = {"mode": 1, "ddq": 0.0, "lost": 0}
            motors.append(store.make("unitree_go/msg/MotorState", q=q, dq=dq, tau_est=tau, **more))
        head = np.zeros(2, np.uint8)
        return store.make("unitree_go/msg/LowState", head=head, motor_state=motors, tick=round(1e3 * t), crc=0)

    return "unitree_go/msg/LowState", make


def low_command(store: Store, kp: Callable[[float], float], feed: float) -> tuple[str, Callable[[float], Any]]:
    def make(t: float) -> Any:
        x = truth(t, 3)
        motors = []
        for i in range(20):
            k = LEG_MOTORS.index(i) if i in LEG_MOTORS else None
            q, dq, tau = (0.0, 0.0, 0.0) if k is None else (x["q_d"][k], feed * x["v_d"][k], feed * x["tau_d"][k])
            gains = {"kp": kp(t), "kd": KD, "mode": 1, "reserve": np.zeros(3, np.uint32)}
            motors.append(store.make("unitree_go/msg/MotorCmd", q=q, dq=dq, tau=tau, **gains))
        return store.make("unitree_go/msg/LowCmd", head=np.zeros(2, np.uint8), motor_cmd=motors, crc=0)

    return "unitree_go/msg/LowCmd", make


def leg(folder: Path, kp: Callable[[float], float] = lambda t: KP, feed: float = 0.0) -> Path:
    store = Store()
    return store.write(folder / "leg", {"/lowcmd": low_command(store, kp, feed), "/lowstate": low_state(store)})


def leg_options(**more: Any) -> dict[str, Any]:
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    usual = {"joints": LEG, "torque": convention, "state_topic": "/lowstate", "command_topic": "/lowcmd"}
    return {**usual, "motors": LEG_MOTORS, **more}


def test_a_leg_of_unitree(tmp_path: Path):
    """The commands themselves state the gains."""
    found = read_bags([leg(tmp_path)], **leg_options())
    holds(found, 3, LEG, 1e-5)
    assert found.gains is not None
    assert found.gains.stiffness == pytest.approx(KP) and found.gains.damping == pytest.approx(KD)
    assert found.meta["stamps"] == "bag"  # the messages have no header


def test_set_points_of_velocity_and_effort_go_to_actuators_of_their_own(tmp_path: Path):
    bag = leg(tmp_path, feed=1.0)
    with pytest.warns(UserWarning, match="set-points of velocity and effort.*--velocity-actuators, --effort-actuators"):
        read_bags([bag], **leg_options())
    names = {"velocity": tuple(f"{j}_v" for j in LEG), "effort": tuple(f"{j}_tau" for j in LEG)}
    options = {f"{field}_actuators": of for field, of in names.items()}
    found = read_bags([bag], **leg_options(**options))
    holds(found, 3, LEG, 1e-5)
    assert found.command_names == (*LEG, *names["velocity"], *names["effort"])
    wanted = [np.concatenate([truth(t, 3)["v_d"], truth(t, 3)["tau_d"]]) for t in found.time]
    assert found.command[:, 3:] == pytest.approx(np.array(wanted), abs=1e-5)
    # kp (q_d - q) + kd (v_d - v) + tau, as a <position>, a <velocity> and a <motor>
    assert found.gains is not None and found.gains.stiffness == pytest.approx([KP] * 3 + [KD] * 3 + [1.0] * 3)
    assert found.gains.damping == pytest.approx(np.zeros(9))
    with pytest.raises(ValueError, match="velocity_actuators must be 3"):
        read_bags([bag], **leg_options(velocity_actuators=["a"]))
    with pytest.raises(ValueError, match="give --command-topic too"):
        read_bags([bag], **leg_options(command_topic=None, effort_actuators=LEG))


def test_gains_that_change_are_not_stated(tmp_path: Path):
    with pytest.warns(UserWarning, match="change their gains kp or kd on the way"):
        found = read_bags([leg(tmp_path, kp=lambda t: KP + t)], **leg_options())
    assert found.gains is None


def test_places_of_joints_are_asked_for(tmp_path: Path):
    bag = leg(tmp_path)
    with pytest.raises(ValueError, match=r"expected 3 numbers \(FL_hip, FL_thigh, FL_calf\), got 20; .* --motors"):
        read_bags([bag], **leg_options(motors=None))
    for motors, said in {
        (3, 4): "must be 3 numbers",
        (3, 4, 4): "different numbers",
        (3, 4, 20): "from 0 to 19",
    }.items():
        with pytest.raises(ValueError, match=said):
            read_bags([bag], **leg_options(motors=motors))
    out = tmp_path / "leg.npz"
    topics = ["--state-topic", "/lowstate", "--command-topic", "/lowcmd", "--torque", "motor", "--gravity"]
    assert main(["convert", str(bag), "--joints", *LEG, "--motors", "3", "4", "5", *topics, "--out", str(out)]) == 0
    holds(load_recording(out), 3, LEG, 1e-5)


def dynamic(store: Store, joints: tuple[str, ...], fields: tuple[str, ...]) -> tuple[str, Callable[[float], Any]]:
    """With a gripper on the same topic that has only a position."""
    keys = {"position": "q", "velocity": "v", "effort": "tau"}

    def make(t: float) -> Any:
        x = truth(t, len(joints))
        values = [
            store.make(
                "control_msgs/msg/InterfaceValue",
                interface_names=[*fields],
                values=np.array([x[keys[f]][i] for f in fields]),
            )
            for i in range(len(joints))
        ]
        gripper = store.make("control_msgs/msg/InterfaceValue", interface_names=["position"], values=np.zeros(1))
        names, every = ["gripper", *joints], [gripper, *values]
        return store.make(
            "control_msgs/msg/DynamicJointState", header=store.header(t), joint_names=names, interface_values=every
        )

    return "control_msgs/msg/DynamicJointState", make


def test_dynamic_joint_states(tmp_path: Path):
    store = Store()
    bag = store.write(
        tmp_path / "a", {"/dynamic_joint_states": dynamic(store, LEG, ("effort", "velocity", "position"))}
    )
    holds(read_bags([bag], joints=LEG, torque=TORQUE, state_topic="/dynamic_joint_states"), 3, LEG, commands=False)
    bag = store.write(tmp_path / "b", {"/dynamic_joint_states": dynamic(store, LEG, ("position",))})
    with pytest.raises(ValueError, match=r"hold no effort.*--torque none"):
        read_bags([bag], joints=LEG, torque=TORQUE, state_topic="/dynamic_joint_states")
    found = read_bags([bag], joints=LEG, torque=None, state_topic="/dynamic_joint_states")
    assert set(found.channels) == {"position"}


def controller(store: Store, joints: tuple[str, ...]) -> tuple[str, Callable[[float], Any]]:
    def point(q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> Any:
        since = store.make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
        more = {"accelerations": np.zeros(0), "time_from_start": since}
        return store.make("trajectory_msgs/msg/JointTrajectoryPoint", positions=q, velocities=v, effort=tau, **more)

    def make(t: float) -> Any:
        x = truth(t, len(joints))
        reference, feedback = point(x["q_d"], x["v_d"], x["tau_d"]), point(x["q"], x["v"], x["tau"])
        more = {"joint_names": list(joints), "reference": reference, "feedback": feedback}
        return store.make("control_msgs/msg/JointTrajectoryControllerState", header=store.header(t), **more)

    return "control_msgs/msg/JointTrajectoryControllerState", make


def test_the_state_of_a_controller_alone(tmp_path: Path):
    """Its feedback is the state, its reference the command with set-points of velocity and effort."""
    store, topic = Store(), "/joint_trajectory_controller/controller_state"
    bag = store.write(tmp_path / "a", {topic: controller(store, LEG)})
    names = {"velocity_actuators": ["v0", "v1", "v2"], "effort_actuators": ["m0", "m1", "m2"]}
    found = read_bags([bag], joints=LEG, torque=TORQUE, state_topic=topic, command_topic=topic, **names)
    holds(found, 3, LEG)
    wanted = [np.concatenate([truth(t, 3)["v_d"], truth(t, 3)["tau_d"]]) for t in found.time]
    assert found.command[:, 3:] == pytest.approx(np.array(wanted)) and found.gains is None


def test_mcap_of_mcap_ros2_support(tmp_path: Path):
    """A file written by another library than the one that reads it."""
    writer = pytest.importorskip("mcap_ros2.writer")
    path = tmp_path / "a.mcap"
    line = "=" * 80
    text = (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
        f"{line}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        f"{line}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )
    with path.open("wb") as stream:
        out = writer.Writer(stream)
        schema = out.register_msgdef("sensor_msgs/msg/JointState", text)
        for t in TIME:
            x, at = truth(t, 3), EPOCH + round(t * 1e9)
            sec, nanosec = divmod(at, 10**9)
            message = {
                "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}, "name": list(LEG),
                "position": x["q"].tolist(), "velocity": x["v"].tolist(), "effort": x["tau"].tolist(),
            }  # fmt: skip
            out.write_message("/joint_states", schema, message, log_time=at, publish_time=at)
        out.finish()
    holds(load_recording(path, joints=LEG, torque=TORQUE), 3, LEG, commands=False)
