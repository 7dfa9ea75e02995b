"""Profiles of a servo between two goals: limits of acceleration and speed.

Hobby servos and industrial controllers convert a goal into a ramp for their position loop.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax.model.actuators import has_feedback
from droid_jax.model.effect_interface import Effect, Theta, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.scene import Scene

ACCELERATION, SPEED = "profile_acceleration", "profile_speed"


@register
def profile_acceleration(scene: Scene) -> Effect | None:
    """The servo's reference accelerates by at most 1/p and brakes in time; p in s^2/rad, 0: no limit."""
    joints = _servos(scene)
    if not joints:
        return None

    def profile(theta: Theta, command: jax.Array, timestep: float) -> jax.Array:
        limit = column(theta, ACCELERATION, scene.command_names)
        most = _gears(scene) / jnp.where(limit > 0.0, limit, 1.0)

        def follow(state, goal):
            at, speed = state
            way = goal - at
            wanted = jnp.sign(way) * jnp.minimum(jnp.abs(way) / timestep, jnp.sqrt(2.0 * most * jnp.abs(way)))
            speed = speed + jnp.clip(wanted - speed, -most * timestep, most * timestep)
            at = at + timestep * speed
            return (at, speed), at

        return jnp.where(limit > 0.0, _followed(follow, command), command)

    return Effect(
        ACCELERATION,
        a.of_joints(ACCELERATION, joints, "s^2/rad", 0.02, 1.0, low=0.0),
        profile=profile,
        profile_limits="acceleration",
        description="a servo that limits the acceleration of its reference",
        signature="fast changes of that joint's command: amplitude falls and lag grows with frequency",
        confused_with=("velocity_feedforward", "command_delay", "servo_gain", SPEED),
        locations=a.locations(joints, ACCELERATION),
        minimum_size=0.002,
    )


@register
def profile_speed(scene: Scene) -> Effect | None:
    """The servo's reference moves at a speed of at most 1/p; p in s/rad, 0: no limit."""
    joints = _servos(scene)
    if not joints:
        return None

    def profile(theta: Theta, command: jax.Array, timestep: float) -> jax.Array:
        limit = column(theta, SPEED, scene.command_names)
        most = _gears(scene) * timestep / jnp.where(limit > 0.0, limit, 1.0)

        def follow(state, goal):
            at, speed = state
            at = at + jnp.clip(goal - at, -most, most)
            return (at, speed), at

        return jnp.where(limit > 0.0, _followed(follow, command), command)

    return Effect(
        SPEED,
        # The score test evaluates at a share of the deviation, 1.5 s/rad.  Higher speed limits do not act on slow
        # commands.
        a.of_joints(SPEED, joints, "s/rad", 5.0, 20.0, low=0.0),
        profile=profile,
        profile_limits="speed",
        description="a servo that limits the speed of its reference",
        signature="large steps of that joint's command, which become ramps of one slope",
        confused_with=("command_delay", "servo_gain", ACCELERATION),
        locations=a.locations(joints, SPEED),
        minimum_size=0.02,
    )


def _followed(follow, command: jax.Array) -> jax.Array:
    """[T, U] positions of a reference that starts at rest at the first command [T, U]."""
    return jax.lax.scan(follow, (command[0], jnp.zeros_like(command[0])), command)[1]


def _gears(scene: Scene) -> np.ndarray:
    """[U] controls for a position of the joint, since a command is a control."""
    return np.where(scene.of_joint, np.abs(scene.model.actuator_gear[:, 0]), 1.0).astype(np.float32)


def _servos(scene: Scene) -> Sequence[str]:
    """Joints of the arm with a position servo."""
    servos = has_feedback(scene.model)
    return [j for j in a.arm(scene) if j in scene.command_names and servos[scene.command_names.index(j)]]
