"""Elastic joints, and joints with backlash.

The servo measures the motor's position, the dynamics move the link.  In an elastic joint with torque tau the motor is
at q + tau c, which its encoder reads and a recording contains.  So a motion that begins under a load begins with the
link behind the recorded position.  In a joint with backlash the motor turns freely by half of it to either side of the
link, whose position is recorded.  Both are quasi-static: vibrations are not simulated.

The torque is solved for with the servo's law, whose gains and damping may be fitted.  Using the torque of the previous
step would be simpler, but with a stiff servo this is a loop with a gain above one, which chatters.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.position_servos import arm_servos
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

LEAST = 0.2  # lower limit of 1 + k c, since a fitted servo may be stiffer than the one from which bounds are computed
COMPLIANCE, BACKLASH = "joint_compliance", "joint_backlash"


@register
def joint_compliance(scene: Scene) -> Effect | None:
    """The motor and its encoder are ahead of the link by tau c, c = 1 / stiffness in rad/(N m).

    The data constrain c relative to the servo's 1 / k: with a soft servo only a softer gear is identifiable.
    """
    servos = arm_servos(scene)
    if servos is None:
        return None

    def servo(theta, state, ctrl):
        compliance = column(theta, COMPLIANCE, servos.joints)
        yielding = jnp.maximum(1.0 + servos.stiffness_in(state) * compliance, LEAST)
        torque = servos.rigid_torque(state, ctrl) / yielding
        return servos.with_lead(state, ctrl, compliance * torque)

    def twist(theta, state, ctrl):
        ahead = column(theta, COMPLIANCE, servos.joints) * servos.held_torque(state, ctrl)
        return jnp.zeros_like(state.qvel).at[servos.dofs].set(ahead)

    columns = np.array([scene.joints.index(j) for j in servos.joints], dtype=int)

    def observe(theta, rollout):
        ahead = column(theta, COMPLIANCE, servos.joints) * rollout.torque[:, columns]
        step = (rollout.time[-1] - rollout.time[0]) / (len(rollout.time) - 1)
        return replace(
            rollout,
            position=rollout.position.at[:, columns].add(ahead),
            velocity=rollout.velocity.at[:, columns].add(jnp.gradient(ahead, axis=0) / step),
        )

    sizes = servos.compliances

    def parameter(joint: str, stiffness: float):
        # The lower bound is below zero so that a rigid joint is not at a bound; 1 + k c stays well above zero.
        usual, high = sizes[joint]
        return a.coefficient(f"{COMPLIANCE}[{joint}]", "rad/(N m)", usual, high, low=-min(usual, 0.5 / stiffness))

    return Effect(
        COMPLIANCE,
        tuple(parameter(j, float(k)) for j, k in zip(servos.joints, servos.stiffness, strict=True)),
        servo=servo,
        twist=twist,
        observe=observe,
        description="an elastic gear between motor and link",
        signature="tracking error in proportion to load",
        confused_with=("servo_gain", "torque_gain"),
        locations=a.locations(servos.joints, COMPLIANCE),
        minimum_size=0.2 * min(usual for usual, _ in sizes.values()),
    )


@register
def joint_backlash(scene: Scene) -> Effect | None:
    """The motor is ahead of the link by half the backlash, rad, in the direction of the torque, if there is any."""
    servos = arm_servos(scene)
    if servos is None:
        return None

    def servo(theta, state, ctrl):
        half = 0.5 * column(theta, BACKLASH, servos.joints)
        stiffness = servos.stiffness_in(state)
        error = servos.rigid_torque(state, ctrl) / jnp.where(stiffness != 0.0, stiffness, 1.0)
        lead = jnp.sign(half) * jnp.clip(error, -jnp.abs(half), jnp.abs(half))
        return servos.with_lead(state, ctrl, lead)

    return Effect(
        BACKLASH,
        a.of_joints(BACKLASH, servos.joints, "rad", 2e-3, 2e-2, low=-2e-3),
        servo=servo,
        description="backlash in a joint's gear",
        signature="a step where the load of that joint changes sign",
        confused_with=("joint_coulomb", "joint_compliance"),
        locations=a.locations(servos.joints, BACKLASH),
        minimum_size=3e-4,
    )
