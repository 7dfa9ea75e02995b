"""Joint friction that grows with the torque of a gear.

Source of `gear_friction`: Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators",
ICRA 2025, models M3 to M5.
"""

import jax.numpy as jnp
import numpy as np

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

SHARE, GEAR = "load_friction", "gear_friction"
MOTOR, LINKS, AT_REST, SPEED = "gear_motor", "gear_links", "gear_at_rest", "gear_speed"
SPEEDS = (0.1, 0.7)  # rad/s, over which the part at rest fades


@register
def load_friction(scene: Scene) -> Effect | None:
    """K |tau|, a share K of the actuator's torque, added to a joint's friction loss."""
    joints, dofs = a.arm(scene), a.arm_dofs(scene)
    if not joints:
        return None

    def frictionloss(theta, state, base):
        return base.at[dofs].add(column(theta, SHARE, joints) * jnp.abs(state.load[dofs]))

    return Effect(
        SHARE,
        a.of_joints(SHARE, joints, "-", 0.05, 1.0, low=0.0),
        frictionloss=frictionloss,
        description="friction of a joint of the arm that grows with its load",
        signature="steps at that joint's reversals that grow with its torque",
        confused_with=("joint_coulomb", "torque_gain"),
        locations=a.locations(joints, SHARE),
        minimum_size=0.01,
    )


@register
def gear_friction(scene: Scene) -> Effect | None:
    """abs(E e - K m) + S exp(-abs(v/vs)) abs(e - m), added to the friction loss of joints with an actuator.

    m is the motor's torque on the gear, e that of the links (`State.gear`).  Their shares add up if the torques are
    opposed, and are subtracted if the load drives the motor.  A joint's damping is part of its motor's torque (back
    electromotive force).
    """
    joints = tuple(j for j in a.arm(scene) if j in scene.command_names)
    if not joints:
        return None
    dofs = np.array([scene.dof(j) for j in joints], dtype=int)

    def frictionloss(theta, state, base):
        motor, links = state.gear[:, dofs]
        speed = state.qvel[dofs]
        motor = motor - state.model.dof_damping[dofs] * speed
        of_load = jnp.abs(column(theta, LINKS, joints) * links - column(theta, MOTOR, joints) * motor)
        slow = jnp.exp(-jnp.abs(speed / a.value(theta, SPEED, SPEEDS[-1])))
        return base.at[dofs].add(of_load + column(theta, AT_REST, joints) * slow * jnp.abs(links - motor))

    return Effect(
        GEAR,
        (
            *(p for name in (MOTOR, LINKS, AT_REST) for p in a.of_joints(name, joints, "-", 0.1, 1.0, low=0.0)),
            a.shape(SPEED, "rad/s", SPEEDS, 0.02, 3.0),
        ),
        frictionloss=frictionloss,
        description="friction of a gear that grows with the torques of its motor and its load",
        signature="steps at that joint's reversals that grow with its torque, higher when it lifts and at low speed",
        confused_with=(SHARE, "joint_stribeck", "joint_coulomb", "servo_gain"),
        special_cases=(SHARE,),
        locations=a.locations(joints, MOTOR, LINKS, AT_REST),
        shape_parameters={SPEED: SPEEDS},
        minimum_size=0.02,
    )
