"""The small linear systems of the constraint solver, many at a time, as the device likes them.

    of_weights, solved = normal_equations(jacobian)
    change = solved(inertia + of_weights(curvature), pull)

On a CPU the products of a row's entries are made once a step and packed, and LAPACK factors.  A GPU makes each product
again sooner than it reads it, and plain arithmetic, which is fused, is faster than the batched calls of its libraries
for matrices of eight rows (NVIDIA H200, door: `benchmarks/results/gpu.json`).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

UNROLLED = 12  # unknowns up to which a GPU solves without a library's call: a program grows with their third power


def normal_equations(
    jacobian: jax.Array,
) -> tuple[Callable[[jax.Array], jax.Array], Callable[[jax.Array, jax.Array], jax.Array]]:
    """Two functions: weights [rows] -> J^T diag(weights) J [n, n], and (A [n, n], b [n]) -> x [n] with A x = b.

    Args:
        jacobian: J [rows, n].

    A is symmetric and positive definite.
    """
    size = jacobian.shape[1]
    if jax.default_backend() == "cpu":
        products = jnp.concatenate([jacobian[:, i:] * jacobian[:, i : i + 1] for i in range(size)], axis=1)
        entry = _packed_index(size)
        return lambda weights: (weights @ products)[entry], by_cholesky

    def of_weights(weights: jax.Array) -> jax.Array:
        return jnp.sum((weights[:, None] * jacobian)[:, :, None] * jacobian[:, None, :], axis=0)

    return of_weights, unrolled if size <= UNROLLED else by_cholesky


def by_cholesky(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """x of A x = b, by the library's factorisation."""
    factor = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
    half = jax.lax.linalg.triangular_solve(factor, right[:, None], left_side=True, lower=True)
    return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)[:, 0]


def unrolled(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """The same, written out entry by entry."""
    size = right.shape[0]
    factor: dict[tuple[int, int], jax.Array] = {}
    scale: list[jax.Array] = []  # 1 / diagonal of the factor
    half: list[jax.Array] = []
    for j in range(size):
        for i in range(j, size):
            left = matrix[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))
            if i == j:
                scale.append(jax.lax.rsqrt(left))
            factor[i, j] = left * scale[j]
        half.append((right[j] - sum(factor[j, k] * half[k] for k in range(j))) * scale[j])
    found: dict[int, jax.Array] = {}
    for i in reversed(range(size)):
        found[i] = (half[i] - sum(factor[k, i] * found[k] for k in range(i + 1, size))) * scale[i]
    return jnp.stack([found[i] for i in range(size)])


def _packed_index(size: int) -> np.ndarray:
    """[size, size] place of each entry in a symmetric matrix's packed upper triangle."""
    entry = np.zeros((size, size), dtype=int)
    row, column = np.triu_indices(size)
    entry[row, column] = entry[column, row] = np.arange(len(row))
    return entry
