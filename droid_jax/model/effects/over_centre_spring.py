"""A self-closing hinge: its spring pulls hardest at a small angle and less further out."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

TORQUE, ANGLE = "over_centre_torque", "over_centre_angle"
ANGLES = (0.1, 0.2, 0.35, 0.55)  # rad, of the peak: 5 to 30 degrees


@register
def over_centre_spring(scene: Scene) -> Effect | None:
    """-A (phi/p) exp(1 - phi/p) on the hinge for phi > 0: zero at phi = 0, A at phi = p, decreasing beyond."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        share = jnp.maximum(a.angle(scene, joint, state), 0.0) / a.value(theta, ANGLE, ANGLES[2])
        return a.at_dof(scene, joint, -a.value(theta, TORQUE) * share * jnp.exp(1.0 - share))

    return Effect(
        "over_centre_spring",
        (a.coefficient(TORQUE, "N m", 1.0, 25.0, low=0.0), a.shape(ANGLE, "rad", ANGLES, 0.05, 0.9)),
        force=force,
        description="a self-closing hinge whose spring pulls hardest at a small angle and fades further out",
        signature="5 to 30 degrees of opening, in both directions",
        confused_with=("latch", "hinge_preload"),
        locations={joint: (TORQUE,)},
        shape_parameters={ANGLE: ANGLES},
        minimum_size=0.1,
    )
