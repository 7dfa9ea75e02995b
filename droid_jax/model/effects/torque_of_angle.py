"""Torques in a joint of the arm that depend on its angle: a cable, and the ripple of a motor or gear."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

STIFFNESS, PULL = "cable_stiffness", "cable_pull"
SINE, COSINE, PERIODS = "ripple_sine", "ripple_cosine", "ripple_periods"
# Periods per turn.  Between two of these values the phase differs by four radians over one radian of motion.  A wider
# spacing would miss ripples in between.  Fewer than LEAST_COUNT periods can imitate any smooth law.
COUNTS = tuple(float(n) for n in range(12, 61, 4))
LEAST_COUNT = 10.0


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


@register
def torque_ripple(scene: Scene) -> Effect | None:
    """A sin(n q) + B cos(n q) in a joint, N m; n periods per turn."""
    joints, positions = a.arm(scene), a.arm_qpos(scene)
    if not joints:
        return None
    dofs = a.arm_dofs(scene)

    def force(theta, state):
        phase = a.value(theta, PERIODS, COUNTS[len(COUNTS) // 2]) * state.qpos[positions]
        torque = column(theta, SINE, joints) * jnp.sin(phase)
        torque = torque + column(theta, COSINE, joints) * jnp.cos(phase)
        return jnp.zeros_like(state.qvel).at[dofs].add(torque)

    return Effect(
        "torque_ripple",
        (
            *a.of_joints(SINE, joints, "N m", 0.1, 1.0),
            *a.of_joints(COSINE, joints, "N m", 0.1, 1.0),
            a.shape(PERIODS, "1/turn", COUNTS, LEAST_COUNT, 80.0),
        ),
        force=force,
        description="torque ripple of a joint's motor or gear",
        signature="periodic in the position of one joint",
        confused_with=("cable_pull",),
        locations=a.locations(joints, SINE, COSINE),
        shape_parameters={PERIODS: COUNTS},
        minimum_size=0.02,
    )
