"""Encoders whose zero is not the model's.

A joint that stands further than its encoder says is a joint whose reference, `qpos0`, is lower by as much: servos, a
prescribed path, the start and what is recorded go by the encoder, and the physics by where the joint is.  What is left
is the gravity compensation, which MuJoCo works out where the joint is, and a controller where its encoder has it.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import Tracer

from droid_jax.model.gravity import change_of_force
from droid_jax.model.scene import Scene


def encoder_error(scene: Scene, model: Any) -> jax.Array | None:
    """[nv] rad or m by which joints stand further than their encoders say; None where no parameter writes it.

    model: the sample's mjx.Model.  Of hinges and slides; zero elsewhere.
    """
    own, given = scene.mjx.qpos0, model.qpos0
    traced = any(isinstance(reference, Tracer) for reference in (own, given))
    if given is own or (not traced and np.array_equal(own, given)):  # an equal one: of a model that a program returned
        return None
    single = np.isin(scene.model.jnt_type, (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)))
    address, dof = scene.model.jnt_qposadr[single], scene.model.jnt_dofadr[single]
    error = jnp.asarray(scene.model.qpos0[address], jnp.float32) - model.qpos0[address]
    return jnp.zeros(scene.model.nv, jnp.float32).at[dof].set(error)


def misplaced_compensation(model: Any, pose: Any, error: jax.Array | None) -> jax.Array | None:
    """[nv] N m: gravity compensation where the encoders say that the joints are, less that where they are.

    None where nothing is compensated, or no encoder is off.
    """
    if error is None or not model.flg_gravcomp or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        return None
    return change_of_force(model, pose, model.body_mass * model.body_gravcomp, -model.opt.gravity, -error)


def misplaced_weight(model: Any, pose: Any, error: jax.Array) -> jax.Array:
    """[nv] N m that a torque whose weight was taken out where the encoders say still holds of it."""
    return change_of_force(model, pose, model.body_mass, model.opt.gravity, -error)
