"""Private parts of mujoco-mjx 3.17.0 that this package uses, under its own names.

Another version of MuJoCo may move or rename them; then only this module changes.  `tests/test_layers.py` checks that no
other module uses `_src` or `_impl`.

Two functions of mjx are replaced by versions that change their behaviour while a simulation step is traced.  A context
variable switches them, so that other threads and other programs get mjx's behaviour.

`exact_segments`: MJX adds 1e-6 m^2 to the squared length of a segment before it divides by it.  On a rail of 18 mm this
moves a capsule's contact by 28 micrometres and turns its normal by 2 mrad.

`midpoint_constraints`: MuJoCo damps a constraint with the velocity at the beginning of the step.  Positions and forces
belong to the middle of the velocity's step (semi-implicit Euler is a leapfrog scheme).  So the damping is half a step
late.  A sticking grasp, which has no memory of its position, then creeps by a tenth of a millimetre per second at 2 ms.
With the mean velocity of the step, v + h/2 J a, the law J a = -b v - k d r - R f becomes
J a = (-b v - k d r - R f) / (1 + b h / 2): b, k and R are divided by 1 + b h / 2.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from types import ModuleType
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp

from droid_jax.quiet import import_mjx, mjx

# Module and name of a function of mjx, looked up at each call, so that it can be replaced.
Replaced = tuple[str, str]
SEGMENT_POINT: Replaced = (
    "math",
    "closest_segment_point",
)  # a, b, p [3] m -> the point of the segment a-b closest to p
CONSTRAINT_LAW: Replaced = ("constraint", "_kbi")  # model, solref, solimp, position -> stiffness, damping, impedance


class ConstraintRows(NamedTuple):
    """The constraint rows of a step: equalities first, then dry friction, then limits and contacts.

    Attributes:
        jacobian: [rows, nv].
        weight: [rows] 1/R, inverse regularisation.
        reference: [rows] aref.
        friction: [rows] N m or N, friction loss.
        force: [rows] of the last solution.
        equalities, frictions: numbers of these rows, fixed when the model is put on the device.
    """

    jacobian: jax.Array
    weight: jax.Array
    reference: jax.Array
    friction: jax.Array
    force: jax.Array
    equalities: int
    frictions: int


class Contacts(NamedTuple):
    """All contacts that the model may have, in a step.

    Attributes:
        geoms: [contacts, 2] ids.
        distance: [contacts] m, negative for penetration.
        first_row: [contacts] index of the first constraint row.
    """

    geoms: jax.Array
    distance: jax.Array
    first_row: jax.Array


@functools.cache
def private(module: str) -> ModuleType:
    """A private module of mjx, imported when it is first used."""
    import_mjx()
    return importlib.import_module(f"mujoco.mjx._src.{module}")


def constraint_rows(data: Any) -> ConstraintRows:
    """The constraint rows of mjx.Data after the kinematics."""
    rows = data._impl
    return ConstraintRows(
        jacobian=rows.efc_J,
        weight=rows.efc_D,
        reference=rows.efc_aref,
        friction=rows.efc_frictionloss,
        force=rows.efc_force,
        equalities=rows.ne,
        frictions=rows.nf,
    )


def with_constraint_force(data: Any, force: jax.Array) -> Any:
    """The mjx.Data with the forces [rows] of its constraints."""
    return data.tree_replace({"_impl.efc_force": force})


def contacts(data: Any) -> Contacts:
    """The contacts of mjx.Data after the kinematics."""
    found = data._impl.contact
    return Contacts(found.geom, found.dist, found.efc_address)


def at_velocity(data: Any, velocity: jax.Array) -> Any:
    """The mjx.Data with the actuator velocities of joint velocities [nv]."""
    return data.tree_replace({"_impl.actuator_velocity": data._impl.actuator_moment @ velocity})


def tendon_jacobian(data: Any) -> jax.Array:
    """[ntendon, nv] d length / d position, of mjx.Data after mjx.tendon."""
    return data._impl.ten_J


def friction_dofs(model: Any) -> Any:
    """[nv] bool, degrees of freedom with a row for dry friction; None if the implementation lays out all rows."""
    return getattr(model._impl, "dof_hasfrictionloss", None)


def has_fluid(model: Any) -> Any:
    """[] bool, whether the mjx.Model's bodies move through air or water."""
    return model.opt._impl.has_fluid_params


def quat_multiply(one: jax.Array, other: jax.Array) -> jax.Array:
    """[4] product of two quaternions (w, x, y, z)."""
    return private("math").quat_mul(one, other)


def array_fields() -> frozenset[str]:
    """Names of the fields of mjx.Model that are inputs of a program, not constants."""
    return frozenset(f.name for f in dataclasses.fields(cast(Any, mjx.Model)) if "jax.Array" in str(f.type))


# ----- functions that are replaced while a step is traced

_TINY = 1e-12  # m^2, avoids a division by zero for a segment without length


def closest_segment_point(a: jax.Array, b: jax.Array, pt: jax.Array) -> jax.Array:
    """Closest point [3] m to pt [3] on the segment a-b."""
    ab = b - a
    t = jnp.dot(pt - a, ab) / jnp.maximum(jnp.dot(ab, ab), _TINY)
    return a + jnp.clip(t, 0.0, 1.0) * ab


def midpoint_law(original: Callable) -> Callable:
    """MJX's (stiffness, damping, impedance) of a constraint row, damped with the step's mean velocity.

    The regularisation R is proportional to (1 - d) / d, so dividing R changes the impedance d.  The stiffness, which is
    multiplied by d, is corrected for that.
    """

    def law(model: Any, solref: jax.Array, solimp: jax.Array, position: jax.Array) -> tuple[jax.Array, ...]:
        stiffness, damping, impedance = original(model, solref, solimp, position)
        share = 1.0 / (1.0 + 0.5 * model.opt.timestep * damping)
        new = 1.0 / (1.0 + share * (1.0 - impedance) / impedance)
        return share * stiffness * impedance / new, share * damping, new

    return law


def _switched(target: Replaced, new: Callable[[Callable], Callable]) -> ContextVar[bool]:
    """Replace a function of mjx by one that a switch changes; returns the switch, off at first.

    new: original -> the function while the switch is on.
    """
    module, name = private(target[0]), target[1]
    original = getattr(module, name)
    if (existing := getattr(original, "switch", None)) is not None:  # by another thread, or this module's first load
        return existing
    switch = ContextVar(name, default=False)
    other = new(original)

    @functools.wraps(original)
    def function(*args: Any, **kwargs: Any) -> Any:
        return (other if switch.get() else original)(*args, **kwargs)

    function.switch = switch  # type: ignore[attr-defined]
    setattr(module, name, function)
    return switch


@functools.cache
def _segments() -> ContextVar[bool]:
    return _switched(SEGMENT_POINT, lambda original: closest_segment_point)


@functools.cache
def _midpoint() -> ContextVar[bool]:
    return _switched(CONSTRAINT_LAW, midpoint_law)


@contextlib.contextmanager
def exact_segments() -> Iterator[None]:
    """While active, traces of mjx's capsule contacts in this thread use the unbiased closest point."""
    with _on(_segments()):
        yield


@contextlib.contextmanager
def midpoint_constraints() -> Iterator[None]:
    """While active, traces of mjx's constraints in this thread are damped with the mean velocity of the step."""
    with _on(_midpoint()):
        yield


@contextlib.contextmanager
def _on(switch: ContextVar[bool]) -> Iterator[None]:
    before = switch.set(True)
    try:
        yield
    finally:
        switch.reset(before)
