"""A policy in the simulation that it was trained in, or in another one: many episodes in one batch."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.wrappers.training import DomainRandomizationVmapWrapper, VmapWrapper

from droid_jax import runtime
from droid_jax.policy.control import Policy
from droid_jax.policy.door_env import DoorEnv
from droid_jax.policy.randomise import Randomise
from droid_jax.policy.trials import Trials


def simulated(policy: Policy, env: DoorEnv, randomise: Randomise | None, episodes: int, seed: int = 0) -> Trials:
    """Episodes of the deterministic policy, each in its own draw of the physics (without, all in the scene's own)."""
    start, physics = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(physics, episodes)
    many = (
        VmapWrapper(env) if randomise is None else DomainRandomizationVmapWrapper(env, lambda sys: randomise(sys, keys))
    )

    def step(carry, _):
        state, won, best, grips, count, steps = carry
        going = state.done == 0.0
        after = many.step(state, policy.act(state.obs, jnp))
        state = jax.tree.map(lambda new, old: jnp.where(_as(going, new), new, old), after, state)
        best = jnp.maximum(best, state.metrics["angle"])
        seen = going * after.metrics["success"], going * after.metrics["grip"]
        return (state, won + seen[0], best, grips + seen[1], count + going, steps + (going & (won == 0.0))), None

    @functools.partial(jax.jit, compiler_options=runtime.compiler_options())
    def run(keys):
        nothing = jnp.zeros(episodes)
        carry = (many.reset(keys), nothing, nothing, nothing, nothing, nothing)
        (state, won, best, grips, count, steps), _ = jax.lax.scan(step, carry, None, length=env.task.steps)
        return won, best, steps, grips / jnp.maximum(count, 1.0), state.metrics["blown_up"]

    won, angle, steps, grip, blown_up = (np.asarray(a) for a in run(jax.random.split(start, episodes)))
    stopped = np.where(blown_up > 0, "the simulation blew up", "")
    return Trials(won > 0, angle.astype(float), steps.astype(int), grip.astype(float), stopped)


def _as(going: jax.Array, like: jax.Array) -> jax.Array:
    return going.reshape(going.shape + (1,) * (like.ndim - 1))
