"""Episodes in the simulation: what is counted, until when, and that physics differ."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from droid_jax.identify.gaussian import prior
from droid_jax.model.door import door_space
from droid_jax.model.door_scene import door_scene
from droid_jax.policy.door_env import DoorEnv
from droid_jax.policy.randomise import randomised
from droid_jax.policy.simulated import simulated
from droid_jax.policy.task import Task


class Still:
    """A policy that keeps the arm where it is and the fingers open."""

    def act(self, observation: Any, numbers: Any) -> Any:
        return numbers.concatenate([numbers.zeros((len(observation), 7)), numbers.ones((len(observation), 2))], axis=1)


@pytest.mark.slow
def test_a_hand_that_stays_opens_nothing_and_steps_count_until_success():
    scene = door_scene(timestep=0.004, limits=True)
    env, randomise = DoorEnv(scene, Task(steps=10)), randomised(scene, prior(door_space(scene)))
    found = simulated(Still(), env, randomise, 3)  # type: ignore[arg-type]
    assert not found.success.any() and (found.steps == 10).all() and (found.grip == 0).all()
    assert (np.abs(found.angle) < 0.01).all() and (found.stopped == "").all()
    env.task = replace(env.task, opened=-1.0, force=0.0, held=0.06)  # any hand that faces the door succeeds
    at_once = simulated(Still(), env, None, 2)  # type: ignore[arg-type]
    assert at_once.success.all() and (at_once.steps == 3).all() and (at_once.grip == 1).all()
