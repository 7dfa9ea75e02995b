"""The door's parameter vector: Table I of the paper, and the nuisances beside it.

`truth(column)` gives the fitted columns of Table I, used as hidden truths for the synthetic robot.
`diag(Sigma_init)` of Table I is half of the mean for nearly every entry, so it is read as
standard deviations.
"""

from __future__ import annotations

from typing import Any

from droid_jax.arguments import instance, one_of
from droid_jax.door.scene import ARM, HINGE, PAPER_DAMPING
from droid_jax.model.fields import (
    body_mass,
    body_mass_scale,
    body_position,
    body_yaw,
    capsule_radius,
    joint_damping,
    joint_frictionloss,
    joint_stiffness,
    pair_friction,
    servo_scale,
    time_offset,
)
from droid_jax.model.parameters import Parameter, Role, Space
from droid_jax.model.scene import TINY_FRICTIONLOSS, Scene

PAPER_DAMPING_STD = (2.0, 2.0, 2.0, 2.0, 2.0, 1.0, 0.2)  # Table I, N m s/rad
JOINT_DAMPING = tuple(f"joint_damping_{i}" for i in range(1, 8))

# Table I, fitted means of door and fingers (left, right), by number of springs.
_TABLE_I: dict[int, dict[str, Any]] = {
    0: dict(door_mass=1.50, knob_mass=1.98, hinge_frictionloss=0.10, hinge_stiffness=0.002, hinge_damping=0.10,
            sliding=(0.47, 1.78), torsional=(1.38, 1.84)),
    1: dict(door_mass=0.92, knob_mass=2.31, hinge_frictionloss=0.0, hinge_stiffness=1.06, hinge_damping=0.71,
            sliding=(1.37, 0.76), torsional=(0.79, 2.29)),
    2: dict(door_mass=2.54, knob_mass=3.99, hinge_frictionloss=0.56, hinge_stiffness=1.24, hinge_damping=0.60,
            sliding=(3.04, 2.68), torsional=(1.04, 2.0)),
}  # fmt: skip


def truth(springs: int) -> dict[str, float]:
    """The nine door and finger values of a fitted column of Table I (0, 1 or 2 springs; ValueError for others)."""
    if springs not in _TABLE_I:
        raise ValueError(f"Table I has doors with {sorted(_TABLE_I)} springs, got {springs}")
    row = dict(_TABLE_I[springs])
    row["hinge_frictionloss"] = max(row["hinge_frictionloss"], TINY_FRICTIONLOSS)  # its row must exist
    for kind in ("sliding", "torsional"):
        left, right = row.pop(kind)
        row[f"{kind}_friction_left"], row[f"{kind}_friction_right"] = left, right
    return row


def door_space(scene: Scene, *, preset: str = "impedance") -> Space:
    """The 16 parameters of Table I.

    Args:
        scene: of `door_scene`.
        preset: "paper" has Table I's own means and deviations, joint damping around 100 N m s/rad and linear
            coordinates; negative samples are redrawn. "impedance" has the same door and gripper, joint damping around
            the scene's own servo damping with a deviation of 10 %, and log coordinates, wide enough that a sprung door,
            200 of Table I's deviations away, is still found.

    Returns:
        A space of D = 16.

    Raises:
        ValueError: another preset, or a scene without a grip.
    """
    one_of(preset, "preset", ("impedance", "paper"))
    instance(scene, "scene", Scene)
    if scene.grip is None:
        raise ValueError(f"scene {scene.name!r} has no grip, whose fingers' friction is part of Table I")
    left, right = scene.grip.fingers
    door = dict(group="Door")
    slides, turns = (
        dict(group="Gripper", width=0.5, role=role) for role in (Role.SLIDING_FRICTION, Role.TORSIONAL_FRICTION)
    )
    parameters = (
        body_mass(scene, "door", mean=1.144, std=0.5, low=0.05, high=10.0, **door),
        body_mass(scene, "knob", mean=0.199, std=0.1, low=0.01, high=8.0, width=0.7, **door),
        joint_frictionloss(scene, HINGE, mean=0.05, std=0.025, low=TINY_FRICTIONLOSS, high=5.0, width=0.7, **door),
        joint_stiffness(scene, HINGE, mean=0.01, std=0.005, high=10.0, width=1.0, **door),
        joint_damping(scene, HINGE, mean=2.0, std=1.0, high=20.0, width=0.7, **door),
        *_joint_dampings(scene, preset),
        pair_friction(scene, left, (0, 1), name="sliding_friction_left", unit="-", std=0.25, **slides),
        pair_friction(scene, right, (0, 1), name="sliding_friction_right", unit="-", std=0.25, **slides),
        pair_friction(scene, left, (2,), name="torsional_friction_left", unit="m", std=0.25, **turns),
        pair_friction(scene, right, (2,), name="torsional_friction_right", unit="m", std=0.25, **turns),
    )
    space = Space(parameters)
    return space.linear() if preset == "paper" else space


def _joint_dampings(scene: Scene, preset: str) -> tuple[Parameter, ...]:
    out: list[Parameter] = []
    for i, joint in enumerate(ARM):
        mean = PAPER_DAMPING[i] if preset == "paper" else float(scene.model.dof_damping[scene.dof(joint)])
        std = PAPER_DAMPING_STD[i] if preset == "paper" else 0.1 * mean
        out.append(
            joint_damping(
                scene, joint, name=JOINT_DAMPING[i], mean=mean, std=std, low=0.01, high=5 * mean, log_offset=0.0,
                group="Robot",
            )
        )  # fmt: skip
    return tuple(out)


def door_nuisances(scene: Scene) -> Space:
    """What is uncertain and of no interest: pose, grasp, link masses, servo gains, timing and torque offsets.

    Deviations of the priors: 2 mm and 0.5 degree of door pose, 1 mm at the knob, 3 % of link masses and servo gains,
    1 ms, 0.1 N m (0.03 at the wrist).

    Args:
        scene: of `door_scene`.

    Returns:
        A space of nuisances, to be given beside `door_space`.

    Raises:
        ValueError: the scene lacks an element of the door's.
    """
    instance(scene, "scene", Scene)
    note: dict[str, Any] = dict(nuisance=True, group="Nuisance")
    pose = [
        body_position(scene, "cabinet", k, std=0.002, limit=0.02, name=f"door_{'xyz'[k]}", **note) for k in range(3)
    ]
    pose += [
        body_yaw(scene, "cabinet", std=0.0087, limit=0.1, name="door_yaw", **note),
        body_position(scene, "knob", 1, std=0.001, limit=0.01, name="knob_lever", **note),
        capsule_radius(scene, "knob", std=0.0005, limit=0.004, name="knob_radius", **note),
    ]
    masses = [body_mass_scale(scene, f"link{i}", name=f"link_mass_scale_{i}", **note) for i in range(2, 8)]
    servos = [servo_scale(scene, j, name=f"servo_scale_{i}", **note) for i, j in enumerate(ARM, 1)]
    return Space((*pose, *masses, *servos, time_offset(), *torque_offsets(ARM)))


def torque_offsets(joints: tuple[str, ...], std: float = 0.1) -> tuple[Parameter, ...]:
    """Constant error of each joint's torque sensor, N m."""
    return tuple(
        Parameter(Role.TORQUE_OFFSET.in_theta(j), "N m", 0.0, std if i < 4 else 0.3 * std, -2.0, 2.0, nuisance=True,
                  group="Nuisance")
        for i, j in enumerate(joints)
    )  # fmt: skip
