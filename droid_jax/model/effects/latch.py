"""A magnetic catch, a ball catch or a latch, which holds the door in its first degrees only."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

TORQUE, WIDTH, EXPONENT = "latch_torque", "latch_width", "latch_exponent"
WIDTHS = (0.02, 0.04, 0.08, 0.14)  # rad
EXPONENTS = (0.6, 1.0, 2.0)


@register
def latch(scene: Scene) -> Effect | None:
    """-A exp(-(phi/width)^n) on the hinge for phi >= 0: n = 1 for a magnet, n = 2 for a ball catch.

    A real frame stops the door at phi = 0.  The simulated door has no frame, so the pull increases from zero over a
    tenth of the width.
    """
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        share = jnp.maximum(a.angle(scene, joint, state), 0.0) / a.value(theta, WIDTH, WIDTHS[2])
        far = share ** a.value(theta, EXPONENT, EXPONENTS[1])
        pull = jnp.exp(-far) - jnp.exp(-10.0 * share - far)
        return a.at_dof(scene, joint, -a.value(theta, TORQUE) * pull)

    return Effect(
        "latch",
        (
            a.coefficient(TORQUE, "N m", 1.0, 25.0, low=0.0),
            a.shape(WIDTH, "rad", WIDTHS, 0.01, 0.2),
            a.shape(EXPONENT, "-", EXPONENTS, 0.5, 2.5),
        ),
        force=force,
        description="a magnetic catch or latch that holds the door in its first degrees",
        signature="the first degrees of opening, and the last of closing",
        confused_with=("hinge_stribeck", "over_centre_spring"),
        locations={joint: (TORQUE,)},
        shape_parameters={WIDTH: WIDTHS, EXPONENT: EXPONENTS},
        minimum_size=0.1,
    )
