"""Actuators of a model: what each drives, its name, and whether it is a servo."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np


def drives_joint(model: mujoco.MjModel) -> np.ndarray:
    """[U] bool, actuators that drive a joint, not a tendon, a site or a body."""
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    return np.isin(model.actuator_trntype, kinds)


def has_feedback(model: mujoco.MjModel) -> np.ndarray:
    """[U] bool, actuators whose force depends on their length, as a position servo's."""
    return (model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE) & (model.actuator_biasprm[:, 1] != 0)


def of_joint(model: mujoco.MjModel, command_names: Sequence[str]) -> np.ndarray:
    """[U] bool, entries of `command_names` that are names of joints."""
    joints = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(model.njnt)}
    return np.array([name in joints for name in command_names], dtype=bool)


def actuator_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """[U] the name of the joint that each actuator drives, else the actuator's name.

    If several actuators drive one joint (a position servo, and its damping as a separate <velocity>), the only servo
    has the joint's name and the others have their own names.  Without a servo, or with several, all have their own.

    Raises ValueError for an actuator that needs its own name and has none, or has the name of a joint.
    """
    joints = [int(j) if of else -1 for j, of in zip(model.actuator_trnid[:, 0], drives_joint(model), strict=True)]
    feedback, names = has_feedback(model), list[str]()
    for i, joint in enumerate(joints):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)
        of_same_joint = [k for k, other in enumerate(joints) if other == joint >= 0]
        if joint >= 0 and (of_same_joint == [i] or [k for k in of_same_joint if feedback[k]] == [i]):
            names.append(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint))
        elif not name or mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0:
            problem = "shares its joint with another one" if joint >= 0 else "drives no joint"
            raise ValueError(f"actuator {name or i!r} {problem}: give it a name that no joint has")
        else:
            names.append(name)
    return tuple(names)


def has_servo_damping(model: mujoco.MjModel) -> bool:
    """Whether any actuator has a velocity gain."""
    return bool(np.any(model.actuator_biasprm[:, 2]) or np.any(model.actuator_gainprm[:, 2]))
