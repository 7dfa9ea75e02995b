"""Delays: between command and servo, and between the arm and what is recorded."""

from dataclasses import replace

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

COMMAND, SENSOR = "command_delay", "sensor_delay"
MEASURED = ("torque",)  # what comes late; positions come from other sensors


@register
def command_delay(scene: Scene) -> Effect | None:
    """q_d(t - delta), s."""
    if not scene.command_names:
        return None
    return Effect(
        COMMAND,
        (a.amplitude(COMMAND, "s", 0.005, 0.05, low=-0.01),),
        command=lambda theta, time, look: look(time - a.value(theta, COMMAND)),
        description="commands that reach the servo late",
        signature="all joints, in proportion to the commanded speed; torques and positions shift together",
        confused_with=(SENSOR, "servo_gain"),
        locations={"commands": (COMMAND,)},
        minimum_size=0.001,
    )


@register
def sensor_delay(scene: Scene) -> Effect | None:
    """y(t - delta) of the torques, s; linear between rows, the first row before the beginning."""

    def observe(theta, rollout):
        time = rollout.time
        step = (time[-1] - time[0]) / (len(time) - 1)
        at = jnp.arange(len(time)) - a.value(theta, SENSOR) / step
        at = jnp.clip(at, 0.0, len(time) - 1.0)
        low = jnp.minimum(at.astype(jnp.int32), len(time) - 2)
        part = (at - low)[:, None]
        late = {n: getattr(rollout, n)[low] * (1 - part) + getattr(rollout, n)[low + 1] * part for n in MEASURED}
        return replace(rollout, **late)

    return Effect(
        SENSOR,
        (a.amplitude(SENSOR, "s", 0.005, 0.05, low=-0.01),),
        observe=observe,
        description="torques that are recorded late",
        signature="all joints, where torques change fast; positions stay",
        confused_with=(COMMAND,),
        locations={"sensors": (SENSOR,)},
        minimum_size=0.001,
    )
