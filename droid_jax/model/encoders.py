"""Encoder zero offsets in a replay, and the gravity compensation that they misplace.

A joint whose position exceeds its encoder's reading by an offset is modelled by a reference `qpos0` that is lower by
that offset.  Positions in the replay are then encoder readings: of servos, of a prescribed path, of the start and of
recordings.  The physics uses the true positions.  Gravity compensation is the exception: MuJoCo computes it at the true
positions, a controller at the encoders' readings.  This module computes the difference.
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
    """[nv] joint position minus encoder reading, rad or m; None if no parameter writes it.

    model: the sample's mjx.Model.  The entries of free and ball joints are zero.
    """
    reference, given = scene.mjx.qpos0, model.qpos0
    traced = any(isinstance(qpos0, Tracer) for qpos0 in (reference, given))
    if given is reference or (not traced and np.array_equal(reference, given)):  # a program may return an equal copy
        return None
    single = np.isin(scene.model.jnt_type, (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)))
    address, dof = scene.model.jnt_qposadr[single], scene.model.jnt_dofadr[single]
    error = jnp.asarray(scene.model.qpos0[address], jnp.float32) - model.qpos0[address]
    return jnp.zeros(scene.model.nv, jnp.float32).at[dof].set(error)


def misplaced_compensation(model: Any, pose: Any, error: jax.Array | None) -> jax.Array | None:
    """[nv] N m, gravity compensation at the encoders' readings minus that at the true positions.

    None if nothing is compensated, or `error` is None.
    """
    if error is None or not model.flg_gravcomp or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        return None
    return change_of_force(model, pose, model.body_mass * model.body_gravcomp, -model.opt.gravity, -error)


def misplaced_weight(model: Any, pose: Any, error: jax.Array) -> jax.Array:
    """[nv] N m, gravity that remains in a torque from which it was subtracted at the encoders' readings."""
    return change_of_force(model, pose, model.body_mass, model.opt.gravity, -error)
