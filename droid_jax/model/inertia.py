"""Inertia of bodies: moments that no body can have, and ten parameters whose every value is a body that can exist.

No body's largest principal moment is above the sum of the others (A + B < C).  Moments that are parameters one by one
can come to that.  A row of values with it is no sample of a search and no draw of a distribution: the replay of it
counts as one that gave no numbers, and draws are drawn again.

The whole inertia as ten parameters has no such rows.

A body's mass, centre and moments make its pseudo-inertia, a symmetric matrix of four rows:

    J = [[S, h], [h', m]]      S = sum of mass times position position',  h = mass times centre

A body can have these numbers if and only if J is positive definite.  With the scene's own J = U0 U0' (U0 upper
triangular) ten numbers z make another one, J(z) = U0 A(z) A(z)' U0', where A is upper triangular too:

    A = e^mass [[e^stretch_x, shear_xy,    shear_xz,    shift_x],
                [0,           e^stretch_y, shear_yz,    shift_y],
                [0,           0,           e^stretch_z, shift_z],
                [0,           0,           0,           1      ]]

z = 0 is the scene's own body.  A shift of 1 moves the centre by about a radius of gyration; mass 0.05 is 10 % heavier.
The numbers are entries of a field `body_pseudo_inertia` [nbody, 10], which no MuJoCo model has: applying values turns
it into mass, centre, orientation and moments (`inertial_fields`).

Source: Rucker and Wensing, Smooth parameterization of rigid-body inertia, IEEE RA-L 2022.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from droid_jax.model.parameters import Parameter, Space, Write
from droid_jax.model.scene import Scene

ROUNDING = 1e-5  # of the largest moment, by which single precision may miss the inequality
PSEUDO_INERTIA = "body_pseudo_inertia"
TERMS = (
    *("mass", "stretch_x", "stretch_y", "stretch_z", "shear_xy", "shear_yz", "shear_xz"),
    *("shift_x", "shift_y", "shift_z"),
)
WEIGHTS = ("body_mass", "body_ipos", "body_iquat", "body_inertia")  # what MuJoCo has for it
FLAT = 1e-6  # share of the largest of a body's three extents squared that each must be


# ----- moments one by one


def free_inertias(space: Space) -> dict[int, list[tuple[int, Write]]]:
    """Body -> (column of the vector, write) of its inertia, of those bodies whose moments do not scale as one."""
    writes = dict[int, list[tuple[int, Write]]]()
    for column, parameter in enumerate(space.parameters):
        for write in parameter.writes:
            if write.field == "body_inertia":
                writes.setdefault(write.index[0], []).append((column, write))
    together = {body: {column for column, _ in of} for body, of in writes.items()}
    return {body: of for body, of in writes.items() if any(_alone(of, column) for column in together[body])}


def inertia_possible(scene: Scene, space: Space, values: Any) -> Any:
    """[...] bool of values [..., D], numpy or jax: whether every body's inertia is one that a body can have."""
    found = None
    for body, writes in free_inertias(space).items():
        first, second, third = _moments(scene, body, writes, lambda column: values[..., column])
        total = first + second + third
        fits = (2 * first <= total * (1 + ROUNDING)) & (2 * second <= total * (1 + ROUNDING))
        fits = fits & (2 * third <= total * (1 + ROUNDING)) & (first > 0) & (second > 0) & (third > 0)
        found = fits if found is None else found & fits
    return np.ones(np.shape(values)[:-1], bool) if found is None else found


def check_inertia(scene: Scene, space: Space) -> None:
    """Warn of bounds that hold an inertia which no body can have; ValueError where the initial means are one.

    The message names the body, its parameters and the moments.
    """
    for body, writes in free_inertias(space).items():
        names = ", ".join(dict.fromkeys(space.parameters[column].name for column, _ in writes))
        called = f"body {scene.model.body(body).name!r} of scene {scene.name!r}"
        means = _moments(scene, body, writes, lambda column: space.mean[column])
        if not bool(inertia_possible(scene, _only(space, writes), np.array([space.mean[c] for c in _columns(writes)]))):
            raise ValueError(
                f"the initial means of {names} give {called} the principal moments {_said(means)} kg m2, of which the "
                "largest is above the sum of the others: no body has that inertia"
            )
        worst = _worst(scene, body, writes, space)
        if worst is not None:
            warnings.warn(
                f"the bounds of {names} hold moments that {called} cannot have ({_said(worst)} kg m2: the largest is "
                "above the sum of the others); such rows are left out of the search and of draws: narrow the bounds, "
                "or vary the mass alone (body_mass, which scales the inertia)",
                stacklevel=3,
            )


def possible_draws(
    scene: Scene, space: Space, draw: Callable[[int], np.ndarray], n: int, rounds: int = 100
) -> np.ndarray:
    """[n, D] draws of which those with an inertia that no body can have are drawn again.

    Args:
        scene: of the parameters.
        space: what a row of the draws means.
        draw: [k, D] new rows.
        n: rows.
        rounds: of drawing again.

    Raises:
        ValueError: where even then some are left.
    """
    values = draw(n)
    for _ in range(rounds):
        bad = ~np.asarray(inertia_possible(scene, space, values))
        if not bad.any():
            return values
        values[bad] = draw(int(bad.sum()))
    raise ValueError(
        f"hardly any draw for scene {scene.name!r} has an inertia that a body can have (the largest principal moment "
        "above the sum of the others): narrow the bounds or the deviations of the body_inertia parameters"
    )


def _alone(writes: list[tuple[int, Write]], column: int) -> bool:
    """Whether a parameter changes a body's moments other than all three by one factor."""
    mine = [write for c, write in writes if c == column]
    alike = {(w.mode, w.gain, w.offset) for w in mine}
    return len(mine) != 3 or len(alike) != 1 or mine[0].mode.value not in ("scale", "divide")


def _moments(scene: Scene, body: int, writes: list[tuple[int, Write]], value: Callable[[int], Any]) -> list[Any]:
    """The three principal moments, kg m2, with the writes applied in the order in which the model takes them."""
    moments: list[Any] = [float(m) for m in scene.model.body_inertia[body]]
    for column, write in writes:
        moments[write.index[1]] = write.new(moments[write.index[1]], value(column))
    return moments


def _columns(writes: list[tuple[int, Write]]) -> list[int]:
    return list(dict.fromkeys(column for column, _ in writes))


def _only(space: Space, writes: list[tuple[int, Write]]) -> Space:
    return Space(tuple(space.parameters[column] for column in _columns(writes)))


def _worst(scene: Scene, body: int, writes: list[tuple[int, Write]], space: Space) -> list[float] | None:
    """Moments at the corner of the bounds that breaks the inequality the most, None where none does.

    Every moment rises or falls with each of its parameters, so the corners hold the extremes.
    """
    columns, worst, most = _columns(writes), None, ROUNDING
    corners = np.array(np.meshgrid(*([0, 1] for _ in columns), indexing="ij")).reshape(len(columns), -1).T
    for corner in corners[:4096]:
        at = {c: (space.high if end else space.low)[c] for c, end in zip(columns, corner, strict=True)}
        moments = [float(m) for m in _moments(scene, body, writes, at.__getitem__)]
        beyond = (2 * max(moments) - sum(moments)) / max(max(moments), 1e-300)
        if beyond > most:
            worst, most = moments, beyond
    return worst


def _said(moments: list[Any]) -> str:
    return ", ".join(f"{float(m):.3g}" for m in moments)


# ----- the whole inertia


def inertia_parameters(
    scene: Scene, body: str, *, std: float = 0.1, high: float = 1.0, **options: Any
) -> tuple[Parameter, ...]:
    """The ten parameters of one body, `inertia_mass[BODY]` and so on, 0 at nominal.

    Args:
        scene: with the body.
        body: by name.
        std: prior deviation of each.
        high: bound of each, to both sides.
        options: further fields of `Parameter`.

    Raises:
        ValueError: no such body, or one without mass or with no extent along an axis: a point, a rod, a plate.
    """
    row = scene.id("body", body)
    check_solid(scene.model, row)
    given = {"group": "Inertia", "unit": "-", "mean": 0.0, "low": -high, "high": high, **options}
    return tuple(
        Parameter(f"inertia_{term}[{body}]", std=std, writes=(Write(PSEUDO_INERTIA, (row, k), element=body),), **given)
        for k, term in enumerate(TERMS)
    )


def check_solid(model: mujoco.MjModel, body: int) -> None:
    """ValueError for a body whose pseudo-inertia is not positive definite."""
    moments = model.body_inertia[body]
    extents = 0.5 * moments.sum() - moments
    if model.body_mass[body] <= 0 or extents.min() <= FLAT * max(extents.max(), 1e-300):
        raise ValueError(
            f"body {model.body(body).name!r} has mass {model.body_mass[body]:.3g} kg and moments "
            f"{', '.join(f'{m:.3g}' for m in moments)} kg m2, those of a point, a rod or a plate: its inertia cannot "
            "be a parameter as a whole; give the body a thickness in the MJCF, or vary its mass (body_mass)"
        )


def check_single_inertia(space: Space) -> None:
    """ValueError where other parameters write the weight of a body whose whole inertia is a parameter."""
    whole = {w.index[0]: w.element for p in space.parameters for w in p.writes if w.field == PSEUDO_INERTIA}
    for p in space.parameters:
        if both := [whole[w.index[0]] for w in p.writes if w.field in WEIGHTS and w.index[0] in whole]:
            raise ValueError(
                f"parameter {p.name!r} and inertia_mass[{both[0]}] both write the inertia of body {both[0]!r}: keep one"
            )


def nominal_field(model: Any, field: str) -> Any:
    """A field's own numbers: of a model, C's or MJX's, or of body_pseudo_inertia, which has none yet."""
    return np.zeros((model.nbody, len(TERMS))) if field == PSEUDO_INERTIA else getattr(model, field)


def as_written(writes: tuple[tuple[str, tuple[int, ...]], ...]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """(field, index) of MuJoCo's own fields; a body's whole inertia is four of them."""
    out: dict[tuple[str, tuple[int, ...]], None] = {}
    for field, index in writes:
        out.update(dict.fromkeys([(f, index[:1]) for f in WEIGHTS] if field == PSEUDO_INERTIA else [(field, index)]))
    return tuple(out)


def inertial_fields(model: mujoco.MjModel, body: int, terms: Any, xp: ModuleType = np) -> dict[str, Any]:
    """The numbers of `WEIGHTS` of a body for its ten terms.

    Args:
        model: with the body's own numbers.
        body: its row.
        terms: [10], numpy's or jax's.
        xp: numpy or jax.numpy.
    """
    root = root_of(*(np.asarray(getattr(model, f)[body], float) for f in WEIGHTS))
    scaled = xp.asarray(root, terms.dtype) @ _factor(terms, xp)
    whole = scaled @ scaled.T
    mass = whole[3, 3]
    centre = whole[:3, 3] / mass
    spread = whole[:3, :3] - mass * xp.outer(centre, centre)  # about the centre
    extents, axes = xp.linalg.eigh(spread)  # ascending, so that moments descend, as MuJoCo has them
    axes = axes * xp.asarray([1.0, 1.0, xp.sign(xp.linalg.det(axes))])
    moments = xp.sum(extents) - extents
    return dict(zip(WEIGHTS, (mass, centre, _quaternion(axes, xp), moments), strict=True))


def root_of(mass: np.ndarray, centre: np.ndarray, quaternion: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """[4, 4] upper triangular U0 with U0 U0' the pseudo-inertia."""
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, quaternion)
    axes = turned.reshape(3, 3)
    whole = np.zeros((4, 4))
    whole[:3, :3] = axes @ np.diag(0.5 * moments.sum() - moments) @ axes.T + mass * np.outer(centre, centre)
    whole[:3, 3] = whole[3, :3] = mass * centre
    whole[3, 3] = mass
    backwards = np.linalg.cholesky(whole[::-1, ::-1])  # lower triangular of the reversed matrix
    return backwards[::-1, ::-1]


def _factor(terms: Any, xp: ModuleType) -> Any:
    """[4, 4] A(z)."""
    size, x, y, z, xy, yz, xz, *shift = terms
    one, none = xp.ones_like(size), xp.zeros_like(size)
    rows = [
        [xp.exp(x), xy, xz, shift[0]],
        [none, xp.exp(y), yz, shift[1]],
        [none, none, xp.exp(z), shift[2]],
        [none, none, none, one],
    ]
    return xp.exp(size) * xp.stack([xp.stack(row) for row in rows])


def _quaternion(axes: Any, xp: ModuleType) -> Any:
    """[4] unit quaternion of a rotation [3, 3], from the largest of four ways to work it out."""
    ((a, b, c), (d, e, f), (g, h, i)) = axes
    ways = xp.stack([
        xp.stack([1 + a + e + i, h - f, c - g, d - b]),
        xp.stack([h - f, 1 + a - e - i, b + d, c + g]),
        xp.stack([c - g, b + d, 1 - a + e - i, f + h]),
        xp.stack([d - b, c + g, f + h, 1 - a - e + i]),
    ])  # fmt: skip
    best = ways[xp.argmax(xp.diagonal(ways))]
    return best / xp.linalg.norm(best) * xp.where(best[0] < 0, -1.0, 1.0)
