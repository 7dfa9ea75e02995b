"""A cable or hose that pulls a joint of the arm."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

STIFFNESS, PULL = "cable_stiffness", "cable_pull"


@register
def cable_pull(scene: Scene) -> Effect | None:
    """-k (q - q0) - p in a joint: stiffness k, N m/rad, and pull p, N m, at the model's reference position q0."""
    joints, positions = a.arm(scene), a.arm_qpos(scene)
    if not joints:
        return None
    dofs, reference = a.arm_dofs(scene), scene.model.qpos0[positions]

    def force(theta, state):
        stretch = state.qpos[positions] - reference
        torque = column(theta, STIFFNESS, joints) * stretch + column(theta, PULL, joints)
        return jnp.zeros_like(state.qvel).at[dofs].add(-torque)

    return Effect(
        "cable_pull",
        (*a.of_joints(STIFFNESS, joints, "N m/rad", 0.5, 10.0), *a.of_joints(PULL, joints, "N m", 0.3, 5.0)),
        force=force,
        description="a cable or hose that pulls on a joint of the arm",
        signature="smooth in the position of one joint, the same at every speed",
        confused_with=("payload", "torque_bias"),
        special_cases=("torque_bias",),  # for k = 0
        locations=a.locations(joints, STIFFNESS, PULL),
        minimum_size=0.1,
    )
