"""Hidden errors of the arm's set-up: a tilted base and encoder zero offsets.

The robot's controller has neither in its model: it compensates the weight of an upright arm at the positions that its
encoders read.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from droid_jax.synthetic.hooks import Hidden, Influence, Live, Place, SensorInput

AZIMUTH = 0.6  # rad from the world's x axis, of the horizontal line about which the base is tilted


def hide_tilted_base(place: Place, a: float) -> Influence:
    """Gravity turned by a rad about a horizontal line at `AZIMUTH`, in the frame of the arm's base.

    The gravity compensation, a force at each body's centre of mass, is not turned.  Gravity on the object is not turned
    either.
    """
    scene = place.scene
    _refuse_motors_that_compensate(scene.model, "tilted_base")
    upright = scene.model.opt.gravity.copy()
    quaternion, tilted = np.zeros(4), np.zeros(3)
    mujoco.mju_axisAngle2Quat(quaternion, np.array([math.cos(AZIMUTH), math.sin(AZIMUTH), 0.0]), a)
    mujoco.mju_rotVecQuat(tilted, upright, quaternion)
    forces = dict[int, np.ndarray]()

    def edit(model: mujoco.MjModel) -> None:
        """Compute the forces from the masses of this repeat's model."""
        if a == 0.0:
            return
        compensated = model.body_mass * model.body_gravcomp
        forces.clear()
        forces.update({body: -mass * upright for body, mass in enumerate(compensated.tolist()) if mass != 0.0})
        for body in _behind(model, scene.object_joint):  # upright gravity on the object
            forces[body] = forces.get(body, np.zeros(3)) + model.body_mass[body] * (upright - tilted)
        model.opt.gravity, model.body_gravcomp[:] = tilted, 0.0

    def begin(live: Live) -> None:
        mujoco.mj_kinematics(live.model, live.data)
        mujoco.mj_comPos(live.model, live.data)

    def step(live: Live) -> None:
        for body, force in forces.items():
            mujoco.mj_applyFT(live.model, live.data, force, np.zeros(3), live.data.xipos[body], body, live.applied)

    return Influence(edit=edit, begin=begin, step=step)


def hide_encoder_zero(place: Place, a: float) -> Influence:
    """Joint positions are a rad larger than their encoders read: at the start, in the servos and in the recording.

    Gravity is compensated at the positions that are read.
    """
    model = place.scene.model
    _refuse_motors_that_compensate(model, "encoder_zero")
    data, gain = mujoco.MjData(model), model.actuator_gainprm[place.actuators, 0]
    feedback = np.where(gain != 0, -model.actuator_biasprm[place.actuators, 1] / np.where(gain != 0, gain, 1.0), 0.0)
    share = feedback * model.actuator_gear[place.actuators, 0]  # 1 for a position servo, 0 for a motor

    def compensation(positions: np.ndarray) -> np.ndarray:
        """[nv] N m, of the controller's model, which other hidden effects do not change."""
        data.qpos[:] = positions
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_passive(model, data)
        return data.qfrc_gravcomp.copy()

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        control[:, place.actuators] += share * a
        return control

    def begin(live: Live) -> None:
        live.position[place.qpos] += a

    def step(live: Live) -> None:
        if a != 0.0 and model.body_gravcomp.any():
            read = live.position.copy()
            read[place.qpos] -= a
            live.applied[:] += compensation(read) - compensation(live.position)

    def sense(signals: SensorInput) -> SensorInput:
        position = signals.position.copy()
        position[:, place.columns] -= a
        return SensorInput(signals.clock, signals.torque, position)

    return Influence(command=command, begin=begin, step=step, sense=sense)


def _refuse_motors_that_compensate(model: mujoco.MjModel, name: str) -> None:
    if model.jnt_actgravcomp.any():
        raise ValueError(f"hidden effect {name!r} does not support actuatorgravcomp: remove it from the MJCF")


def _behind(model: mujoco.MjModel, joint: str | None) -> list[int]:
    """Bodies that a joint moves; empty without a joint."""
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
