"""Torque ripple: cogging of a motor or the teeth of a gear, periodic in a joint's position."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

SINE, COSINE, PERIODS = "ripple_sine", "ripple_cosine", "ripple_periods"
# Periods a turn.  Between two of them the phase drifts by four radians over one radian of motion: were it more, a
# ripple between two counts would look like neither.  Fewer than FEWEST make a curve that mimics anything smooth.
COUNTS = tuple(float(n) for n in range(12, 61, 4))
FEWEST = 10.0


@register
def torque_ripple(scene: Scene) -> Effect | None:
    """A sin(n q) + B cos(n q) in a joint, N m; n periods a turn."""
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
            a.shape(PERIODS, "1/turn", COUNTS, FEWEST, 80.0),
        ),
        force=force,
        description="torque ripple of a joint's motor or gear",
        signature="periodic in the position of one joint",
        confused_with=("cable_pull",),
        locations=a.locations(joints, SINE, COSINE),
        shape_parameters={PERIODS: COUNTS},
        minimum_size=0.02,
    )
