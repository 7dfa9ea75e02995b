"""Joint friction that grows with the torque a gear carries."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

SHARE = "load_friction"


@register
def load_friction(scene: Scene) -> Effect | None:
    """K |tau| sgn(qd): a share K of the actuator's torque, on top of a joint's friction loss."""
    joints, dofs = a.arm(scene), a.arm_dofs(scene)
    if not joints:
        return None

    def frictionloss(theta, state, base):
        return base.at[dofs].add(column(theta, SHARE, joints) * jnp.abs(state.load[dofs]))

    return Effect(
        SHARE,
        a.of_joints(SHARE, joints, "-", 0.05, 1.0, low=0.0),
        frictionloss=frictionloss,
        description="friction of a joint of the arm that grows with its load",
        signature="steps at that joint's reversals that grow with its torque",
        confused_with=("joint_coulomb", "torque_gain"),
        locations=a.places(joints, SHARE),
        minimum_size=0.01,
    )
