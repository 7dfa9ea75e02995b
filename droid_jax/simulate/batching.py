"""A function of one parameter vector, made into a compiled batch over all devices; a loop that is cheap to batch.

Rows are processed in blocks of one fixed size (on a CPU one of two), so that a program compiles once however many rows
a stage asks for.  A block is split over the devices with shard_map; only what is wrapped here is
sharded, search and statistics stay on one device.  In a run of several processes each does its share of the rows
(`distributed`).

`jax.vmap` of a loop over time steps traces the loop's body, then batches it again and again until it knows which of its
values differ by row.  In `time_loop` the batch goes inside the loop, whose state differs by row throughout: the step is
traced twice, and batched once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_batching import custom_vmap
from jax.sharding import PartitionSpec

from droid_jax import distributed, runtime

AXIS = "population"
CPU_BLOCK = 32  # rows; on a CPU blocks of 64 to 512 run 12 to 25 % faster, and every smaller stage would pay for them
MANY_BLOCK = 128  # rows, where batches always have many: 24 windows of an arm's log ran 1.4 to 1.8 times as fast
LARGE_BLOCK = 256  # rows, where a whole number of such blocks is asked for, as users choose populations: a fifth faster
GPU_BLOCK = 4096  # rows at most in one piece on an accelerator


def block_size(rows: int, many: bool = False) -> int:
    """Rows of a block: one of two sizes on a CPU, the next power of two up to GPU_BLOCK elsewhere.

    many: the program that takes the block always gets many rows.
    """
    power = 1 << max(5, (rows - 1).bit_length())
    smallest = (MANY_BLOCK if many else CPU_BLOCK) if jax.default_backend() == "cpu" else min(GPU_BLOCK, power)
    devices = runtime.devices_mesh().size
    return -(-smallest // devices) * devices


def blocks(values: Any) -> Iterator[tuple[np.ndarray, int]]:
    """Cut [P, D] into (block [B, D], rows that count); the last block repeats its last row.

    On a CPU blocks have LARGE_BLOCK rows where that fills them all: two programs then serve every number of rows.

    Raises ValueError for an array that is not [P, D] with P >= 1.
    """
    values = np.asarray(values)
    if values.ndim != 2 or len(values) == 0:
        raise ValueError(f"expected parameter vectors [P, D] with P >= 1, got shape {values.shape}")
    exact = jax.default_backend() == "cpu" and len(values) % LARGE_BLOCK == 0
    size = LARGE_BLOCK if exact and LARGE_BLOCK % runtime.devices_mesh().size == 0 else block_size(len(values))
    for start in range(0, len(values), size):
        block = values[start : start + size]
        # Repeating a row keeps the padding inside the valid range.
        yield np.concatenate([block, np.repeat(block[-1:], size - len(block), axis=0)]), len(block)


def over_block(function: Callable[..., Any], alike: bool = True) -> Callable[..., Any]:
    """Compile `function` ([D], *more -> pytree) for whole blocks: [B, D], *more -> the same with a leading [B].

    B must be a multiple of the number of devices (see `block_size`).  What comes after the values (pytrees of arrays)
    is no constant of the program: other arrays of the same shapes compile nothing again.  The result lives on the
    devices, sharded by rows.
    alike: whether what comes after the values is shared by all rows; else each row has its own, with a leading [B].
    """
    rows = PartitionSpec(AXIS)

    def block(values: jax.Array, more: tuple[Any, ...]) -> Any:
        return jax.vmap(function, in_axes=(0, *[None if alike else 0] * len(more)))(values, *more)

    # check_vma: mjx's own loops mix sharded and constant carries, which the check refuses.
    specs = rows, PartitionSpec() if alike else rows
    mapped = jax.shard_map(
        runtime.in_full(block), mesh=runtime.devices_mesh(), in_specs=specs, out_specs=rows, check_vma=False
    )
    compiled = jax.jit(mapped, compiler_options=runtime.compiler_options())
    return lambda values, *more: compiled(jnp.asarray(values, jnp.float32), more)


def over_population(function: Callable[[jax.Array], Any]) -> Callable[[Any], Any]:
    """Compile `function` ([D] -> pytree) for any number of rows: [P, D] -> the same on the host, [P, ...]."""
    compiled = over_block(function)
    return lambda values: in_blocks(compiled, values)


def in_blocks(function: Callable[[np.ndarray], Any], values: Any) -> Any:
    """`function` ([B, D] -> pytree with a leading [B]) of any number of rows [P, D], block by block: [P, ...], on the
    host of every process.
    """
    return distributed.over_processes(lambda rows: _in_blocks(function, rows), values)


def _in_blocks(function: Callable[[np.ndarray], Any], values: Any) -> Any:
    pieces = [jax.tree.map(lambda a, n=count: np.asarray(a)[:n], function(block)) for block, count in blocks(values)]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *pieces)


def time_loop(step: Callable[[Any, jax.Array, Any], Any], sample: Any, state: Any, steps: Any) -> Any:
    """The state after `steps` time steps, a number that is an input: state = step(sample, k, state) for k = 0, 1, ...

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
        if not any(jax.tree.leaves((of_own, of_state))):  # jax.jacfwd: the primal of rows that differ in tangents alone
            ended = looped(lambda k, now: step(whole(own), k, now), state, count)
            return ended, jax.tree.map(lambda _: False, state)
        begun = jax.tree.map(lambda a, b: a if b else jnp.broadcast_to(a, (rows, *a.shape)), state, of_state)
        axes = jax.tree.map(lambda b: 0 if b else None, of_own)
        one = jax.vmap(lambda own, k, now: step(whole(own), k, now), in_axes=(axes, None, 0))
        return looped(lambda k, now: one(own, k, now), begun, count), jax.tree.map(lambda _: True, state)

    own = [leaf for t, leaf in zip(traced, leaves, strict=True) if t]
    return run(own, jax.tree.map(jnp.asarray, state), jnp.asarray(steps, jnp.int32))
