"""Parameters of a servo's DC motor: torque constant and resistance, or stall torque and no-load speed.

A servo's electronics apply a duty d of the supply voltage V to a motor with torque constant K and resistance R.  The
firmware has a gain g of the position error:

    d = clip(g (u - q), -1, 1)        torque = K V / R d - K^2 / R w

In an MJCF that is <position kp="g K V/R" forcerange="-K V/R K V/R"/> on a joint with damping K^2/R (back electromotive
force).  With the stall torque T = K V / R and the no-load speed W = V / K the damping is T / W.  Each term below is a
factor on the MJCF's numbers, 1 at nominal.  It also scales viscous friction, which is part of the damping.  Recordings
may state the gain of the firmware (`simulate.servo_gains`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from droid_jax.model.fields import write
from droid_jax.model.parameters import Mode, Parameter, Scaling, Write
from droid_jax.model.scene import Scene

STALL, NO_LOAD, CONSTANT, RESISTANCE = "stall_torque", "no_load_speed", "torque_constant", "resistance"
# term -> modes of its writes to the torques per duty (gains and limit), and of those to the back electromotive force
MOTOR_TERMS = {
    STALL: ((Mode.SCALE,), (Mode.SCALE,)),
    NO_LOAD: ((), (Mode.DIVIDE,)),
    CONSTANT: ((Mode.SCALE,), (Mode.SCALE, Mode.SCALE)),
    RESISTANCE: ((Mode.DIVIDE,), (Mode.DIVIDE,)),
}


def motor_parameter(scene: Scene, term: str, joint: str, *, std: float = 0.2, **options: Any) -> Parameter:
    """A factor on a property of the motor that drives a joint, 1 at nominal.

    Args:
        scene: with an actuator of the joint.
        term: a key of `MOTOR_TERMS`.
        joint: name of the joint.
        std: prior deviation.
        options: further fields of `Parameter`; bounds are 0.2 and 5 unless given.

    Returns:
        The parameter.

    Raises:
        ValueError: the term is unknown or has no effect on this joint, or the joint has no actuator.
    """
    if term not in MOTOR_TERMS:
        raise ValueError(f"unknown motor term {term!r}; valid: {', '.join(MOTOR_TERMS)}")
    if joint not in scene.driven_joints:
        raise ValueError(f"no actuator drives {joint!r}; driven joints: {', '.join(scene.driven_joints)}")
    per_duty, back = MOTOR_TERMS[term]
    writes = [write(scene, field, index, mode) for field, index in _per_duty(scene, joint) for mode in per_duty]
    dof = scene.dof(joint)
    damped = scene.model.dof_damping[dof] > 0
    writes += [write(scene, "dof_damping", (dof,), mode) for mode in back if damped]
    if not writes:
        raise ValueError(
            f"joint {joint!r} has no damping, which its motor's {term} would change; set it in the MJCF to the stall "
            "torque over the no-load speed"
        )
    return _factor(f"{joint}_{term}", std, tuple(writes), options)


def _factor(name: str, std: float, writes: tuple[Write, ...], options: dict[str, Any]) -> Parameter:
    given = {"name": name, "unit": "-", "mean": 1.0, "low": 0.2, "high": 5.0, "scaling": Scaling.LOG, **options}
    return Parameter(std=std, writes=writes, **given)


def _per_duty(scene: Scene, joint: str) -> list[tuple[str, tuple[int, ...]]]:
    """(field, index) of the model's entries that are proportional to torque per duty: gains and an active limit."""
    model, u = scene.model, scene.command_names.index(joint)
    entries = [("actuator_gainprm", (u, 0))]
    entries += [("actuator_biasprm", (u, k)) for k in (1, 2) if model.actuator_biasprm[u, k] != 0]
    if model.actuator_forcelimited[u]:
        entries += [("actuator_forcerange", (u, k)) for k in (0, 1) if np.isfinite(model.actuator_forcerange[u, k])]
    return entries
