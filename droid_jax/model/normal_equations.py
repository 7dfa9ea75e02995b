"""Batches of small linear systems of the constraint solver, with an implementation for CPUs and one for GPUs.

    of_weights, solved = normal_equations(jacobian)
    change = solved(inertia + of_weights(curvature), pull)

On a CPU the products of a row's entries are computed once a step and packed.  A GPU computes each product faster than
it reads it.  Small matrices are factored by unrolled arithmetic.  On a GPU it is faster than batched library calls
(NVIDIA H200, door: `benchmarks/results/gpu.json`).  On a CPU it is as fast as LAPACK, and XLA can compile a time loop
without library calls into one kernel (`simulate.batching`).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

UNROLLED = 12  # most unknowns that are solved by unrolled arithmetic; the program's size grows with their cube


def normal_equations(
    jacobian: jax.Array,
) -> tuple[Callable[[jax.Array], jax.Array], Callable[[jax.Array, jax.Array], jax.Array]]:
    """Two functions: weights [rows] -> J^T diag(weights) J [n, n], and (A [n, n], b [n]) -> x [n] with A x = b.

    Args:
        jacobian: J [rows, n].

    A is symmetric and positive definite.
    """
    size = jacobian.shape[1]
    solved = solver(size)
    if jax.default_backend() == "cpu":
        products = jnp.concatenate([jacobian[:, i:] * jacobian[:, i : i + 1] for i in range(size)], axis=1)
        entry = _packed_index(size)
        return lambda weights: (weights @ products)[entry], solved

    def of_weights(weights: jax.Array) -> jax.Array:
        return jnp.sum((weights[:, None] * jacobian)[:, :, None] * jacobian[:, None, :], axis=0)

    return of_weights, solved


def solver(size: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """(A [n, n], b [n]) -> x [n] with A x = b, for positive definite A of this size."""
    return unrolled if size <= UNROLLED else by_cholesky


def by_cholesky(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """x with A x = b, by a Cholesky factorisation of the library."""
    factor = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
    half = jax.lax.linalg.triangular_solve(factor, right[:, None], left_side=True, lower=True)
    return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)[:, 0]


def unrolled(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """x with A x = b, by an unrolled Cholesky factorisation."""
    size = right.shape[0]
    factor: dict[tuple[int, int], jax.Array] = {}
    scale: list[jax.Array] = []  # 1 / diagonal of the factor
    half: list[jax.Array] = []
    for j in range(size):
        for i in range(j, size):
            remainder = matrix[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))
            if i == j:
                scale.append(jax.lax.rsqrt(remainder))
            factor[i, j] = remainder * scale[j]
        half.append((right[j] - sum(factor[j, k] * half[k] for k in range(j))) * scale[j])
    x: dict[int, jax.Array] = {}
    for i in reversed(range(size)):
        x[i] = (half[i] - sum(factor[k, i] * x[k] for k in range(i + 1, size))) * scale[i]
    return jnp.stack([x[i] for i in range(size)])


def _packed_index(size: int) -> np.ndarray:
    """[size, size] index of each entry of a symmetric matrix in its packed upper triangle."""
    entry = np.zeros((size, size), dtype=int)
    row, column = np.triu_indices(size)
    entry[row, column] = entry[column, row] = np.arange(len(row))
    return entry
