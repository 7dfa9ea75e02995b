"""Environments side by side, each with physics of its own, on every device with other ones.

brax gives every device the same keys to randomise with: on sixteen devices 256 environments would share 16 doors.
And it draws them anew for every part of a training that was interrupted.
"""

from __future__ import annotations

import droid_jax.model.quiet_mjx  # noqa: F401  brax would import mujoco.mjx with its two lines about warp

# isort: split
import contextlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import AutoResetWrapper, EpisodeWrapper, wrap

from droid_jax.policy.randomise import Randomise

AXIS = "i"  # brax's name for its devices


def wrapped(randomise: Randomise | None, devices: int, seed: int) -> Callable[..., Env]:
    """What brax's PPO shall do with an environment before it trains in it, and again before it tries in it.

    Tried are other doors than those it trains on, lest the best of several policies is chosen for its own doors.
    """
    uses = itertools.count()

    def wrap_env(env: Env, episode_length: int, action_repeat: int, randomization_fn: Any) -> Env:
        if randomise is None:
            return wrap(env, episode_length, action_repeat)
        count = len(randomization_fn.keywords["rng"])  # of environments on one device
        use = next(uses)
        there = 1 if use else devices  # it tries on one, so that the best policy is chosen for the same doors anywhere
        doors = Doors(env, randomise, count, there, jax.random.fold_in(jax.random.PRNGKey(seed), use))
        return AutoResetWrapper(EpisodeWrapper(doors, episode_length, action_repeat))

    return wrap_env


class Doors(Wrapper):
    """`count` environments on each device; physics are drawn once, for all devices, from the key alone."""

    def __init__(self, env: Env, randomise: Randomise, count: int, devices: int, key: jax.Array) -> None:
        super().__init__(env)
        self.count = count
        sys: Any = env.sys  # type: ignore[attr-defined]
        self.physics, self.axes = randomise(sys, jax.random.split(key, count * devices))

    def reset(self, rng: jax.Array) -> State:
        """rng: [count] keys."""
        return self._each(lambda env, key: env.reset(key), rng)

    def step(self, state: State, action: jax.Array) -> State:
        """state, action: of `count` environments."""
        return self._each(lambda env, s, a: env.step(s, a), state, action)

    def _each(self, act: Callable[..., State], *arguments: Any) -> State:
        def one(sys: Any, *own: Any) -> State:
            with self._having(sys) as env:
                return act(env, *own)

        return jax.vmap(one, in_axes=(self.axes, *(0 for _ in arguments)))(self._own(), *arguments)

    def _own(self) -> Any:
        """The physics of this device's environments."""
        first = device_index() * self.count

        def rows(axis: int | None, leaf: Any) -> Any:
            return leaf if axis is None else jax.lax.dynamic_slice_in_dim(leaf, first, self.count)

        return jax.tree.map(rows, self.axes, self.physics, is_leaf=lambda axis: axis is None)

    @contextlib.contextmanager
    def _having(self, sys: Any) -> Iterator[Any]:
        env: Any = self.env.unwrapped
        before, env.sys = env.sys, sys
        try:
            yield env
        finally:
            env.sys = before


def device_index() -> jax.Array:
    """Number of the device that brax runs this on; 0 where it uses one alone, as in its evaluations."""
    try:
        return jax.lax.axis_index(AXIS)
    except NameError:  # no such axis here
        return jnp.zeros((), jnp.int32)
