"""A servo's torque limit that falls with speed: a DC motor at its full voltage.

With stall torque T the motor gives torques between -T - D w and T - D w, D = T / W for a no-load speed W.  Back
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
SLOPES = (0.0, 0.2)  # s/rad
LEAST = 1e-6  # 1/(N m), of a limit that is finite
USUAL_SPEED = 1.0  # rad/s, of motions that are recorded


@register
def torque_speed_line(scene: Scene) -> Effect | None:
    """Torques between -1/p - s t w and 1/p - s t w; p in 1/(N m) for each joint, s in s/rad for all.

    t is a usual torque of the joint, so that s is one over the speed at which the limit has fallen by as much.  It is
    that of the MJCF also for a recording with numbers of its own, since all recordings share s.
    """
    servos = arm_servos(scene)
    if servos is None:
        return None

    nominal = scene.nominal
    friction = USUAL_SPEED * nominal.model.dof_damping[servos.dofs] + nominal.model.dof_frictionloss[servos.dofs]
    usual = usual_torques(nominal, servos.joints) + friction

    def limits(theta, state):
        inverse, none = column(theta, LINE, servos.joints), jnp.array([-jnp.inf, jnp.inf])
        stall = 1.0 / jnp.maximum(inverse, LEAST)
        fall = a.value(theta, SLOPE) * jnp.asarray(usual, jnp.float32) * state.qvel[servos.dofs]
        middle, half = -fall / servos.gear, stall / jnp.abs(servos.gear)
        ends = jnp.stack([middle - half, middle + half], axis=1)  # a sort would keep the loop from one kernel
        every = jnp.tile(none, (len(state.model.actuator_gear), 1))
        return every.at[servos.actuators].set(jnp.where(inverse[:, None] > 0.0, ends, none))

    of_joints = (
        a.coefficient(f"{LINE}[{joint}]", "1/(N m)", 6.0 / torque, 30.0 / torque, low=0.0)
        for joint, torque in zip(servos.joints, usual.tolist(), strict=True)
    )
    return Effect(
        LINE,
        (*of_joints, a.shape(SLOPE, "s/rad", SLOPES, 0.0, 1.0)),
        limits=limits,
        description="a motor whose torque is limited, the more the faster it turns",
        signature="fast or heavily loaded moves of that joint, which lag while its command is far ahead",
        confused_with=("profile_acceleration", "profile_speed", "servo_gain", "joint_compliance"),
        locations=a.locations(servos.joints, LINE),
        shape_parameters={SLOPE: SLOPES},
        minimum_size=0.4 / float(max(usual)),
    )
