"""What the torque sensor of a joint adds: friction as it sees it on the link side, a constant, a gain.

    tau += viscous * qd + coulomb * tanh(qd / SMOOTHING) + torque_offset        [N m]

These are observation parameters: they change what is read, not how the arm moves.  The model's own
`joint_damping` and `joint_frictionloss` lie on the motor side, where a link-side sensor cannot see
them; what it does see is friction of the bearings behind it.  Model: the linear friction of Gaz et al.,
RA-L 2019, with a smooth sign (`direction`).

A torque sensor of another gain reads (1 + torque_gain) tau.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from droid_jax.model.effect_interface import Effect, Rollout, Theta, column
from droid_jax.model.parameters import OF_A_JOINT, Parameter, Role, Space

SMOOTHING = 0.01  # rad/s: `direction` reaches 0.96 at twice this speed
GAIN = Role.TORQUE_GAIN.value
TERMS = tuple(role.value for role in OF_A_JOINT)
_UNITS = {Role.VISCOUS: "N m s/rad", Role.COULOMB: "N m", Role.TORQUE_OFFSET: "N m", Role.TORQUE_GAIN: "-"}
_SLIDES = {"N m s/rad": "N s/m", "N m": "N"}  # the same on a joint that slides
_GROUPS = {Role.TORQUE_GAIN: "Sensors"}
_DEVIATIONS = {Role.VISCOUS: 0.3, Role.COULOMB: 0.5, Role.TORQUE_OFFSET: 0.3}  # of the prior


def direction(velocity: jax.Array) -> jax.Array:
    """Smooth sign of a speed, rad/s; speeds well below SMOOTHING have no direction yet."""
    return jnp.tanh(velocity / SMOOTHING)


def joint_friction_effect(joints: Sequence[str], direction: Callable[[jax.Array], jax.Array] = direction) -> Effect:
    """Adds viscous and Coulomb friction to the torque of `joints`, the channel order of the scene.

    direction: of a speed.  Along a prescribed motion jnp.sign, since samples at rest are known there (`simulate.rest`);
    a servo's simulated joints have none.

    Reads `viscous[joint]` and `coulomb[joint]` from theta; absent means zero.  The offset is left to
    `droid_jax.simulate.replay.torque_offset_effect`, which reads `torque_offset[joint]`.
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
    """Torque sensors of another gain: reads `torque_gain[joint]` of `joints`, the channel order of the scene."""

    def observe(theta: Theta, rollout: Rollout) -> Rollout:
        return replace(rollout, torque=rollout.torque * (1.0 + column(theta, GAIN, joints)))

    return Effect(GAIN, observe=observe)


def joint_friction_space(joints: Sequence[str]) -> Space:
    """Three parameters a joint, `viscous[joint]`, `coulomb[joint]` and `torque_offset[joint]`, all zero at first.

    Bounds are ten deviations to either side: zero, no friction, is then no edge, and a fit that comes out
    negative shows that something other than friction was fitted.
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
    """One of those parameters with a prior deviation and bounds of its own (low: -high unless given).

    slides: the joint does, so that its unit is N.  options: nuisance, group.
    Raises ValueError for an unknown term or joint.
    """
    if term not in TERMS:
        raise ValueError(f"unknown sensor term {term!r}; valid: {', '.join(TERMS)}")
    if joint not in joints:
        raise ValueError(f"unknown joint {joint!r}; measured joints: {', '.join(joints)}")
    role = Role(term)
    unit = _SLIDES.get(_UNITS[role], _UNITS[role]) if slides else _UNITS[role]
    options = {"unit": unit, "mean": 0.0, "group": _GROUPS.get(role, "Joint friction"), **options}
    return Parameter(role.in_theta(joint), std=std, low=-high if low is None else low, high=high, **options)
