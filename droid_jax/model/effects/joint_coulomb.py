"""Additional dry friction of the arm's joints."""

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

LOSS = "joint_coulomb"


@register
def joint_coulomb(scene: Scene) -> Effect | None:
    """A constant Fc, N m, added to a joint's friction loss."""
    joints, dofs = a.arm(scene), a.arm_dofs(scene)
    if not joints:
        return None

    def frictionloss(theta, state, base):
        return base.at[dofs].add(column(theta, LOSS, joints))

    def native(values, model):
        return {("dof_frictionloss", d): values.get(f"{LOSS}[{j}]", 0.0) for j, d in zip(joints, dofs, strict=True)}

    return Effect(
        LOSS,
        a.of_joints(LOSS, joints, "N m", 0.3, 5.0, low=0.0),
        frictionloss=frictionloss,
        native=native,
        description="dry friction in a joint of the arm",
        signature="a step at every reversal of that joint, in all phases",
        confused_with=("joint_stribeck", "joint_directional", "load_friction"),
        locations=a.locations(joints, LOSS),
        minimum_size=0.03,
    )
