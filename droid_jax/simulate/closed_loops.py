"""Closed kinematic loops (connected, welded, coupled bodies) and floating bases at the start of a motion: how far loops
stand open there and where the joints that nobody commands or measures close them; whether anything holds a base."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

OPEN = 0.01  # rad or m that joints must move to close a loop: as far apart as repeats may begin (`StartConfig.scatter`)
EXACT = 1e-6  # m or rad: a loop open by less is closed
STAGES = 20  # from the scene's pose to where the motion starts, so that a linkage stays on its branch
ITERATIONS = 30  # of Gauss-Newton at each stage
_KINDS = {
    mujoco.mjtEq.mjEQ_CONNECT: "connect",
    mujoco.mjtEq.mjEQ_WELD: "weld",
    mujoco.mjtEq.mjEQ_JOINT: "joint",
    mujoco.mjtEq.mjEQ_TENDON: "tendon",
}


@dataclass(frozen=True)
class Loop:
    """An equality that a pose does not fulfil.

    name: in words.  gap: distance, m or rad.  turn: the most that a joint moves where all together close it, rad or m.
    """

    name: str
    gap: float
    turn: float


def open_loops(scene: Scene, qpos: np.ndarray) -> list[Loop]:
    """The active equalities that a pose [nq] leaves open by more than EXACT, the widest first.

    The distance is the norm of an equality's rows: m (of a weld with the sines of half its angles), rad of hinges.
    """
    model = _of_equalities(scene.model)
    if model is None:
        return []
    data = mujoco.MjData(model)
    ids, errors, jacobian = _equalities(model, data, qpos)
    found = []
    for i in np.unique(ids):
        gap = float(np.linalg.norm(errors[ids == i]))
        turn = np.linalg.lstsq(jacobian[ids == i], errors[ids == i], rcond=1e-8)[0]
        if gap > EXACT:
            found.append(Loop(_called(model, int(i)), gap, float(np.abs(turn).max(initial=0.0))))
    return sorted(found, key=lambda loop: -loop.turn)


def closed(scene: Scene, qpos: np.ndarray, fixed: Iterable[int]) -> np.ndarray:
    """[nq] the pose in which the joints that are free to move come closest to fulfilling the scene's equalities.

    Gauss-Newton on the free joints, in STAGES from the scene's own pose on, whose loops the compiler closed.

    Args:
        scene: with the equalities.
        qpos: [nq] the pose, rad and m.
        fixed: position addresses of the joints of one degree that stay where they are.
    """
    model = _of_equalities(scene.model)
    if model is None or not open_loops(scene, qpos):
        return qpos
    kept = sorted(set(fixed))
    still = np.isin(scene.model.jnt_qposadr[scene.model.dof_jntid], kept)
    data, pose = mujoco.MjData(model), model.qpos0.copy()
    begin = pose.copy()
    for stage in np.arange(1, STAGES + 1) / STAGES:
        pose[kept] = begin[kept] + stage * (qpos[kept] - begin[kept])
        pose = _closest(model, data, pose, ~still)
    found = _closest(model, data, qpos, ~still)
    here, there = (float(np.linalg.norm(_equalities(model, data, p)[1])) for p in (pose, found))
    best = pose if here <= there + EXACT else found  # where the scene's own pose is no start, the given one may be
    touched = np.isin(scene.model.dof_jntid, scene.model.dof_jntid[_of_loops(model, data, best)])
    return _only(scene.model, qpos, best, touched & ~still)


def moved_by_loops(scene: Scene, qpos: np.ndarray) -> set[int]:
    """Position addresses of joints of one degree that connected or welded bodies hold in a pose [nq]."""
    model = _of_equalities(scene.model)
    if model is None:
        return set()
    data = mujoco.MjData(model)
    ids, _, jacobian = _equalities(model, data, qpos)
    between = np.isin(model.eq_type[ids], (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))
    dofs = np.flatnonzero(np.any(jacobian[between] != 0, axis=0))
    return {int(model.jnt_qposadr[model.dof_jntid[d]]) for d in dofs}


def coupled_to_others(scene: Scene, joints: Iterable[str]) -> list[str]:
    """Names of the equalities that join a measured joint of the scene to joints that are not among these."""
    model = _of_equalities(scene.model)
    if model is None:
        return []
    ids, _, jacobian = _equalities(model, mujoco.MjData(model), model.qpos0)
    known = np.zeros(model.nv, bool)
    known[[scene.dof(joint) for joint in joints]] = True
    found = []
    for i in np.unique(ids):
        felt = np.any(jacobian[ids == i] != 0, axis=0)
        if felt[scene.joint_dofs].any() and felt[~known].any():
            found.append(_called(model, int(i)))
    return found


def _of_equalities(model: mujoco.MjModel) -> mujoco.MjModel | None:
    """The model with no constraint but its equalities, in dense rows; None where it has none."""
    off = mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if not model.neq or not model.eq_active0.any() or model.opt.disableflags & off:
        return None
    model = model.__copy__()
    kind = mujoco.mjtDisableBit
    model.opt.disableflags |= kind.mjDSBL_CONTACT | kind.mjDSBL_LIMIT | kind.mjDSBL_FRICTIONLOSS
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return model


def _equalities(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[E] equality of each row, [E] its error, [E, nv] its derivative, in a pose [nq]."""
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    rows = np.asarray(data.efc_J).reshape(-1, model.nv)[: data.ne]
    return np.array(data.efc_id[: data.ne]), np.array(data.efc_pos[: data.ne]), rows.copy()


def _of_loops(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> np.ndarray:
    """Velocity addresses that some equality feels."""
    return np.flatnonzero(np.any(_equalities(model, data, qpos)[2] != 0, axis=0))


def _closest(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, free: np.ndarray) -> np.ndarray:
    """[nq] where Gauss-Newton on the free [nv] degrees of freedom ends, each step halved until the error falls."""
    pose = qpos.copy()
    _, errors, jacobian = _equalities(model, data, pose)
    for _ in range(ITERATIONS):
        if np.linalg.norm(errors) < 1e-3 * EXACT:
            break
        step = np.zeros(model.nv)
        step[free] = np.linalg.lstsq(jacobian[:, free], -errors, rcond=1e-8)[0]
        for share in 0.5 ** np.arange(8):
            moved = pose.copy()
            mujoco.mj_integratePos(model, moved, share * step, 1.0)
            _, tried, slope = _equalities(model, data, moved)
            if np.linalg.norm(tried) < np.linalg.norm(errors):
                pose, errors, jacobian = moved, tried, slope
                break
        else:
            break
    return pose


def _only(model: mujoco.MjModel, qpos: np.ndarray, other: np.ndarray, dofs: np.ndarray) -> np.ndarray:
    """[nq] a pose with the joints of some degrees of freedom [nv] as another one has them."""
    pose = qpos.copy()
    widths = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
    for joint in np.unique(model.dof_jntid[dofs]):
        first = model.jnt_qposadr[joint]
        place = slice(first, first + widths.get(mujoco.mjtJoint(model.jnt_type[joint]), 1))
        pose[place] = other[place]
    return pose


def _called(model: mujoco.MjModel, index: int) -> str:
    """An equality in words: its name, or its kind and what it joins."""
    kind = _KINDS.get(mujoco.mjtEq(model.eq_type[index]), "equality")
    if name := mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_EQUALITY, index):
        return f"<{kind}> {name!r}"
    what = mujoco.mjtObj(model.eq_objtype[index])
    ends = [int(i) for i in (model.eq_obj1id[index], model.eq_obj2id[index]) if i >= 0]
    if kind in ("joint", "tendon"):
        what = mujoco.mjtObj.mjOBJ_JOINT if kind == "joint" else mujoco.mjtObj.mjOBJ_TENDON
    return f"<{kind}> of {' and '.join(mujoco.mj_id2name(model, what, i) or str(i) for i in ends)}"


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
