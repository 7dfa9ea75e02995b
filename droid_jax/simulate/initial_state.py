"""The initial pose of a recorded motion in the scene, and the check of the gravity convention of its torques."""

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
from droid_jax.simulate.closed_loops import OPEN, close_loops, moved_by_loops, open_loops

WEIGHT = 0.01  # N m or N, uncompensated weight below this counts as none (the smallest noise that `cost` assumes)
POSES = 50  # of a motion, at which the weight is computed


@dataclass(frozen=True)
class StartConfig:
    """Thresholds of where a motion starts, and of whether its repeats start at the same place.

    Attributes:
        ajar: rad or m; an object that is measured within this distance of the scene's pose starts in the scene's pose,
            since cameras are noisy.
        scatter: rad or m; repeats whose measured starts differ by less start at the same place.
        noise: standard deviations of a position's noise by which starts must differ, too.
        early: s at the beginning of a repeat, from which that noise is estimated.
        alike: rad or m; measured starts that differ by less share one replay.
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
    """[nq] the initial pose: stated (qpos0), else measured, else the first command of a position servo.

    Other joints start as in the scene, except those that an equality couples to a known joint, and those that close a
    kinematic loop.

    Args:
        scene: the simulated one.
        recording: with the start.
        config: thresholds.

    Returns:
        [nq] rad and m.

    Raises:
        ValueError: the start of a commanded joint is unknown, qpos0 names a joint that the scene does not have, or no
            free joint can close a loop.
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
            f"recording {recording.name!r} does not say where {', '.join(guessed)} starts: state it in qpos0 "
            "or measure its position"
        )
    qpos = close_loops(scene, _coupled(scene, stated), [scene.qpos(joint) for joint in stated])
    if wide := [loop for loop in open_loops(scene, qpos) if loop.turn > OPEN]:
        raise ValueError(
            f"recording {recording.name!r} starts where {wide[0].name} of scene {scene.name!r} is open by "
            f"{wide[0].gap:.3g} (m or rad), and no joint that nobody commands, measures or states can close it: state "
            "a start that closes it (qpos0), or correct the lengths or the equality in the MJCF"
        )
    return qpos


def stated_start(scene: Scene, recording: Recording) -> np.ndarray:
    """[nq] the initial pose before `start_pose` closes kinematic loops, with the default thresholds."""
    return _coupled(scene, _stated(scene, recording, DEFAULT_START))


def _stated(scene: Scene, recording: Recording, config: StartConfig) -> dict[str, float]:
    """Joint -> initial position, rad or m, of the joints whose start the recording contains."""
    sent = {joint: path[0] for joint, path in commanded_positions(scene, recording).items()}
    return {**sent, **_measured(scene, recording, config.ajar), **recording.qpos0}


def _coupled(scene: Scene, stated: Mapping[str, float]) -> np.ndarray:
    """[nq] the scene's pose with the stated joints, and with the joints that <equality><joint> couples to them.

    q1 - q1_0 = polynomial of q2 - q2_0.  A linear polynomial is also solved for q2.
    """
    model, known = scene.model, {scene.qpos(joint): q for joint, q in stated.items()}
    qpos = scene.initial_qpos(stated)
    couplings = _couplings(model)
    for _ in couplings:  # repeated, since a coupling in a chain needs the one before it
        for first, second, c in couplings:
            if second in known and first not in known:
                known[first] = model.qpos0[first] + float(np.polyval(c[::-1], known[second] - model.qpos0[second]))
            elif first in known and second not in known and c[1] != 0 and not c[2:].any():
                known[second] = model.qpos0[second] + (known[first] - model.qpos0[first] - c[0]) / c[1]
    for address, q in known.items():
        qpos[address] = q
    return qpos


def coupled_addresses(scene: Scene, qpos: np.ndarray) -> set[int]:
    """Position addresses of unmeasured joints whose position in a pose [nq] an equality determines."""
    model = scene.model
    measured = {scene.qpos(j) for j in (*scene.joints, *([scene.object_joint] if scene.object_joint else []))}
    addresses = set[int]()
    for first, second, c in _couplings(model):
        coupled = np.polyval(c[::-1], qpos[second] - model.qpos0[second])
        if np.isclose(qpos[first] - model.qpos0[first], coupled, atol=1e-9):
            addresses |= {first if first not in measured else second} - measured
    return addresses | (moved_by_loops(scene, qpos) - measured)


def _couplings(model: mujoco.MjModel) -> list[tuple[int, int, np.ndarray]]:
    """Of each active equality between two joints: both position addresses, and its polynomial [5]."""
    rows = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0 & (model.eq_obj2id >= 0))
    ends = (model.jnt_qposadr[of[rows]].tolist() for of in (model.eq_obj1id, model.eq_obj2id))
    return list(zip(*ends, model.eq_data[rows, :5], strict=True))


def check_weight(scene: Scene, recording: Recording, qpos0: np.ndarray) -> None:
    """Raise ValueError if the recorded torques exclude gravity but the scene does not compensate it.

    The C engine computes the uncompensated weight at the joints along the motion.  A vertical joint axis carries none.
    """
    if recording.torque.gravity or "torque" not in recording.channels:
        return
    joints = [j for j in recording.channels["torque"].columns if j in scene.joints and j != scene.object_joint]
    weight = _uncompensated(scene.model, _poses(scene, recording, qpos0))
    heavy = [j for j in joints if weight[scene.dof(j)] > WEIGHT]
    if heavy:
        most = max(heavy, key=lambda j: weight[scene.dof(j)])
        raise ValueError(
            f"recording {recording.name!r} says that its torque excludes gravity, but scene {scene.name!r} does not "
            f"compensate the weight at {', '.join(heavy)} (up to {weight[scene.dof(most)]:.3g} N m at {most}): set "
            'gravcomp="1" on the bodies they carry, or state that the torque contains gravity'
        )


def holding_controls(scene: Scene, qpos0: np.ndarray) -> np.ndarray:
    """[U] the controls at which actuators with position feedback exert no force at rest in a pose [nq]; else 0.

    Such an actuator's force is gain * control + b0 + b1 * length + b2 * velocity, as that of a position servo.  The
    control is clipped to its range.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = qpos0
    mujoco.mj_fwdPosition(model, data)
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm
    holds = has_feedback(model) & (gain != 0)
    control = np.where(holds, -(bias[:, 0] + bias[:, 1] * data.actuator_length) / np.where(holds, gain, 1.0), 0.0)
    low, high = model.actuator_ctrlrange.T
    return np.where(model.actuator_ctrllimited, np.clip(control, low, high), control)


def weight_share(model: Any, joints: np.ndarray, gravity: bool) -> np.ndarray:
    """[J] the factor (1, 0 or -1) of qfrc_gravcomp that converts actuator torques to the recording's convention.

    Actuators that compensate gravity themselves (actuatorgravcomp) have it in their torques already.

    Args:
        model: of the C engine or MJX.
        joints: [J] velocity addresses.
        gravity: whether the recorded torque contains gravity.
    """
    contained = model.jnt_actgravcomp[model.dof_jntid[joints]].astype(float)
    return (1.0 if gravity else 0.0) - contained


def _uncompensated(model: mujoco.MjModel, poses: np.ndarray) -> np.ndarray:
    """[nv] the largest uncompensated gravity torque over poses [K, nq], N m or N."""
    data, most = mujoco.MjData(model), np.zeros(model.nv)
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        most = np.maximum(most, np.abs(data.qfrc_bias - data.qfrc_gravcomp))
    return most


def _poses(scene: Scene, recording: Recording, qpos0: np.ndarray) -> np.ndarray:
    """[POSES, nq] poses along the commanded motion; joints without position servos stay at the start."""
    poses = np.tile(qpos0, (POSES, 1))
    rows = np.linspace(0, len(recording.time) - 1, POSES).round().astype(int)
    for joint, path in commanded_positions(scene, recording).items():
        poses[:, scene.qpos(joint)] = path[rows]
    return poses


def command_columns(scene: Scene, recording: Recording) -> dict[int, int]:
    """Index of each commanded actuator -> column of the recording's command."""
    columns = scene.command_index(recording.command_names)
    return {int(u): int(columns[u]) for u in np.flatnonzero(columns >= 0)}


def commanded_positions(scene: Scene, recording: Recording) -> dict[str, np.ndarray]:
    """Joint -> commanded positions [T] of its position servo, rad or m; motors are left out."""
    model = scene.model
    kp, position_gain, gear = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1], model.actuator_gear[:, 0]
    servos = np.flatnonzero((kp != 0) & (position_gain == -kp))
    columns = scene.command_index(recording.command_names)
    sent = [u for u in servos if scene.of_joint[u] and columns[u] >= 0]
    return {scene.command_names[u]: recording.command[:, columns[u]] / gear[u] for u in sent}


def _measured(scene: Scene, recording: Recording, ajar: float) -> dict[str, float]:
    """Joint -> measured initial position, rad or m, of the scene's hinges and slides."""
    start = recording.measured_start()
    hinge, channel = scene.object_joint, recording.channels.get("object_angle")
    if hinge and hinge not in scene.joints and channel is not None:
        measured, reference = start.pop(channel.columns[0], None), scene.model.qpos0[scene.qpos(hinge)]
        if measured is not None and abs(measured - reference) > ajar:
            start[hinge] = measured
    return {joint: q for joint, q in start.items() if joint in scene.single_joints}
