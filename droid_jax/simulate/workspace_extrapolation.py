"""Extrapolate a demonstration in the workspace: the hand moves the object a third further around its joint."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import scipy

from droid_jax.model.effect_interface import Rollout
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.time_scaling import TimeScaling, time_scaled
from droid_jax.simulate.hand_path import minimum_jerk, solve_pose

FURTHER = "the same motion, opened a third further"
SHARE = 1 / 3  # additional motion of the object, as a share of its motion
MARGIN = 0.05  # rad or m, least distance of a joint from the ends of its range
KNOTS = 20  # poses of the hand in the additional motion


def opened_further(scene: Scene, recording: Recording, replayed: Rollout) -> Recording | None:
    """The recording with an additional motion: where the object was open most, the hand opens it further and returns.

    Inverse kinematics keeps the hand's pose relative to the object.  The servo's error is unchanged.  The speed is that
    of the middle of the opening.

    Args:
        scene: with the object.
        recording: with commands.
        replayed: its replay with one model, [T, ...] from time 0.

    Returns:
        The longer recording; None if no hand holds the object at its largest opening, or the motion is out of reach.
    """
    if scene.object_joint is None or (hand := _hand(scene)) is None:
        return None
    angle = replayed.object_angle - replayed.object_angle[0]
    last = int(np.argmax(np.abs(angle)))
    if not np.all(replayed.contact[last]):
        return None
    extra = SHARE * angle[last]
    path = _path(scene, hand, replayed.position[last], replayed.object_angle[last] + np.linspace(0.0, extra, KNOTS))
    if path is None:
        return None
    at, seconds = float(replayed.time[last]), _seconds(replayed.time[: last + 1], angle[: last + 1])
    stretched = TimeScaling(
        FURTHER,
        lambda d: d + 2 * seconds,
        lambda t, d: np.where(t < at, t, np.maximum(at, t - 2 * seconds)),
    )
    longer = time_scaled(recording, stretched)
    since = longer.time - longer.time[0] - at
    share = minimum_jerk(np.minimum(since, 2 * seconds - since) / seconds)
    step = scipy.interpolate.CubicSpline(np.linspace(0.0, 1.0, KNOTS), path - path[0])(share)  # [T, J]
    command = longer.command.copy()
    columns = [recording.command_names.index(j) for j in scene.joints]
    command[:, columns] += step
    gains = recording.gains
    if gains is not None and gains.damping is not None:  # the lag of a servo without a velocity reference
        lag = (gains.damping / gains.stiffness)[columns]
        command[:, columns] += lag * np.gradient(step, longer.time, axis=0)
    return replace(longer, command=command)


def _hand(scene: Scene) -> str | None:
    """The body of the last measured joint before the fingers that hold the object; None if nothing holds it."""
    model, of_joints = scene.model, {int(scene.model.jnt_bodyid[scene.id("joint", j)]) for j in scene.joints}
    for pair in np.concatenate([*scene.finger_pairs, np.zeros(0, int)]):
        for geom in (model.pair_geom1[pair], model.pair_geom2[pair]):
            body = int(model.geom_bodyid[geom])
            while body and body not in of_joints:
                body = int(model.body_parentid[body])
            if body:
                return model.body(body).name
    return None


def _path(scene: Scene, hand: str, q: np.ndarray, angles: np.ndarray) -> np.ndarray | None:
    """[K, J] joint positions from q [J] that keep the hand's pose relative to the object at angles [K] of its joint.

    None if a joint would come too close to an end of its range.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    joint = scene.id("joint", str(scene.object_joint))
    if _outside(model, np.array([joint]), angles[-1:]):
        return None
    moved = int(model.jnt_bodyid[joint])

    def object_pose(angle: float) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[scene.qpos(str(scene.object_joint))] = angle
        mujoco.mj_kinematics(model, data)
        return data.xpos[moved].copy(), data.xmat[moved].reshape(3, 3).copy()

    data.qpos[scene.joint_qpos] = q
    at, frame = object_pose(angles[0])
    body = scene.id("body", hand)
    place, turn = frame.T @ (data.xpos[body] - at), frame.T @ data.xmat[body].reshape(3, 3)
    path = [q]
    try:
        for angle in angles[1:]:
            at, frame = object_pose(angle)
            path.append(solve_pose(scene, path[-1], at + frame @ place, frame @ turn, body=hand))
    except ValueError:
        return None
    ids = np.array([scene.id("joint", j) for j in scene.joints])
    return None if _outside(model, ids, np.array(path)) else np.array(path)


def _outside(model: mujoco.MjModel, joints: np.ndarray, positions: np.ndarray) -> bool:
    """Whether positions [..., J] come within MARGIN of the ends of the joints' ranges."""
    low, high = model.jnt_range[joints].T
    beyond = (positions < low + MARGIN) | (positions > high - MARGIN)
    return bool(np.any(beyond & model.jnt_limited[joints].astype(bool)))


def _seconds(time: np.ndarray, angle: np.ndarray) -> float:
    """s, duration of the additional opening; its peak speed is the mean speed of the middle 80 % of the opening."""
    progress = np.abs(angle) / np.abs(angle[-1])
    begin, end = (time[int(np.argmax(progress >= share))] for share in (0.1, 0.9))
    peak = 1.875  # peak speed of minimum jerk over its mean speed
    return float(peak * SHARE * (end - begin) / 0.8)
