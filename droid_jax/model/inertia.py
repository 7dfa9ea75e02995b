"""Physical consistency of inertias: a check of separate moments, and a parameterisation that is always consistent.

The largest principal moment of a body is at most the sum of the others (C <= A + B).  Parameters that are single
moments can violate this.  The replay of such a vector counts as not finite in a search, and a draw of a distribution is
repeated.  The parameterisation of a whole inertia by ten parameters cannot violate it.

A body's mass, centre of mass and moments form its pseudo-inertia, a symmetric matrix [4, 4]:

    J = [[S, h], [h', m]]      S = sum of mass times position position',  h = mass times centre

The numbers are physically consistent if and only if J is positive definite.  With the scene's J = U0 U0' (U0 upper
triangular), ten numbers z give another one, J(z) = U0 A(z) A(z)' U0', where A is upper triangular too:

    A = e^mass [[e^stretch_x, shear_xy,    shear_xz,    shift_x],
                [0,           e^stretch_y, shear_yz,    shift_y],
                [0,           0,           e^stretch_z, shift_z],
                [0,           0,           0,           1      ]]

z = 0 is the scene's body.  A shift of 1 moves the centre of mass by about a radius of gyration; mass 0.05 is 10 %
heavier.  Parameters write the numbers to a field `body_pseudo_inertia` [nbody, 10], which no MuJoCo model has.
Applying values converts it to mass, centre of mass, orientation and moments (`inertial_fields`).

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

ROUNDING = 1e-5  # of the largest moment, by which rounding to single precision may violate the inequality
PSEUDO_INERTIA = "body_pseudo_inertia"
TERMS = (
    *("mass", "stretch_x", "stretch_y", "stretch_z", "shear_xy", "shear_yz", "shear_xz"),
    *("shift_x", "shift_y", "shift_z"),
)
WEIGHTS = ("body_mass", "body_ipos", "body_iquat", "body_inertia")  # MuJoCo's fields of an inertia
FLAT = 1e-6  # least squared extent of a body along an axis, as a share of the largest


# ----- moments one by one


def free_inertias(space: Space) -> dict[int, list[tuple[int, Write]]]:
    """Body -> (column of the vector, write) of its moments, for bodies whose moments do not scale by one factor."""
    writes = dict[int, list[tuple[int, Write]]]()
    for column, parameter in enumerate(space.parameters):
        for write in parameter.writes:
            if write.field == "body_inertia":
                writes.setdefault(write.index[0], []).append((column, write))
    together = {body: {column for column, _ in of} for body, of in writes.items()}
    return {body: of for body, of in writes.items() if any(_alone(of, column) for column in together[body])}


def inertia_possible(scene: Scene, space: Space, values: Any) -> Any:
    """[...] bool, whether all inertias are physically consistent for values [..., D], numpy or jax."""
    possible = None
    for body, writes in free_inertias(space).items():
        first, second, third = _moments(scene, body, writes, lambda column: values[..., column])
        total = first + second + third
        of_body = (2 * first <= total * (1 + ROUNDING)) & (2 * second <= total * (1 + ROUNDING))
        of_body = of_body & (2 * third <= total * (1 + ROUNDING)) & (first > 0) & (second > 0) & (third > 0)
        possible = of_body if possible is None else possible & of_body
    return np.ones(np.shape(values)[:-1], bool) if possible is None else possible


def check_inertia(scene: Scene, space: Space) -> None:
    """Warn if the bounds allow an inertia that no body can have; raise ValueError if the initial means are one.

    The message names the body, its parameters and the moments.
    """
    for body, writes in free_inertias(space).items():
        names = ", ".join(dict.fromkeys(space.parameters[column].name for column, _ in writes))
        label = f"body {scene.model.body(body).name!r} of scene {scene.name!r}"
        means = _moments(scene, body, writes, lambda column: space.mean[column])
        if not bool(inertia_possible(scene, _only(space, writes), np.array([space.mean[c] for c in _columns(writes)]))):
            raise ValueError(
                f"the initial means of {names} give {label} the principal moments {_listed(means)} kg m2, of which the "
                "largest is above the sum of the others: no body has that inertia"
            )
        worst = _worst(scene, body, writes, space)
        if worst is not None:
            warnings.warn(
                f"the bounds of {names} allow moments that {label} cannot have ({_listed(worst)} kg m2: the largest is "
                "above the sum of the others); searches and draws leave such values out: narrow the bounds, or vary "
                "the mass only (body_mass, which scales the inertia)",
                stacklevel=3,
            )


def possible_draws(
    scene: Scene, space: Space, draw: Callable[[int], np.ndarray], n: int, rounds: int = 100
) -> np.ndarray:
    """[n, D] draws; those with an inertia that no body can have are repeated.

    Args:
        scene: of the parameters.
        space: meaning of a row.
        draw: k -> [k, D] new draws.
        n: number of draws.
        rounds: most repetitions.

    Raises:
        ValueError: some draws are still inconsistent after that.
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
    """Whether a parameter changes a body's moments in another way than all three by one factor."""
    of_column = [write for c, write in writes if c == column]
    rules = {(w.mode, w.gain, w.offset) for w in of_column}
    return len(of_column) != 3 or len(rules) != 1 or of_column[0].mode.value not in ("scale", "divide")


def _moments(scene: Scene, body: int, writes: list[tuple[int, Write]], value: Callable[[int], Any]) -> list[Any]:
    """The three principal moments, kg m2, after the writes in their order."""
    moments: list[Any] = [float(m) for m in scene.model.body_inertia[body]]
    for column, write in writes:
        moments[write.index[1]] = write.new(moments[write.index[1]], value(column))
    return moments


def _columns(writes: list[tuple[int, Write]]) -> list[int]:
    return list(dict.fromkeys(column for column, _ in writes))


def _only(space: Space, writes: list[tuple[int, Write]]) -> Space:
    return Space(tuple(space.parameters[column] for column in _columns(writes)))


def _worst(scene: Scene, body: int, writes: list[tuple[int, Write]], space: Space) -> list[float] | None:
    """The moments at the corner of the bounds that violates the inequality the most; None if no corner does.

    Each moment is monotonic in each of its parameters, so the extremes are at corners.
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


def _listed(moments: list[Any]) -> str:
    return ", ".join(f"{float(m):.3g}" for m in moments)


# ----- the whole inertia


def inertia_parameters(
    scene: Scene, body: str, *, std: float = 0.1, high: float = 1.0, **options: Any
) -> tuple[Parameter, ...]:
    """The ten parameters of a body's inertia, `inertia_mass[BODY]` and so on, 0 at nominal.

    Args:
        scene: with the body.
        body: its name.
        std: prior deviation of each.
        high: bound of each, to both sides.
        options: further fields of `Parameter`.

    Returns:
        The parameters, in the order of `TERMS`.

    Raises:
        ValueError: there is no such body, or it has no mass, or no extent along an axis (a point, a rod, a plate).
    """
    row = scene.id("body", body)
    check_solid(scene.model, row)
    given = {"group": "Inertia", "unit": "-", "mean": 0.0, "low": -high, "high": high, **options}
    return tuple(
        Parameter(f"inertia_{term}[{body}]", std=std, writes=(Write(PSEUDO_INERTIA, (row, k), element=body),), **given)
        for k, term in enumerate(TERMS)
    )


def check_solid(model: mujoco.MjModel, body: int) -> None:
    """Raise ValueError for a body whose pseudo-inertia is not positive definite."""
    moments = model.body_inertia[body]
    extents = 0.5 * moments.sum() - moments
    if model.body_mass[body] <= 0 or extents.min() <= FLAT * max(extents.max(), 1e-300):
        raise ValueError(
            f"body {model.body(body).name!r} has mass {model.body_mass[body]:.3g} kg and moments "
            f"{', '.join(f'{m:.3g}' for m in moments)} kg m2, those of a point, a rod or a plate: its whole inertia "
            "cannot be a parameter; give the body a thickness in the MJCF, or vary its mass (body_mass)"
        )


def check_single_inertia(space: Space) -> None:
    """Raise ValueError if other parameters write the inertia of a body whose whole inertia is a parameter."""
    whole = {w.index[0]: w.element for p in space.parameters for w in p.writes if w.field == PSEUDO_INERTIA}
    for p in space.parameters:
        if both := [whole[w.index[0]] for w in p.writes if w.field in WEIGHTS and w.index[0] in whole]:
            raise ValueError(
                f"parameter {p.name!r} and inertia_mass[{both[0]}] both write the inertia of body {both[0]!r}: keep one"
            )


def nominal_field(model: Any, field: str) -> Any:
    """A field of a model, of C or MJX; zeros for body_pseudo_inertia, which models do not have."""
    return np.zeros((model.nbody, len(TERMS))) if field == PSEUDO_INERTIA else getattr(model, field)


def as_written(writes: tuple[tuple[str, tuple[int, ...]], ...]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """(field, index) with body_pseudo_inertia replaced by MuJoCo's four fields of an inertia."""
    out: dict[tuple[str, tuple[int, ...]], None] = {}
    for field, index in writes:
        out.update(dict.fromkeys([(f, index[:1]) for f in WEIGHTS] if field == PSEUDO_INERTIA else [(field, index)]))
    return tuple(out)


def inertial_fields(model: mujoco.MjModel, body: int, terms: Any, xp: ModuleType = np) -> dict[str, Any]:
    """The fields `WEIGHTS` of a body for its ten numbers z.

    Args:
        model: with the nominal body.
        body: its id.
        terms: [10] z, numpy or jax.
        xp: numpy or jax.numpy.

    Returns:
        Field -> its row: mass [] kg, centre of mass [3] m, quaternion [4], moments [3] kg m2.
    """
    root = root_of(*(np.asarray(getattr(model, f)[body], float) for f in WEIGHTS))
    scaled = xp.asarray(root, terms.dtype) @ _factor(terms, xp)
    whole = scaled @ scaled.T
    mass = whole[3, 3]
    centre = whole[:3, 3] / mass
    spread = whole[:3, :3] - mass * xp.outer(centre, centre)  # about the centre of mass
    extents, axes = xp.linalg.eigh(spread)  # ascending, so that moments descend, as MuJoCo has them
    axes = axes * xp.asarray([1.0, 1.0, xp.sign(xp.linalg.det(axes))])
    moments = xp.sum(extents) - extents
    return dict(zip(WEIGHTS, (mass, centre, _quaternion(axes, xp), moments), strict=True))


def root_of(mass: np.ndarray, centre: np.ndarray, quaternion: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """[4, 4] upper triangular U0, so that U0 U0' is the pseudo-inertia."""
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
    """[4] unit quaternion of a rotation [3, 3], by the best conditioned of four formulas."""
    ((a, b, c), (d, e, f), (g, h, i)) = axes
    ways = xp.stack([
        xp.stack([1 + a + e + i, h - f, c - g, d - b]),
        xp.stack([h - f, 1 + a - e - i, b + d, c + g]),
        xp.stack([c - g, b + d, 1 - a + e - i, f + h]),
        xp.stack([d - b, c + g, f + h, 1 - a - e + i]),
    ])  # fmt: skip
    best = ways[xp.argmax(xp.diagonal(ways))]
    return best / xp.linalg.norm(best) * xp.where(best[0] < 0, -1.0, 1.0)
