"""Two functions of mujoco-mjx 3.17.0 that act differently while a simulation step is traced, and only then.

The functions in mjx's modules are exchanged once, for ones that ask what holds where they are called: other threads,
and other programs' traces, find what mjx does by itself.

`exact_segments`: MJX adds 1e-6 m^2 to the squared length of a segment before it divides by it.  On
a rail of 18 mm that moves a capsule's contact by 28 micrometres and turns its normal by 2 mrad.

`midpoint_constraints`: MuJoCo damps a constraint with the velocity at the beginning of the step.
Positions and forces belong to the middle of the velocity's step (semi-implicit Euler is a leapfrog
scheme), so that damping is half a step late, and a sticking grasp, which has no memory of its
position, creeps away by a tenth of a millimetre a second at 2 ms.  With the mean velocity of the
step instead, v + h/2 J a, the law J a = -b v - k d r - R f becomes
J a = (-b v - k d r - R f) / (1 + b h / 2): b, k and R are divided by 1 + b h / 2.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp

from droid_jax.model.mjx_internals import CONSTRAINT_LAW, SEGMENT_POINT, Place

_TINY = 1e-12  # m^2: keeps a segment of no length finite


def closest_segment_point(a: jax.Array, b: jax.Array, pt: jax.Array) -> jax.Array:
    """Closest point [3] m to pt [3] on the segment a-b."""
    ab = b - a
    t = jnp.dot(pt - a, ab) / jnp.maximum(jnp.dot(ab, ab), _TINY)
    return a + jnp.clip(t, 0.0, 1.0) * ab


def midpoint_law(original: Callable) -> Callable:
    """MJX's (stiffness, damping, impedance) of a constraint row, damped with the step's mean velocity.

    The regularisation R is proportional to (1 - d) / d, so dividing R means another impedance d;
    the stiffness is corrected for the d it is multiplied with.
    """

    def law(model: Any, solref: jax.Array, solimp: jax.Array, position: jax.Array) -> tuple[jax.Array, ...]:
        stiffness, damping, impedance = original(model, solref, solimp, position)
        share = 1.0 / (1.0 + 0.5 * model.opt.timestep * damping)
        new = 1.0 / (1.0 + share * (1.0 - impedance) / impedance)
        return share * stiffness * impedance / new, share * damping, new

    return law


def _switched(place: Place, new: Callable[[Callable], Callable]) -> ContextVar[bool]:
    """Exchange a function of mjx for one with two ways to act; the switch between them, off at first.

    new: of mjx's own function, what acts while the switch is on.
    """
    module, name = place
    original = getattr(module, name)
    if (before := getattr(original, "switch", None)) is not None:  # this module was loaded a second time
        return before
    switch = ContextVar(name, default=False)
    other = new(original)

    @functools.wraps(original)
    def function(*args: Any, **kwargs: Any) -> Any:
        return (other if switch.get() else original)(*args, **kwargs)

    function.switch = switch  # type: ignore[attr-defined]
    setattr(module, name, function)
    return switch


_SEGMENTS = _switched(SEGMENT_POINT, lambda original: closest_segment_point)
_MIDPOINT = _switched(CONSTRAINT_LAW, midpoint_law)


@contextlib.contextmanager
def exact_segments() -> Iterator[None]:
    """While active, traces of mjx's capsule contacts in this thread use the unbiased closest point."""
    with _on(_SEGMENTS):
        yield


@contextlib.contextmanager
def midpoint_constraints() -> Iterator[None]:
    """While active, traces of mjx's constraints in this thread are damped with the mean velocity of the step."""
    with _on(_MIDPOINT):
        yield


@contextlib.contextmanager
def _on(switch: ContextVar[bool]) -> Iterator[None]:
    before = switch.set(True)
    try:
        yield
    finally:
        switch.reset(before)
