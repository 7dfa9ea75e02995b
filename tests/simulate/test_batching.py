"""Batches over blocks and devices: any number of rows, in order, equal to single rows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from droid_jax import runtime
from droid_jax.simulate.batching import block_size, blocks, over_block, over_population


def function(v: jax.Array) -> dict[str, jax.Array]:
    return {"sum": jnp.sum(v), "outer": jnp.outer(v, v[:2]), "big": v[0] > 0.5, "chain": jnp.sin(jnp.cumsum(v))}


def one(v: np.ndarray) -> dict[str, np.ndarray]:
    return {"sum": v.sum(), "outer": np.outer(v, v[:2]), "big": v[0] > 0.5, "chain": np.sin(np.cumsum(v))}


@pytest.fixture(scope="module")
def batch():
    return over_population(function)


@pytest.mark.parametrize("rows", [1, 2, 31, 32, 33, 64, 97])
def test_any_number_of_rows_equals_row_by_row(batch, rows: int):
    values = np.random.default_rng(rows).normal(size=(rows, 5))
    got = batch(values)
    assert all(isinstance(a, np.ndarray) and len(a) == rows for a in got.values())
    for i, v in enumerate(values.astype(np.float32)):
        for name, expected in one(v).items():
            # the batch computes in float32
            np.testing.assert_allclose(got[name][i], expected, rtol=1e-5, atol=1e-6, err_msg=f"{name} of row {i}")


def test_a_row_does_not_depend_on_the_others(batch):
    values = np.random.default_rng(0).normal(size=(70, 5))
    order = np.random.default_rng(1).permutation(70)
    together, mixed = batch(values)["chain"], batch(values[order])["chain"]
    np.testing.assert_array_equal(mixed, together[order])
    np.testing.assert_array_equal(batch(values[40:41])["chain"], together[40:41])


def test_a_nan_row_does_not_affect_others(batch):
    values = np.ones((5, 5))
    values[3] = np.nan
    assert np.isnan(batch(values)["sum"]).tolist() == [False, False, False, True, False]


def test_blocks_cover_the_rows_once_and_repeat_the_last():
    values = np.arange(45 * 2, dtype=float).reshape(45, 2)
    pieces = list(blocks(values))
    size = block_size(45)
    assert size % runtime.devices_mesh().size == 0
    assert all(block.shape == (size, 2) for block, _ in pieces)
    np.testing.assert_array_equal(np.concatenate([b[:n] for b, n in pieces]), values)
    last, count = pieces[-1]
    assert (last[count:] == last[count - 1]).all()


def test_a_program_of_long_motions_gives_the_same():
    kernels = list[bool]()

    def motion(values):
        kernels.append(runtime._LOOP_KERNELS.get())
        return jax.lax.fori_loop(0, 50, lambda i, x: jnp.sin(x) * 2.0 + x, values)

    values = np.random.default_rng(0).normal(size=(45, 40))
    usual = over_population(motion)(values)
    assert not any(kernels)
    kernels.clear()
    long = over_population(motion, long=True)(values)
    assert kernels and all(kernels)
    np.testing.assert_allclose(long, usual, rtol=1e-4, atol=1e-6)


def test_programs_with_large_batches_have_larger_blocks_on_a_cpu():
    assert block_size(45) == block_size(4500) < block_size(45, many=True) == block_size(4500, many=True)
    assert block_size(45, many=True) % runtime.devices_mesh().size == 0


def test_the_tests_run_on_two_devices_and_a_block_uses_both():
    assert runtime.devices_mesh().size == 2
    out = over_block(lambda v: v.sum())(np.ones((32, 3)))
    assert {len(s.data) for s in out.addressable_shards} == {16}
    assert len({s.device for s in out.addressable_shards}) == 2


@pytest.mark.parametrize("shape", [(5,), (0, 5), (2, 3, 4), ()])
def test_other_shapes_are_refused(batch, shape: tuple[int, ...]):
    with pytest.raises(ValueError, match=r"\[P, D\] with P >= 1, got shape"):
        batch(np.zeros(shape))
