"""Evaluate a policy in simulation: many episodes in one batch, split over the devices.

Training and `evaluate` share the compiled program where they have equally many rows.
"""

from __future__ import annotations

import droid_jax.model.quiet_mjx  # noqa: F401  brax would import mujoco.mjx with its two lines about warp

# isort: split
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.wrappers.training import DomainRandomizationVmapWrapper, VmapWrapper
from jax.sharding import PartitionSpec

from droid_jax import runtime
from droid_jax.policy.control import Policy, differing
from droid_jax.policy.environment import Environment
from droid_jax.policy.randomise import Randomise
from droid_jax.policy.trials import BLOWN_UP, Trials

jax.tree_util.register_dataclass(  # not where it is defined: control.py needs numpy alone
    Policy, data_fields=("mean", "std", "weights", "biases"), meta_fields=("interface",)
)

ROWS = 64  # of a device: numbers of episodes up to its multiples share a program
TRIALS = 2**31 - 1  # stream of a seed; a training with the same seed selects its policy on the first streams


def simulated(policy: Policy, env: Environment, randomise: Randomise | None, episodes: int, seed: int = 0) -> Trials:
    """Simulate episodes of the deterministic policy.

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
    start, physics = jax.random.split(jax.random.fold_in(jax.random.key(seed), TRIALS))
    return batch_of_episodes(env, randomise, episodes, physics)(policy, start).trials


class Played(NamedTuple):
    """Outcomes of episodes, and their mean sum of rewards."""

    trials: Trials
    reward: float


def batch_of_episodes(
    env: Environment, randomise: Randomise | None, episodes: int, physics: jax.Array
) -> Callable[[Policy, jax.Array], Played]:
    """A function that simulates episodes of a policy, always with the same draws of the physics.

    The policy and the physics that vary are inputs of the program, so that other policies and draws share it.

    Args:
        env: of the robot, door and task that policies are trained for.
        randomise: as in `simulated`.
        episodes: number of them.
        physics: key of the draws.

    Returns:
        (policy, key of the starts) -> the outcomes.
    """
    drawn, axes = (env.sys, None) if randomise is None else randomise(env.sys, jax.random.split(physics, episodes))
    devices = runtime.devices_mesh()
    episode = np.minimum(np.arange(_rows(episodes, devices.size)), episodes - 1)  # of each row; the last one fills up
    split = PartitionSpec(*devices.axis_names)
    varied = jax.tree.map(lambda leaf: leaf[episode], _varied(axes, drawn))

    def run(policy, varied, keys):
        sys: Any = _filled(axes, varied, drawn), axes
        many = VmapWrapper(env) if randomise is None else DomainRandomizationVmapWrapper(env, lambda _: sys)

        def step(carry, _):
            state, won, best, grips, rewards, count, steps = carry
            going = state.done == 0.0
            after = many.step(state, policy.act(state.obs, jnp))
            state = jax.tree.map(lambda new, old: jnp.where(_as(going, new), new, old), after, state)
            best = jnp.maximum(best, state.metrics["angle"])
            success, grip = going * after.metrics["success"], going * after.metrics["grip"]
            rewards = rewards + going * after.reward
            won, steps = won + success, steps + (going & (won == 0.0))
            return (state, won, best, grips + grip, rewards, count + going, steps), None

        carry = (many.reset(keys), *[jnp.zeros(len(keys))] * 6)
        (state, won, best, grips, rewards, count, steps), _ = jax.lax.scan(step, carry, None, length=env.task.steps)
        return won, best, steps, grips / jnp.maximum(count, 1.0), state.metrics["blown_up"], rewards

    # check_vma: mjx's own loops mix sharded and constant carries, which the check refuses.
    mapped = jax.shard_map(
        run, mesh=devices, in_specs=(PartitionSpec(), split, split), out_specs=split, check_vma=False
    )  # fmt: skip
    program = jax.jit(mapped, compiler_options=runtime.compiler_options())

    def played(policy: Policy, start: jax.Array) -> Played:
        found = program(policy, varied, jax.random.split(start, episodes)[episode])
        won, angle, steps, grip, blown_up, rewards = (np.asarray(a)[:episodes] for a in found)
        stopped = np.where(blown_up > 0, BLOWN_UP, "")
        trials = Trials(won > 0, angle.astype(float), steps.astype(int), grip.astype(float), stopped)
        return Played(trials, float(rewards.mean()))

    return played


def _rows(episodes: int, devices: int) -> int:
    """Rows of the program: as many for each device, and whole blocks of `ROWS` where they are many."""
    each = math.ceil(episodes / devices)
    return devices * (each if each <= ROWS // 2 else ROWS * math.ceil(each / ROWS))


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
