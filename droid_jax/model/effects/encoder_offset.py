"""Encoder zero offsets of the arm's joints."""

import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import ENCODER
from droid_jax.model.fields import joint_encoder_offset as encoder_parameter
from droid_jax.model.scene import Scene

WIDTH = {False: (0.0175, 0.09), True: (0.002, 0.02)}  # prior deviation and bound; False: hinge, rad, True: slide, m
LEAST_CHANGE = 1e-3  # N m/rad (N/m), a joint whose offset changes torques by less is no location
POSES, OFFSET = 10, 0.05  # states at which this is tested, and the tested offset, rad or m


@register
def encoder_offset(scene: Scene) -> Effect | None:
    """A joint's position is its encoder's reading plus an offset, rad; its reference `qpos0` decreases by the offset.

    Servo, gravity compensation, prescribed path and recorded positions use the reading (see `model.encoders`).
    """
    joints = tuple(j for j in a.arm(scene) if _changes_torques(scene, j))
    if not joints:
        return None

    def parameter(joint: str):
        std, most = WIDTH[scene.slides(joint)]
        return encoder_parameter(scene, joint, std=std, high=most, unit="rad", group=a.GROUP)

    return Effect(
        ENCODER,
        tuple(parameter(j) for j in joints),
        description="an encoder whose zero is not the model's",
        signature="weight and inertia at another angle of one joint",
        confused_with=("gravity_direction", "payload", "cable_pull", "torque_bias"),
        locations=a.locations(joints, ENCODER),
        minimum_size=2e-3,
    )


def _changes_torques(scene: Scene, joint: str) -> bool:
    """Whether torques along a motion of the encoders depend on the joint's zero.

    They do not for a free arm's first joint with a vertical axis.  They do if something is gripped.
    """
    if scene.grip is not None or scene.model.npair:
        return True
    model = scene.model.__copy__()
    model.body_gravcomp[:] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data, rng, change = mujoco.MjData(model), np.random.default_rng(0), 0.0
    for _ in range(POSES):
        torques = []
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-1.0, 1.0, model.nv), 1.0)
        velocity, acceleration = rng.normal(0.0, 1.0, (2, model.nv))
        for offset in (0.0, OFFSET):
            data.qpos[scene.qpos(joint)] += offset
            data.qvel[:], data.qacc[:] = velocity, acceleration
            mujoco.mj_inverse(model, data)
            torques.append(data.qfrc_inverse[a.arm_dofs(scene)].copy())
        change = max(change, float(np.abs(torques[1] - torques[0]).max()))
    return bool(change > LEAST_CHANGE * OFFSET)
