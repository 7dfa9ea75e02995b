"""What C MuJoCo simulates and MJX takes without a word and leaves out: refused, since no result would show it."""

from __future__ import annotations

import mujoco
import numpy as np

# C MuJoCo's model arrays that MJX accepts in a file and then leaves out (mujoco-mjx 3.17.0):
# field, and what it is.
IGNORED = (
    ("jnt_stiffnesspoly", "polynomial joint stiffness"),
    ("dof_dampingpoly", "polynomial joint damping"),
    ("tendon_stiffnesspoly", "polynomial tendon stiffness"),
    ("tendon_dampingpoly", "polynomial tendon damping"),
    ("actuator_delay", "actuator delay"),
    ("actuator_damping", "actuator damping"),
    ("actuator_dampingpoly", "polynomial actuator damping"),
    ("actuator_armature", "actuator armature"),
    ("sensor_delay", "sensor delay"),
    ("actuator_actearly", "early activation of actuators"),
    ("geom_adhesion", "adhesion of geoms"),
    ("pair_adhesion", "adhesion of contact pairs"),
    ("geom_surfacevel", "surface velocity"),
)


def refuse_ignored(model: mujoco.MjModel, name: str) -> None:
    """Raise ValueError listing every feature of the model that MJX would silently leave out."""
    found = [what for field, what in IGNORED if _used(model, field)]
    if np.any(model.opt.disableactuator != 0):
        found.append("disabled actuator groups")
    if model.opt.noslip_iterations > 0:
        found.append("the noslip solver")
    passive = (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER)
    if sum(bool(model.opt.disableflags & bit) for bit in passive) == 1:
        found.append("springs without dampers, or the other way round (a flag: MJX then drops both, and gravcomp)")
    if found:
        raise ValueError(
            f"scene {name!r} uses features that MJX accepts and then ignores: {', '.join(found)}; "
            "remove them from the MJCF or add the effect through the program's own library"
        )


def _used(model: mujoco.MjModel, field: str) -> bool:
    array = getattr(model, field, None)
    return array is not None and np.size(array) > 0 and bool(np.any(np.asarray(array) != 0))
