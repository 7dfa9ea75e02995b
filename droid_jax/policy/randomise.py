"""Randomise physics by a Gaussian over parameters: brax's randomization_fn(sys, rng) -> (sys_v, in_axes).

The Gaussian may be the prior, CMA-ES's covariance or the calibrated one; `fixed` uses one vector.  `sys` is `Physics`,
so that parameters outside the model (of effects) vary too.  Only fields that parameters write, and fields derived from
them, are batched.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax.arguments import instance
from droid_jax.identify.gaussian import Gaussian
from droid_jax.model.fields import check_space, element_name
from droid_jax.model.inertia import possible_draws
from droid_jax.model.mjx_internals import friction_dofs
from droid_jax.model.parameters import Space
from droid_jax.model.physics import POSE, UNIT, Physics, entries_written, joined_bodies, make_physics, written_fields
from droid_jax.model.scene import TINY_FRICTIONLOSS, Scene

Randomise = Callable[[Any, jax.Array], tuple[Any, Any]]
ROWS = 256  # draws are compiled for multiples of it


def randomised(scene: Scene, gaussian: Gaussian) -> Randomise:
    """A randomization_fn for environments whose `sys` is `Physics`: one draw of the Gaussian for each key.

    Args:
        scene: that the Gaussian is of.
        gaussian: over any part of the scene's parameters, effects included.

    Returns:
        brax's randomization_fn, (sys, rng [N, 2]) -> (sys_v, in_axes).

    Raises:
        ValueError: a Gaussian of another scene.
    """
    check_space(instance(scene, "scene", Scene), instance(gaussian, "gaussian", Gaussian).space)

    def randomise(sys: Physics, rng: jax.Array) -> tuple[Physics, Physics]:
        seed = _seed(rng)
        values = possible_draws(scene, gaussian.space, lambda n: gaussian.sample(seed, n), _count(rng))
        return physics_of(scene, gaussian.space, values), axes(scene, gaussian.space)

    return randomise


def of_method(method: str, scene: Scene, gaussian: Gaussian) -> Randomise:
    """The randomisation of a method of Table II: the Gaussian's centre for "mean", else draws of the Gaussian."""
    return fixed(scene, gaussian.space, gaussian.centre) if method == "mean" else randomised(scene, gaussian)


def randomised_model(scene: Scene, gaussian: Gaussian) -> Randomise:
    """A randomization_fn for environments whose `sys` is an mjx.Model (mujoco_playground's): it varies model fields.

    Entries that no parameter writes keep the environment's values, except those derived from masses and positions,
    which are the scene's. It warns of parameters that are not fields of the model; they do not vary.

    Args:
        scene: of the same MJCF, whose visual geoms the environment may have.
        gaussian: over any part of the scene's parameters.

    Returns:
        (mjx.Model, rng [N, 2]) -> (batched mjx.Model, in_axes). It raises ValueError for a model of another scene, and
        for a model in which a friction loss that varies has no constraint row.

    Raises:
        ValueError: a Gaussian of another scene.
    """
    both, fields = randomised(scene, gaussian), _batched(scene, gaussian.space)
    outside = [p.name for p in gaussian.space.parameters if not p.writes]
    if outside:
        warnings.warn(
            f"an environment with an mjx.Model cannot vary {', '.join(outside)}: they are no fields of the model",
            stacklevel=2,
        )
    written = dict[str, list[tuple[int, ...]]]()
    for field, index in entries_written(gaussian.space):  # writing an entry of a unit vector changes the whole vector
        written.setdefault(field, []).append(index[: 1 if field in UNIT else None])

    def randomise(model: Any, rng: jax.Array) -> tuple[Any, Any]:
        geoms = _geoms_among(scene, model, fields)
        _check_friction_rows(scene, model, written.get("dof_frictionloss", ()))
        drawn, _ = both(Physics(scene.mjx, {}), rng)
        values = {field: getattr(drawn.model, field) for field in fields}
        for field in (f for f in fields if f in written or f in geoms):
            batch, ids = jnp.repeat(getattr(model, field)[None], _count(rng), axis=0), geoms.get(field, slice(None))
            for index in written.get(field, [()]):  # a derived field is replaced as a whole
                at = (np.arange(batch.shape[1])[ids][index[0]], *index[1:]) if index else (ids,)
                batch = batch.at[(slice(None), *at)].set(values[field][(slice(None), *index)])
            values[field] = batch
        if "eq_data" in values:
            batch = jnp.repeat(model.eq_data[None], _count(rng), axis=0)
            for rows in joined_bodies(scene.mjx).values():
                batch = batch.at[:, rows, POSE].set(values["eq_data"][:, rows, POSE])
            values["eq_data"] = batch
        return model.replace(**values), _zeros(model, fields)

    return randomise


def _geoms_among(scene: Scene, model: Any, fields: Sequence[str]) -> dict[str, np.ndarray]:
    """geom_ field -> ids of the scene's geoms in a model with visual geoms; empty for a model without.

    Raises ValueError if a field has another shape than in the scene.
    """
    visual = model.ngeom != scene.model.ngeom and len(scene.spec.geoms) == model.ngeom
    rows = {field: scene.full_geom_ids for field in fields if visual and field.startswith("geom_")}
    for field in fields:
        expected, given = (jax.tree.map(jnp.shape, getattr(m, field)) for m in (scene.mjx, model))
        if expected != given and not (field in rows and expected[1:] == given[1:]):
            raise ValueError(
                f"the environment's model has {field} of shape {given}, the scene {scene.name!r} of {expected}: the "
                "scene must be of the environment's MJCF"
            )
    return rows


def _check_friction_rows(scene: Scene, model: Any, written: Iterable[tuple[int, ...]]) -> None:
    """Raise ValueError for a friction loss that was zero when MJX laid out the constraint rows, which has none."""
    rows = friction_dofs(model)
    without = [i for (i, *_) in written if rows is not None and not rows[i]]
    if without:
        names = ", ".join(element_name(scene.model, "dof_frictionloss", (i,)) or f"dof {i}" for i in without)
        raise ValueError(
            f"the environment's MJCF has no friction loss at {names}, so MJX has no constraint row for it and draws "
            f"would have no effect; set it to {TINY_FRICTIONLOSS:g} or more"
        )


def fixed(scene: Scene, space: Space, values: np.ndarray) -> Randomise:
    """A randomization_fn with the same values [D] in every environment."""
    check_space(scene, space)

    def randomise(sys: Physics, rng: jax.Array) -> tuple[Physics, Physics]:
        return physics_of(scene, space, np.repeat(values[None], _count(rng), axis=0)), axes(scene, space)

    return randomise


def physics_of(scene: Scene, space: Space, values: np.ndarray) -> Physics:
    """Physics of rows of values [N, D], batched along `axes`."""
    count, each = len(values), axes(scene, space)
    whole = values[np.minimum(np.arange(count + -count % ROWS), count - 1)]  # the last row fills up
    make = jax.vmap(lambda row: make_physics(scene, space, row), out_axes=each)
    made = jax.jit(make)(jnp.asarray(whole, jnp.float32))
    return jax.tree.map(
        lambda axis, leaf: leaf if axis is None else leaf[:count], each, made, is_leaf=lambda axis: axis is None
    )


def axes(scene: Scene, space: Space) -> Physics:
    """The in_axes of `physics_of` for vmap: 0 for leaves that vary from row to row, None for shared ones."""
    model = _zeros(scene.mjx, _batched(scene, space))
    theta: dict[str, Any] = {p.name: 0 for p in space.parameters if not p.writes}
    return Physics(model, theta)


def _batched(scene: Scene, space: Space) -> tuple[str, ...]:
    """Fields of an mjx.Model that vary from row to row."""
    return tuple(field for field in written_fields(space) if hasattr(scene.mjx, field))


def _zeros(model: Any, fields: Sequence[str]) -> Any:
    """The model's tree with 0 in these fields and None in all others."""
    zeros = {field: jax.tree.map(lambda leaf: 0, getattr(model, field)) for field in fields}
    return jax.tree.map(lambda leaf: None, model).replace(**zeros)


def _count(rng: jax.Array) -> int:
    """Number of keys in a batch, raw or typed."""
    return int(rng.shape[0])


def _seed(rng: jax.Array) -> np.random.Generator:
    """A numpy generator from a batch of keys; the same keys give the same draws."""
    raw = jax.random.key_data(rng) if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else rng
    return np.random.default_rng(np.asarray(raw).ravel().tolist())
