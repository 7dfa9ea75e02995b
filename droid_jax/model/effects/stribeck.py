"""Friction that is higher at rest than in motion (Stribeck): of the arm's joints, of the hinge.

exp(-|v/vs|^n): n = 1 after Tustin, n = 2 after Armstrong-Helouvry (Automatica 1994, table 3).
"""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

JOINT, JOINT_SPEED, JOINT_EXPONENT = "joint_stribeck", "joint_stribeck_speed", "joint_stribeck_exponent"
HINGE, HINGE_SPEED, HINGE_EXPONENT = "hinge_stribeck", "hinge_stribeck_speed", "hinge_stribeck_exponent"
SPEEDS = (0.01, 0.03, 0.1)  # rad/s


def _excess(theta, speed_name: str, exponent_name: str, velocity):
    """exp(-|v/vs|^n)."""
    share = jnp.abs(velocity / a.value(theta, speed_name, SPEEDS[1]))
    return jnp.exp(-(share ** a.value(theta, exponent_name, a.EXPONENTS[1])))


@register
def joint_stribeck(scene: Scene) -> Effect | None:
    """(Fs - Fc) exp(-|v/vs|^n), N m, added to a joint's friction loss."""
    joints, dofs = a.arm(scene), a.arm_dofs(scene)
    if not joints:
        return None

    def frictionloss(theta, state, base):
        extra = column(theta, JOINT, joints) * _excess(theta, JOINT_SPEED, JOINT_EXPONENT, state.qvel[dofs])
        return base.at[dofs].add(extra)

    return Effect(
        JOINT,
        (
            *a.of_joints(JOINT, joints, "N m", 0.2, 2.0, low=0.0),
            a.shape(JOINT_SPEED, "rad/s", SPEEDS, 0.005, 0.2),
            a.shape(JOINT_EXPONENT, "-", a.EXPONENTS, 1.0, 2.5),
        ),
        frictionloss=frictionloss,
        description="friction of a joint of the arm that is higher at rest than in motion",
        signature="breakaway and reversals of that joint",
        confused_with=("joint_coulomb",),
        special_cases=("joint_coulomb",),  # for vs above the joint's largest speed
        locations=a.locations(joints, JOINT),
        shape_parameters={JOINT_SPEED: SPEEDS, JOINT_EXPONENT: a.EXPONENTS},
        minimum_size=0.05,
    )


@register
def hinge_stribeck(scene: Scene) -> Effect | None:
    """`joint_stribeck` on the object's hinge."""
    joint = a.hinge(scene)
    if joint is None:
        return None
    dof = scene.dof(joint)

    def frictionloss(theta, state, base):
        return base.at[dof].add(a.value(theta, HINGE) * _excess(theta, HINGE_SPEED, HINGE_EXPONENT, state.qvel[dof]))

    return Effect(
        HINGE,
        (
            a.coefficient(HINGE, "N m", 0.5, 3.0, low=0.0),
            a.shape(HINGE_SPEED, "rad/s", SPEEDS, 0.005, 0.2),
            a.shape(HINGE_EXPONENT, "-", a.EXPONENTS, 1.0, 2.5),
        ),
        frictionloss=frictionloss,
        description="friction of the hinge that is higher at rest than in motion",
        signature="breakaway and reversals of the door",
        confused_with=("latch", "joint_stribeck"),
        locations={joint: (HINGE,)},
        shape_parameters={HINGE_SPEED: SPEEDS, HINGE_EXPONENT: a.EXPONENTS},
        minimum_size=0.1,
    )
