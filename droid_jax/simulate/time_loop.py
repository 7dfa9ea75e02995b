"""A loop over time steps whose number is an input, and that is cheap to batch.

`jax.vmap` of a loop traces the loop's body, then batches it again and again until it knows which of its values differ
by row.  Here the batch goes inside the loop, whose state differs by row throughout: the step is traced twice, and
batched once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.custom_batching import custom_vmap


def time_loop(step: Callable[[Any, jax.Array, Any], Any], sample: Any, state: Any, steps: Any) -> Any:
    """The state after `steps` steps: state = step(sample, k, state) for k = 0, 1, ...

    Args:
        step: takes what the steps of a sample share, the step's number and the state before it.
        sample: a pytree; leaves that are no tracers stay constants of the program.
        state: a pytree of arrays, whose shapes and types a step keeps.
        steps: an integer, or a traced one, of which no program is special; the same for all rows of a batch.

    Raises:
        ValueError: rows of a batch take different numbers of steps.
    """
    leaves, tree = jax.tree.flatten(sample)
    traced = [isinstance(leaf, Tracer) for leaf in leaves]

    def whole(own: Any) -> Any:
        given = iter(own)
        return jax.tree.unflatten(tree, [next(given) if t else leaf for t, leaf in zip(traced, leaves, strict=True)])

    def looped(of_state: Callable[[jax.Array, Any], Any], state: Any, count: jax.Array) -> Any:
        return jax.lax.fori_loop(jnp.zeros((), jnp.int32), count, of_state, state)

    @custom_vmap
    def run(own: Any, state: Any, count: jax.Array) -> Any:
        return looped(lambda k, now: step(whole(own), k, now), state, count)

    @run.def_vmap
    def run_rows(rows: int, batched: Any, own: Any, state: Any, count: jax.Array) -> Any:
        of_own, of_state, of_count = batched
        if of_count:
            raise ValueError("all rows of a batch take the same number of steps")
        begun = jax.tree.map(lambda a, b: a if b else jnp.broadcast_to(a, (rows, *a.shape)), state, of_state)
        axes = jax.tree.map(lambda b: 0 if b else None, of_own)
        one = jax.vmap(lambda own, k, now: step(whole(own), k, now), in_axes=(axes, None, 0))
        return looped(lambda k, now: one(own, k, now), begun, count), jax.tree.map(lambda _: True, state)

    own = [leaf for t, leaf in zip(traced, leaves, strict=True) if t]
    return run(own, jax.tree.map(jnp.asarray, state), jnp.asarray(steps, jnp.int32))
