"""Paths of a hand: minimum-jerk time profiles, and inverse kinematics by damped least squares."""

from __future__ import annotations

import mujoco
import numpy as np

from droid_jax.model.scene import Scene


def minimum_jerk(fraction: np.ndarray) -> np.ndarray:
    """Minimum-jerk step from 0 to 1 over fractions 0 to 1 of the duration (Flash and Hogan 1985)."""
    s = np.clip(fraction, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def solve_pose(
    scene: Scene,
    q: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    *,
    body: str | None = None,
) -> np.ndarray:
    """Inverse kinematics by damped least squares.

    Args:
        scene: with the arm.
        q: [J] rad or m, initial joint positions.
        position: [3] m, target position of the frame.
        rotation: [3, 3] target rotation of the frame.
        body: whose frame is moved; None: the site `pinch`.

    Returns:
        [J] joint positions.

    Raises:
        ValueError: the iteration does not converge.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    frame = data.site("pinch") if body is None else data.body(body)
    carrier = int(model.site_bodyid[scene.id("site", "pinch")] if body is None else scene.id("body", body))
    jacobian = np.zeros((6, model.nv))
    q = np.array(q, dtype=float)
    error = np.zeros(6)
    for _ in range(100):
        data.qpos[scene.joint_qpos] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        current = frame.xmat.reshape(3, 3)
        error[:3] = position - frame.xpos
        error[3:] = 0.5 * np.sum(np.cross(current, rotation, axisa=0, axisb=0), axis=0)
        if np.linalg.norm(error) < 1e-7:
            return q
        mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], frame.xpos, carrier)
        arm = jacobian[:, scene.joint_dofs]
        q = q + arm.T @ np.linalg.solve(arm @ arm.T + 1e-8 * np.eye(6), error)
    raise ValueError(f"inverse kinematics ended {np.linalg.norm(error):.1e} away from the pose at {position} m")
