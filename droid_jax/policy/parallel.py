"""Batched environments with different physics in each environment and on each device, for brax's PPO.

brax gives all devices the same keys for its randomisation: on sixteen devices 256 environments would share 16 doors.
It also draws new physics for each part of an interrupted training, and begins all episodes at once.
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
from brax.envs.wrappers.training import AutoResetWrapper, EpisodeWrapper, VmapWrapper

from droid_jax.policy.randomise import Randomise

AXIS = "i"  # brax's name for its devices


def wrapped(randomise: Randomise | None, devices: int, seed: int) -> Callable[..., Env]:
    """The wrapper that brax's PPO applies to its environment, once for training and once for evaluations.

    We have evaluations of our own (`evaluate.batch_of_episodes`), which use all devices; brax's are never run.
    """
    uses = itertools.count()

    def wrap_env(env: Env, episode_length: int, action_repeat: int, randomization_fn: Any) -> Env:
        if next(uses):
            return Unused(env)
        if randomise is None:
            many: Env = VmapWrapper(env)
        else:
            count = len(randomization_fn.keywords["rng"])  # of environments on one device
            physics = jax.random.fold_in(jax.random.PRNGKey(seed), 0)  # evaluations draw from 1
            many = RandomisedEnvs(env, randomise, count, devices, physics)
        return AutoResetWrapper(Staggered(many, episode_length, action_repeat))

    return wrap_env


class Staggered(EpisodeWrapper):
    """Episodes whose first ones are of random lengths, so that a batch holds all phases of an episode.

    Environments that begin together stay in step: every batch would show the same few actions of all episodes.
    """

    def reset(self, rng: jax.Array) -> State:
        """Reset the environments, [N] keys, in random phases of their episodes."""
        state = super().reset(rng)
        steps = state.info["steps"]
        phase = jax.random.randint(jax.random.fold_in(rng[0], 1), steps.shape, 0, self.episode_length)
        return state.replace(info={**state.info, "steps": phase.astype(steps.dtype)})  # type: ignore[attr-defined]


class RandomisedEnvs(Wrapper):
    """`count` environments on each device, whose physics are drawn once for all devices from one key."""

    def __init__(self, env: Env, randomise: Randomise, count: int, devices: int, key: jax.Array) -> None:
        super().__init__(env)
        self.count = count
        sys: Any = env.sys  # type: ignore[attr-defined]
        self.physics, self.axes = randomise(sys, jax.random.split(key, count * devices))

    def reset(self, rng: jax.Array) -> State:
        """Reset `count` environments; rng: [count] keys."""
        return self._each(lambda env, key: env.reset(key), rng)

    def step(self, state: State, action: jax.Array) -> State:
        """Step `count` environments."""
        return self._each(lambda env, s, a: env.step(s, a), state, action)

    def _each(self, act: Callable[..., State], *arguments: Any) -> State:
        def one(sys: Any, *values: Any) -> State:
            with self._with_physics(sys) as env:
                return act(env, *values)

        return jax.vmap(one, in_axes=(self.axes, *(0 for _ in arguments)))(self._physics_here(), *arguments)

    def _physics_here(self) -> Any:
        """The physics of this device's environments."""
        first = device_index() * self.count

        def rows(axis: int | None, leaf: Any) -> Any:
            return leaf if axis is None else jax.lax.dynamic_slice_in_dim(leaf, first, self.count)

        return jax.tree.map(rows, self.axes, self.physics, is_leaf=lambda axis: axis is None)

    @contextlib.contextmanager
    def _with_physics(self, sys: Any) -> Iterator[Any]:
        env: Any = self.env.unwrapped
        before, env.sys = env.sys, sys
        try:
            yield env
        finally:
            env.sys = before


class Unused(Wrapper):
    """The environment of brax's evaluations, whose reset brax compiles although it runs none of them."""

    def reset(self, rng: jax.Array) -> State:
        """A state without content; rng: a key for each environment."""
        nothing = jnp.zeros(len(rng))
        return State(None, nothing, nothing, nothing)


def device_index() -> jax.Array:
    """Index of the device on which brax runs this; 0 outside its map over devices."""
    try:
        return jax.lax.axis_index(AXIS)
    except NameError:  # no mapped axis
        return jnp.zeros((), jnp.int32)
