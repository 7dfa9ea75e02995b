"""A door closer: a damper that acts while the door closes."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

DAMPING, EXPONENT = "closer_damping", "closer_exponent"


@register
def door_closer(scene: Scene) -> Effect | None:
    """c w0 (|w| / w0)^n on the hinge for w < 0, w0 = 0.3 rad/s.  Its preload is the effect hinge_preload."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        closing = jnp.minimum(a.speed(scene, joint, state), 0.0)
        brake = a.damping(closing, a.value(theta, EXPONENT, a.EXPONENTS[1]))
        return a.at_dof(scene, joint, a.value(theta, DAMPING) * brake)

    return Effect(
        "door_closer",
        (a.coefficient(DAMPING, "N m s/rad", 2.0, 6.0, low=0.0), a.shape(EXPONENT, "-", a.EXPONENTS, 0.8, 2.2)),
        force=force,
        description="a door closer's damper, which brakes while the door closes",
        signature="closing only, growing with speed",
        confused_with=("drag", "opening_check"),
        locations={joint: (DAMPING,)},
        shape_parameters={EXPONENT: a.EXPONENTS},
        minimum_size=0.1,
    )
