"""Springs of a door's hinge: a preload, a spring that stiffens, a self-closing hinge."""

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.parameters import Role
from droid_jax.model.scene import Scene

PRELOAD = "hinge_preload"
SQUARE, CUBE = "hardening_square", "hardening_cube"
PEAK_TORQUE, PEAK_ANGLE = "over_centre_torque", "over_centre_angle"
PEAK_ANGLES = (0.1, 0.2, 0.35, 0.55)  # rad: 5 to 30 degrees


@register
def hinge_preload(scene: Scene) -> Effect | None:
    """-t0 on the hinge, N m, at every angle (a preloaded spring, a seal, a cord under tension); positive closes."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def native(values, model):
        """The same torque by another rest angle of the hinge's spring; None without a spring."""
        stiffness = model.jnt_stiffness[scene.id("joint", joint)]
        return {("qpos_spring", scene.qpos(joint)): -values[PRELOAD] / stiffness} if stiffness > 0 else None

    return Effect(
        PRELOAD,
        (a.coefficient(PRELOAD, "N m", 0.5, 5.0, role=Role.OBJECT_TORQUE),),
        force=lambda theta, state: a.at_dof(scene, joint, -a.value(theta, PRELOAD)),
        native=native,
        description="a constant torque that closes (or opens) the door",
        signature="the whole opening, the same at every angle and speed",
        confused_with=("tilted_frame", "over_centre_spring"),
        locations={joint: (PRELOAD,)},
        minimum_size=0.05,
    )


@register
def hardening_spring(scene: Scene) -> Effect | None:
    """-k2 phi |phi| - k3 phi^3 on the hinge; N m/rad^2 and N m/rad^3."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        phi = a.angle(scene, joint, state)
        torque = a.value(theta, SQUARE) * phi * abs(phi) + a.value(theta, CUBE) * phi**3
        return a.at_dof(scene, joint, -torque)

    return Effect(
        "hardening_spring",
        (a.coefficient(SQUARE, "N m/rad^2", 0.5, 5.0), a.coefficient(CUBE, "N m/rad^3", 0.5, 5.0)),
        force=force,
        description="a hinge spring that gets stiffer the further the door opens",
        signature="late in the opening, the same at every speed and in both directions",
        confused_with=("tilted_frame", "opening_check", "angle_friction"),
        locations={joint: (SQUARE, CUBE)},
        minimum_size=0.1,
    )


@register
def over_centre_spring(scene: Scene) -> Effect | None:
    """-A (phi/p) exp(1 - phi/p) on the hinge for phi > 0: zero at phi = 0, A at phi = p, decreasing beyond."""
    joint = a.hinge(scene)
    if joint is None:
        return None

    def force(theta, state):
        share = jnp.maximum(a.angle(scene, joint, state), 0.0) / a.value(theta, PEAK_ANGLE, PEAK_ANGLES[2])
        return a.at_dof(scene, joint, -a.value(theta, PEAK_TORQUE) * share * jnp.exp(1.0 - share))

    return Effect(
        "over_centre_spring",
        (a.coefficient(PEAK_TORQUE, "N m", 1.0, 25.0, low=0.0), a.shape(PEAK_ANGLE, "rad", PEAK_ANGLES, 0.05, 0.9)),
        force=force,
        description="a self-closing hinge whose spring pulls hardest at a small angle and fades further out",
        signature="5 to 30 degrees of opening, in both directions",
        confused_with=("latch", "hinge_preload"),
        locations={joint: (PEAK_TORQUE,)},
        shape_parameters={PEAK_ANGLE: PEAK_ANGLES},
        minimum_size=0.1,
    )
