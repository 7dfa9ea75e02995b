"""A constant torque on the hinge: a preloaded spring, a seal, a cord under tension."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.parameters import Role
from droid_jax.model.scene import Scene

NAME = "hinge_preload"


@register
def hinge_preload(scene: Scene) -> Effect | None:
    """-t0 on the hinge, N m; positive closes."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def native(values, model):
        """The same torque by another rest angle of the hinge's spring; None without a spring."""
        stiffness = model.jnt_stiffness[scene.id("joint", joint)]
        return {("qpos_spring", scene.qpos(joint)): -values[NAME] / stiffness} if stiffness > 0 else None

    return Effect(
        NAME,
        (a.coefficient(NAME, "N m", 0.5, 5.0, role=Role.OBJECT_TORQUE),),
        force=lambda theta, state: a.at_dof(scene, joint, -a.value(theta, NAME)),
        native=native,
        description="a constant torque that closes (or opens) the door",
        signature="the whole opening, the same at every angle and speed",
        confused_with=("tilted_frame", "over_centre_spring"),
        locations={joint: (NAME,)},
        minimum_size=0.05,
    )
