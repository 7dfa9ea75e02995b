"""Dampers of a door's hinge: drag, a door closer, an opening check."""

import jax
import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

DRAG = "drag"
CLOSER_DAMPING, CLOSER_EXPONENT = "closer_damping", "closer_exponent"
CHECK_DAMPING, CHECK_ANGLE, CHECK_EXPONENT = "check_damping", "check_angle", "check_exponent"
CHECK_ANGLES = (0.3, 0.5, 0.7)  # rad, at which the braking begins
CHECK_WIDTH = 0.05  # rad, over which it builds up


@register
def drag(scene: Scene) -> Effect | None:
    """-c w |w| on the hinge, N m s^2/rad^2: air, a fluid damper."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        w = a.speed(scene, joint, state)
        return a.at_dof(scene, joint, -a.value(theta, DRAG) * w * abs(w))

    return Effect(
        DRAG,
        (a.coefficient(DRAG, "N m s^2/rad^2", 0.5, 20.0, low=0.0),),
        force=force,
        description="drag of the door that grows with the square of its speed",
        signature="the difference between fast and slow phases",
        confused_with=("door_closer", "opening_check"),
        locations={joint: (DRAG,)},
        minimum_size=0.1,
    )


@register
def door_closer(scene: Scene) -> Effect | None:
    """c w0 (|w| / w0)^n on the hinge for w < 0, w0 = 0.3 rad/s.  Its preload is the effect hinge_preload."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        closing = jnp.minimum(a.speed(scene, joint, state), 0.0)
        brake = a.damping(closing, a.value(theta, CLOSER_EXPONENT, a.EXPONENTS[1]))
        return a.at_dof(scene, joint, a.value(theta, CLOSER_DAMPING) * brake)

    return Effect(
        "door_closer",
        (
            a.coefficient(CLOSER_DAMPING, "N m s/rad", 2.0, 6.0, low=0.0),
            a.shape(CLOSER_EXPONENT, "-", a.EXPONENTS, 0.8, 2.2),
        ),
        force=force,
        description="a door closer's damper, which brakes while the door closes",
        signature="closing only, growing with speed",
        confused_with=("drag", "opening_check"),
        locations={joint: (CLOSER_DAMPING,)},
        shape_parameters={CLOSER_EXPONENT: a.EXPONENTS},
        minimum_size=0.1,
    )


@register
def opening_check(scene: Scene) -> Effect | None:
    """-c w0 (w / w0)^n on the hinge beyond phi_b for w > 0, w0 = 0.3 rad/s."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        phi, w = a.angle(scene, joint, state), a.speed(scene, joint, state)
        beyond = jax.nn.sigmoid((phi - a.value(theta, CHECK_ANGLE, CHECK_ANGLES[1])) / CHECK_WIDTH)
        brake = a.damping(jnp.maximum(w, 0.0), a.value(theta, CHECK_EXPONENT, a.EXPONENTS[1]))
        return a.at_dof(scene, joint, -a.value(theta, CHECK_DAMPING) * beyond * brake)

    return Effect(
        "opening_check",
        (
            a.coefficient(CHECK_DAMPING, "N m s/rad", 2.0, 6.0, low=0.0),
            a.shape(CHECK_ANGLE, "rad", CHECK_ANGLES, 0.1, 1.2),
            a.shape(CHECK_EXPONENT, "-", a.EXPONENTS, 0.8, 2.2),
        ),
        force=force,
        description="an opening check, which brakes the door beyond some angle",
        signature="late in a fast opening",
        confused_with=("hardening_spring", "drag"),
        locations={joint: (CHECK_DAMPING,)},
        shape_parameters={CHECK_ANGLE: CHECK_ANGLES, CHECK_EXPONENT: a.EXPONENTS},
        minimum_size=0.1,
    )
