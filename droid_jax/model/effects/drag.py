"""Drag that grows with the square of the door's speed: air, a fluid damper."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

DRAG = "drag"


@register
def drag(scene: Scene) -> Effect | None:
    """-c w |w| on the hinge, N m s^2/rad^2."""
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
