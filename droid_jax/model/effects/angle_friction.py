"""Dry friction of the hinge that changes as the door opens: a door that drags on the floor."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

SLOPE, CURVE = "angle_friction_slope", "angle_friction_curve"


@register
def angle_friction(scene: Scene) -> Effect | None:
    """F(phi) = F0 + f1 phi + f2 phi^2 in place of the hinge's constant F0, never below zero."""
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
