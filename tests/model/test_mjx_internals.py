"""Closest points of capsule axes against a float64 search, and the switch that uses them in MJX."""

from __future__ import annotations

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from droid_jax.model.mjx_internals import (
    CONSTRAINT_LAW,
    SEGMENT_POINT,
    closest_segment_point,
    exact_segments,
    midpoint_constraints,
    private,
)


def replaced(function: tuple[str, str]):
    """The function that mjx calls."""
    return getattr(private(function[0]), function[1])


def mjx_point(a, b, p):
    """The function that mjx calls now."""
    return replaced(SEGMENT_POINT)(a, b, p)


def brute_point(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The best of many points, refined around it; no formula is shared with the tested code."""
    low, high = 0.0, 1.0
    for _ in range(8):
        t = np.linspace(low, high, 41)
        best = t[np.argmin(np.linalg.norm(a + t[:, None] * (b - a) - p, axis=1))]
        width = (high - low) / 20
        low, high = max(0.0, best - width), min(1.0, best + width)
    return a + best * (b - a)


def brute_distance(a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray) -> float:
    """Smallest distance between two segments: alternating projections, from several starts (convex)."""
    best = np.inf
    for start in (a0, a1, (a0 + a1) / 2):
        on_a = start
        for _ in range(200):
            on_b = b0 + np.clip((on_a - b0) @ (b1 - b0) / ((b1 - b0) @ (b1 - b0)), 0, 1) * (b1 - b0)
            on_a = a0 + np.clip((on_b - a0) @ (a1 - a0) / ((a1 - a0) @ (a1 - a0)), 0, 1) * (a1 - a0)
        best = min(best, float(np.linalg.norm(on_a - on_b)))
    return best


def rails_and_knobs(count: int) -> np.ndarray:
    """[count, 4, 3] m: rails of 18 mm, knobs of 50 mm, in a grasp (float32 numbers, as float64)."""
    rng = np.random.default_rng(3)
    out = np.empty((count, 4, 3))
    for row in out:
        rail, knob = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        middle = np.array([0.55, 0.0, 0.66]) + 0.01 * rng.normal(size=3)
        apart = middle + 0.02 * rng.normal(size=3)
        row[:] = middle - 0.009 * rail, middle + 0.009 * rail, apart - 0.025 * knob, apart + 0.025 * knob
    return out.astype(np.float32).astype(float)


def test_closest_point_on_a_segment():
    points = jax.jit(jax.vmap(lambda s: closest_segment_point(s[0], s[1], s[2])))
    cases = rails_and_knobs(300)
    got = points(jnp.asarray(cases, jnp.float32))
    expected = np.array([brute_point(a, b, p) for a, b, p, _ in cases])
    # A metre in float32 is resolved to 6e-8 m; the projection on 18 mm loses one digit more.
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_segments_of_no_length_and_ends():
    a = jnp.array([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(closest_segment_point(a, a, a + 1.0), a)
    b = a + jnp.array([0.0, 0.0, 0.018])
    np.testing.assert_array_equal(closest_segment_point(a, b, a - 1.0), a)
    np.testing.assert_allclose(closest_segment_point(a, b, b + 1.0), b, rtol=1e-7)


def distances(cases: np.ndarray) -> np.ndarray:
    def one(s):
        on_a, on_b = private(SEGMENT_POINT[0]).closest_segment_to_segment_points(s[0], s[1], s[2], s[3])
        return jnp.linalg.norm(on_a - on_b)

    return np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(cases, jnp.float32)))


def test_capsule_distances_are_exact_inside_the_context():
    cases = rails_and_knobs(300)
    expected = np.array([brute_distance(*c) for c in cases])
    biased = distances(cases)
    with exact_segments():
        exact = distances(cases)
    # 1e-6 m is a hundredth of the grasp's penetration.
    assert np.abs(exact - expected).max() < 1e-6
    assert np.abs(exact - expected).max() < 0.5 * np.abs(biased - expected).max()


def test_the_bias_it_removes_is_real():
    """On a rail of 18 mm MJX's function has an error of 28 micrometres at its end."""
    a, b = np.zeros(3), np.array([0.018, 0.0, 0.0])
    off = mjx_point(jnp.asarray(a), jnp.asarray(b), jnp.asarray(b)) - b
    assert 2.5e-5 < float(np.abs(off).max()) < 6e-5
    np.testing.assert_allclose(closest_segment_point(jnp.asarray(a), jnp.asarray(b), jnp.asarray(b)), b, atol=1e-9)


def test_the_original_comes_back_even_after_an_error():
    a, b = jnp.zeros(3), jnp.array([0.018, 0.0, 0.0])
    biased = mjx_point(a, b, b)
    with pytest.raises(RuntimeError), exact_segments():
        np.testing.assert_array_equal(mjx_point(a, b, b), b)
        raise RuntimeError
    np.testing.assert_array_equal(mjx_point(a, b, b), biased)
    with exact_segments(), exact_segments():
        pass
    np.testing.assert_array_equal(mjx_point(a, b, b), biased)


def test_two_threads_that_trace_at_once_restore_mjx():
    """One enters while the other is inside, and leaves after it."""
    with exact_segments(), midpoint_constraints():  # which replaces both functions where it has not happened yet
        pass
    functions = replaced(SEGMENT_POINT), replaced(CONSTRAINT_LAW)
    a, b = jnp.zeros(3), jnp.array([0.018, 0.0, 0.0])
    biased = mjx_point(a, b, b)
    first_is_in, second_is_in, first_is_out = (threading.Event() for _ in range(3))
    seen = {}

    def first() -> None:
        with exact_segments(), midpoint_constraints():
            first_is_in.set()
            assert second_is_in.wait(60)
        first_is_out.set()

    def second() -> None:
        assert first_is_in.wait(60)
        seen["before"] = mjx_point(a, b, b)
        with exact_segments(), midpoint_constraints():
            second_is_in.set()
            assert first_is_out.wait(60)
            seen["inside"] = mjx_point(a, b, b)
        seen["after"] = mjx_point(a, b, b)

    threads = [threading.Thread(target=run) for run in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    np.testing.assert_array_equal(seen["before"], biased)  # whatever another thread traces meanwhile
    np.testing.assert_array_equal(seen["inside"], b)
    np.testing.assert_array_equal(seen["after"], biased)
    assert (replaced(SEGMENT_POINT), replaced(CONSTRAINT_LAW)) == functions
    np.testing.assert_array_equal(mjx_point(a, b, b), biased)
