"""A hinge spring that stiffens as the door opens."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

SQUARE, CUBE = "hardening_square", "hardening_cube"


@register
def hardening_spring(scene: Scene) -> Effect | None:
    """-k2 phi |phi| - k3 phi^3 on the hinge; N m/rad^2 and N m/rad^3."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        phi = a.angle(scene, joint, state)
        torque = a.value(theta, SQUARE) * phi * abs(phi) + a.value(theta, CUBE) * phi**3
        return a.at_dof(scene, joint, -torque)

    return Effect(
        "hardening_spring",
        (a.coefficient(SQUARE, "N m/rad^2", 0.5, 5.0), a.coefficient(CUBE, "N m/rad^3", 0.5, 5.0)),
        force=force,
        description="a hinge spring that gets stiffer the further the door opens",
        signature="late in the opening, the same at every speed and in both directions",
        confused_with=("tilted_frame", "opening_check", "angle_friction"),
        locations={joint: (SQUARE, CUBE)},
        minimum_size=0.1,
    )
