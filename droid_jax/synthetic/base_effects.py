"""Hidden errors of how the arm was set up: a base that leans, encoders whose zeros are off.

The robot's controller knows of neither: it compensates the weight of an upright arm where its encoders say that it is.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place, Seen

AZIMUTH = 0.6  # rad from the world's x axis, of the horizontal line about which the base leans


def hide_tilted_base(place: Place, a: float) -> Influence:
    """Gravity turned by a rad about a horizontal line at `AZIMUTH`, in the frame of the arm's base.

    The compensation, a force at each body's centre of mass, stays upright.  What the object hangs from does not lean.
    """
    scene = place.scene
    _refuse_motors_that_compensate(scene.model, "tilted_base")
    upright = scene.model.opt.gravity.copy()
    quaternion, leaning = np.zeros(4), np.zeros(3)
    mujoco.mju_axisAngle2Quat(quaternion, np.array([math.cos(AZIMUTH), math.sin(AZIMUTH), 0.0]), a)
    mujoco.mju_rotVecQuat(leaning, upright, quaternion)
    held = dict[int, np.ndarray]()

    def edit(model: mujoco.MjModel) -> None:
        """Of each repeat's own masses."""
        if a == 0.0:
            return
        carried = model.body_mass * model.body_gravcomp
        held.clear()
        held.update({body: -mass * upright for body, mass in enumerate(carried.tolist()) if mass != 0.0})
        for body in _behind(model, scene.object_joint):  # back to upright
            held[body] = held.get(body, np.zeros(3)) + model.body_mass[body] * (upright - leaning)
        model.opt.gravity, model.body_gravcomp[:] = leaning, 0.0

    def begin(live: Live) -> None:
        mujoco.mj_kinematics(live.model, live.data)
        mujoco.mj_comPos(live.model, live.data)

    def step(live: Live) -> None:
        for body, force in held.items():
            mujoco.mj_applyFT(live.model, live.data, force, np.zeros(3), live.data.xipos[body], body, live.applied)

    return Influence(edit=edit, begin=begin, step=step)


def hide_encoder_zero(place: Place, a: float) -> Influence:
    """Joints stand a rad further than their encoders say: at the start, wherever a servo holds them, in the recording.

    Gravity is compensated as if they stood where they are read.
    """
    model = place.scene.model
    _refuse_motors_that_compensate(model, "encoder_zero")
    read, gain = mujoco.MjData(model), model.actuator_gainprm[place.actuators, 0]
    feedback = np.where(gain != 0, -model.actuator_biasprm[place.actuators, 1] / np.where(gain != 0, gain, 1.0), 0.0)
    ahead = feedback * model.actuator_gear[place.actuators, 0]  # 1 of a position servo, 0 of a motor

    def compensation(positions: np.ndarray) -> np.ndarray:
        """By the model that the controller has, whatever other effects made of the robot's own."""
        read.qpos[:] = positions
        mujoco.mj_kinematics(model, read)
        mujoco.mj_comPos(model, read)
        mujoco.mj_passive(model, read)
        return read.qfrc_gravcomp.copy()

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        control[:, place.actuators] += ahead * a
        return control

    def begin(live: Live) -> None:
        live.position[place.qpos] += a

    def step(live: Live) -> None:
        if a != 0.0 and model.body_gravcomp.any():
            seen = live.position.copy()
            seen[place.qpos] -= a
            live.applied[:] += compensation(seen) - compensation(live.position)

    def sense(seen: Seen) -> Seen:
        position = seen.position.copy()
        position[:, place.columns] -= a
        return Seen(seen.clock, seen.torque, position)

    return Influence(command=command, begin=begin, step=step, sense=sense)


def _refuse_motors_that_compensate(model: mujoco.MjModel, name: str) -> None:
    if model.jnt_actgravcomp.any():
        raise ValueError(f"hidden effect {name!r} knows no actuatorgravcomp: take it out of the MJCF")


def _behind(model: mujoco.MjModel, joint: str | None) -> list[int]:
    """Bodies that a joint moves; none where there is no joint."""
    if joint is None:
        return []
    moved = [int(model.jnt_bodyid[model.joint(joint).id])]
    for body in range(moved[0] + 1, model.nbody):
        if int(model.body_parentid[body]) in moved:
            moved.append(body)
    return moved


BASE = (
    Hidden("tilted_base", "rad", (0.005, 0.05), "base", hide_tilted_base, "a base that is not level", signed=True),
    Hidden("encoder_zero", "rad", (0.005, 0.05), "arm", hide_encoder_zero, "encoders whose zeros are off", signed=True),
)
