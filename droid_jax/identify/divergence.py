"""Why a replay gives no numbers: which joint leaves its range first, when, and what its servo would need."""

from __future__ import annotations

import numpy as np

from droid_jax.model.actuators import drives_joint
from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene

FAR = 30.0  # rad or m from zero that a joint without a range does not come to: some five turns
WIDTHS = 1.0  # of its range, by which a joint with one has left it for good


def blow_up(scene: Scene, rollout: Rollout) -> str:
    """What is to be said of a replay of one sample that blew up, in a clause; empty where no joint shows it.

    Args:
        scene: of the replay.
        rollout: host arrays [T, ...]; position [T, J] in the order of the scene's joints.
    """
    position, time = np.asarray(rollout.position, np.float64), np.asarray(rollout.time, np.float64)
    if not position.size:
        return ""
    bounds = np.array([_far(scene, joint) for joint in scene.joints])  # [J, 2]
    with np.errstate(invalid="ignore"):
        gone = ~((position >= bounds[:, 0]) & (position <= bounds[:, 1]))
    gone |= ~np.isfinite(np.asarray(rollout.velocity)) | ~np.isfinite(np.asarray(rollout.torque))
    rows = np.flatnonzero(gone.any(axis=1))
    if not rows.size:
        return ""
    row = int(rows[0])
    with np.errstate(invalid="ignore", over="ignore"):
        speed = np.nan_to_num(np.abs(np.asarray(rollout.velocity, np.float64)[max(row - 1, 0)]), nan=np.inf)
    first = max(np.flatnonzero(gone[row]), key=lambda j: speed[j])
    joint = scene.joints[first]
    return f"{joint} leaves its range at step {row} ({time[row]:.3g} s){_needs(scene, joint)}"


def _far(scene: Scene, joint: str) -> tuple[float, float]:
    """Where a joint has left its range for good, rad or m."""
    low, high = scene.model.jnt_range[scene.id("joint", joint)]
    beyond = WIDTHS * (high - low)
    return (low - beyond, high + beyond) if low < high else (-FAR, FAR)


def _needs(scene: Scene, joint: str) -> str:
    """The time step or armature with which a joint's servo is stable, where the scene's own is not.

    A servo of stiffness k on an inertia I, stepped explicitly, is stable for steps below 2 sqrt(I / k).
    """
    model, dof = scene.model, scene.dof(joint)
    mine = drives_joint(model) & (model.actuator_trnid[:, 0] == scene.id("joint", joint))
    stiffness = float(-(model.actuator_biasprm[mine, 1] * model.actuator_gear[mine, 0] ** 2).sum())
    weight, step = float(model.dof_invweight0[dof]), float(model.opt.timestep)
    if stiffness <= 0 or weight <= 0 or step * np.sqrt(stiffness * weight) < 1.0:
        return ""
    limit, needed = 2.0 / np.sqrt(stiffness * weight), stiffness * step**2 / 4.0
    unit, torque = ("kg", "N/m") if scene.slides(joint) else ("kg m2", "N m/rad")
    return (
        f", where its servo's {stiffness:.3g} {torque} on {1.0 / weight:.2g} {unit} need a time step well below "
        f"{1e3 * limit:.2g} ms, or armature well above {needed:.2g} {unit}"
    )
