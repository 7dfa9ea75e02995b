"""Helpers of effects: parameters for a hinge or for each joint, non-negative friction, damping laws."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import State, Theta
from droid_jax.model.parameters import Parameter, Role
from droid_jax.model.scene import Scene

GROUP = "Effect"
USUAL_SPEED = 0.3  # rad/s, reference speed of `damping`
RELIEF = 1.5  # multiple of that speed at which a damper's relief valve opens
EXPONENTS = (1.0, 2.0)  # values of a damper's exponent, and of that of Stribeck friction


def coefficient(
    name: str, unit: str, typical: float, high: float, *, low: float | None = None, role: Role = Role.OTHER
) -> Parameter:
    """A coefficient, zero at neutral; typical: prior deviation; low: lower bound, None: -high."""
    return Parameter(name, unit, 0.0, typical, -high if low is None else low, high, group=GROUP, role=role)


def shape(name: str, unit: str, values: Sequence[float], low: float, high: float) -> Parameter:
    """A shape parameter (a width, position or speed) with the middle one of `values` as mean."""
    ordered = sorted(values)
    return Parameter(name, unit, ordered[len(ordered) // 2], (high - low) / 4, low, high, group=GROUP)


def never_negative(friction: jax.Array, extra: jax.Array) -> jax.Array:
    """friction + extra, at least zero (or at least `friction` if that is negative already)."""
    return jnp.maximum(friction + extra, jnp.minimum(friction, 0.0))


def arm(scene: Scene) -> tuple[str, ...]:
    """The measured joints without the object's joint."""
    return tuple(j for j in scene.joints if j != scene.object_joint)


def arm_dofs(scene: Scene) -> np.ndarray:
    """[J] velocity addresses of the arm's joints."""
    return np.array([scene.dof(j) for j in arm(scene)], dtype=int)


def arm_qpos(scene: Scene) -> np.ndarray:
    """[J] position addresses of the arm's joints."""
    return np.array([scene.qpos(j) for j in arm(scene)], dtype=int)


def of_joints(
    name: str, joints: Sequence[str], unit: str, typical: float, high: float, *, low: float | None = None
) -> tuple[Parameter, ...]:
    """One coefficient for each joint, `name[joint]`."""
    return tuple(coefficient(f"{name}[{j}]", unit, typical, high, low=low) for j in joints)


def locations(joints: Sequence[str], *names: str) -> dict[str, tuple[str, ...]]:
    """Location -> coefficients, for an effect with the coefficients `names` at each joint."""
    return {j: tuple(f"{n}[{j}]" for n in names) for j in joints}


def value(theta: Theta, name: str, neutral: float = 0.0) -> jax.Array:
    """[] an entry of theta; `neutral` if theta lacks it."""
    return jnp.asarray(theta.get(name, neutral), jnp.float32)


def hinge(scene: Scene) -> str | None:
    """The object's joint if it is a hinge, else None."""
    joint = scene.object_joint
    if joint is None or scene.model.jnt_type[scene.id("joint", joint)] != mujoco.mjtJoint.mjJNT_HINGE:
        return None
    return joint


def at_dof(scene: Scene, joint: str, torque: jax.Array) -> jax.Array:
    """[nv] generalised force of a torque [] N m at one joint."""
    return jnp.zeros(scene.model.nv, jnp.float32).at[scene.dof(joint)].set(torque)


def angle(scene: Scene, joint: str, state: State) -> jax.Array:
    """[] rad, position of a joint."""
    return state.qpos[scene.qpos(joint)]


def speed(scene: Scene, joint: str, state: State) -> jax.Array:
    """[] rad/s, velocity of a joint."""
    return state.qvel[scene.dof(joint)]


def damping(speed: jax.Array, exponent: jax.Array) -> jax.Array:
    """[] rad/s, w0 (|w| / w0)^exponent, which a damper's coefficient multiplies; w0 = USUAL_SPEED.

    Oil in a narrow gap damps linearly, in an orifice quadratically.  From RELIEF * w0 on a relief valve opens and the
    value is constant.  This also avoids ringing, since the force is computed from the velocity before the step.
    """
    return USUAL_SPEED * jnp.minimum(jnp.abs(speed) / USUAL_SPEED, RELIEF) ** exponent
