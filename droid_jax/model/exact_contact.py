"""MJX's closest point on a segment, without the bias that moves grasp contacts.

mujoco-mjx 3.17.0 adds 1e-6 m^2 to the squared length of a segment before it divides by it.  On a
rail of 18 mm that moves a capsule's contact by 28 micrometres and turns its normal by 2 mrad:
0.1 N m of joint torque by the end of a door opening.  `exact_segments` puts the unbiased function
in its place while a simulation step is traced, and only then.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
from mujoco.mjx._src import math as mjx_math

_TINY = 1e-12  # m^2: keeps a segment of no length finite


def closest_segment_point(a: jax.Array, b: jax.Array, pt: jax.Array) -> jax.Array:
    """Closest point [3] m to pt [3] on the segment a-b."""
    ab = b - a
    t = jnp.dot(pt - a, ab) / jnp.maximum(jnp.dot(ab, ab), _TINY)
    return a + jnp.clip(t, 0.0, 1.0) * ab


@contextlib.contextmanager
def exact_segments() -> Iterator[None]:
    """While active, traces of mjx's capsule contacts use the unbiased function."""
    original = mjx_math.closest_segment_point
    mjx_math.closest_segment_point = closest_segment_point
    try:
        yield
    finally:
        mjx_math.closest_segment_point = original
