"""Dry friction beyond a joint's constant: of the arm's joints, and of a hinge whose friction changes with its angle."""

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

LOSS = "joint_coulomb"
SLOPE, CURVE = "angle_friction_slope", "angle_friction_curve"


@register
def joint_coulomb(scene: Scene) -> Effect | None:
    """A constant Fc, N m, added to a joint's friction loss."""
    joints, dofs = a.arm(scene), a.arm_dofs(scene)
    if not joints:
        return None

    def frictionloss(theta, state, base):
        return base.at[dofs].add(column(theta, LOSS, joints))

    def native(values, model):
        return {("dof_frictionloss", d): values.get(f"{LOSS}[{j}]", 0.0) for j, d in zip(joints, dofs, strict=True)}

    return Effect(
        LOSS,
        a.of_joints(LOSS, joints, "N m", 0.3, 5.0, low=0.0),
        frictionloss=frictionloss,
        native=native,
        description="dry friction in a joint of the arm",
        signature="a step at every reversal of that joint, in all phases",
        confused_with=("joint_stribeck", "joint_directional", "load_friction"),
        locations=a.locations(joints, LOSS),
        minimum_size=0.03,
    )


@register
def angle_friction(scene: Scene) -> Effect | None:
    """F0 + f1 phi + f2 phi^2 in place of the hinge's constant F0, never below zero: a door that drags on the floor."""
    joint = a.hinge(scene)
    if joint is None:
        return None
    dof = scene.dof(joint)

    def frictionloss(theta, state, base):
        phi = a.angle(scene, joint, state)
        extra = a.value(theta, SLOPE) * phi + a.value(theta, CURVE) * phi**2
        return base.at[dof].set(a.never_negative(base[dof], extra))

    return Effect(
        "angle_friction",
        (a.coefficient(SLOPE, "N m/rad", 0.5, 5.0), a.coefficient(CURVE, "N m/rad^2", 0.5, 5.0)),
        frictionloss=frictionloss,
        description="dry friction of the hinge that changes with the door's angle",
        signature="hysteresis over the angle: opening and closing differ more at some angles",
        confused_with=("hardening_spring", "hinge_directional"),
        locations={joint: (SLOPE, CURVE)},
        minimum_size=0.1,
    )
