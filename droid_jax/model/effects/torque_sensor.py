"""Errors of torque sensors: an offset, a gain error, a drift over the recording, crosstalk."""

from dataclasses import replace

import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, column
from droid_jax.model.effects import coefficients as a
from droid_jax.model.effects.registry import register
from droid_jax.model.joint_friction import GAIN, torque_gain_effect
from droid_jax.model.scene import Scene

BIAS, DRIFT = "torque_bias", "torque_drift"
CROSSTALK, BEFORE, AFTER = "torque_crosstalk", "crosstalk_before", "crosstalk_after"


@register
def torque_bias(scene: Scene) -> Effect | None:
    """tau + b, N m."""

    def observe(theta, rollout):
        return replace(rollout, torque=rollout.torque + column(theta, BIAS, scene.joints))

    return Effect(
        BIAS,
        a.of_joints(BIAS, scene.joints, "N m", 0.3, 10.0),
        observe=observe,
        description="a constant error of a joint's torque sensor",
        signature="one joint, the same throughout, also at rest",
        confused_with=("payload", "cable_pull"),
        locations=a.locations(scene.joints, BIAS),
        minimum_size=0.05,
    )


@register
def torque_gain(scene: Scene) -> Effect | None:
    """(1 + g) tau."""
    return Effect(
        GAIN,
        a.of_joints(GAIN, scene.joints, "-", 0.03, 0.3),
        observe=torque_gain_effect(scene.joints).observe,
        description="a wrong gain of a joint's torque sensor",
        signature="one joint, in proportion to its torque",
        confused_with=("servo_gain", "load_friction"),
        locations=a.locations(scene.joints, GAIN),
        minimum_size=0.01,
    )


@register
def torque_drift(scene: Scene) -> Effect | None:
    """tau + d (t - t_end / 2), d in N m/s; the drift has zero mean, so that it is no offset."""

    def observe(theta, rollout):
        middle = rollout.time - 0.5 * (rollout.time[0] + rollout.time[-1])
        return replace(rollout, torque=rollout.torque + column(theta, DRIFT, scene.joints) * middle[:, None])

    return Effect(
        DRIFT,
        a.of_joints(DRIFT, scene.joints, "N m/s", 0.02, 0.3),
        observe=observe,
        description="a torque sensor that drifts during a recording",
        signature="one joint, growing steadily with time in any motion",
        confused_with=("torque_bias", "cable_pull"),
        locations=a.locations(scene.joints, DRIFT),
        minimum_size=0.005,
        over_time=True,
    )


@register
def torque_crosstalk(scene: Scene) -> Effect | None:
    """tau_i + b tau_(i-1) + c tau_(i+1), shares of the neighbouring channels' torques."""
    joints = a.arm(scene)
    if len(joints) < 2:
        return None

    def observe(theta, rollout):
        rows = [scene.joints.index(joint) for joint in joints]
        torque = rollout.torque[:, rows]
        none = jnp.zeros_like(torque[:, :1])
        before = jnp.concatenate([none, torque[:, :-1]], axis=1)
        after = jnp.concatenate([torque[:, 1:], none], axis=1)
        leakage = column(theta, BEFORE, joints) * before + column(theta, AFTER, joints) * after
        return replace(rollout, torque=jnp.asarray(rollout.torque).at[:, rows].add(leakage))

    names = {joint: (f"{BEFORE}[{joint}]", f"{AFTER}[{joint}]") for joint in joints}
    locations = {j: tuple(n for n, exists in zip(names[j], (i > 0, i + 1 < len(joints)), strict=True) if exists)
                 for i, j in enumerate(joints)}  # fmt: skip
    return Effect(
        CROSSTALK,
        tuple(a.coefficient(name, "-", 0.03, 0.3) for of_joint in locations.values() for name in of_joint),
        observe=observe,
        description="a joint's torque sensor that also reads its neighbours' torques",
        signature="one joint, in proportion to the torque of a neighbouring joint",
        confused_with=("torque_gain", "torque_bias"),
        locations=locations,
        minimum_size=0.01,
    )
