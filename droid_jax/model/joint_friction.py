"""The model of a joint's torque sensor: link-side friction, a constant offset, a gain error.

    tau += viscous * qd + coulomb * tanh(qd / SMOOTHING) + torque_offset        [N m]

These parameters change the measured torque, not the motion.  The model's `joint_damping` and `joint_frictionloss` are
on the motor side, which a link-side sensor does not measure.  It measures the friction of the bearings between sensor
and link.  The model is the linear friction of Gaz et al., RA-L 2019, with a smooth sign (`direction`).

A torque sensor with a gain error reads (1 + torque_gain) tau.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, Rollout, Theta, column
from droid_jax.model.parameters import OF_A_JOINT, Parameter, Role, Space

SMOOTHING = 0.01  # rad/s, at twice this speed `direction` is 0.96
GAIN = Role.TORQUE_GAIN.value
TERMS = tuple(role.value for role in OF_A_JOINT)
_UNITS = {Role.VISCOUS: "N m s/rad", Role.COULOMB: "N m", Role.TORQUE_OFFSET: "N m", Role.TORQUE_GAIN: "-"}
_SLIDES = {"N m s/rad": "N s/m", "N m": "N"}  # the same on a joint that slides
_GROUPS = {Role.TORQUE_GAIN: "Sensors"}
_DEVIATIONS = {Role.VISCOUS: 0.3, Role.COULOMB: 0.5, Role.TORQUE_OFFSET: 0.3}  # of the prior


def direction(velocity: jax.Array) -> jax.Array:
    """Smooth sign of a speed, rad/s; near zero for speeds well below SMOOTHING."""
    return jnp.tanh(velocity / SMOOTHING)


def joint_friction_effect(joints: Sequence[str], direction: Callable[[jax.Array], jax.Array] = direction) -> Effect:
    """The effect that adds viscous and Coulomb friction to the torques of `joints`, in channel order.

    It reads `viscous[joint]` and `coulomb[joint]` from theta, 0 if theta lacks them.
    `droid_jax.simulate.replay.torque_offset_effect` adds the offset.

    direction: sign of a speed.  Along a prescribed motion it is jnp.sign, since samples at rest are treated separately
    there (`simulate.rest`).
    """
    joints = tuple(joints)

    def observe(theta: Theta, rollout: Rollout) -> Rollout:
        speed = rollout.velocity  # [T, J]
        viscous, coulomb = (column(theta, role.value, joints) for role in (Role.VISCOUS, Role.COULOMB))
        friction = viscous * speed + coulomb * direction(speed)
        return replace(rollout, torque=rollout.torque + friction)

    parameters = joint_friction_space(joints).of_role(Role.VISCOUS, Role.COULOMB)
    return Effect("joint friction", parameters=parameters, observe=observe)


def torque_gain_effect(joints: Sequence[str]) -> Effect:
    """The effect of gain errors of torque sensors, `torque_gain[joint]` of `joints`, in channel order."""

    def observe(theta: Theta, rollout: Rollout) -> Rollout:
        return replace(rollout, torque=rollout.torque * (1.0 + column(theta, GAIN, joints)))

    return Effect(GAIN, observe=observe)


def joint_friction_space(joints: Sequence[str]) -> Space:
    """Three parameters for each joint, `viscous[joint]`, `coulomb[joint]` and `torque_offset[joint]`, with mean zero.

    Bounds are ten deviations to either side.  So no friction is not at a bound, and a negative fit shows that it
    describes something other than friction.
    """
    return Space(
        tuple(
            Parameter(role.in_theta(joint), _UNITS[role], 0.0, std, -10 * std, 10 * std, group="Joint friction")
            for role, std in _DEVIATIONS.items()
            for joint in joints
        )
    )


def sensor_parameter(
    joints: Sequence[str],
    term: str,
    joint: str,
    *,
    std: float,
    high: float,
    low: float | None = None,
    slides: bool = False,
    **options: Any,
) -> Parameter:
    """One parameter of a joint's torque sensor, with mean zero.

    Args:
        joints: measured joints.
        term: one of `TERMS`.
        joint: name of the joint.
        std: prior deviation.
        high: upper bound.
        low: lower bound; None: -high.
        slides: whether the joint is a slide, so that its torque is in N.
        options: further fields of `Parameter` (nuisance, group).

    Returns:
        The parameter.

    Raises:
        ValueError: the term or the joint is unknown.
    """
    if term not in TERMS:
        raise ValueError(f"unknown sensor term {term!r}; valid: {', '.join(TERMS)}")
    if joint not in joints:
        raise ValueError(f"unknown joint {joint!r}; measured joints: {', '.join(joints)}")
    role = Role(term)
    unit = _SLIDES.get(_UNITS[role], _UNITS[role]) if slides else _UNITS[role]
    options = {"unit": unit, "mean": 0.0, "group": _GROUPS.get(role, "Joint friction"), **options}
    return Parameter(role.in_theta(joint), std=std, low=-high if low is None else low, high=high, **options)
