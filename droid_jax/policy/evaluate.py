"""Evaluate a policy in simulation: many episodes in one batch."""

from __future__ import annotations

import droid_jax.model.quiet_mjx  # noqa: F401  brax would import mujoco.mjx with its two lines about warp

# isort: split
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.wrappers.training import DomainRandomizationVmapWrapper, VmapWrapper

from droid_jax import runtime
from droid_jax.policy.control import Policy, differing
from droid_jax.policy.environment import Environment
from droid_jax.policy.randomise import Randomise
from droid_jax.policy.trials import BLOWN_UP, Trials

jax.tree_util.register_dataclass(  # not where it is defined: control.py needs numpy alone
    Policy, data_fields=("mean", "std", "weights", "biases"), meta_fields=("interface",)
)


def simulated(policy: Policy, env: Environment, randomise: Randomise | None, episodes: int, seed: int = 0) -> Trials:
    """Simulate episodes of the deterministic policy.

    The policy and the physics that vary are inputs of the program, so that other policies and draws share it.

    Args:
        policy: to be evaluated.
        env: of the same robot, door and task.
        randomise: draws the physics of each episode; None: all episodes have the environment's physics.
        episodes: number of them.
        seed: of starts and draws.

    Returns:
        The outcomes.

    Raises:
        ValueError: the policy was trained for another robot, door or task.
    """
    if other := differing(policy.interface, env.interface):
        raise ValueError(f"the policy was trained for another robot, door or task: {', '.join(other)} differ")
    start, physics = jax.random.split(jax.random.key(seed))
    drawn, axes = (env.sys, None) if randomise is None else randomise(env.sys, jax.random.split(physics, episodes))

    @functools.partial(jax.jit, compiler_options=runtime.compiler_options())
    def run(policy, varied, keys):
        sys: Any = _filled(axes, varied, drawn), axes
        many = VmapWrapper(env) if randomise is None else DomainRandomizationVmapWrapper(env, lambda _: sys)

        def step(carry, _):
            state, won, best, grips, count, steps = carry
            going = state.done == 0.0
            after = many.step(state, policy.act(state.obs, jnp))
            state = jax.tree.map(lambda new, old: jnp.where(_as(going, new), new, old), after, state)
            best = jnp.maximum(best, state.metrics["angle"])
            success, grip = going * after.metrics["success"], going * after.metrics["grip"]
            return (state, won + success, best, grips + grip, count + going, steps + (going & (won == 0.0))), None

        nothing = jnp.zeros(episodes)
        carry = (many.reset(keys), nothing, nothing, nothing, nothing, nothing)
        (state, won, best, grips, count, steps), _ = jax.lax.scan(step, carry, None, length=env.task.steps)
        return won, best, steps, grips / jnp.maximum(count, 1.0), state.metrics["blown_up"]

    found = run(policy, _varied(axes, drawn), jax.random.split(start, episodes))
    won, angle, steps, grip, blown_up = (np.asarray(a) for a in found)
    stopped = np.where(blown_up > 0, BLOWN_UP, "")
    return Trials(won > 0, angle.astype(float), steps.astype(int), grip.astype(float), stopped)


def _varied(axes: Any, drawn: Any) -> Any:
    """The physics with None for leaves that all episodes share, which are constants of the program."""
    return jax.tree.map(lambda axis, leaf: None if axis is None else leaf, axes, drawn, is_leaf=_shared)


def _filled(axes: Any, varied: Any, drawn: Any) -> Any:
    """The inverse of `_varied`."""
    return jax.tree.map(lambda a, each, leaf: leaf if a is None else each, axes, varied, drawn, is_leaf=_shared)


def _shared(axis: int | None) -> bool:
    return axis is None


def _as(going: jax.Array, like: jax.Array) -> jax.Array:
    return going.reshape(going.shape + (1,) * (like.ndim - 1))
