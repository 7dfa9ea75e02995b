"""Free and ball joints that carry measured joints: whether anything in the scene holds them where a motion starts."""

from __future__ import annotations

import mujoco
import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

WATCHED = 0.3  # s, for which the servos hold the start pose: what nothing holds falls 0.44 m in it
FALLEN = 0.1  # m by which a floating body moves then, at least, where what touches it does not hold it
TURNED = 0.3  # rad, likewise


def refuse_floating(scene: Scene, recording: Recording, qpos0: np.ndarray, control: np.ndarray) -> None:
    """Raise ValueError where a free or ball joint carries measured or commanded joints and nothing holds it.

    A robot that hung or was clamped when it was recorded falls in the replay if its MJCF floats.  What may hold a
    joint is an equality, an actuator, a spring, dry friction or a contact; whether it does is tried in the C engine,
    with the servos at the start.

    Args:
        scene: with the joint.
        recording: that is to be replayed.
        qpos0: [nq] start pose, rad and m.
        control: [U] controls that hold it.
    """
    commanded = [j for j in recording.command_names if j in scene.single_joints]
    floating = scene.floating_ids(dict.fromkeys((*scene.joints, *commanded)))
    if not floating:
        return
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos0, control
    mujoco.mj_forward(model, data)
    held = {joint: _may_hold(model, data, joint) for joint in floating}
    begin = {joint: _place(model, data, joint) for joint in floating}
    for _ in range(max(1, round(WATCHED / model.opt.timestep))):
        mujoco.mj_step(model, data)
        held = {joint: found or _touches(model, data, joint) for joint, found in held.items()}
    for joint, found in held.items():
        place, turned = _place(model, data, joint)
        fallen = float(np.linalg.norm(place - begin[joint][0]))
        angle = np.zeros(3)
        mujoco.mju_subQuat(angle, turned, begin[joint][1])
        away = fallen > FALLEN or float(np.linalg.norm(angle)) > TURNED
        if found and not away:
            continue
        free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        moves = f"it moves by {fallen:.2g} m and turns by {np.linalg.norm(angle):.2g} rad within {WATCHED:g} s"
        raise ValueError(
            f"recording {recording.name!r} holds commands, and nothing in scene {scene.name!r} holds the "
            f"{'free' if free else 'ball'} joint {scene.joint_called(joint)}, which carries measured joints: "
            f"{moves if away else 'whatever the commands do moves it'}; where the robot was clamped or hung, weld it "
            "to the world (take that joint out of the MJCF)"
        )


def _dofs(model: mujoco.MjModel, joint: int) -> slice:
    first = int(model.jnt_dofadr[joint])
    return slice(first, first + (6 if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE else 3))


def _may_hold(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> bool:
    """Whether a spring, dry friction, an actuator or an equality acts on a joint."""
    dofs = _dofs(model, joint)
    if model.jnt_stiffness[joint] > 0 or np.any(model.dof_frictionloss[dofs] > 0):
        return True
    moment = np.zeros((data.actuator_moment.size and model.nu, model.nv))
    for row in range(len(moment)):
        first, count = int(data.moment_rowadr[row]), int(data.moment_rownnz[row])
        moment[row, data.moment_colind[first : first + count]] = data.actuator_moment.ravel()[first : first + count]
    return bool(np.any(moment[:, dofs] != 0)) or _acts(model, data, joint, mujoco.mjtConstraint.mjCNSTR_EQUALITY)


def _touches(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> bool:
    kinds = mujoco.mjtConstraint
    contacts = (kinds.mjCNSTR_CONTACT_FRICTIONLESS, kinds.mjCNSTR_CONTACT_PYRAMIDAL, kinds.mjCNSTR_CONTACT_ELLIPTIC)
    return _acts(model, data, joint, *contacts)


def _acts(model: mujoco.MjModel, data: mujoco.MjData, joint: int, *kinds: mujoco.mjtConstraint) -> bool:
    """Whether a constraint of these kinds acts on a joint now."""
    rows = np.flatnonzero(np.isin(data.efc_type, [int(k) for k in kinds]))
    if not rows.size:
        return False
    dense = np.zeros((data.nefc, model.nv))
    if mujoco.mj_isSparse(model):
        for row in rows:
            first, count = int(data.efc_J_rowadr[row]), int(data.efc_J_rownnz[row])
            dense[row, data.efc_J_colind[first : first + count]] = data.efc_J[first : first + count]
    else:
        dense = np.asarray(data.efc_J).reshape(-1, model.nv)
    return bool(np.any(dense[rows, _dofs(model, joint)] != 0))


def _place(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """[3] m and [4] quaternion of the body that a joint moves."""
    body = int(model.jnt_bodyid[joint])
    return data.xipos[body].copy(), data.xquat[body].copy()
