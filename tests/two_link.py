"""An arm of two links that servos drive, and a made-up recording of it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, ServoGains, TorqueConvention, TorqueSide

JOINTS = ("shoulder", "elbow")
KP = {"shoulder": 60.0, "elbow": 25.0}
# The actuators stand in the other order than the joints, and one sensor is the file's own.
ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast" iterations="100"/>
<worldbody>
  <body name="upper" {gravcomp}><joint name="shoulder" axis="0 1 0" armature="0.12" damping="3" {friction}/>
    <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="2" contype="0" conaffinity="0"/>
    <body name="fore" pos=".3 0 0" {gravcomp}><joint name="elbow" axis="0 1 0" armature="0.05" damping="1" {friction}/>
      <geom type="capsule" size=".02" fromto="0 0 0 .25 0 0" mass="1" contype="0" conaffinity="0"/></body></body>
</worldbody>
<actuator><position name="e" joint="elbow" kp="25"/><position name="s" joint="shoulder" kp="60"/></actuator>
<sensor>{sensor}</sensor></mujoco>"""
MOTOR = TorqueConvention(TorqueSide.MOTOR, gravity=False)


def arm(*, gravcomp: bool = True, friction: float = 0.0, sensor: str = "") -> Scene:
    xml = ARM.format(gravcomp='gravcomp="1"' if gravcomp else "", friction=f'frictionloss="{friction}"', sensor=sensor)
    return compile_scene(mujoco.MjSpec.from_string(xml), "arm", joints=JOINTS)


def motion(seconds: float = 1.0, rate: float = 500.0) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(round(seconds * rate) + 1) / rate
    ramp = np.clip(time / 0.3, 0, 1) ** 3
    return time, np.stack([0.4 * ramp * np.sin(5 * time), -0.3 + 0.5 * ramp * np.sin(8 * time)], axis=1)


def recording(**changes) -> Recording:
    time, command = motion()
    torque = np.random.default_rng(0).normal(size=(2, len(time), 2))
    start = dict(
        name="wave",
        time=time,
        command=command,
        command_names=JOINTS,
        channels={"torque": Channel("torque", "N m", JOINTS, time, torque, np.ones(torque.shape, bool))},
        torque=MOTOR,
        qpos0={"shoulder": 0.0, "elbow": -0.3},
        gains=ServoGains(np.array([60.0, 25.0]), np.array([3.0, 1.0])),
    )
    return Recording(**{**start, **changes})


def measured(first: float, columns: tuple[str, ...] = JOINTS) -> dict[str, Channel]:
    """Positions that begin at `first` and `first` + 0.1 in the two repeats, and torques."""
    time, command = motion()
    values = np.stack([command + first, command + first + 0.1]) - command[0]
    position = Channel("position", "rad", columns, time, values[..., : len(columns)], np.ones_like(values, bool))
    return {**recording().channels, "position": replace(position, mask=np.ones(position.values.shape, bool))}
