"""A function of a few variables as a table: where its nodes lie, and how far straight lines between them miss it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

Function = Callable[[np.ndarray], np.ndarray]  # [K, axes] -> [K]
FINE, COARSE = 1e-3, 5e-3  # of the function: error between nodes of variables, and of parameters
SMALL = 0.02  # of its largest value: what is smaller counts as this
ROUNDING = 1e-5  # what float32 leaves of a friction
MOST, MOST_BESIDE, MOST_SHAPES = 2500, 300, 17  # nodes of a variable, of one beside another, of a parameter
WITHIN = (0.5, 0.3)  # of the way to the next node, where lines are compared: the middle alone may be a ripple's zero


@dataclass(frozen=True)
class GridAxis:
    """nodes: [N] ascending, of a variable, or of a parameter whose fitted value is among them."""

    name: str
    unit: str
    nodes: np.ndarray


def first_nodes(low: float, high: float) -> np.ndarray:
    """Even ones, and closer ones about zero, where laws have their corners."""
    near = np.geomspace(1e-5, 1.0, 16) * max(abs(low), abs(high))
    close = np.concatenate([-near, [0.0], near])
    return np.unique(np.concatenate([np.linspace(low, high, 33), close[(close > low) & (close < high)]]))


def refined(axes: Sequence[GridAxis], functions: Sequence[Function], fitted: Sequence[float]) -> list[GridAxis]:
    """Axes with nodes put in where straight lines between them miss one of the functions.

    fitted: values of the parameters, which are the first axes; variables are refined at these.
    """
    out, shapes = list(axes), len(fitted)
    variable = MOST if len(axes) - shapes == 1 else MOST_BESIDE
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
    """Nodes and middles between them, until no line misses by more than a share of what is there."""
    largest = float(np.abs(along(nodes)).max())
    while 1 < len(nodes) < most:
        at, missed = along(nodes), np.zeros(len(nodes) - 1)
        for share in WITHIN:
            there = along((1.0 - share) * nodes[:-1] + share * nodes[1:])
            allowed = slack * (np.abs(there) + SMALL * largest) + ROUNDING
            line = (1.0 - share) * at[:-1] + share * at[1:]
            missed = np.maximum(missed, (np.abs(there - line) / allowed).max(axis=1))
        middle = 0.5 * (nodes[1:] + nodes[:-1])
        bad = np.flatnonzero((missed > 1.0) & (np.diff(nodes) > 1e-7 * np.ptp(nodes)))
        if not bad.size:
            break
        worst = bad[np.argsort(missed[bad])[::-1][: most - len(nodes)]]
        nodes = np.unique(np.concatenate([nodes, middle[worst]]))
    return nodes


def on_grid(axes: Sequence[GridAxis], function: Function) -> np.ndarray:
    """A function on the nodes of all axes."""
    grid = np.stack(np.meshgrid(*(a.nodes for a in axes), indexing="ij"), axis=-1).reshape(-1, len(axes))
    return function(grid).reshape([len(a.nodes) for a in axes])


def differences(axes: Sequence[GridAxis], function: Function, table: np.ndarray, points: int = 4000) -> np.ndarray:
    """[points] difference between a table and its function, at points in random cells."""
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
