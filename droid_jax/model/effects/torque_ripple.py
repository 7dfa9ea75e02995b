"""Torque ripple: cogging of a motor or the teeth of a gear, periodic in a joint's position."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

SINE, COSINE, PERIODS = "ripple_sine", "ripple_cosine", "ripple_periods"
# Periods per turn.  Between two of these values the phase differs by four radians over one radian of motion.  A wider
# spacing would miss ripples in between.  Fewer than LEAST_COUNT periods can imitate any smooth law.
COUNTS = tuple(float(n) for n in range(12, 61, 4))
LEAST_COUNT = 10.0


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
