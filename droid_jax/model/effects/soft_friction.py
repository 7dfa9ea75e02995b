"""Dry friction of the arm's joints that does not creep, as MuJoCo's soft constraint does."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import write
from droid_jax.model.parameters import Mode, Parameter
from droid_jax.model.scene import Scene

FIRM = 0.9999  # mjMAXIMP, the largest impedance of a MuJoCo constraint
FIRMNESS = "friction_firmness"
EVERYWHERE = "all joints"  # all joints share MuJoCo's default, and each alone may be below the minimum effect size


@register
def soft_friction(scene: Scene) -> Effect | None:
    """The impedance d of a joint's friction constraint, a share s of the way from the MJCF's to 0.9999.

    In MuJoCo a joint under a load that friction holds creeps with the velocity load (1 - d) / (d b) times the inverse
    inertia; b is the constraint's damping.  s = 1 removes the creep, s = 0 is the unchanged model.

    Source: MuJoCo documentation, "Computation", section "Constraint model" (R = (1 - d) / d times A, aref = -b v).
    """
    model, writes = scene.model, {}
    for joint in a.arm(scene):
        solimp, dof = model.dof_solimp[scene.dof(joint)], scene.dof(joint)
        if scene.spec.joint(joint).frictionloss > 0 and solimp[0] < FIRM:  # in the MJCF, or as a parameter
            ends = [(k, FIRM - float(solimp[k])) for k in (0, 1)]  # dmin and dmax; friction uses dmin
            writes[joint] = tuple(write(scene, "dof_solimp", (dof, k), Mode.ADD, gain=gain) for k, gain in ends)
    if not writes:
        return None
    names = {joint: f"{FIRMNESS}[{joint}]" for joint in writes}
    together = {EVERYWHERE: tuple(names.values())} if len(writes) > 1 else {}
    return Effect(
        "soft_friction",
        tuple(Parameter(names[j], "-", 0.0, 0.5, 0.0, 1.0, writes=w, group=a.GROUP) for j, w in writes.items()),
        description="dry friction that holds a joint which creeps in the model",
        signature="a joint that rests under load, or turns back",
        confused_with=("joint_coulomb", "joint_stribeck", "servo_gain"),
        remedy="In MuJoCo, joints that friction holds creep by default. Take solimpfriction of these joints from "
        "extended.patch into the MJCF, or fit with --joint-friction held",
        locations={**a.locations(tuple(writes), FIRMNESS), **together},
        minimum_size=0.1,
        natural_bounds=tuple(names.values()),
    )
