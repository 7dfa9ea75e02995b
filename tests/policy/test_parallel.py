"""Physics of environments side by side: each its own, on every device others, the same after a stop."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from droid_jax.policy.parallel import AXIS, Doors, wrapped

COUNT = 3


class Physics(NamedTuple):
    """One field that varies, one that does not."""

    stiffness: Any
    gravity: Any


class Spring(Env):
    """Observes its own physics."""

    sys: Any = Physics(jnp.zeros(()), jnp.full(2, 9.81))

    def reset(self, rng):
        return State(None, self._observe(), jnp.zeros(()), jnp.zeros(()), {})

    def step(self, state, action):
        return state.replace(obs=self._observe(), reward=action)  # pyright: ignore[reportAttributeAccessIssue]

    def _observe(self):
        return jnp.append(self.sys.gravity, self.sys.stiffness)

    observation_size = action_size = 3
    backend = "none"


def randomise(sys: Physics, rng) -> tuple[Physics, Any]:
    return Physics(jax.vmap(jax.random.uniform)(rng), sys.gravity), Physics(0, None)


def stiffnesses(doors: Doors, devices: int, act: bool) -> np.ndarray:
    """[devices, COUNT] what the environments of each device see at reset, or after a step."""

    def run(rng):
        state = doors.reset(rng)
        return (doors.step(state, jnp.zeros(COUNT)) if act else state).obs

    rng = jax.random.split(jax.random.PRNGKey(5), (devices, COUNT))
    seen = jax.pmap(run, axis_name=AXIS, devices=jax.local_devices()[:devices])(rng)
    np.testing.assert_allclose(seen[..., :2], 9.81)
    return np.asarray(seen[..., 2])


@pytest.mark.parametrize("act", [False, True])
def test_every_environment_of_every_device_has_its_own_physics(act: bool):
    assert jax.local_device_count() >= 2
    env = Spring()
    found = stiffnesses(Doors(env, randomise, COUNT, 2, jax.random.PRNGKey(1)), 2, act)
    assert len(np.unique(found)) == 2 * COUNT
    np.testing.assert_array_equal(stiffnesses(Doors(env, randomise, COUNT, 2, jax.random.PRNGKey(1)), 2, act), found)
    assert not np.intersect1d(stiffnesses(Doors(env, randomise, COUNT, 2, jax.random.PRNGKey(2)), 2, act), found).size
    assert env.sys is Spring.sys  # as it was


def test_outside_of_braxs_devices_there_is_one():
    doors = Doors(Spring(), randomise, COUNT, 2, jax.random.PRNGKey(1))
    alone = jax.jit(doors.reset)(jax.random.split(jax.random.PRNGKey(0), COUNT)).obs[:, 2]
    np.testing.assert_array_equal(alone, doors.physics.stiffness[:COUNT])


def test_what_is_tried_is_not_what_is_trained_on():
    """brax wraps the environment twice, and gives both the same keys where they are as many."""
    keys = jax.random.split(jax.random.PRNGKey(0), COUNT)
    wrap_env = wrapped(randomise, 2, 1)
    trained, tried = (wrap_env(Spring(), 10, 1, partial(randomise, rng=keys)).reset(keys).obs[:, 2] for _ in range(2))
    assert not np.intersect1d(trained, tried).size
    again = wrapped(randomise, 2, 1)(Spring(), 10, 1, partial(randomise, rng=keys)).reset(keys).obs[:, 2]
    np.testing.assert_array_equal(again, trained)


def test_brax_gets_one_environment_for_each_of_its_keys():
    keys = jax.random.split(jax.random.PRNGKey(0), COUNT)
    env = wrapped(randomise, 2, 1)(Spring(), 10, 1, partial(randomise, rng=keys))
    assert env.reset(keys).obs.shape == (COUNT, 3)
    alike = wrapped(None, 2, 1)(Spring(), 10, 1, None)
    np.testing.assert_array_equal(alike.reset(keys).obs[:, 2], np.zeros(COUNT))
