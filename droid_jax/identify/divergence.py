"""Why a replay blew up: the joint that left its range first, when, and the time step that its servo needs."""

from __future__ import annotations

import numpy as np

from droid_jax.model.actuators import drives_joint
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene

UNLIMITED_RANGE = 30.0  # rad or m from zero, some five turns, beyond which a joint without a range has blown up
RANGE_MARGIN = 1.0  # widths of its range beyond which a joint with one has blown up


def blow_up(scene: Scene, rollout: Rollout) -> str:
    """Return a clause that explains why a replay of one sample blew up; empty if no joint shows it.

    Args:
        scene: of the replay.
        rollout: host arrays [T, ...]; position [T, J] in the order of the scene's joints.
    """
    position, time = np.asarray(rollout.position, np.float64), np.asarray(rollout.time, np.float64)
    if not position.size:
        return ""
    bounds = np.array([_blow_up_bounds(scene, joint) for joint in scene.joints])  # [J, 2]
    with np.errstate(invalid="ignore"):
        outside = ~((position >= bounds[:, 0]) & (position <= bounds[:, 1]))
    outside |= ~np.isfinite(np.asarray(rollout.velocity)) | ~np.isfinite(np.asarray(rollout.torque))
    rows = np.flatnonzero(outside.any(axis=1))
    if not rows.size:
        return ""
    row = int(rows[0])
    with np.errstate(invalid="ignore", over="ignore"):
        speed = np.nan_to_num(np.abs(np.asarray(rollout.velocity, np.float64)[max(row - 1, 0)]), nan=np.inf)
    fastest = max(np.flatnonzero(outside[row]), key=lambda j: speed[j])
    joint = scene.joints[fastest]
    return f"{joint} leaves its range at step {row} ({time[row]:.3g} s){_stability_limit(scene, joint)}"


def _blow_up_bounds(scene: Scene, joint: str) -> tuple[float, float]:
    """Positions of a joint, rad or m, beyond which its replay has blown up."""
    low, high = scene.model.jnt_range[scene.id("joint", joint)]
    margin = RANGE_MARGIN * (high - low)
    return (low - margin, high + margin) if low < high else (-UNLIMITED_RANGE, UNLIMITED_RANGE)


def _stability_limit(scene: Scene, joint: str) -> str:
    """A clause with the time step or armature that makes a joint's servo stable; empty if it is stable.

    A servo of stiffness k on an inertia I, integrated explicitly, is stable for time steps below 2 sqrt(I / k).
    """
    model, dof = scene.model, scene.dof(joint)
    servos = drives_joint(model) & (model.actuator_trnid[:, 0] == scene.id("joint", joint))
    stiffness = float(-(model.actuator_biasprm[servos, 1] * model.actuator_gear[servos, 0] ** 2).sum())
    inverse_inertia, step = float(model.dof_invweight0[dof]), float(model.opt.timestep)
    if stiffness <= 0 or inverse_inertia <= 0 or step * np.sqrt(stiffness * inverse_inertia) < 1.0:
        return ""
    limit, needed = 2.0 / np.sqrt(stiffness * inverse_inertia), stiffness * step**2 / 4.0
    unit, torque = ("kg", "N/m") if scene.slides(joint) else ("kg m2", "N m/rad")
    return (
        f", where its servo's {stiffness:.3g} {torque} on {1.0 / inverse_inertia:.2g} {unit} need a time step well "
        f"below {1e3 * limit:.2g} ms, or armature well above {needed:.2g} {unit}"
    )
