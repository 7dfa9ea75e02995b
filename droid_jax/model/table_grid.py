"""Tables of a function of a few variables: adaptive nodes, and the error of linear interpolation between them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

Function = Callable[[np.ndarray], np.ndarray]  # [K, axes] -> [K]
FINE, COARSE = 1e-3, 5e-3  # relative interpolation error between nodes of variables, and of parameters
LEAST_VALUE = 0.02  # of the largest value, least value to which an error is relative
ROUNDING = 1e-5  # N m, rounding of a friction in float32
# Most nodes of a single variable, of one of several variables, and of a parameter.
MOST_SINGLE, MOST_OF_SEVERAL, MOST_SHAPES = 2500, 300, 17
WITHIN = (0.5, 0.3)  # shares of the way between nodes at which errors are tested; a ripple may vanish in the middle


@dataclass(frozen=True)
class GridAxis:
    """An axis of a table: a variable or a parameter; nodes [N] are ascending and contain the fitted value."""

    name: str
    unit: str
    nodes: np.ndarray


def first_nodes(low: float, high: float) -> np.ndarray:
    """Evenly spaced nodes, and denser ones about zero, where laws have corners."""
    distances = np.geomspace(1e-5, 1.0, 16) * max(abs(low), abs(high))
    dense = np.concatenate([-distances, [0.0], distances])
    return np.unique(np.concatenate([np.linspace(low, high, 33), dense[(dense > low) & (dense < high)]]))


def refined(axes: Sequence[GridAxis], functions: Sequence[Function], fitted: Sequence[float]) -> list[GridAxis]:
    """Axes with nodes inserted where linear interpolation of one of the functions is too inaccurate.

    fitted: values of the parameters, which are the first axes.  Variables are refined at these values.
    """
    out, shapes = list(axes), len(fitted)
    variable = MOST_SINGLE if len(axes) - shapes == 1 else MOST_OF_SEVERAL
    for k in (*range(shapes, len(axes)), *range(shapes)):
        most, slack = (MOST_SHAPES, COARSE) if k < shapes else (variable, FINE)
        others = [
            np.array([fitted[i]]) if i < shapes <= k else axis.nodes[:: max(1, len(axis.nodes) // 30)]
            for i, axis in enumerate(out)
            if i != k
        ]
        rows = np.array(list(itertools.product(*others))) if others else np.zeros((1, 0))

        def along(x: np.ndarray, k: int = k, rows: np.ndarray = rows) -> np.ndarray:  # [N] -> [N, functions * rows]
            grid = np.insert(np.tile(rows, (len(x), 1)), k, np.repeat(x, len(rows)), axis=1)
            return np.concatenate([f(grid).reshape(len(x), -1) for f in functions], axis=1)

        out[k] = GridAxis(out[k].name, out[k].unit, _split(out[k].nodes, along, most, slack))
    return out


def _split(nodes: np.ndarray, along: Function, most: int, slack: float) -> np.ndarray:
    """Insert nodes in the middle of cells until the relative interpolation error is at most `slack`."""
    largest = float(np.abs(along(nodes)).max())
    while 1 < len(nodes) < most:
        at, error = along(nodes), np.zeros(len(nodes) - 1)  # error: of each cell, 1 is allowed
        for share in WITHIN:
            exact = along((1.0 - share) * nodes[:-1] + share * nodes[1:])
            allowed = slack * (np.abs(exact) + LEAST_VALUE * largest) + ROUNDING
            line = (1.0 - share) * at[:-1] + share * at[1:]
            error = np.maximum(error, (np.abs(exact - line) / allowed).max(axis=1))
        middle = 0.5 * (nodes[1:] + nodes[:-1])
        bad = np.flatnonzero((error > 1.0) & (np.diff(nodes) > 1e-7 * np.ptp(nodes)))
        if not bad.size:
            break
        worst = bad[np.argsort(error[bad])[::-1][: most - len(nodes)]]
        nodes = np.unique(np.concatenate([nodes, middle[worst]]))
    return nodes


def on_grid(axes: Sequence[GridAxis], function: Function) -> np.ndarray:
    """Values of a function at the nodes of all axes."""
    grid = np.stack(np.meshgrid(*(a.nodes for a in axes), indexing="ij"), axis=-1).reshape(-1, len(axes))
    return function(grid).reshape([len(a.nodes) for a in axes])


def differences(axes: Sequence[GridAxis], function: Function, table: np.ndarray, points: int = 4000) -> np.ndarray:
    """[points] absolute interpolation errors of a table at random points of random cells."""
    rng, x = np.random.default_rng(0), np.empty((points, len(axes)))
    for i, axis in enumerate(axes):
        cell = rng.integers(max(len(axis.nodes) - 1, 1), size=points)
        width = np.diff(axis.nodes, append=axis.nodes[-1])
        x[:, i] = axis.nodes[cell] + rng.uniform(size=points) * width[cell]
    wide = [i for i, a in enumerate(axes) if len(a.nodes) > 1]
    if not wide:
        return np.abs(function(x) - table.reshape(-1)[0])
    narrow = tuple(i for i in range(len(axes)) if i not in wide)
    inner = scipy.interpolate.RegularGridInterpolator([axes[i].nodes for i in wide], np.squeeze(table, narrow))
    return np.abs(inner(x[:, wide]) - function(x))
