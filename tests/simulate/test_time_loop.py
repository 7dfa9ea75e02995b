"""A loop over time steps: alone, in a batch, and how often its step is traced."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from droid_jax.simulate.time_loop import time_loop


def summed(traced: list[int]) -> Any:
    """steps of x + rate * k from a start, which notes each time that its step is traced."""

    def step(sample: Any, k: jax.Array, state: jax.Array) -> jax.Array:
        traced.append(1)
        rate, fixed = sample
        return state + rate * k + fixed

    return lambda rate, start, steps: time_loop(step, (rate, 2.0), start, steps)


RATES = jnp.array([1.0, -0.5, 3.0])


def test_a_batch_is_its_rows_and_traces_a_step_twice():
    traced = list[int]()
    loop = summed(traced)
    batch = jax.jit(jax.vmap(lambda rate, steps: loop(rate, jnp.float32(0.5), steps), in_axes=(0, None)))(RATES, 5)
    assert len(traced) == 2  # for its shapes, and for the batch
    np.testing.assert_array_equal(batch, 0.5 + 10.0 * RATES + 2.0 * 5)  # 0 + 1 + 2 + 3 + 4 = 10
    alone = [jax.jit(loop)(rate, jnp.float32(0.5), 5) for rate in RATES]
    np.testing.assert_array_equal(batch, jnp.stack(alone))


def test_starts_of_their_own_and_no_steps():
    loop, starts = summed([]), jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(jax.vmap(lambda r, s: loop(r, s, 0))(RATES, starts), starts)
    np.testing.assert_array_equal(jax.vmap(lambda r, s: loop(r, s, 2))(RATES, starts), starts + RATES + 4.0)


def test_rows_with_different_numbers_of_steps_are_refused():
    loop = summed([])
    with pytest.raises(ValueError, match="the same number of steps"):
        jax.vmap(lambda rate, steps: loop(rate, jnp.float32(0.0), steps))(RATES, jnp.array([1, 2, 3]))
