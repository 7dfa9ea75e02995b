"""Logs of a Dynamixel XL330 with a pendulum as recordings of positions and commands, with the gain of each.

The logs are Rhoban/bam's (Apache 2.0), `MOTION_kpGAIN.npz`.  They are not part of this repository.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from inverse_fit import read_npz

from droid_jax.recordings.checks import validate
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Channel, Recording, ServoGains, TorqueConvention, TorqueSide

JOINT = "servo"
SOURCE = "Logs of Rhoban/bam (an XL330 with a pendulum) hold time, goal_position, position and torque_enable."
KEYS = ("time", "goal_position", "position", "torque_enable")
MOTIONS = ("sin_sin", "sin_time_square", "up_and_down", "lift_and_drop")
GAINS = (200, 400, 800)
# N m/rad per unit of the firmware's gain, by the data sheet: see xl330.xml.
STIFFNESS = 0.874 / 400
RATE = 200.0  # Hz, about the host's 5.4 ms
SECONDS = 5.95  # of a log, all alike: recordings of one length share a compiled replay
DRIVEN = 1.95  # s of `lift_and_drop`, whose motor is switched off after 2 s: only this part is used


def log_name(motion: str, gain: int) -> str:
    """Name of a recording and of its file."""
    return f"{motion}_kp{gain}"


def xl330_log(folder: Path, motion: str, gain: int) -> Recording:
    """One log on a regular clock; ValueError where its file is missing or lacks something."""
    name = log_name(motion, gain)
    data = read_npz(folder, f"{name}.npz", KEYS, SOURCE)
    time = np.asarray(data["time"], float)
    time = time - time[0]
    on = np.asarray(data["torque_enable"], bool)
    end = DRIVEN if not on.all() else SECONDS
    if time[-1] < end or (not on.all() and time[~on][0] < end):
        raise ValueError(f"{folder / name}.npz: the servo is driven for less than {end} s")
    clock = np.arange(0.0, end, 1.0 / RATE)
    position, goal = (
        interpolate(clock, time, np.asarray(data[k], float).reshape(-1, 1)) for k in ("position", "goal_position")
    )
    channel = Channel("position", "rad", (JOINT,), clock, position[None], np.ones((1, *position.shape), bool))
    recording = Recording(
        name=name,
        time=clock,
        command=goal,
        command_names=(JOINT,),
        channels={"position": channel},
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True),
        gains=ServoGains(np.array([STIFFNESS * gain]), np.zeros(1)),
        meta={"source": SOURCE},
    )
    validate(recording)
    return recording
