"""Dry friction of the arm's joints that holds where MuJoCo's lets a joint creep."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import write
from droid_jax.model.parameters import Mode, Parameter
from droid_jax.model.scene import Scene

FIRM = 0.9999  # mjMAXIMP, the firmest constraint that MuJoCo has
FIRMNESS = "friction_firmness"
EVERYWHERE = "all joints"  # MuJoCo's default is that of every joint, and each alone may be too little to be named


@register
def soft_friction(scene: Scene) -> Effect | None:
    """The impedance d of a joint's friction constraint goes from the MJCF's towards 0.9999 by a share s.

    MuJoCo lets a joint that friction holds under a load creep at load (1 - d) / (d b) times its inverse inertia, b the
    constraint's damping, so that s = 1 takes all of it away and s = 0 is the model as it is.
    Source: MuJoCo documentation, "Computation", section "Constraint model" (R = (1 - d) / d times A, aref = -b v).
    """
    model, writes = scene.model, {}
    for joint in a.arm(scene):
        solimp, dof = model.dof_solimp[scene.dof(joint)], scene.dof(joint)
        if scene.spec.joint(joint).frictionloss > 0 and solimp[0] < FIRM:  # of its own, or asked for to be fitted
            ends = [(k, FIRM - float(solimp[k])) for k in (0, 1)]  # at least and at most; friction is at the least
            writes[joint] = tuple(write(scene, "dof_solimp", (dof, k), Mode.ADD, gain=gain) for k, gain in ends)
    if not writes:
        return None
    names = {joint: f"{FIRMNESS}[{joint}]" for joint in writes}
    together = {EVERYWHERE: tuple(names.values())} if len(writes) > 1 else {}
    return Effect(
        "soft_friction",
        tuple(Parameter(names[j], "-", 0.0, 0.5, 0.0, 1.0, writes=w, group=a.GROUP) for j, w in writes.items()),
        description="dry friction that holds a joint where the model's lets it creep",
        signature="a joint that rests under load, or turns back",
        confused_with=("joint_coulomb", "joint_stribeck", "servo_gain"),
        remedy="MuJoCo's own friction lets joints creep that stand still. Take solimpfriction of these joints from "
        "extended.patch into the MJCF, or fit with --joint-friction held",
        locations={**a.locations(tuple(writes), FIRMNESS), **together},
        minimum_size=0.1,
        natural_bounds=tuple(names.values()),
    )
