"""Where a recorded motion starts in the scene, and whether the scene carries the weight that its torque holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np

from droid_jax.arguments import check_fields, number
from droid_jax.model.actuators import has_feedback
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.closed_loops import OPEN, closed, moved_by_loops, open_loops

WEIGHT = 0.01  # N m or N: a joint that feels less uncompensated weight feels none (noise below it is never believed)
POSES = 50  # of a motion, at which the weight is looked at


@dataclass(frozen=True)
class StartConfig:
    """What decides where a motion starts, and whether repeats start at one place.

    ajar: rad or m; an object seen no further than this from the scene's pose stands there, as cameras are noisy.
    scatter: rad or m; repeats whose measured starts are closer are taken to start at one place.
    noise: deviations of a position's noise that starts must be apart too.
    early: s at the beginning, in which that noise is looked at.
    alike: rad or m; measured starts that are closer differ by the noise of a sensor, and share one replay.
    """

    ajar: float = 0.02
    scatter: float = 0.01
    noise: float = 6.0
    early: float = 0.2
    alike: float = 2e-3

    def __post_init__(self) -> None:
        check_fields(self, **dict.fromkeys(("ajar", "scatter", "noise", "early", "alike"), partial(number, least=0)))


DEFAULT_START = StartConfig()


def start_pose(scene: Scene, recording: Recording, config: StartConfig = DEFAULT_START) -> np.ndarray:
    """[nq] where the motion starts: as stated (qpos0), else as measured, else where its servos were sent first.

    Of joints that nobody commanded or measured one that an equality couples to another starts where that has it, those
    of a closed loop where they close it, all others stand as in the scene.
    Raises ValueError for a joint that has or needs a command and of which nothing says where it starts, for one
    that the scene does not have, and for a loop that no such joint can close.
    """
    for joint in recording.qpos0:
        try:
            scene.qpos(joint)
        except ValueError as error:
            raise ValueError(f"recording {recording.name!r}, qpos0: {error}") from None
    stated = _stated(scene, recording, config)
    asked = {*scene.needs_command, *recording.command_names}
    guessed = [j for j in scene.driven_joints if j in asked and j not in stated]
    if guessed:
        raise ValueError(
            f"recording {recording.name!r} does not tell where {', '.join(guessed)} starts: state it in qpos0 "
            "or measure its position"
        )
    qpos = closed(scene, _coupled(scene, stated), [scene.qpos(joint) for joint in stated])
    if wide := [loop for loop in open_loops(scene, qpos) if loop.turn > OPEN]:
        raise ValueError(
            f"recording {recording.name!r} starts where {wide[0].name} of scene {scene.name!r} is open by "
            f"{wide[0].gap:.3g} (m or rad), and no joint that nobody commands, measures or states can close it: state "
            "a start that closes it (qpos0), or mend the lengths or the equality in the MJCF"
        )
    return qpos


def stated_start(scene: Scene, recording: Recording, config: StartConfig = DEFAULT_START) -> np.ndarray:
    """[nq] where the motion starts, before the joints of closed loops are moved to close them."""
    return _coupled(scene, _stated(scene, recording, config))


def _stated(scene: Scene, recording: Recording, config: StartConfig) -> dict[str, float]:
    """Joint -> where it starts, rad or m, of those of which the recording says it."""
    sent = {joint: path[0] for joint, path in sent_to(scene, recording).items()}
    return {**sent, **_measured(scene, recording, config.ajar), **recording.qpos0}


def _coupled(scene: Scene, stated: Mapping[str, float]) -> np.ndarray:
    """[nq] the scene's pose with these joints in it, and those that equalities couple to them where these have them.

    q1 - q1_0 = polynomial of q2 - q2_0 (MuJoCo's <equality><joint>); from q1 to q2 where the polynomial is a line.
    """
    model, known = scene.model, {scene.qpos(joint): q for joint, q in stated.items()}
    qpos = scene.initial_qpos(stated)
    couplings = _couplings(model)
    for _ in couplings:  # in a chain each needs the one before
        for first, second, c in couplings:
            if second in known and first not in known:
                known[first] = model.qpos0[first] + float(np.polyval(c[::-1], known[second] - model.qpos0[second]))
            elif first in known and second not in known and c[1] != 0 and not c[2:].any():
                known[second] = model.qpos0[second] + (known[first] - model.qpos0[first] - c[0]) / c[1]
    for address, q in known.items():
        qpos[address] = q
    return qpos


def following(scene: Scene, qpos: np.ndarray) -> set[int]:
    """Position addresses of joints that stand, in a pose [nq], where an equality has them; of measured ones none."""
    model = scene.model
    own = {scene.qpos(j) for j in (*scene.joints, *([scene.object_joint] if scene.object_joint else []))}
    found = set[int]()
    for first, second, c in _couplings(model):
        there = np.polyval(c[::-1], qpos[second] - model.qpos0[second])
        if np.isclose(qpos[first] - model.qpos0[first], there, atol=1e-9):
            found |= {first if first not in own else second} - own
    return found | (moved_by_loops(scene, qpos) - own)


def _couplings(model: mujoco.MjModel) -> list[tuple[int, int, np.ndarray]]:
    """Of each active equality that couples one joint to another: both position addresses, and its polynomial [5]."""
    rows = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0 & (model.eq_obj2id >= 0))
    ends = (model.jnt_qposadr[of[rows]].tolist() for of in (model.eq_obj1id, model.eq_obj2id))
    return list(zip(*ends, model.eq_data[rows, :5], strict=True))


def check_weight(scene: Scene, recording: Recording, qpos0: np.ndarray) -> None:
    """Raise ValueError where a torque without the arm's weight is compared with joints that feel it.

    Judged by the C engine along the motion: a joint with an upright axis feels none.
    """
    if recording.torque.gravity or "torque" not in recording.channels:
        return
    joints = [j for j in recording.channels["torque"].columns if j in scene.joints and j != scene.object_joint]
    felt = _uncompensated(scene.model, _poses(scene, recording, qpos0))
    heavy = [j for j in joints if felt[scene.dof(j)] > WEIGHT]
    if heavy:
        most = max(heavy, key=lambda j: felt[scene.dof(j)])
        raise ValueError(
            f"recording {recording.name!r} says that its torque holds no weight, but in scene {scene.name!r} nothing "
            f"compensates that of {', '.join(heavy)} (up to {felt[scene.dof(most)]:.3g} N m at {most}): set "
            'gravcomp="1" on the bodies they carry, or state that the torque contains gravity'
        )


def holding(scene: Scene, qpos0: np.ndarray) -> np.ndarray:
    """[U] the controls at which the actuators hold the pose [nq] by themselves; 0 without position feedback.

    Of an actuator whose force is gain * control + b0 + b1 * length + b2 * velocity, as a position servo's is: that of
    no force at rest, within its range.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = qpos0
    mujoco.mj_fwdPosition(model, data)
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm
    held = has_feedback(model) & (gain != 0)
    control = np.where(held, -(bias[:, 0] + bias[:, 1] * data.actuator_length) / np.where(held, gain, 1.0), 0.0)
    low, high = model.actuator_ctrlrange.T
    return np.where(model.actuator_ctrllimited, np.clip(control, low, high), control)


def weight_share(model: Any, joints: np.ndarray, gravity: bool) -> np.ndarray:
    """[J] 1, 0 or -1: how often the compensated weight (qfrc_gravcomp) is missing in the actuators' torque.

    model: of the C engine or MJX; joints: [J] velocity addresses; gravity: the torque shall contain the weight.
    Where the motors themselves compensate it (actuatorgravcomp), their torque contains it already.
    """
    contained = model.jnt_actgravcomp[model.dof_jntid[joints]].astype(float)
    return (1.0 if gravity else 0.0) - contained


def _uncompensated(model: mujoco.MjModel, poses: np.ndarray) -> np.ndarray:
    """[nv] the largest torque over poses [K, nq] that gravity leaves to the actuators, N m or N."""
    data, most = mujoco.MjData(model), np.zeros(model.nv)
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        most = np.maximum(most, np.abs(data.qfrc_bias - data.qfrc_gravcomp))
    return most


def _poses(scene: Scene, recording: Recording, qpos0: np.ndarray) -> np.ndarray:
    """[POSES, nq] along the motion, as commanded; joints without position servos stay at the start."""
    poses = np.tile(qpos0, (POSES, 1))
    rows = np.linspace(0, len(recording.time) - 1, POSES).round().astype(int)
    for joint, path in sent_to(scene, recording).items():
        poses[:, scene.qpos(joint)] = path[rows]
    return poses


def sent_columns(scene: Scene, recording: Recording) -> dict[int, int]:
    """Actuator -> column of the recording's command that it gets, of those that get one."""
    columns = scene.command_index(recording.command_names)
    return {int(u): int(columns[u]) for u in np.flatnonzero(columns >= 0)}


def sent_to(scene: Scene, recording: Recording) -> dict[str, np.ndarray]:
    """Joint -> the positions [T] its servo is sent to, rad or m; what drives no position (a motor) is left out."""
    model = scene.model
    kp, position_gain, gear = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1], model.actuator_gear[:, 0]
    servos = np.flatnonzero((kp != 0) & (position_gain == -kp))
    columns = scene.command_index(recording.command_names)
    sent = [u for u in servos if scene.of_joint[u] and columns[u] >= 0]
    return {scene.command_names[u]: recording.command[:, columns[u]] / gear[u] for u in sent}


def _measured(scene: Scene, recording: Recording, ajar: float) -> dict[str, float]:
    """Joint -> measured position at the start, rad or m, of the scene's joints of one degree."""
    start = recording.measured_start()
    hinge, channel = scene.object_joint, recording.channels.get("object_angle")
    if hinge and hinge not in scene.joints and channel is not None:
        seen, own = start.pop(channel.columns[0], None), scene.model.qpos0[scene.qpos(hinge)]
        if seen is not None and abs(seen - own) > ajar:
            start[hinge] = seen
    return {joint: q for joint, q in start.items() if joint in scene.single_joints}
