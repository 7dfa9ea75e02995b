"""Orientations of an arm's links, for forces that depend on them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.scene import Scene

Turned = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]


def turned(scene: Scene, body: int) -> Turned | None:
    """A function (qpos [nq], qpos0 [nq]) -> axes [nv, 3] of the joints that carry a body, and its rotation [3, 3], in
    the world.

    Axes of degrees of freedom that do not turn the body are zero.  None if a free or ball joint carries it.
    """
    model, links = scene.model, list[int]()
    while body:
        links.insert(0, body)
        body = int(model.body_parentid[body])
    joints = [j for link in links for j in range(model.njnt) if model.jnt_bodyid[j] == link]
    if {int(model.jnt_type[j]) for j in joints} & {mujoco.mjtJoint.mjJNT_FREE.value, mujoco.mjtJoint.mjJNT_BALL.value}:
        return None
    frames = {link: jnp.asarray(_matrix(model.body_quat[link]), jnp.float32) for link in links}

    def at(qpos: jax.Array, qpos0: jax.Array) -> tuple[jax.Array, jax.Array]:
        axes, rotation = jnp.zeros((model.nv, 3), jnp.float32), jnp.eye(3, dtype=jnp.float32)
        for link in links:
            rotation = rotation @ frames[link]
            for joint in (j for j in joints if model.jnt_bodyid[j] == link):
                if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                    continue
                address, axis = int(model.jnt_qposadr[joint]), np.asarray(model.jnt_axis[joint], np.float32)
                axes = axes.at[int(model.jnt_dofadr[joint])].set(rotation @ axis)
                rotation = rotation @ _about(axis, qpos[address] - qpos0[address])
        return axes, rotation

    return at


def _about(axis: np.ndarray, angle: jax.Array) -> jax.Array:
    """[3, 3] rotation about a unit axis [3] by an angle [] rad.  Rodrigues' formula."""
    x, y, z = axis
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], jnp.float32)
    return jnp.eye(3) + jnp.sin(angle) * cross + (1.0 - jnp.cos(angle)) * (cross @ cross)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)
