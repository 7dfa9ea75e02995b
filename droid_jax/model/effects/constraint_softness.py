"""Constraints that are softer or firmer than the model's: dry friction of joints, contacts of the fingers."""

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.fields import write
from droid_jax.model.parameters import Mode, Parameter
from droid_jax.model.scene import Scene

FIRM = 0.9999  # mjMAXIMP, the largest impedance of a MuJoCo constraint
FIRMNESS = "friction_firmness"
SOFTNESS = "contact_softness"
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
