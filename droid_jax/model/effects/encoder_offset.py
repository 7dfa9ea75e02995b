"""An encoder whose zero is not the model's."""

import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import ENCODER
from droid_jax.model.fields import joint_encoder_offset as encoder_parameter
from droid_jax.model.scene import Scene

WIDTH = {False: (0.0175, 0.09), True: (0.002, 0.02)}  # prior deviation and bound: a degree of hinges, 2 mm of slides
FELT = 1e-3  # N m/rad (N/m): a joint with an offset that changes the torques by less is no place of it
POSES, APART = 10, 0.05  # states at which that is looked at, and the offset tried, rad or m


@register
def encoder_offset(scene: Scene) -> Effect | None:
    """A joint stands at what its encoder reads plus an offset, rad: its reference `qpos0` is lower by as much.

    Servo, gravity compensation, prescribed path and recorded positions go by the encoder (see `model.encoders`).
    """
    joints = tuple(j for j in a.arm(scene) if _felt(scene, j))
    if not joints:
        return None

    def parameter(joint: str):
        std, most = WIDTH[scene.slides(joint)]
        return encoder_parameter(scene, joint, std=std, high=most, unit="rad", group=a.GROUP)

    return Effect(
        ENCODER,
        tuple(parameter(j) for j in joints),
        description="an encoder whose zero is not the model's",
        signature="weight that goes by another angle of one joint, and inertia with it",
        confused_with=("gravity_direction", "payload", "cable_pull", "torque_bias"),
        locations=a.locations(joints, ENCODER),
        minimum_size=2e-3,
    )


def _felt(scene: Scene, joint: str) -> bool:
    """Whether torques, along motions of the encoders, depend on where the joint's zero is: of a free arm's first joint,
    upright, they do not; where something is gripped they do."""
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
        for offset in (0.0, APART):
            data.qpos[scene.qpos(joint)] += offset
            data.qvel[:], data.qacc[:] = velocity, acceleration
            mujoco.mj_inverse(model, data)
            torques.append(data.qfrc_inverse[a.arm_dofs(scene)].copy())
        change = max(change, float(np.abs(torques[1] - torques[0]).max()))
    return bool(change > FELT * APART)
