"""Apply parameter values to a model: `Physics` for MJX, and an MjModel for C MuJoCo.

The compiler derives quantities from mass, inertia and geometry (inverse weights, the diagonal of the inertia matrix,
subtree masses).  Both functions derive them again, so that applying values equals compiling an MJCF with them.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.inertia import PSEUDO_INERTIA, as_written, check_single_inertia, inertial_fields, nominal_field
from droid_jax.model.mjx_internals import array_fields, quat_multiply, tendon_jacobian
from droid_jax.model.parameters import Space, Write
from droid_jax.model.scene import Scene
from droid_jax.model.unsupported_features import IGNORED
from droid_jax.quiet import mjx
from droid_jax.runtime import first_device

# Fields from which the compiler derives others.
_SOURCES = {"body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "body_iquat", "dof_armature",
            "jnt_pos", "jnt_axis"}  # fmt: skip
_PLACES = {"geom_pos", "geom_quat"}  # C MuJoCo stores whether these frames are the body's
DERIVED = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "tendon_length0",
    "tendon_invweight0",
    "eq_data",
    "stat",
)
# Fields of unit vectors, which are normalised after single components are written.
UNIT = ("body_quat", "body_iquat", "geom_quat", "site_quat", "jnt_axis")
POSE = slice(3, 10)  # columns of MjModel.eq_data that follow from the poses of two joined bodies
_AUTOMATIC = 11  # column of MjModel.eq_data that is 1 if the compiler derived a weld's pose
_SLIDES_ONLY = 2  # MjModel.body_simple of a body on slides, whose inertia matrix contains only its mass


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Physics:
    """A model with parameter values applied, and the parameters outside it.

    Attributes:
        model: mjx.Model.
        theta: name -> scalar, for parameters without model fields (offsets, effects).
    """

    model: Any
    theta: dict[str, jax.Array]


def model_writes(space: Space) -> tuple[tuple[int, Write], ...]:
    """(column of the vector, write) for all writes of the space."""
    return tuple((i, w) for i, p in enumerate(space.parameters) for w in p.writes)


def written_fields(space: Space) -> tuple[str, ...]:
    """Names of the model fields that applying a vector changes, including derived ones."""
    fields = dict.fromkeys(field for field, _ in entries_written(space))
    if _SOURCES & set(fields):
        fields.update(dict.fromkeys(DERIVED))
    return tuple(fields)


def entries_written(space: Space) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """(field, index) of MuJoCo's fields that parameters set; the index of a row if the whole row is set."""
    return as_written(tuple((w.field, w.index) for _, w in model_writes(space)))


def check_field(scene: Scene, field: str) -> None:
    """Raise ValueError for a field that MJX does not have, treats as constant, or does not read for this scene."""
    if field == PSEUDO_INERTIA:
        return
    if field not in _varied_fields() or np.asarray(getattr(scene.model, field)).dtype.kind != "f":
        raise ValueError(f"{field!r} cannot be a parameter: MJX does not simulate it, or takes it as fixed")
    if field == "body_gravcomp" and not scene.model.body_gravcomp.any():
        raise ValueError(
            f"'body_gravcomp' cannot be a parameter: scene {scene.name!r} was compiled without gravity compensation, "
            "so MJX does not compute it; set gravcomp of a body in the MJCF"
        )


@functools.cache
def _varied_fields() -> frozenset[str]:
    """Fields of mjx.Model that are inputs of a program and are read."""
    return array_fields() - {field for field, _ in IGNORED}


def make_physics(scene: Scene, space: Space, values: jax.Array) -> Physics:
    """The physics of one parameter vector [D]; traceable, to be vmapped over samples.

    Raises ValueError for fields that MJX does not read (see `check_field`).
    """
    model = scene.mjx
    by_field: dict[str, list[tuple[int, Write]]] = {}
    for column, write in model_writes(space):
        by_field.setdefault(write.field, []).append((column, write))
    changed = {}
    for field, writes in by_field.items():
        check_field(scene, field)
        nominal = jnp.asarray(nominal_field(model, field), jnp.float32 if field == PSEUDO_INERTIA else None)
        new: dict[tuple[int, ...], jax.Array] = {}
        for column, w in writes:  # several writes of one entry are applied in their order
            new[w.index] = w.new(new.get(w.index, nominal[w.index]), values[column])
        index = tuple(np.array(axis) for axis in zip(*new, strict=True))
        changed[field] = nominal.at[index].set(jnp.stack(list(new.values())).astype(nominal.dtype))
    if PSEUDO_INERTIA in changed:
        terms = changed.pop(PSEUDO_INERTIA)
        check_single_inertia(space)
        for body in dict.fromkeys(w.index[0] for _, w in by_field[PSEUDO_INERTIA]):
            for field, number in inertial_fields(scene.model, body, terms[body], jnp).items():
                array = changed.get(field, jnp.asarray(getattr(model, field)))
                changed[field] = array.at[body].set(number.astype(array.dtype))
    for field in set(UNIT) & set(changed):
        changed[field] /= jnp.linalg.norm(changed[field], axis=1, keepdims=True)
    model = model.replace(**changed)
    if _SOURCES & set(changed):
        model = derive(model)
    return Physics(model, theta_of(space, values))


def derive(model: Any) -> Any:
    """An mjx.Model with the fields that mj_setConst derives from masses, inertias and geometry at the pose qpos0.

    These are body_subtreemass, body_invweight0 [nbody, 2], dof_invweight0 [nv], dof_M0 [nv], tendon_length0 and
    tendon_invweight0 [ntendon], eq_data of connected and welded bodies, stat.meaninertia and stat.meanmass.  As in C,
    free and ball joints average over their degrees of freedom, the inverse weight of a body on slides is that of its
    mass, and dof_M0 does not contain the armature of tendons.
    """
    data: Any = mjx.make_data(model, device=first_device()).replace(qpos=model.qpos0)
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.crb(model, data)
    inertia = bare = mjx.full_m(model, data)
    if model.ntendon:
        data = mjx.tendon_armature(model, mjx.tendon(model, data))
        inertia = mjx.full_m(model, data)
    inverse = jnp.linalg.inv(inertia)
    subtree = _subtree_mass(model)
    meaninertia = jnp.mean(jnp.diagonal(inertia))
    stat = model.stat.replace(meaninertia=meaninertia, meanmass=subtree[0] / (model.nbody - 1))
    slides = model.body_simple == _SLIDES_ONLY
    of_mass = 1.0 / jnp.where(slides, jnp.asarray(model.body_mass), 1.0)
    of_body = jnp.stack([of_mass, jnp.zeros_like(of_mass)], axis=-1)
    bodies = jnp.where(slides[:, None], of_body, _body_invweight(model, data, inverse))
    dofs = _dof_average(model) @ jnp.diagonal(inverse)
    derived = dict(
        body_subtreemass=subtree,
        body_invweight0=bodies,
        dof_invweight0=jnp.where(slides[model.dof_bodyid], of_mass[model.dof_bodyid], dofs),
        dof_M0=jnp.diagonal(bare),
        eq_data=_equality_data(model, data),
        stat=stat,
    )
    if model.ntendon:
        pull = tendon_jacobian(data)
        derived.update(tendon_length0=data.ten_length, tendon_invweight0=jnp.einsum("ti,ij,tj->t", pull, inverse, pull))
    return model.replace(**derived)


def _equality_data(model: Any, data: Any) -> jax.Array:
    """eq_data of joined bodies at qpos0: a connect's anchor in the second body, and a weld's relative pose.

    As in mj_setConst, a pose that the MJCF states is unchanged.
    """
    numbers = jnp.asarray(model.eq_data)
    for kind, rows in joined_bodies(model).items():
        one, two = np.asarray(model.eq_obj1id)[rows], np.asarray(model.eq_obj2id)[rows]
        at, turned = data.xpos, data.xmat
        anchor = numbers[rows, :3]  # in the first body of a connect, in the second of a weld
        if kind == mujoco.mjtEq.mjEQ_CONNECT:
            world = at[one] + jnp.einsum("eij,ej->ei", turned[one], anchor)
            numbers = numbers.at[rows, 3:6].set(jnp.einsum("eji,ej->ei", turned[two], world - at[two]))
            continue
        world = at[two] + jnp.einsum("eij,ej->ei", turned[two], anchor)
        place = jnp.einsum("eji,ej->ei", turned[one], world - at[one])
        back = data.xquat[one] * jnp.array([1.0, -1.0, -1.0, -1.0])
        pose = jnp.concatenate([place, jax.vmap(quat_multiply)(back, data.xquat[two])], axis=1)
        automatic = numbers[rows, _AUTOMATIC, None] > 0
        numbers = numbers.at[rows, POSE].set(jnp.where(automatic, pose, numbers[rows, POSE]))
    return numbers


def joined_bodies(model: Any) -> dict[mujoco.mjtEq, np.ndarray]:
    """Kind of equality (connect, weld) -> rows of eq_data between two bodies, if there are any."""
    between = np.asarray(model.eq_objtype) == mujoco.mjtObj.mjOBJ_BODY
    kinds = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
    rows = {kind: np.flatnonzero(between & (np.asarray(model.eq_type) == kind)) for kind in kinds}
    return {kind: of_kind for kind, of_kind in rows.items() if of_kind.size}


def _ancestors(model: Any) -> np.ndarray:
    """[nbody, nbody] True where the column's body is the row's body or one of its ancestors."""
    above = np.eye(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        above[body] |= above[model.body_parentid[body]]
    return above


def moved_bodies(model: Any) -> np.ndarray:
    """[nbody, nv] True where a degree of freedom moves a body."""
    return _ancestors(model)[:, model.dof_bodyid]


def _subtree_mass(model: Any) -> jax.Array:
    return jnp.asarray(_ancestors(model).T, dtype=model.body_mass.dtype) @ model.body_mass


def _body_invweight(model: Any, data: Any, inverse: jax.Array) -> jax.Array:
    """[nbody, 2] mean of diag(J M^-1 J^T) over translation and rotation, J at the body's centre of mass."""
    moves = jnp.asarray(moved_bodies(model), dtype=inverse.dtype)  # [nbody, nv]
    angular, linear = data.cdof[:, :3], data.cdof[:, 3:]
    arm = data.xipos - data.subtree_com[model.body_rootid]
    jac_linear = linear[None] + jnp.cross(angular[None], arm[:, None])  # [nbody, nv, 3]
    jac_linear = jac_linear * moves[..., None]
    jac_angular = angular[None] * moves[..., None]

    def weight(jac: jax.Array) -> jax.Array:
        return jnp.einsum("bik,ij,bjk->b", jac, inverse, jac) / 3

    return jnp.stack([weight(jac_linear), weight(jac_angular)], axis=-1)


def _dof_average(model: Any) -> np.ndarray:
    """[nv, nv] matrix that averages over the translations and over the rotations of free and ball joints."""
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
    """A copy of the scene's MjModel with the values [D] applied and constants derived."""
    model = copy.copy(scene.model)
    terms = nominal_field(model, PSEUDO_INERTIA)
    for column, write in model_writes(space):
        array = terms if write.field == PSEUDO_INERTIA else getattr(model, write.field)
        array[write.index] = write.new(array[write.index], float(values[column]))
    bodies = {w.index[0] for _, w in model_writes(space) if w.field == PSEUDO_INERTIA}
    if bodies:
        check_single_inertia(space)
    for body in bodies:
        for field, number in inertial_fields(scene.model, body, terms[body]).items():
            getattr(model, field)[body] = number
    settle(model, entries_written(space))
    return model


def settle(model: mujoco.MjModel, entries: Sequence[tuple[str, tuple[int, ...]]], *, derive: bool = False) -> None:
    """Make a model of the C engine what the compiler makes of it, after some of its numbers were written.

    entries: (field, index) that were.  derive: work the constants out again, whichever these were.
    """
    bodies, written = set[int](), {field for field, _ in entries}
    for field, index in entries:
        if field in ("body_ipos", "body_iquat"):
            bodies.add(index[0])
        elif field in ("jnt_pos", "jnt_axis"):
            bodies.add(int(model.jnt_bodyid[index[0]]))
    no_short_cut(model, sorted(bodies))
    for array in (getattr(model, field) for field in written.intersection(UNIT)):
        array /= np.linalg.norm(array, axis=1, keepdims=True)
    if derive or (_SOURCES | _PLACES) & written:
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        # mj_setConst does not update the statistics, with which the solver scales its tolerance.
        model.stat.meaninertia = _inertia_of(model, data).mean()
        model.stat.meanmass = model.body_subtreemass[0] / (model.nbody - 1)
    if (_PLACES | {"geom_size"}) & written:  # bounding boxes of several geoms are not updated
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        _bound(model, {index[0] for field, index in entries if field == "geom_size"})


def no_short_cut(model: mujoco.MjModel, bodies: Sequence[int]) -> None:
    """Disable C MuJoCo's shortcuts for bodies whose inertial frame is the body frame or contains the joints."""
    if model.body_simple[bodies].any():
        model.dof_simplenum[:] = 0
    model.body_sameframe[bodies] = model.body_simple[bodies] = 0


def _inertia_of(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """[nv] diagonal of the inertia matrix in the pose of `data`, with the armature of tendons."""
    if not model.tendon_armature.any():
        return model.dof_M0
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return np.diagonal(full)


def _bound(model: mujoco.MjModel, geoms: Iterable[int]) -> None:
    """Update bounding radius and box of primitive geoms, as the compiler does; meshes are unchanged."""
    for geom in geoms:
        x, y, z = model.geom_size[geom]
        bounds = {
            mujoco.mjtGeom.mjGEOM_SPHERE: ((x, x, x), x),
            mujoco.mjtGeom.mjGEOM_CAPSULE: ((x, x, x + y), x + y),
            mujoco.mjtGeom.mjGEOM_CYLINDER: ((x, x, y), np.hypot(x, y)),
            mujoco.mjtGeom.mjGEOM_ELLIPSOID: ((x, y, z), max(x, y, z)),
            mujoco.mjtGeom.mjGEOM_BOX: ((x, y, z), np.sqrt(x**2 + y**2 + z**2)),
        }.get(mujoco.mjtGeom(int(model.geom_type[geom])))
        if bounds is not None:
            model.geom_aabb[geom, 3:], model.geom_rbound[geom] = bounds


def theta_of(space: Space, values: Any) -> dict[str, Any]:
    """Name -> value, of a vector [D], for the parameters outside the model."""
    return {p.name: values[i] for i, p in enumerate(space.parameters) if not p.writes}
