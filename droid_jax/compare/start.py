"""Where a recorded motion starts in the scene, whether its joints can make it, and whether the scene carries the weight
that its torque holds."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from droid_jax.measure.recording import Channel, Recording
from droid_jax.model.actuators import has_feedback
from droid_jax.model.scene import Scene

AJAR = 0.02  # rad or m: an object seen no further than this from the scene's pose stands there, as cameras are noisy
WEIGHT = 0.01  # N m or N: a joint that feels less uncompensated weight feels none (noise below it is never believed)
POSES = 50  # of a motion, at which the weight is looked at
BEGINNING = 0.02  # s (six rows at least), in which the speed at the start is looked at
MOVING = 0.25  # of the motion's largest speed: a joint that is faster at the start does not begin at rest
BEYOND = 0.05  # of its range, by which a joint may be outside of it unremarked
TURNS = 4  # from its zero, that a hinge without a range is believed to make; degrees look like that from 25 on


def start_pose(scene: Scene, recording: Recording) -> np.ndarray:
    """[nq] where the motion starts: as stated (qpos0), else as measured, else where its servos were sent first.

    Of joints that nobody commanded or measured one that an equality couples to another starts where that has it, all
    others stand as in the scene.
    Raises ValueError for a joint that has or needs a command and of which nothing says where it starts.
    """
    sent = {joint: path[0] for joint, path in _sent(scene, recording).items()}
    told = {**sent, **_measured(scene, recording), **recording.qpos0}
    asked = {*scene.needs_command, *recording.command_names}
    guessed = [j for j in scene.driven_joints if j in asked and j not in told]
    if guessed:
        raise ValueError(
            f"recording {recording.name!r} does not tell where {', '.join(guessed)} starts: state it in qpos0 "
            "or measure its position"
        )
    return _coupled(scene, told)


def _coupled(scene: Scene, told: Mapping[str, float]) -> np.ndarray:
    """[nq] the scene's pose with these joints in it, and those that equalities couple to them where these have them.

    q1 - q1_0 = polynomial of q2 - q2_0 (MuJoCo's <equality><joint>); from q1 to q2 where the polynomial is a line.
    """
    model, known = scene.model, {scene.qpos(joint): q for joint, q in told.items()}
    qpos = scene.initial_qpos(told)
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
    return found


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


def warn_if_moving(recording: Recording) -> None:
    """Warn where joints were measured to move already when a recording with commands begins: its replay is at rest.

    The speed at the start is that of a line through the mean of the repeats over so short a time that a servo that sets
    off from rest is not fast yet; it must be five times its own error.
    """
    channel = recording.channels.get("position")
    if channel is None:
        return
    moving = [j for i, j in enumerate(channel.columns) if _moves(recording.time[0], channel, i)]
    if moving:
        warnings.warn(
            f"recording {recording.name!r} begins while {', '.join(moving)} moves, and a replay begins at rest: let "
            "the recording begin where the robot stands still",
            stacklevel=2,
        )


def command_notes(scene: Scene, recording: Recording) -> list[str]:
    """What is to be known of the commands: a <motor> that takes radians for torques, geared servos, actuators that got
    none."""
    said = (open_loop(scene, recording), geared(scene, recording), left_alone(scene, recording))
    return [text for text in said if text]


def warn_of_commands(scene: Scene, recording: Recording) -> None:
    """Warn of what is to be known of the commands."""
    for text in command_notes(scene, recording):
        warnings.warn(text, stacklevel=2)


def open_loop(scene: Scene, recording: Recording) -> str:
    """What is to be known where the recording's commands drive actuators without position feedback; else empty."""
    open_ones = np.flatnonzero(~has_feedback(scene.model) & scene.of_joint)
    joints = [scene.command_names[u] for u in open_ones if scene.command_names[u] in recording.command_names]
    if not joints or not recording.command.size:
        return ""
    return (
        f"the actuators of {', '.join(joints)} have no position feedback: the commands of recording "
        f"{recording.name!r} are taken as their torques (or forces, or speeds); for position commands use "
        "<position> servos"
    )


def geared(scene: Scene, recording: Recording) -> str:
    """What is to be known where the recording's commands go to position servos with a gear; else empty."""
    gear = scene.model.actuator_gear[:, 0]
    servos = np.flatnonzero(has_feedback(scene.model) & scene.of_joint & (gear != 1.0))
    joints = [scene.command_names[u] for u in servos if scene.command_names[u] in recording.command_names]
    if not joints or not recording.command.size:
        return ""
    return (
        f"the servos of {', '.join(joints)} have a gear: the commands of recording {recording.name!r} are taken as "
        "MuJoCo's controls, which are the joint's position times the gear"
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


def left_alone(scene: Scene, recording: Recording) -> str:
    """What is to be known where the recording has commands, but none for some actuators; else empty."""
    if not recording.command.size:
        return ""
    left = [
        (n, f)
        for n, f in zip(scene.command_names, has_feedback(scene.model), strict=True)
        if n not in recording.command_names
    ]
    said = {
        "held where the motion starts": [n for n, feedback in left if feedback],
        "given 0 (no position feedback)": [n for n, feedback in left if not feedback],
    }
    told = "; ".join(f"{', '.join(names)} {what}" for what, names in said.items() if names)
    return f"recording {recording.name!r} has not all commands: {told}" if told else ""


def _moves(begin: float, channel: Channel, column: int) -> bool:
    """Whether a position's path has a speed of its own where the motion begins."""
    time, seen = channel.time - begin, channel.mask[..., column].all(axis=0)
    path = channel.values[..., column].mean(axis=0)
    rows = np.flatnonzero(seen & (time >= 0.0))
    first = rows[: max(6, int(np.sum(time[rows] <= BEGINNING)))]
    if len(first) < 6:  # a line through two points has no error to be judged by
        return False
    (speed, _), covariance = np.polyfit(time[first], path[first], 1, cov=True)
    steps = rows[:: len(first)]  # as far apart as the beginning is long
    fastest = np.abs(np.diff(path[steps]) / np.diff(time[steps])).max(initial=0.0)
    return bool(abs(speed) > max(MOVING * fastest, 5.0 * np.sqrt(covariance[0, 0])))


def check_range(scene: Scene, recording: Recording) -> None:
    """Raise ValueError where a measured joint goes, or is sent, so far outside its range that the unit is wrong.

    One that is outside by more than BEYOND of its range is warned of, and a hinge without a range, which may be a
    wheel, where it goes more than TURNS from its zero.
    """
    sent = _sent(scene, recording) if recording.command.size else {}
    paths = [("is sent to", joint, path) for joint, path in sent.items()]
    paths += [("starts at", joint, np.array([q])) for joint, q in recording.qpos0.items()]
    if channel := recording.channels.get("position"):
        seen = np.where(channel.mask, channel.values, np.nan).reshape(-1, len(channel.columns))
        paths += [("is measured at", joint, seen[:, i]) for i, joint in enumerate(channel.columns)]
    for what, joint, path in paths:
        if joint in scene.joints and not np.isnan(path).all():
            _check_reach(scene, joint, path, f"recording {recording.name!r}: {joint} {what}")


def _check_reach(scene: Scene, joint: str, path: np.ndarray, begin: str) -> None:
    """As `check_range`, of one joint's path [K], NaN where it was not seen; begin: of what is said."""
    index = scene.id("joint", joint)
    slide = scene.slides(joint)
    low, high = scene.model.jnt_range[index]
    if low < high:  # whether the replay holds it there or not
        beyond = np.maximum(low - path, path - high)
        worst = int(np.nanargmax(beyond))
        unit = "m: are these millimetres?" if slide else "rad: are these degrees?"
        if beyond[worst] > high - low:
            raise ValueError(f"{begin} {path[worst]:.4g}, far outside its range {low:.4g} .. {high:.4g} {unit}")
        if beyond[worst] > BEYOND * (high - low):
            warnings.warn(f"{begin} {path[worst]:.4g}, outside its range {low:.4g} .. {high:.4g} {unit}", stacklevel=3)
    elif not slide:
        turns = np.abs(path) / (2 * np.pi)
        worst = int(np.nanargmax(turns))
        if turns[worst] > TURNS:
            warnings.warn(f"{begin} {path[worst]:.4g} rad, {turns[worst]:.3g} turns: are these degrees?", stacklevel=3)


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
    for joint, path in _sent(scene, recording).items():
        poses[:, scene.qpos(joint)] = path[rows]
    return poses


def _sent(scene: Scene, recording: Recording) -> dict[str, np.ndarray]:
    """Joint -> the positions [T] its servo is sent to, rad or m; what drives no position (a motor) is left out."""
    model = scene.model
    kp, position_gain, gear = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1], model.actuator_gear[:, 0]
    servos = np.flatnonzero((kp != 0) & (position_gain == -kp))
    columns = scene.command_index(recording.command_names)
    sent = [u for u in servos if scene.of_joint[u] and columns[u] >= 0]
    return {scene.command_names[u]: recording.command[:, columns[u]] / gear[u] for u in sent}


def _measured(scene: Scene, recording: Recording) -> dict[str, float]:
    """Joint -> measured position at the start, rad or m, of the scene's joints of one degree."""
    start = recording.measured_start()
    hinge, channel = scene.object_joint, recording.channels.get("object_angle")
    if hinge and hinge not in scene.joints and channel is not None:
        seen, own = start.pop(channel.columns[0], None), scene.model.qpos0[scene.qpos(hinge)]
        if seen is not None and abs(seen - own) > AJAR:
            start[hinge] = seen
    return {joint: q for joint, q in start.items() if joint in scene.single_joints}
