"""A door closer: a damper that works while the door closes."""

import jax.numpy as jnp

from droid_jax.model.effects import amplitudes as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect

DAMPING = "closer_damping"


@register
def door_closer(scene: Scene) -> Effect | None:
    """-c w on the hinge where w < 0, N m s/rad.  Its preload is the effect hinge_preload."""
    joint = a.hinge(scene)
    if joint is None:
        return None
    return Effect(
        "door_closer",
        (a.amplitude(DAMPING, "N m s/rad", 2.0, 20.0, low=0.0),),
        force=lambda theta, state: a.at_dof(
            scene, joint, -a.value(theta, DAMPING) * jnp.minimum(a.speed(scene, joint, state), 0.0)
        ),
        what="a door closer's damper, which brakes while the door closes",
        mark="closing only, growing with speed",
        confused_with=("drag", "opening_check"),
        places={joint: (DAMPING,)},
        smallest=0.2,
    )
