"""What the effects share: parameters for a hinge or for every joint, and what holds a friction above zero."""

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
USUAL_SPEED = 0.3  # rad/s
RELIEF = 1.5
EXPONENTS = (1.0, 2.0)  # of a damper, of Stribeck's excess


def coefficient(
    name: str, unit: str, typical: float, high: float, *, low: float | None = None, role: Role = Role.OTHER
) -> Parameter:
    """A size that is zero at neutral; typical: its prior deviation; low: -high unless given."""
    return Parameter(name, unit, 0.0, typical, -high if low is None else low, high, group=GROUP, role=role)


def shape(name: str, unit: str, values: Sequence[float], low: float, high: float) -> Parameter:
    """A width, position or speed that matters only beside a coefficient; it starts at the middle of `values`."""
    ordered = sorted(values)
    return Parameter(name, unit, ordered[len(ordered) // 2], (high - low) / 4, low, high, group=GROUP)


def never_negative(friction: jax.Array, extra: jax.Array) -> jax.Array:
    """Friction with something added or taken away, never below zero; one that is negative already stays as it is."""
    return jnp.maximum(friction + extra, jnp.minimum(friction, 0.0))


def arm(scene: Scene) -> tuple[str, ...]:
    """The measured joints but the object's own."""
    return tuple(j for j in scene.joints if j != scene.object_joint)


def arm_dofs(scene: Scene) -> np.ndarray:
    """[J] their degrees of freedom."""
    return np.array([scene.dof(j) for j in arm(scene)], dtype=int)


def arm_qpos(scene: Scene) -> np.ndarray:
    """[J] their entries of qpos."""
    return np.array([scene.qpos(j) for j in arm(scene)], dtype=int)


def of_joints(
    name: str, joints: Sequence[str], unit: str, typical: float, high: float, *, low: float | None = None
) -> tuple[Parameter, ...]:
    """One coefficient a joint, `name[joint]`."""
    return tuple(coefficient(f"{name}[{j}]", unit, typical, high, low=low) for j in joints)


def locations(joints: Sequence[str], *names: str) -> dict[str, tuple[str, ...]]:
    """location -> coefficients, for effects with the coefficients `names` in every joint."""
    return {j: tuple(f"{n}[{j}]" for n in names) for j in joints}


def value(theta: Theta, name: str, neutral: float = 0.0) -> jax.Array:
    """[] an entry of theta; its neutral value where theta has none."""
    return jnp.asarray(theta.get(name, neutral), jnp.float32)


def hinge(scene: Scene) -> str | None:
    """The object's joint where it is a hinge, else None."""
    joint = scene.object_joint
    if joint is None or scene.model.jnt_type[scene.id("joint", joint)] != mujoco.mjtJoint.mjJNT_HINGE:
        return None
    return joint


def at_dof(scene: Scene, joint: str, torque: jax.Array) -> jax.Array:
    """[nv] a torque [] at one joint."""
    return jnp.zeros(scene.model.nv, jnp.float32).at[scene.dof(joint)].set(torque)


def angle(scene: Scene, joint: str, state: State) -> jax.Array:
    """[] rad."""
    return state.qpos[scene.qpos(joint)]


def speed(scene: Scene, joint: str, state: State) -> jax.Array:
    """[] rad/s."""
    return state.qvel[scene.dof(joint)]


def damping(speed: jax.Array, exponent: jax.Array) -> jax.Array:
    """[] rad/s, what a damper's coefficient multiplies: the speed where it is 0.3 rad/s, growing with its power.

    Oil through a narrow gap is linear in the speed, through an orifice quadratic; above RELIEF times
    0.3 rad/s a valve opens, which also keeps a force that is taken at the old speed from ringing.
    """
    return USUAL_SPEED * jnp.minimum(jnp.abs(speed) / USUAL_SPEED, RELIEF) ** exponent
