"""A servo's torque limit that falls with speed: a DC motor at its full voltage.

With stall torque T and no-load speed W the motor gives torques between -T (1 + w / W) and T (1 - w / W).  Back
electromotive force that is part of the joint's damping in the MJCF needs no slope (`model.dc_motor`).
"""

from __future__ import annotations

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.effect_scaling import usual_torques
from droid_jax.model.effects.position_servos import arm_servos
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

LINE, SLOPE = "torque_speed_line", "torque_speed_slope"
SLOPES = (0.0, 0.2)  # s/rad, one over the no-load speed
USUAL_SPEED = 1.0  # rad/s, of motions that are recorded


@register
def torque_speed_line(scene: Scene) -> Effect | None:
    """Torques between -(1/p) (1 + s w) and (1/p) (1 - s w), p in 1/(N m) for each joint and s in s/rad for all."""
    servos = arm_servos(scene)
    if servos is None:
        return None

    def servo(theta, state, ctrl):
        inverse, slope = column(theta, LINE, servos.joints), a.value(theta, SLOPE)
        limit = 1.0 / jnp.maximum(inverse, 1e-6)
        fall = slope * state.qvel[servos.dofs]
        torque = servos.rigid_torque(state, ctrl)
        excess = jnp.clip(torque, -limit * (1.0 + fall), limit * (1.0 - fall)) - torque
        return servos.with_torque(state, ctrl, jnp.where(inverse > 0.0, excess, 0.0))

    rubbing = USUAL_SPEED * scene.model.dof_damping[servos.dofs] + scene.model.dof_frictionloss[servos.dofs]
    usual = dict(zip(servos.joints, usual_torques(scene, servos.joints) + rubbing, strict=True))
    of_joints = (a.coefficient(f"{LINE}[{j}]", "1/(N m)", 6.0 / t, 30.0 / t, low=0.0) for j, t in usual.items())
    return Effect(
        LINE,
        (*of_joints, a.shape(SLOPE, "s/rad", SLOPES, 0.0, 1.0)),
        servo=servo,
        description="a motor whose torque is limited, the more the faster it turns",
        signature="fast or heavily loaded moves of that joint, which lag while its command is far ahead",
        confused_with=("profile_acceleration", "profile_speed", "servo_gain", "joint_compliance"),
        locations=a.locations(servos.joints, LINE),
        shape_parameters={SLOPE: SLOPES},
        minimum_size=0.4 / max(usual.values()),
    )
