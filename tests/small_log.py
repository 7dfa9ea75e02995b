"""A log without commands of one joint whose equation of motion is known, for the tests of searches in such logs."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np

from droid_jax.cost.residuals import CompareConfig
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.identify.multistart import RefineConfig
from droid_jax.model.fields import joint_damping
from droid_jax.model.joint_friction import SMOOTHING
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.scene import Scene, compile_scene
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide

MJCF = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="forearm">
      <joint name="elbow" axis="0 0 1" damping="0.4"/>
      <inertial pos="0.2 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
    </body>
  </worldbody>
</mujoco>
"""
CONFIG = DiscrepancyConfig(
    refine=RefineConfig(iterations=10, basin_hops=0, spreads=0),
    compare=CompareConfig(whitened=True, motion_cutoff=10.0),
)
ASKED = ("joint_coulomb", "cable_pull", "torque_drift", "torque_gain")
INERTIA = 0.09  # kg m^2 about the joint
COULOMB, NOISE = 0.5, 0.06  # N m
PARAMETERS = [
    {"field": "dof_damping", "element": "elbow", "unit": "N m s/rad", "std": 0.4, "high": 10.0},
    {"sensor": "torque_offset", "element": "elbow", "std": 0.3, "high": 3.0},
]


def write_elbow(folder: Path) -> tuple[str, ...]:
    """Scene and parameters as files, and the options that name them."""
    (folder / "elbow.xml").write_text(MJCF)
    (folder / "parameters.json").write_text(json.dumps(PARAMETERS))
    return ("--scene", str(folder / "elbow.xml"), "--parameters", str(folder / "parameters.json"), "--joints", "elbow")


def elbow() -> Scene:
    return compile_scene(mujoco.MjSpec.from_string(MJCF), "elbow", joints=["elbow"])


def elbow_space(scene: Scene) -> Space:
    return Space(
        (
            joint_damping(scene, "elbow", std=0.4, high=10.0),
            Parameter("torque_offset[elbow]", "N m", 0.0, 0.3, -3.0, 3.0),
        )
    )


def elbow_log(coulomb: float, seconds: float = 36.0, repeats: int = 1, pace: float = 1.0) -> Recording:
    """Sines, their torque by hand, and noise that is correlated for a fifth of a second.

    pace: of the motion; recordings as long as each other share a compiled program.
    """
    time = np.arange(0.0, seconds, 0.01)
    size, w = np.array([[0.5], [0.15]]), 2 * np.pi * pace * np.array([[0.23], [0.51]])
    phase = w * time
    q, qd, qdd = (
        (size * np.sin(phase)).sum(0), (size * w * np.cos(phase)).sum(0), -(size * w**2 * np.sin(phase)).sum(0)
    )  # fmt: skip
    white = np.random.default_rng(3).normal(0.0, NOISE, (repeats, len(time) + 19))
    noise = np.stack([np.convolve(w, np.ones(20) / np.sqrt(20), "valid") for w in white])
    torque = INERTIA * qdd + 0.6 * qd + 0.1 + coulomb * np.tanh(qd / SMOOTHING) + noise
    mask = np.ones((repeats, len(time), 1), bool)
    channels = {
        "position": Channel("position", "rad", ("elbow",), time, np.tile(q[:, None], (repeats, 1, 1)), mask),
        "torque": Channel("torque", "N m", ("elbow",), time, torque[..., None], mask),
    }
    convention = TorqueConvention(TorqueSide.MOTOR, gravity=True)
    return Recording("elbow", np.zeros(0), np.zeros((0, 0)), (), channels, convention, qpos0={})
