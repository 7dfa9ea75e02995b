"""A contact between fingers and knob that is softer (or stiffer) than the model's."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import write
from droid_jax.model.parameters import Mode, Parameter
from droid_jax.model.scene import Scene

SOFTNESS = "contact_softness"


@register
def contact_compliance(scene: Scene) -> Effect | None:
    """The contacts' time constant (solref) times 1 + s."""
    if scene.grip is None:
        return None
    pairs = [scene.id("pair", pair) for finger in scene.grip.fingers for pair in finger]
    if (scene.model.pair_solref[pairs, 0] <= 0).any():  # solref states stiffness and damping, no time constant
        return None
    writes = tuple(write(scene, "pair_solref", (pair, 0), Mode.SCALE, offset=1.0) for pair in pairs)
    return Effect(
        "contact_compliance",
        (Parameter(SOFTNESS, "-", 0.0, 0.5, -0.5, 12.0, writes=writes, group=a.GROUP),),
        description="fingertips or a knob that are softer than the model's",
        signature="grasp and breakaway, the peaks of the load",
        confused_with=("hinge_stribeck", "joint_compliance"),
        locations={"grip": (SOFTNESS,)},
        minimum_size=0.2,
    )
