"""Inertia that no body can have: the largest of three principal moments above the sum of the others (A + B < C).

Moments that are parameters one by one can come to that.  A row of values with it is no sample of a search and no draw
of a distribution: the replay of it counts as one that gave no numbers, and draws are drawn again.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from droid_jax.model.parameters import Space, Write
from droid_jax.model.scene import Scene

ROUNDING = 1e-5  # of the largest moment, by which single precision may miss the inequality


def free_inertias(scene: Scene, space: Space) -> dict[int, list[tuple[int, Write]]]:
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
    for body, writes in free_inertias(scene, space).items():
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
    for body, writes in free_inertias(scene, space).items():
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
