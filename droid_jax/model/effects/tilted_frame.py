"""A tilted door frame: gravity opens or closes the door."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

SINE, COSINE = "tilt_sine", "tilt_cosine"


@register
def tilted_frame(scene: Scene) -> Effect | None:
    """-(A sin phi + B cos phi) on the hinge, N m: m g d sin(alpha) for tilts forward and sideways."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        phi = a.angle(scene, joint, state)
        return a.at_dof(scene, joint, -(a.value(theta, SINE) * jnp.sin(phi) + a.value(theta, COSINE) * jnp.cos(phi)))

    return Effect(
        "tilted_frame",
        (a.coefficient(SINE, "N m", 0.3, 3.0), a.coefficient(COSINE, "N m", 0.3, 3.0)),
        force=force,
        description="a frame out of plumb, so that gravity moves the door",
        signature="smooth over the angle, the same at every speed and in both directions",
        confused_with=("hinge_preload", "hardening_spring"),
        special_cases=("hinge_preload",),  # A = 0, over a small range of angles
        locations={joint: (SINE, COSINE)},
        minimum_size=0.05,
    )
