"""The environment interface of training and trials: brax's, with the scene, the task and the robot interface."""

from __future__ import annotations

import droid_jax.model.quiet_mjx  # noqa: F401  brax would import mujoco.mjx with its two lines about warp

# isort: split
from typing import Any

import numpy as np
from brax.envs.base import Env

from droid_jax.model.effect_interface import Effect
from droid_jax.model.scene import Scene
from droid_jax.policy.control import Interface


class Environment(Env):
    """A brax environment whose `sys` is `Physics` and whose metrics are success, angle, grip and blown_up.

    Attributes:
        scene: of the environment.
        task: a dataclass of numbers; `steps` is the largest number of actions of an episode.
        effects: of an extended model.
        start: [nq] pose at the start of an episode.
        interface: of a robot that uses the policy.
        sys: the physics.
    """

    scene: Scene
    task: Any
    effects: tuple[Effect, ...]
    start: np.ndarray
    interface: Interface
    sys: Any
