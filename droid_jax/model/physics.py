"""Parameter values -> a model to simulate: `Physics` for MJX and the C twin for MuJoCo.

Mass, inertia and geometry enter quantities that the compiler derives (inverse weights, the
diagonal of the inertia matrix, subtree masses).  Both paths derive them again, so that applying
values equals compiling an MJCF that has them.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from droid_jax.model.ignored import IGNORED
from droid_jax.model.parameters import Space, Write
from droid_jax.model.scene import Scene

# Writing one of these changes what the compiler derives.
_SOURCES = {"body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "body_iquat", "dof_armature",
            "jnt_pos", "jnt_axis"}  # fmt: skip
DERIVED = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_length0",
    "tendon_invweight0",
    "stat",
)
# Writes set one component of these at a time; a compiler, and engines in their own ways, make them unit vectors.
_UNIT = ("body_quat", "body_iquat", "geom_quat", "site_quat", "jnt_axis")
_SLIDES_ONLY = 2  # MjModel.body_simple of a body whose inertia is its mass alone


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Physics:
    """A model with the fields that parameters write, and the parameters that live outside it.

    model: mjx.Model.
    theta: name -> scalar, for parameters without model fields (offsets, effects).
    """

    model: Any
    theta: dict[str, jax.Array]


def model_writes(space: Space) -> tuple[tuple[int, Write], ...]:
    """(column of the vector, write) for every model entry the space sets."""
    return tuple((i, w) for i, p in enumerate(space.parameters) for w in p.writes)


def written_fields(space: Space) -> tuple[str, ...]:
    """Names of the model fields that applying a vector changes, derived ones included."""
    fields = dict.fromkeys(w.field for _, w in model_writes(space))
    if _SOURCES & set(fields):
        fields.update(dict.fromkeys(DERIVED))
    return tuple(fields)


def check_field(scene: Scene, field: str) -> None:
    """Raise ValueError for a field of the C model that MJX does not have, takes as fixed, or does not read here."""
    if field not in _varied_fields() or np.asarray(getattr(scene.model, field)).dtype.kind != "f":
        raise ValueError(f"{field!r} cannot be a parameter: MJX does not simulate it, or takes it as fixed")
    if field == "body_gravcomp" and not scene.model.body_gravcomp.any():
        raise ValueError(
            f"'body_gravcomp' cannot be a parameter: scene {scene.name!r} was compiled without gravity compensation, "
            "which MJX then leaves out; give a body gravcomp in the MJCF"
        )


@functools.cache
def _varied_fields() -> frozenset[str]:
    """Fields of mjx.Model that are arrays of its program's input, not constants of the program, and are read."""
    arrays = {f.name for f in dataclasses.fields(mjx.Model) if "jax.Array" in str(f.type)}
    return frozenset(arrays - {field for field, _ in IGNORED})


def make_physics(scene: Scene, space: Space, values: jax.Array) -> Physics:
    """The physics of one parameter vector [D]; traceable, so vmap it over samples.

    Raises ValueError for fields that MJX would not read (see `check_field`).
    """
    model = scene.mjx
    by_field: dict[str, list[tuple[int, Write]]] = {}
    for column, write in model_writes(space):
        by_field.setdefault(write.field, []).append((column, write))
    changed = {}
    for field, writes in by_field.items():
        check_field(scene, field)
        nominal = jnp.asarray(getattr(model, field))
        new: dict[tuple[int, ...], jax.Array] = {}
        for column, w in writes:  # several parameters of one entry act one after the other
            new[w.index] = w.new(new.get(w.index, nominal[w.index]), values[column])
        index = tuple(np.array(axis) for axis in zip(*new, strict=True))
        changed[field] = nominal.at[index].set(jnp.stack(list(new.values())).astype(nominal.dtype))
    for field in set(_UNIT) & set(changed):
        changed[field] /= jnp.linalg.norm(changed[field], axis=1, keepdims=True)
    model = model.replace(**changed)
    if _SOURCES & set(by_field):
        model = derive(model)
    theta = {p.name: values[i] for i, p in enumerate(space.parameters) if not p.writes}
    return Physics(model, theta)


def derive(model: Any) -> Any:
    """Recompute what mj_setConst derives from masses, inertias and geometry at the pose qpos0.

    body_subtreemass, body_invweight0 [nbody,2], dof_invweight0 [nv], dof_M0 [nv], tendon_length0 and
    tendon_invweight0 [ntendon], stat.meaninertia and stat.meanmass.  As in C, free and ball joints
    average over their degrees of freedom, and a lone body on slides counts with its mass alone.
    """
    data = mjx.make_data(model).replace(qpos=model.qpos0)
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.crb(model, data)
    inertia = mjx.full_m(model, data)
    inverse = jnp.linalg.inv(inertia)
    diagonal = jnp.diagonal(inertia)
    subtree = _subtree_mass(model)
    stat = model.stat.replace(meaninertia=jnp.mean(diagonal), meanmass=subtree[0] / (model.nbody - 1))
    slides = model.body_simple == _SLIDES_ONLY
    of_mass = 1.0 / jnp.where(slides, jnp.asarray(model.body_mass), 1.0)
    of_body = jnp.stack([of_mass, jnp.zeros_like(of_mass)], axis=-1)
    bodies = jnp.where(slides[:, None], of_body, _body_invweight(model, data, inverse))
    dofs = _dof_average(model) @ jnp.diagonal(inverse)
    derived = dict(
        body_subtreemass=subtree,
        body_invweight0=bodies,
        dof_invweight0=jnp.where(slides[model.dof_bodyid], of_mass[model.dof_bodyid], dofs),
        dof_M0=diagonal,
        stat=stat,
    )
    if model.ntendon:
        data = mjx.tendon(model, data)
        pull = data._impl.ten_J
        derived.update(tendon_length0=data.ten_length, tendon_invweight0=jnp.einsum("ti,ij,tj->t", pull, inverse, pull))
    return model.replace(**derived)


def _ancestors(model: Any) -> np.ndarray:
    """[nbody, nbody] True where the column's body is the row's body or one above it."""
    above = np.eye(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        above[body] |= above[model.body_parentid[body]]
    return above


def _subtree_mass(model: Any) -> jax.Array:
    return jnp.asarray(_ancestors(model).T, dtype=model.body_mass.dtype) @ model.body_mass


def _body_invweight(model: Any, data: Any, inverse: jax.Array) -> jax.Array:
    """[nbody, 2] mean of diag(J M^-1 J^T) over translation and rotation, J at the body's centre of mass."""
    moves = jnp.asarray(_ancestors(model)[:, model.dof_bodyid], dtype=inverse.dtype)  # [nbody, nv]
    angular, linear = data.cdof[:, :3], data.cdof[:, 3:]
    arm = data.xipos - data.subtree_com[model.body_rootid]
    jac_linear = linear[None] + jnp.cross(angular[None], arm[:, None])  # [nbody, nv, 3]
    jac_linear = jac_linear * moves[..., None]
    jac_angular = angular[None] * moves[..., None]

    def weight(jac: jax.Array) -> jax.Array:
        return jnp.einsum("bik,ij,bjk->b", jac, inverse, jac) / 3

    return jnp.stack([weight(jac_linear), weight(jac_angular)], axis=-1)


def _dof_average(model: Any) -> np.ndarray:
    """[nv, nv] averaging over the translations and over the rotations of free and ball joints."""
    blocks = np.zeros((model.nv, model.nv), dtype=np.float32)
    dof = 0
    for kind in model.jnt_type:
        sizes = {mujoco.mjtJoint.mjJNT_FREE: (3, 3), mujoco.mjtJoint.mjJNT_BALL: (3,)}.get(
            mujoco.mjtJoint(int(kind)), (1,)
        )
        for size in sizes:
            blocks[dof : dof + size, dof : dof + size] = 1 / size
            dof += size
    return blocks


def make_c_model(scene: Scene, space: Space, values: np.ndarray) -> mujoco.MjModel:
    """The C twin: a copy of the scene's MjModel with the values [D] applied and constants derived."""
    model = copy.copy(scene.model)
    for column, write in model_writes(space):
        array = getattr(model, write.field)
        array[write.index] = write.new(array[write.index], float(values[column]))
    written = {w.field for _, w in model_writes(space)}
    for array in (getattr(model, field) for field in written.intersection(_UNIT)):
        array /= np.linalg.norm(array, axis=1, keepdims=True)
    if _SOURCES & written:
        mujoco.mj_setConst(model, mujoco.MjData(model))
        # mj_setConst leaves the statistics alone; the solver scales its tolerance with them.
        model.stat.meaninertia = model.dof_M0.mean()
        model.stat.meanmass = model.body_subtreemass[0] / (model.nbody - 1)
    return model


def theta_of(space: Space, values: np.ndarray) -> dict[str, float]:
    """Name -> value for the parameters that live outside the model."""
    return {p.name: float(values[i]) for i, p in enumerate(space.parameters) if not p.writes}
