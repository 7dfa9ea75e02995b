"""Dry friction that differs between the two directions: of the arm's joints, of the hinge."""

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.joint_friction import direction
from droid_jax.model.scene import Scene

JOINT, HINGE = "joint_directional", "hinge_directional"


@register
def joint_directional(scene: Scene) -> Effect | None:
    """F+ - F- = 2 d: friction loss + d sgn(qd) in a joint, never below zero, N m."""
    joints, dofs = a.arm(scene), a.arm_dofs(scene)
    if not joints:
        return None

    def frictionloss(theta, state, base):
        extra = column(theta, JOINT, joints) * direction(state.qvel[dofs])
        return base.at[dofs].set(a.never_negative(base[dofs], extra))

    return Effect(
        JOINT,
        a.of_joints(JOINT, joints, "N m", 0.2, 2.0),
        frictionloss=frictionloss,
        description="dry friction of a joint of the arm that differs between its two directions",
        signature="an offset that depends on the direction of that joint's motion",
        confused_with=("joint_coulomb", "torque_bias"),
        locations=a.locations(joints, JOINT),
        minimum_size=0.03,
    )


@register
def hinge_directional(scene: Scene) -> Effect | None:
    """`joint_directional` on the object's hinge."""
    joint = a.hinge(scene)
    if joint is None:
        return None
    dof = scene.dof(joint)

    def frictionloss(theta, state, base):
        extra = a.value(theta, HINGE) * direction(state.qvel[dof])
        return base.at[dof].set(a.never_negative(base[dof], extra))

    return Effect(
        HINGE,
        (a.coefficient(HINGE, "N m", 0.3, 3.0),),
        frictionloss=frictionloss,
        description="dry friction of the hinge that differs between opening and closing",
        signature="a step at the door's reversals",
        confused_with=("hinge_preload", "angle_friction"),
        locations={joint: (HINGE,)},
        minimum_size=0.05,
    )
