"""What a policy's robot must know of the scene that the policy was trained in, as plain numbers."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from droid_jax.door.demonstration import PLANS, joint_path
from droid_jax.door.hand import Hand, hand_of, pads_at
from droid_jax.door.task import Task
from droid_jax.model.scene import Scene
from droid_jax.policy.control import Interface

PLAN = PLANS["A"]  # whose arm pose and hand roll a policy has
SPEED = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)  # rad/s, Panda: Franka's data sheet
ROOM = 0.12  # m that the hand may be away from where an opening by the book has it
WIDEST = 1.2  # rad, of that opening


def interface_of(scene: Scene, task: Task, start: np.ndarray) -> Interface:
    """Of the built-in scene.  start: [nq], `DoorEnv.start`.  The base frame is the scene's world."""
    model, hand, arm = scene.model, hand_of(scene), list(scene.joint_dofs)
    fingers = [scene.qpos(name) for name in scene.finger_joints]
    motors = [scene.command_names.index(name) for name in scene.joints]
    at_zero = np.zeros(model.nq)
    data, closed = _posed(model, at_zero), _posed(model, start)
    frames = [_pose(data.xpos[body], data.xmat[body]) for body in model.dof_bodyid[arm]]
    pinch = _pose(data.site_xpos[hand.pinch], data.site_xmat[hand.pinch])
    links = [np.eye(4), *frames, pinch]
    shut, slides = _pads(model, hand, at_zero), np.zeros((2, 3))
    for k, address in enumerate(fingers):
        moved = at_zero.copy()
        moved[address] = 0.01
        slides[k] = (_pads(model, hand, moved)[k] - shut[k]) / 0.01
    return Interface(
        period=task.control,
        reach=task.reach,
        width=task.width,
        ranges=model.jnt_range[model.dof_jntid[arm]].copy(),
        speed=np.array(SPEED),
        effort=model.jnt_actfrcrange[model.dof_jntid[arm], 1].copy(),
        stiffness=model.actuator_gainprm[motors, 0].copy(),
        damping=model.dof_damping[arm].copy(),
        workspace=_workspace(scene, hand, start),
        chain=np.array([np.linalg.inv(a) @ b for a, b in itertools.pairwise(links)]),
        pads=shut,
        slides=slides,
        start=start[[*scene.joint_qpos, *fingers]],
        knob=_pose(closed.site_xpos[hand.knob], closed.site_xmat[hand.knob]),
    )


def _workspace(scene: Scene, hand: Hand, start: np.ndarray) -> np.ndarray:
    """[2, 3] m, lowest and highest corner around the pinch point of an opening by the book, and its start."""
    path = joint_path(scene, PLAN, np.linspace(0.0, WIDEST, 25), np.zeros(25))
    points = []
    for arm in [start[scene.joint_qpos], *path]:
        qpos = start.copy()
        qpos[scene.joint_qpos] = arm
        points.append(_posed(scene.model, qpos).site_xpos[hand.pinch].copy())
    return np.array([np.min(points, axis=0) - ROOM, np.max(points, axis=0) + ROOM])


def _pads(model: mujoco.MjModel, hand: Hand, qpos: np.ndarray) -> np.ndarray:
    """[2, 3] m, the pads in the pinch point's frame."""
    data = _posed(model, qpos)
    return pads_at(hand, data, data.site_xpos[hand.pinch], data.site_xmat[hand.pinch].reshape(3, 3))


def _posed(model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def _pose(position: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix.reshape(3, 3), position
    return pose
