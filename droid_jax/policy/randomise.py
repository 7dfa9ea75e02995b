"""From a Gaussian over parameters to randomised physics: brax's randomization_fn(sys, rng) -> (sys_v, in_axes).

Any Gaussian will do: the prior, a fitted mean alone (`fixed`), CMA-ES's covariance or the calibrated one.  `sys` is
our `Physics`, so that parameters outside the model (effects) vary too.  Only fields that parameters write, and what
follows from them, are batched.
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
    """Draws of the Gaussian, or its middle alone where the method of Table II is "mean"."""
    return fixed(scene, gaussian.space, gaussian.centre) if method == "mean" else randomised(scene, gaussian)


def randomised_model(scene: Scene, gaussian: Gaussian) -> Randomise:
    """A randomization_fn for environments that know an mjx.Model only (mujoco_playground's): the model fields alone.

    Numbers that no parameter writes stay the environment's own, those apart that follow from masses and places: they
    are the scene's. Warns of parameters that live outside the model: they have no place there and stay at neutral.

    Args:
        scene: of the same MJCF, whose visual geoms the environment may have.
        gaussian: over any part of the scene's parameters.

    Returns:
        (mjx.Model, rng [N, 2]) -> (batched mjx.Model, in_axes). It raises ValueError when called with a model of
        another scene, or with one in which a friction loss that varies has no row.

    Raises:
        ValueError: a Gaussian of another scene.
    """
    both, fields = randomised(scene, gaussian), _batched(scene, gaussian.space)
    outside = [p.name for p in gaussian.space.parameters if not p.writes]
    if outside:
        warnings.warn(
            f"an environment that knows an mjx.Model only cannot vary {', '.join(outside)}: they are no fields of it",
            stacklevel=2,
        )
    written = dict[str, list[tuple[int, ...]]]()
    for field, index in entries_written(gaussian.space):  # of a unit vector all that was scaled with what is written
        written.setdefault(field, []).append(index[: 1 if field in UNIT else None])

    def randomise(model: Any, rng: jax.Array) -> tuple[Any, Any]:
        geoms = _geoms_among(scene, model, fields)
        _check_friction_rows(scene, model, written.get("dof_frictionloss", ()))
        drawn, _ = both(Physics(scene.mjx, {}), rng)
        values = {field: getattr(drawn.model, field) for field in fields}
        for field in (f for f in fields if f in written or f in geoms):
            own, ids = jnp.repeat(getattr(model, field)[None], _count(rng), axis=0), geoms.get(field, slice(None))
            for index in written.get(field, [()]):  # of a derived field everything
                at = (np.arange(own.shape[1])[ids][index[0]], *index[1:]) if index else (ids,)
                own = own.at[(slice(None), *at)].set(values[field][(slice(None), *index)])
            values[field] = own
        if "eq_data" in values:
            own = jnp.repeat(model.eq_data[None], _count(rng), axis=0)
            for rows in joined_bodies(scene.mjx).values():
                own = own.at[:, rows, POSE].set(values["eq_data"][:, rows, POSE])
            values["eq_data"] = own
        return model.replace(**values), _zeros(model, fields)

    return randomise


def _geoms_among(scene: Scene, model: Any, fields: Sequence[str]) -> dict[str, np.ndarray]:
    """geom_ field -> ids of the scene's geoms in a model that has the looks too; empty where it has none.

    ValueError where a field's shape is of another scene.
    """
    looks = model.ngeom != scene.model.ngeom and len(scene.spec.geoms) == model.ngeom
    rows = {field: scene.full_geom_ids for field in fields if looks and field.startswith("geom_")}
    for field in fields:
        own, given = (jax.tree.map(jnp.shape, getattr(m, field)) for m in (scene.mjx, model))
        if own != given and not (field in rows and own[1:] == given[1:]):
            raise ValueError(
                f"the environment's model has {field} of shape {given}, the scene {scene.name!r} of {own}: the "
                "scene must be of the environment's MJCF"
            )
    return rows


def _check_friction_rows(scene: Scene, model: Any, written: Iterable[tuple[int, ...]]) -> None:
    """ValueError for a friction loss that was zero when the model was compiled: MJX laid out no row for it."""
    rows = friction_dofs(model)
    without = [i for (i, *_) in written if rows is not None and not rows[i]]
    if without:
        names = ", ".join(element_name(scene.model, "dof_frictionloss", (i,)) or f"dof {i}" for i in without)
        raise ValueError(
            f"the environment's MJCF has no friction loss at {names}, and MJX no row for it: what is drawn would have "
            f"no effect; give it {TINY_FRICTIONLOSS:g} or more there"
        )


def fixed(scene: Scene, space: Space, values: np.ndarray) -> Randomise:
    """The same values [D] in every environment: no randomisation."""
    check_space(scene, space)

    def randomise(sys: Physics, rng: jax.Array) -> tuple[Physics, Physics]:
        return physics_of(scene, space, np.repeat(values[None], _count(rng), axis=0)), axes(scene, space)

    return randomise


def physics_of(scene: Scene, space: Space, values: np.ndarray) -> Physics:
    """Physics of rows of values [N, D], batched where `axes` says so."""
    make = jax.vmap(lambda row: make_physics(scene, space, row), out_axes=axes(scene, space))
    return jax.jit(make)(jnp.asarray(values, jnp.float32))


def axes(scene: Scene, space: Space) -> Physics:
    """0 for what varies from row to row, None for what all share; to be handed to vmap."""
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
    """Keys in a batch of them, raw or typed."""
    return int(rng.shape[0])


def _seed(rng: jax.Array) -> np.random.Generator:
    """A host generator out of a batch of keys; the same keys give the same draws."""
    raw = jax.random.key_data(rng) if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else rng
    return np.random.default_rng(np.asarray(raw).ravel().tolist())
