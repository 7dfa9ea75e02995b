"""A scripted opening for tests: commands to the knob, grip and pull, and a policy that plays them."""

from __future__ import annotations

import numpy as np

from droid_jax.door.demonstration import PLANS, joint_path
from droid_jax.door.task import Task
from droid_jax.model.scene import Scene
from droid_jax.policy.control import Interface

REACH, GRIP = 0.8, 0.4  # s


def opening(scene: Scene, task: Task, seconds: float, angle: float, hold: float = 0.0) -> np.ndarray:
    """Commands [K, 9] that compensate the lag of the servo."""
    reach, grip, pull, rest = (round(s / task.control) for s in (REACH, GRIP, seconds, hold))
    angles = np.concatenate([np.zeros(reach + grip), np.linspace(0.0, angle, pull), np.full(rest, angle)])
    standoffs = np.concatenate([np.linspace(task.standoff, 0.0, reach), np.zeros(grip + pull + rest)])
    fingers = np.concatenate([np.full(reach, 0.04), np.zeros(grip + pull + rest)])
    path = joint_path(scene, PLANS["A"], angles, standoffs)
    lag = scene.model.dof_damping[scene.joint_dofs] / scene.model.actuator_gainprm[:7, 0]
    path = path + lag * np.gradient(path, task.control, axis=0)
    return np.column_stack([path, fingers, fingers])


def action(task: Task, position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[9] the action that asks for a command [9] at joint positions [7]."""
    return np.concatenate([(target[:7] - position) / task.reach, 2 * target[7:] / task.width - 1])


class Script:
    """A policy that plays commands, whatever it sees but the joints' positions; for one trial."""

    def __init__(self, task: Task, commands: np.ndarray, interface: Interface):
        self.task, self.commands, self.interface, self.at = task, commands, interface, 0

    def act(self, observation: np.ndarray) -> np.ndarray:
        target = self.commands[min(self.at, len(self.commands) - 1)]
        self.at += 1
        return action(self.task, observation[:7], target)
