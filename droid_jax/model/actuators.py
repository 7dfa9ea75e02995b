"""What each actuator of a model drives, how it is called, and whether it is a servo."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np


def drives_joint(model: mujoco.MjModel) -> np.ndarray:
    """[U] bool, actuators that drive a joint, and not a tendon, a site or a body."""
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    return np.isin(model.actuator_trntype, kinds)


def has_feedback(model: mujoco.MjModel) -> np.ndarray:
    """[U] bool, actuators whose force follows their own position, as a position servo's does."""
    return (model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE) & (model.actuator_biasprm[:, 1] != 0)


def of_joint(model: mujoco.MjModel, command_names: Sequence[str]) -> np.ndarray:
    """[U] bool, those of `command_names` that are joints."""
    joints = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(model.njnt)}
    return np.array([name in joints for name in command_names], dtype=bool)


def actuator_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """[U] the joint that each actuator drives, or its own name where it drives none.

    Of several that drive one joint (a position servo with its damping in a <velocity> of its own) the servo goes by the
    joint's name, the others by their own; where there is no servo, or more than one, all go by their own.
    """
    joints = [int(j) if of else -1 for j, of in zip(model.actuator_trnid[:, 0], drives_joint(model), strict=True)]
    feedback, names = has_feedback(model), list[str]()
    for i, joint in enumerate(joints):
        own = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)
        rivals = [k for k, other in enumerate(joints) if other == joint >= 0]
        if joint >= 0 and (rivals == [i] or [k for k in rivals if feedback[k]] == [i]):
            names.append(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint))
        elif not own or mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, own) >= 0:
            what = "has another one beside it" if joint >= 0 else "drives no joint"
            raise ValueError(f"actuator {own or i!r} {what}: give it a name that no joint has")
        else:
            names.append(own)
    return tuple(names)


def has_servo_damping(model: mujoco.MjModel) -> bool:
    """Whether any actuator has a velocity gain: its force then follows the joint's velocity."""
    return bool(np.any(model.actuator_biasprm[:, 2]) or np.any(model.actuator_gainprm[:, 2]))
