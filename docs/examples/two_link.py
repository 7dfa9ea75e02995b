"""A scene that is not the door: a two-link arm's masses and friction from its motor torques.

    python docs/examples/two_link.py

`fit` is all that a study of your own needs; `record` stands in for the robot, with plain C MuJoCo.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

import droid_jax as dj
from droid_jax.model.fields import body_mass, joint_damping, joint_frictionloss
from droid_jax.recordings.recording import Channel, ServoGains, TorqueConvention, TorqueSide

if TYPE_CHECKING:
    from droid_jax.identify.pipeline import Identified

MJCF = Path(__file__).with_name("two_link.xml")
JOINTS = ("shoulder", "elbow")
TRUTH = {"forearm_mass": 1.1, "shoulder_damping": 3.1, "elbow_damping": 0.6, "elbow_frictionloss": 0.35}


def fit(recording: dj.Recording, config: dj.IdentifyConfig | None = None) -> Identified:
    """What the program is for: scene, parameters, cost, fit."""
    scene = dj.load_scene(MJCF)
    space = dj.Space(
        (
            body_mass(scene, "forearm", std=0.3, high=3.0),
            joint_damping(scene, "shoulder", std=1.0, high=20.0),
            joint_damping(scene, "elbow", std=0.5, high=20.0),
            joint_frictionloss(scene, "elbow", std=0.1, high=2.0),
        )
    )
    cost = dj.make_cost(scene, space, [recording])
    print(f"before: {cost(space.mean[None])[0]:.3f} N m")
    found = dj.identify_parameters(scene, space, [recording], config=config)
    print(f"after:  {cost(found.best[None])[0]:.3f} N m")
    return found


def record(repeats: int = 5, seed: int = 0) -> dj.Recording:
    """The arm with its true values repeats one motion; noise of 0.02 N m on the motor torques at 500 Hz."""
    model = mujoco.MjModel.from_xml_path(str(MJCF))
    model.opt.timestep = 0.0002
    forearm = model.body("forearm").id
    model.body_inertia[forearm] *= TRUTH["forearm_mass"] / model.body_mass[forearm]
    model.body_mass[forearm] = TRUTH["forearm_mass"]
    model.dof_damping[:] = TRUTH["shoulder_damping"], TRUTH["elbow_damping"]
    model.dof_frictionloss[1] = TRUTH["elbow_frictionloss"]
    time = np.arange(0.0, 3.0, 0.002)
    command = np.column_stack([0.6 * np.sin(2.2 * time), 0.9 * (1 - np.cos(3.1 * time))])
    data, torque = mujoco.MjData(model), np.empty((len(time), 2))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for k in range(10 * len(time)):
        for joint in range(2):
            data.ctrl[joint] = np.interp(k * 0.0002, time, command[:, joint])
        mujoco.mj_step(model, data)
        if k % 10 == 0:  # the step leaves the forces of the state that it started from
            torque[k // 10] = data.qfrc_actuator
    measured = torque + np.random.default_rng(seed).normal(0, 0.02, (repeats, *torque.shape))
    channel = Channel("torque", "N m", JOINTS, time, measured, np.ones(measured.shape, bool))
    return dj.Recording(
        name="two-link",
        time=time,
        command=command,
        command_names=JOINTS,
        channels={"torque": channel},
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True),
        qpos0={"shoulder": 0.0, "elbow": 0.0},
        gains=ServoGains(np.array([80.0, 40.0]), np.array([2.0, 1.0])),
    )


def main() -> None:
    """Record, save, fit, and print what was found beside the truth."""
    dj.tune()  # before anything that starts jax
    recording = record()
    print(f"recording: {dj.save_recording(recording, Path('runs') / 'two_link.npz')}")
    found = fit(recording)
    for p, best, low, high in zip(found.space.parameters, found.best, *found.gaussian.interval(), strict=True):
        print(f"{p.name:20s} {best:.3f} [{low:.3f}, {high:.3f}] {p.unit:10s} truth {TRUTH[p.name]:.3f}")


if __name__ == "__main__":
    main()
