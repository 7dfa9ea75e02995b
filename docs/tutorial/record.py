"""The logs of the tutorial: a two-link arm in plain C MuJoCo in place of a robot.

    python docs/tutorial/record.py

It differs from arm.xml in its forearm's mass and its joints' damping, and in something that arm.xml has no number
for: dry friction in the shoulder, a little less of it while the joint moves fast.  Ten repeats of each of three
motions, with noise on the motor torques: train as a ROS 2 bag for each repeat, validation as a CSV folder, test as
an npz file.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import mujoco
import numpy as np

import droid_jax as dj
from droid_jax.recordings.recording import Channel, ServoGains, TorqueConvention, TorqueSide

HERE = Path(__file__).resolve().parent
JOINTS = ("shoulder", "elbow")
MASS, DAMPING = 1.0, (2.6, 0.7)  # kg of the forearm, N m s/rad
FRICTION = 0.7  # N m, of the shoulder
STIFFNESS = (80.0, 40.0)  # N m/rad, as in arm.xml
REPEATS, RATE, FINE = 10, 100.0, 20  # samples per second; steps of the simulation between two samples
NOISE, START = 0.03, 0.002  # N m; rad by which a repeat starts elsewhere
MOTIONS = {"train": (0.5, 1.9, 0.8, 2.9), "validation": (0.7, 1.2, 0.5, 2.3), "test": (0.4, 2.6, 0.9, 1.7)}
SECONDS = 4.0


def command_of(motion: tuple[float, float, float, float], time: np.ndarray) -> np.ndarray:
    """[T, 2] rad: two sines that begin at rest."""
    a, u, b, v = motion
    ease = np.clip(time / 0.8, 0.0, 1.0) ** 2
    return np.column_stack([a * np.sin(u * time) * ease, b * np.sin(v * time) * ease])


def arm() -> mujoco.MjModel:
    """The synthetic robot's own model."""
    model = mujoco.MjModel.from_xml_path(str(HERE / "arm.xml"))
    model.opt.timestep = 1.0 / (RATE * FINE)
    forearm = model.body("forearm").id
    model.body_inertia[forearm] *= MASS / model.body_mass[forearm]
    model.body_mass[forearm] = MASS
    model.dof_damping[:] = DAMPING
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def repeat(command: np.ndarray, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[2, T, 2]: torque of the motors [N m] and position [rad], without noise."""
    model = arm()
    data, seen = mujoco.MjData(model), np.empty((2, *command.shape))
    data.qpos[:] = rng.normal(0.0, START, 2)
    fine = np.arange(len(time) * FINE) / (RATE * FINE)
    targets = np.column_stack([np.interp(fine, time, column) for column in command.T])
    for k, target in enumerate(targets):
        data.ctrl[:] = target
        speed = data.qvel[0]
        position = data.qpos.copy()
        data.qfrc_applied[0] = -FRICTION * np.tanh(speed / 0.01) * (0.85 + 0.15 * np.exp(-abs(speed) / 0.3))
        mujoco.mj_step(model, data)
        if k % FINE == 0:  # the step leaves the forces of the state that it started from
            seen[:, k // FINE] = data.qfrc_actuator, position
    return seen


def recording(name: str, seed: int) -> dj.Recording:
    """Ten repeats of a motion."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, SECONDS, 1.0 / RATE)
    command = command_of(MOTIONS[name], time)
    torque, position = np.stack([repeat(command, time, rng) for _ in range(REPEATS)], axis=1)
    torque = torque + rng.normal(0.0, NOISE, torque.shape)
    return dj.Recording(
        name=name,
        time=time,
        command=command.round(6),
        command_names=JOINTS,
        channels={
            "torque": Channel("torque", "N m", JOINTS, time, torque.round(4), np.ones(torque.shape, bool)),
            "position": Channel("position", "rad", JOINTS, time, position.round(6), np.ones(torque.shape, bool)),
        },
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True),
        qpos0=dict.fromkeys(JOINTS, 0.0),
        gains=ServoGains(np.array(STIFFNESS), np.array([0.0, 0.0])),
        meta={"source": "synthetic robot (plain C MuJoCo), docs/tutorial/record.py"},
    )


def write_bags(folder: Path, made: dj.Recording) -> None:
    """One ROS 2 bag for each repeat: sensor_msgs/JointState on /joint_states (effort) and on /command (position)."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    state = types["sensor_msgs/msg/JointState"]
    names, none = list(made.command_names), np.zeros(0)
    for number in range(made.repeats):
        bag = folder / f"repeat_{number:02d}"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            joints, command = (
                writer.add_connection(topic, state.__msgtype__, typestore=store)
                for topic in ("/joint_states", "/command")
            )
            for k, at in enumerate(made.time):
                nanoseconds = round(1e9 * at)
                head = header(stamp(*divmod(nanoseconds, 10**9)), "")
                position, effort = (made.channels[name].values[number, k] for name in ("position", "torque"))
                messages = (
                    (joints, state(head, names, position, none, effort)),
                    (command, state(head, names, made.command[k], none, none)),
                )
                for topic, message in messages:
                    writer.write(topic, nanoseconds, store.serialize_cdr(message, state.__msgtype__))
        (bag / f"{bag.name}.mcap").rename(folder / f"{bag.name}.mcap")  # it needs no metadata.yaml beside it
        shutil.rmtree(bag)


def main() -> None:
    """Write DATA anew."""
    data = HERE / "data"
    shutil.rmtree(data, ignore_errors=True)
    data.mkdir()
    for seed, name in enumerate(MOTIONS):
        made = recording(name, seed)
        if name == "train":
            write_bags(data / name, made)
        else:
            print(dj.save_recording(made, data / (name if name == "validation" else f"{name}.npz")))


if __name__ == "__main__":
    main()
