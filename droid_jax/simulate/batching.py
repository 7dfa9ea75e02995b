"""Compile a function of one parameter vector for batches sharded over all devices; a time loop that is cheap to batch.

On a CPU rows are processed in blocks of one fixed size.  So a program compiles once for any number of rows.
`jax.shard_map` splits a block over the devices.  Only the functions that are wrapped here are sharded; search and
statistics run on one device.  In a run of several processes each process computes a part of the rows (`distributed`).

`jax.vmap` of a loop over time steps traces the loop's body and batches it repeatedly, until it knows which values
differ by row.  `time_loop` batches the step inside the loop and treats the whole state as different by row.  So the
step is traced twice and batched once.

On a CPU XLA runs a loop's operations one by one, each as a kernel of its own, and a time step has hundreds.  With few
rows, starting them takes half of the time.  XLA can also compile a whole loop into one kernel, which it does for loops
that touch a kilobyte at most.  `over_block` raises that bound for long motions: a block of 32 doors is then replayed
1.5 times as fast, and compiling takes 15 s longer.  Loops with library calls or a sort stay as they are.
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
CPU_BLOCK = 32  # rows, up to a multiple of the devices; with a kernel for each operation 256 run a fifth faster
MANY_BLOCK = 128  # rows, for batches that are always large: 24 windows of an arm's log ran 1.4 to 1.8 times as fast
GPU_BLOCK = 4096  # most rows of a block on an accelerator


def block_size(rows: int, many: bool = False) -> int:
    """Rows of a block: a fixed number on a CPU, the next power of two up to GPU_BLOCK on an accelerator.

    many: whether the batches of this program are always large (MANY_BLOCK in place of CPU_BLOCK).
    """
    power = 1 << max(5, (rows - 1).bit_length())
    smallest = (MANY_BLOCK if many else CPU_BLOCK) if jax.default_backend() == "cpu" else min(GPU_BLOCK, power)
    devices = runtime.devices_mesh().size
    return -(-smallest // devices) * devices


def blocks(values: Any) -> Iterator[tuple[np.ndarray, int]]:
    """Yield [P, D] in blocks: (block [B, D], number of rows that are not padding).

    The last block is padded with copies of its last row.

    Raises ValueError for an array that is not [P, D] with P >= 1.
    """
    values = np.asarray(values)
    if values.ndim != 2 or len(values) == 0:
        raise ValueError(f"expected parameter vectors [P, D] with P >= 1, got shape {values.shape}")
    size = block_size(len(values))
    for start in range(0, len(values), size):
        block = values[start : start + size]
        # Repeating a row keeps the padding inside the valid range.
        yield np.concatenate([block, np.repeat(block[-1:], size - len(block), axis=0)]), len(block)


def over_block(function: Callable[..., Any], shared: bool = True, long: bool = False) -> Callable[..., Any]:
    """Compile `function` ([D], *more -> pytree) for whole blocks: [B, D], *more -> the same with a leading [B].

    B must be a multiple of the number of devices (see `block_size`).  `more` are pytrees of arrays and inputs of the
    program: other arrays of the same shapes do not compile it again.  The result stays on the devices, sharded by rows.

    shared: whether all rows share `more`; if not, its arrays have a leading [B].
    long: whether on a CPU its loops are compiled into one kernel each, which takes longer to compile.
    """
    rows = PartitionSpec(AXIS)

    def block(values: jax.Array, more: tuple[Any, ...]) -> Any:
        return jax.vmap(function, in_axes=(0, *[None if shared else 0] * len(more)))(values, *more)

    # check_vma: mjx's own loops mix sharded and constant carries, which the check refuses.
    specs = rows, PartitionSpec() if shared else rows
    mapped = jax.shard_map(
        runtime.in_full(block), mesh=runtime.devices_mesh(), in_specs=specs, out_specs=rows, check_vma=False
    )
    compiled = jax.jit(mapped, compiler_options=runtime.compiler_options())

    def run(values: Any, *more: Any) -> Any:
        return compiled(jnp.asarray(values, jnp.float32), more)

    return runtime.with_loop_kernels(run) if long else run


def over_population(function: Callable[[jax.Array], Any], long: bool = False) -> Callable[[Any], Any]:
    """Compile `function` ([D] -> pytree) for any number of rows: [P, D] -> the same on the host, [P, ...].

    long: see `over_block`.
    """
    compiled = over_block(function, long=long)
    return lambda values: in_blocks(compiled, values)


def in_blocks(function: Callable[[np.ndarray], Any], values: Any) -> Any:
    """Apply `function` ([B, D] -> pytree with a leading [B]) to rows [P, D] block by block.

    Returns a pytree with a leading [P], on the host of every process.
    """
    return distributed.over_processes(lambda rows: _in_blocks(function, rows), values)


def _in_blocks(function: Callable[[np.ndarray], Any], values: Any) -> Any:
    pieces = [jax.tree.map(lambda a, n=count: np.asarray(a)[:n], function(block)) for block, count in blocks(values)]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *pieces)


def time_loop(step: Callable[[Any, jax.Array, Any], Any], sample: Any, state: Any, steps: Any) -> Any:
    """The state after `steps` time steps: state = step(sample, k, state) for k = 0, 1, ...

    Args:
        step: takes the sample, the number of the step, and the state before it.
        sample: a pytree that all steps share.  Leaves that are not traced are constants of the program.
        state: the initial state, a pytree of arrays.  A step keeps their shapes and types.
        steps: an integer, which may be traced; the same for all rows of a batch.

    Returns:
        A pytree like `state`.

    Raises:
        ValueError: rows of a batch take different numbers of steps.
    """
    leaves, tree = jax.tree.flatten(sample)
    traced = [isinstance(leaf, Tracer) for leaf in leaves]

    def merged(inputs: Any) -> Any:
        remaining = iter(inputs)
        merged_leaves = [next(remaining) if t else leaf for t, leaf in zip(traced, leaves, strict=True)]
        return jax.tree.unflatten(tree, merged_leaves)

    def looped(of_state: Callable[[jax.Array, Any], Any], state: Any, count: jax.Array) -> Any:
        return jax.lax.fori_loop(jnp.zeros((), jnp.int32), count, of_state, state)

    @custom_vmap
    def run(inputs: Any, state: Any, count: jax.Array) -> Any:
        return looped(lambda k, now: step(merged(inputs), k, now), state, count)

    @run.def_vmap
    def run_rows(rows: int, batched: Any, inputs: Any, state: Any, count: jax.Array) -> Any:
        inputs_batched, state_batched, count_batched = batched
        if count_batched:
            raise ValueError("all rows of a batch take the same number of steps")
        if not any(jax.tree.leaves((inputs_batched, state_batched))):  # the primal in jax.jacfwd: only tangents differ
            last = looped(lambda k, now: step(merged(inputs), k, now), state, count)
            return last, jax.tree.map(lambda _: False, state)
        first = jax.tree.map(lambda a, b: a if b else jnp.broadcast_to(a, (rows, *a.shape)), state, state_batched)
        axes = jax.tree.map(lambda b: 0 if b else None, inputs_batched)
        one = jax.vmap(lambda inputs, k, now: step(merged(inputs), k, now), in_axes=(axes, None, 0))
        return looped(lambda k, now: one(inputs, k, now), first, count), jax.tree.map(lambda _: True, state)

    inputs = [leaf for t, leaf in zip(traced, leaves, strict=True) if t]
    return run(inputs, jax.tree.map(jnp.asarray, state), jnp.asarray(steps, jnp.int32))
