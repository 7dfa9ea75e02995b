"""Timing: delays of commands and of measured torques, clocks of different rates, velocity feedforward."""

from dataclasses import replace

import jax.numpy as jnp

from droid_jax.model.actuators import has_feedback
from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

COMMAND, SENSOR = "command_delay", "sensor_delay"
RATE, AHEAD = "clock_rate", "velocity_feedforward"
SPAN = 0.01  # s, over which the speed of a command is computed: half a period of a host that sends at 50 Hz
MEASURED = ("torque",)  # delayed channels; positions come from other sensors


@register
def command_delay(scene: Scene) -> Effect | None:
    """Command q_d(t - delta), delta in s."""
    if not scene.command_names:
        return None
    return Effect(
        COMMAND,
        (a.coefficient(COMMAND, "s", 0.005, 0.05, low=-0.01),),
        command=lambda theta, time, command_at: command_at(time - a.value(theta, COMMAND)),
        description="commands that reach the servo late",
        signature="all joints, in proportion to the commanded speed; torques and positions shift together",
        confused_with=(SENSOR, "servo_gain"),
        locations={"commands": (COMMAND,)},
        minimum_size=0.001,
    )


@register
def sensor_delay(scene: Scene) -> Effect | None:
    """Torques y(t - delta), delta in s, linearly interpolated; constant before the first row."""

    def observe(theta, rollout):
        time = rollout.time
        step = (time[-1] - time[0]) / (len(time) - 1)
        at = jnp.arange(len(time)) - a.value(theta, SENSOR) / step
        at = jnp.clip(at, 0.0, len(time) - 1.0)
        low = jnp.minimum(at.astype(jnp.int32), len(time) - 2)
        part = (at - low)[:, None]
        delayed = {n: getattr(rollout, n)[low] * (1 - part) + getattr(rollout, n)[low + 1] * part for n in MEASURED}
        return replace(rollout, **delayed)

    return Effect(
        SENSOR,
        (a.coefficient(SENSOR, "s", 0.005, 0.05, low=-0.01),),
        observe=observe,
        description="torques that are recorded late",
        signature="all joints, where torques change fast; positions are not affected",
        confused_with=(COMMAND,),
        locations={"sensors": (SENSOR,)},
        minimum_size=0.001,
    )


@register
def clock_rate(scene: Scene) -> Effect | None:
    """Command q_d((1 + r) t): the recorder's clock is slower than the commands' by a share r; both start at zero."""
    if not scene.command_names:
        return None
    return Effect(
        RATE,
        (a.coefficient(RATE, "-", 1e-3, 0.02),),
        command=lambda theta, time, command_at: command_at(time * (1.0 + a.value(theta, RATE))),
        description="commands and measurements on clocks of different rates",
        signature="a delay of all joints that grows steadily over the recording",
        confused_with=(COMMAND,),
        locations={"commands": (RATE,)},
        minimum_size=1e-4,
        over_time=True,
    )


@register
def velocity_feedforward(scene: Scene) -> Effect | None:
    """Command q_d + c dq_d/dt of a joint's position servo, c in s; dq_d/dt is the difference over the last `SPAN`."""
    servos = has_feedback(scene.model)
    joints = tuple(j for j in a.arm(scene) if j in scene.command_names and servos[scene.command_names.index(j)])
    if not joints:
        return None

    def command(theta, time, command_at):
        now = command_at(time)
        return now + column(theta, AHEAD, scene.command_names) * (now - command_at(time - SPAN)) / SPAN

    return Effect(
        AHEAD,
        a.of_joints(AHEAD, joints, "s", 0.01, 0.3),
        command=command,
        description="a servo with velocity feedforward, or with less of it than the model's",
        signature="tracking error of one joint in proportion to its commanded speed",
        confused_with=(COMMAND, "servo_gain"),
        locations=a.locations(joints, AHEAD),
        minimum_size=1e-3,
    )
