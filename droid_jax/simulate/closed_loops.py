"""Closed kinematic loops and floating bases at the start of a motion.

Equalities (connect, weld, joint, tendon) that the start violates are closed by the joints that nobody commands or
measures.  A floating base that nothing supports is refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

OPEN = 0.01  # rad or m, largest motion of a joint that may close a loop; the scatter of starts (`StartConfig.scatter`)
EXACT = 1e-6  # m or rad, an equality with a smaller error counts as satisfied
STAGES = 20  # from the scene's pose to the start, so that a linkage stays on its branch
ITERATIONS = 30  # of Gauss-Newton in each stage
HOLD_DURATION = 0.3  # s, for which the servos hold the start pose in the test of a floating base: free fall is 0.44 m
FALL_LIMIT = 0.1  # m, a floating body that moves further in that time is not held
TURN_LIMIT = 0.3  # rad, likewise
_KINDS = {
    mujoco.mjtEq.mjEQ_CONNECT: "connect",
    mujoco.mjtEq.mjEQ_WELD: "weld",
    mujoco.mjtEq.mjEQ_JOINT: "joint",
    mujoco.mjtEq.mjEQ_TENDON: "tendon",
}


@dataclass(frozen=True)
class Loop:
    """An equality that a pose violates.

    Attributes:
        name: of the equality, for messages.
        gap: norm of its error, m or rad.
        turn: rad or m, largest motion of a joint in the smallest joint motion that closes it.
    """

    name: str
    gap: float
    turn: float


def open_loops(scene: Scene, qpos: np.ndarray) -> list[Loop]:
    """The active equalities that a pose [nq] violates by more than EXACT, the largest `turn` first.

    An equality's error is the norm of its rows: m (a weld adds the sines of half its angles), or rad for hinges.
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


def close_loops(scene: Scene, qpos: np.ndarray, fixed: Iterable[int]) -> np.ndarray:
    """[nq] the pose in which the free joints come closest to satisfying the scene's equalities.

    Gauss-Newton moves the free joints, in STAGES from the scene's reference pose, whose loops the compiler closed.

    Args:
        scene: with the equalities.
        qpos: [nq] the pose, rad and m.
        fixed: position addresses of hinges and slides that must not move.
    """
    model = _of_equalities(scene.model)
    if model is None or not open_loops(scene, qpos):
        return qpos
    addresses = sorted(set(fixed))
    fixed_dofs = np.isin(scene.model.jnt_qposadr[scene.model.dof_jntid], addresses)
    data, staged = mujoco.MjData(model), model.qpos0.copy()
    reference = staged.copy()
    for stage in np.arange(1, STAGES + 1) / STAGES:
        staged[addresses] = reference[addresses] + stage * (qpos[addresses] - reference[addresses])
        staged = _closest(model, data, staged, ~fixed_dofs)
    direct = _closest(model, data, qpos, ~fixed_dofs)
    errors = [float(np.linalg.norm(_equalities(model, data, pose)[1])) for pose in (staged, direct)]
    best = staged if errors[0] <= errors[1] + EXACT else direct  # the way from the reference pose may end elsewhere
    touched = np.isin(scene.model.dof_jntid, scene.model.dof_jntid[_of_loops(model, data, best)])
    return _only(scene.model, qpos, best, touched & ~fixed_dofs)


def moved_by_loops(scene: Scene, qpos: np.ndarray) -> set[int]:
    """Position addresses of hinges and slides on which a connect or weld equality acts in a pose [nq]."""
    model = _of_equalities(scene.model)
    if model is None:
        return set()
    data = mujoco.MjData(model)
    ids, _, jacobian = _equalities(model, data, qpos)
    between = np.isin(model.eq_type[ids], (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD))
    dofs = np.flatnonzero(np.any(jacobian[between] != 0, axis=0))
    return {int(model.jnt_qposadr[model.dof_jntid[d]]) for d in dofs}


def coupled_to_others(scene: Scene, joints: Iterable[str]) -> list[str]:
    """Names of the equalities that couple a measured joint of the scene to a joint that is not in `joints`."""
    model = _of_equalities(scene.model)
    if model is None:
        return []
    ids, _, jacobian = _equalities(model, mujoco.MjData(model), model.qpos0)
    known = np.zeros(model.nv, bool)
    known[[scene.dof(joint) for joint in joints]] = True
    names = []
    for i in np.unique(ids):
        coupled = np.any(jacobian[ids == i] != 0, axis=0)
        if coupled[scene.joint_dofs].any() and coupled[~known].any():
            names.append(_called(model, int(i)))
    return names


def _of_equalities(model: mujoco.MjModel) -> mujoco.MjModel | None:
    """A copy of the model with its equalities as the only constraints, in dense rows; None if it has none."""
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
    """Of each constraint row in a pose [nq]: [E] its equality, [E] its error, [E, nv] its Jacobian."""
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    rows = np.asarray(data.efc_J).reshape(-1, model.nv)[: data.ne]
    return np.array(data.efc_id[: data.ne]), np.array(data.efc_pos[: data.ne]), rows.copy()


def _of_loops(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> np.ndarray:
    """Velocity addresses on which an equality acts."""
    return np.flatnonzero(np.any(_equalities(model, data, qpos)[2] != 0, axis=0))


def _closest(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, free: np.ndarray) -> np.ndarray:
    """[nq] the result of Gauss-Newton on the free degrees of freedom [nv]; steps are halved until the error falls."""
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
    """[nq] a pose with the joints of some degrees of freedom [nv] taken from another pose."""
    pose = qpos.copy()
    widths = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
    for joint in np.unique(model.dof_jntid[dofs]):
        first = model.jnt_qposadr[joint]
        place = slice(first, first + widths.get(mujoco.mjtJoint(model.jnt_type[joint]), 1))
        pose[place] = other[place]
    return pose


def _called(model: mujoco.MjModel, index: int) -> str:
    """An equality for messages: its name, or its kind and what it couples."""
    kind = _KINDS.get(mujoco.mjtEq(model.eq_type[index]), "equality")
    if name := mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_EQUALITY, index):
        return f"<{kind}> {name!r}"
    what = mujoco.mjtObj(model.eq_objtype[index])
    ends = [int(i) for i in (model.eq_obj1id[index], model.eq_obj2id[index]) if i >= 0]
    if kind in ("joint", "tendon"):
        what = mujoco.mjtObj.mjOBJ_JOINT if kind == "joint" else mujoco.mjtObj.mjOBJ_TENDON
    return f"<{kind}> of {' and '.join(mujoco.mj_id2name(model, what, i) or str(i) for i in ends)}"


def refuse_floating(scene: Scene, recording: Recording, qpos0: np.ndarray, control: np.ndarray) -> None:
    """Raise ValueError if a free or ball joint carries measured or commanded joints and nothing holds it.

    A robot that hung or was clamped in reality falls in the replay if its MJCF floats.  An equality, an actuator, a
    spring, dry friction or a contact may hold a joint.  The C engine tests whether they do: the servos hold the start
    pose for HOLD_DURATION.

    Args:
        scene: with the joint.
        recording: to be replayed.
        qpos0: [nq] start pose, rad and m.
        control: [U] controls that hold the start pose.
    """
    commanded = [j for j in recording.command_names if j in scene.single_joints]
    floating = scene.floating_ids(dict.fromkeys((*scene.joints, *commanded)))
    if not floating:
        return
    model = scene.model
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = qpos0, control
    mujoco.mj_forward(model, data)
    supported = {joint: _may_hold(model, data, joint) for joint in floating}
    begin = {joint: _pose(model, data, joint) for joint in floating}
    for _ in range(max(1, round(HOLD_DURATION / model.opt.timestep))):
        mujoco.mj_step(model, data)
        supported = {joint: before or _touches(model, data, joint) for joint, before in supported.items()}
    for joint, has_support in supported.items():
        position, quaternion = _pose(model, data, joint)
        fall = float(np.linalg.norm(position - begin[joint][0]))
        rotation = np.zeros(3)
        mujoco.mju_subQuat(rotation, quaternion, begin[joint][1])
        turn = float(np.linalg.norm(rotation))
        moved = fall > FALL_LIMIT or turn > TURN_LIMIT
        if has_support and not moved:
            continue
        free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        reason = f"it moves by {fall:.2g} m and turns by {turn:.2g} rad within {HOLD_DURATION:g} s"
        raise ValueError(
            f"recording {recording.name!r} has commands, and nothing in scene {scene.name!r} holds the "
            f"{'free' if free else 'ball'} joint {scene.joint_called(joint)}, which carries measured joints: "
            f"{reason if moved else 'every command moves it'}; if the robot was clamped or hung, weld it to the world "
            "(remove that joint from the MJCF)"
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


def _pose(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """[3] m, centre of mass, and [4] quaternion of the body that a joint moves."""
    body = int(model.jnt_bodyid[joint])
    return data.xipos[body].copy(), data.xquat[body].copy()
