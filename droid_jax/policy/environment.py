"""What training and trials ask of an environment: brax's, with the scene, the task and the interface behind it."""

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
    """A brax environment whose `sys` is `Physics` and whose metrics have success, angle, grip and blown_up.

    task: a dataclass of numbers that a policy belongs to; `steps`: actions of an episode at most.
    effects: of an extended model.  start: [nq] where an episode starts.  interface: what a robot must know of it.
    """

    scene: Scene
    task: Any
    effects: tuple[Effect, ...]
    start: np.ndarray
    interface: Interface
    sys: Any
