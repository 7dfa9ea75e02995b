"""A pendulum on a position servo, simulated in plain C with fine steps, for tests of fits to positions alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, ServoGains, TorqueConvention, TorqueSide

MJCF = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="swing" axis="0 1 0" damping="{damping}" armature="{armature}"/>
      <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-4 1e-4 1e-4"/>
    </body>
  </worldbody>
  <actuator><position name="swing" joint="swing" kp="{kp}"/></actuator>
</mujoco>
"""
START = {"damping": 0.05, "armature": 0.004, "kp": 1.0}  # of the scene
TRUE = {"damping": 0.1, "armature": 0.008}
SECONDS, RATE = 2.0, 125.0
PARAMETERS = [
    {"field": "dof_damping", "element": "swing", "name": "damping", "std": 0.05, "low": 0.001, "high": 1.0},
    {"field": "dof_armature", "element": "swing", "name": "armature", "std": 0.004, "low": 1e-4, "high": 0.1},
]


def pendulum() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(MJCF.format(**START)), "pendulum")


def write_pendulum(folder: Path) -> tuple[str, ...]:
    """Scene and parameters as files, and the options that name them."""
    (folder / "pendulum.xml").write_text(MJCF.format(**START))
    (folder / "parameters.json").write_text(json.dumps(PARAMETERS))
    return ("--scene", str(folder / "pendulum.xml"), "--parameters", str(folder / "parameters.json"))


def ramped(goal: np.ndarray, steepest: float, step: float = 1e-4) -> np.ndarray:
    """Positions [T] that follow a goal [T] from rest with bounded acceleration and without overshoot."""
    place, speed, out = goal[0], 0.0, []
    for aim in goal:
        way = aim - place
        wanted = np.sign(way) * min(abs(way) / step, np.sqrt(2 * steepest * abs(way)))
        speed += min(max(wanted - speed, -steepest * step), steepest * step)
        place += step * speed
        out.append(place)
    return np.array(out)


def swung(
    name: str,
    kp: float,
    frequency: float,
    channels: Sequence[str] = ("position",),
    noise: float = 1e-4,
    repeats: int = 1,
    friction: float = 0.0,
    command: np.ndarray | None = None,
    steepest: float = np.inf,
) -> Recording:
    """Recording of the true pendulum at a servo gain kp [N m/rad] that follows a sine of a frequency [Hz].

    command: [T] at RATE, in place of the sine.  steepest: rad/s^2, by which the servo's own goal accelerates at most.
    """
    model = mujoco.MjModel.from_xml_string(MJCF.format(**TRUE, kp=kp))
    model.opt.timestep = 1e-4
    model.dof_frictionloss[:], model.dof_solimp[:, :2] = friction, 0.9999  # N m, that holds
    data = mujoco.MjData(model)
    time = np.arange(0.0, SECONDS, 1.0 / RATE) if command is None else np.arange(len(command)) / RATE
    fine = np.arange(round(time[-1] / 1e-4) + 1) * 1e-4
    if command is None:
        command = 0.8 * np.sin(2 * np.pi * frequency * time) ** 2 * np.sign(np.sin(2 * np.pi * frequency * time))
    control = np.interp(fine, time, command)
    if np.isfinite(steepest):
        control = ramped(control, steepest)
    traces = {"position": [], "velocity": [], "torque": []}
    every = round(1.0 / RATE / 1e-4)
    for step, ctrl in enumerate(control):
        data.ctrl[0] = ctrl
        mujoco.mj_forward(model, data)
        if step % every == 0:
            traces["position"].append(data.qpos[0])
            traces["velocity"].append(data.qvel[0])
            traces["torque"].append(data.qfrc_actuator[0])
        mujoco.mj_step(model, data)
    rng = np.random.default_rng(len(name))
    units = {"position": "rad", "velocity": "rad/s", "torque": "N m"}
    shape = (repeats, len(time), 1)
    measured = {
        c: Channel(c, units[c], ("swing",), time, np.array(traces[c])[None, :, None] + rng.normal(0, noise, shape),
                   np.ones(shape, bool))
        for c in channels
    }  # fmt: skip
    return Recording(
        name=name,
        time=time,
        command=command[:, None],
        command_names=("swing",),
        channels=measured,
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True),
        qpos0={"swing": 0.0},
        gains=ServoGains(np.array([kp]), np.zeros(1)),
    )
