"""What this package uses of mujoco-mjx 3.17.0 beyond its public interface, under names of our own.

Another MuJoCo may move or rename any of it; then this module changes and no other.  `tests/test_layers.py` holds that
no other module names `_src` or `_impl`.
"""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any, NamedTuple, cast

from droid_jax.model.quiet_mjx import mjx

# isort: split
import jax
import mujoco.mjx._src.constraint as _constraint
import mujoco.mjx._src.math as _math

# Where mjx looks up a function each time it is called, so that another one can take its place: module, name in it.
Place = tuple[ModuleType, str]
SEGMENT_POINT: Place = (_math, "closest_segment_point")  # a, b, p [3] m -> the point of the segment a-b closest to p
CONSTRAINT_LAW: Place = (_constraint, "_kbi")  # model, solref, solimp, position -> stiffness, damping, impedance


class ConstraintRows(NamedTuple):
    """The constraint problem of a step: equalities first, then dry friction, then limits and contacts.

    jacobian: [rows, nv]; weight: [rows] 1/R, the inverse regularisation; reference: [rows] aref; friction: [rows] bound
    of the force of dry friction, N m or N; force: [rows] of the last solution; equalities, frictions: how many rows
    are of each, fixed when the model is put on the device.
    """

    jacobian: jax.Array
    weight: jax.Array
    reference: jax.Array
    friction: jax.Array
    force: jax.Array
    equalities: int
    frictions: int


class Contacts(NamedTuple):
    """Contacts of a step, as many as the model may have.

    geoms: [contacts, 2] ids; distance: [contacts] m, negative where they penetrate; first_row: [contacts] of each one's
    rows among the constraints.
    """

    geoms: jax.Array
    distance: jax.Array
    first_row: jax.Array


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
    """The mjx.Data with the actuators' speeds that joint velocities [nv] give."""
    return data.tree_replace({"_impl.actuator_velocity": data._impl.actuator_moment @ velocity})


def tendon_jacobian(data: Any) -> jax.Array:
    """[ntendon, nv] d length / d position, of mjx.Data after mjx.tendon."""
    return data._impl.ten_J


def friction_dofs(model: Any) -> Any:
    """[nv] bool, degrees of freedom with a row for dry friction; None where the implementation lays out all rows."""
    return getattr(model._impl, "dof_hasfrictionloss", None)


def has_fluid(model: Any) -> Any:
    """[] bool, whether the mjx.Model's bodies move through air or water."""
    return model.opt._impl.has_fluid_params


def quat_multiply(one: jax.Array, other: jax.Array) -> jax.Array:
    """[4] product of two quaternions (w, x, y, z)."""
    return _math.quat_mul(one, other)


def array_fields() -> frozenset[str]:
    """Names of the fields of mjx.Model that are arrays of its program's input, not constants of the program."""
    return frozenset(f.name for f in dataclasses.fields(cast(Any, mjx.Model)) if "jax.Array" in str(f.type))
