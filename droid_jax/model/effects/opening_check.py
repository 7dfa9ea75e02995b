"""An opening check: a damper that brakes a door that is opened fast and far."""

import jax
import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

DAMPING, ANGLE, EXPONENT = "check_damping", "check_angle", "check_exponent"
ANGLES = (0.3, 0.5, 0.7)  # rad, at which the braking begins
SOFT = 0.05  # rad, over which it builds up


@register
def opening_check(scene: Scene) -> Effect | None:
    """-c w0 (w / w0)^n on the hinge beyond phi_b for w > 0, w0 = 0.3 rad/s."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        phi, w = a.angle(scene, joint, state), a.speed(scene, joint, state)
        beyond = jax.nn.sigmoid((phi - a.value(theta, ANGLE, ANGLES[1])) / SOFT)
        brake = a.damping(jnp.maximum(w, 0.0), a.value(theta, EXPONENT, a.EXPONENTS[1]))
        return a.at_dof(scene, joint, -a.value(theta, DAMPING) * beyond * brake)

    return Effect(
        "opening_check",
        (
            a.coefficient(DAMPING, "N m s/rad", 2.0, 6.0, low=0.0),
            a.shape(ANGLE, "rad", ANGLES, 0.1, 1.2),
            a.shape(EXPONENT, "-", a.EXPONENTS, 0.8, 2.2),
        ),
        force=force,
        description="an opening check, which brakes the door beyond some angle",
        signature="late in a fast opening",
        confused_with=("hardening_spring", "drag"),
        locations={joint: (DAMPING,)},
        shape_parameters={ANGLE: ANGLES, EXPONENT: a.EXPONENTS},
        minimum_size=0.1,
    )
