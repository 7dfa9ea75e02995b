"""Gears that give way: elastic joints, and joints with backlash.

The servo measures the motor, the dynamics move the link.  With the load tau of the step before, the
motor stands at q + tau / k in an elastic joint, and half a backlash ahead of the link on the side
that pushes.  Both are quasi-static: ringing is not simulated.
"""

import jax.numpy as jnp
import numpy as np

from droid_jax.model.effects import amplitudes as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect

COMPLIANCE, BACKLASH = "joint_compliance", "joint_backlash"
PUSHING = 0.1  # N m of load at which a gear surely leans on one side


def _driven(scene: Scene) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The arm's driven joints, their actuators [J] and their degrees of freedom [J]."""
    joints = tuple(j for j in a.arm(scene) if j in scene.command_names)
    actuators = np.array([scene.command_names.index(j) for j in joints], dtype=int)
    return joints, actuators, np.array([scene.dof(j) for j in joints], dtype=int)


@register
def joint_compliance(scene: Scene) -> Effect | None:
    """Motor ahead of the link by tau c, c = 1 / stiffness, rad/(N m)."""
    joints, actuators, dofs = _driven(scene)
    if not joints:
        return None

    def servo(theta, state, ctrl):
        return ctrl.at[actuators].add(-a.column(theta, COMPLIANCE, joints) * state.load[dofs])

    return Effect(
        COMPLIANCE,
        a.of_joints(COMPLIANCE, joints, "rad/(N m)", 1e-4, 5e-4, low=-1e-4),
        servo=servo,
        what="an elastic gear between motor and link",
        mark="tracking error in proportion to load",
        confused_with=("servo_gain", "torque_gain"),
        places=a.places(joints, COMPLIANCE),
        smallest=2e-5,
    )


@register
def joint_backlash(scene: Scene) -> Effect | None:
    """Motor ahead of the link by half the backlash, on the side that pushes, rad."""
    joints, actuators, dofs = _driven(scene)
    if not joints:
        return None

    def servo(theta, state, ctrl):
        half = 0.5 * a.column(theta, BACKLASH, joints)
        return ctrl.at[actuators].add(-half * jnp.tanh(state.load[dofs] / PUSHING))

    return Effect(
        BACKLASH,
        a.of_joints(BACKLASH, joints, "rad", 2e-3, 2e-2, low=-2e-3),
        servo=servo,
        what="backlash in a joint's gear",
        mark="a step where the load of that joint changes sign",
        confused_with=("joint_coulomb", "joint_compliance"),
        places=a.places(joints, BACKLASH),
        smallest=3e-4,
    )
