"""Figures of torques over time for the search for a missing effect: each joint's overlay and what is left."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from droid_jax.report.gap_figures import as_floats
from droid_jax.report.gap_maps import Cell
from droid_jax.report.gap_words import OF, TIME, joint_phase, variable_words
from droid_jax.report.style import AFTER, BEFORE, LINE, MEASURED, WIDE, label_bottom, legend, panel_columns, styled
from droid_jax.report.torque_figures import fill, shade, thin, torque_grid
from droid_jax.report.words import label

POINTS = 60  # buckets of a line: fourteen panels must fit into the page as SVG
SCATTERS = 2.0  # half width of the band, in deviations of the repeats


@styled
def torque_overlays(traces: Mapping[str, Any], unit: str, extended: bool = True, width: float = WIDE) -> Figure:
    """Every joint's torque over time with, below it, measurement minus simulation.

    traces: joints [J]; time [K] s; measured, scatter, before, after [K, J] in `unit`; phases.
    extended: False where no effect entered the model: no "after".
    """
    joints, columns = traces["joints"], panel_columns(width)
    figure, upper, lower = torque_grid(len(joints), width)
    for j, joint in enumerate(joints):
        _overlay(upper[j], traces, j, extended)
        _residual(lower[j], traces, j, extended)
        for panel in (upper[j], lower[j]):
            shade(panel, traces["phases"], named=j < columns and panel is upper[j])
        upper[j].set_title(label(joint))
        upper[j].set_ylabel(f"Torque [{unit}]" if j % columns == 0 else "")
        lower[j].set_ylabel(f"Residual [{unit}]" if j % columns == 0 else "")
    upper[0].set_xlim(traces["time"][0], traces["time"][-1])
    label_bottom(lower, width, "Time [s]")
    figure.align_ylabels([axes for j in range(0, len(joints), columns) for axes in (upper[j], lower[j])])
    legend(figure, upper[0], width, columns=4)
    return figure


def _models(extended: bool) -> list[tuple[str, str, dict[str, Any]]]:
    """(key, label, look) of the simulations drawn."""
    base = ("before", "base model", {"color": BEFORE, "linestyle": (0, (4, 1.5))})
    return [base, ("after", "with what was missing", {"color": AFTER, "linewidth": 1.0})][: 2 if extended else 1]


def _overlay(axes: Axes, traces: Mapping[str, Any], j: int, extended: bool) -> None:
    time, measured, scatter = traces["time"], traces["measured"][:, j], SCATTERS * traces["scatter"][:, j]
    what = "measured, ±2 deviations of the repeats"
    repeated = fill(axes, time, measured - scatter, measured + scatter, what, POINTS)
    name = "measured, mean" if repeated else "measured"
    axes.plot(*thin(time, measured, POINTS), color=MEASURED, linewidth=2.2, label=name)
    for key, name, look in _models(extended):
        axes.plot(*thin(time, traces[key][:, j], POINTS), label=name, **look)
    axes.margins(y=0.14)  # room for the phases' names


def _residual(axes: Axes, traces: Mapping[str, Any], j: int, extended: bool) -> None:
    time, scatter = traces["time"], SCATTERS * traces["scatter"][:, j]
    fill(axes, time, -scatter, scatter, buckets=POINTS)
    axes.axhline(0.0, color=LINE, linewidth=0.8)
    for key, _, look in _models(extended):
        axes.plot(*thin(time, traces["measured"][:, j] - traces[key][:, j], POINTS), **look)


@styled
def remainder(traces: Mapping[str, Any], cells: Sequence[Cell], unit: str, width: float = WIDE) -> Figure:
    """Descriptive: what is left where most is left, over time at one joint and over the located variable.

    traces: as above, of the fitted demonstration.  cells: of the last model; see `located`.
    """
    joint, binned = located(cells, traces["joints"]), located_bins(cells)
    wide, panels = panel_columns(width) == 2, 1 if binned is None else 2
    shape = (1, panels) if wide else (panels, 1)
    figure = Figure(figsize=(width, 2.8 if wide else 2.7 * panels), layout="constrained")
    left, *right = figure.subplots(*shape, squeeze=False).ravel()
    time, j = traces["time"], traces["joints"].index(joint)
    scatter = SCATTERS * traces["scatter"][:, j]
    shade(left, traces["phases"], named=True)
    fill(left, time, -scatter, scatter, "±2 deviations of the repeats", POINTS)
    left.axhline(0.0, color=LINE, linewidth=0.8)
    left.plot(*thin(time, traces["measured"][:, j] - traces["after"][:, j]), color=AFTER, label="measured − simulated")
    left.set(title=label(joint), xlabel="Time [s]", ylabel=f"Residual [{unit}]", xlim=(time[0], time[-1]))
    left.margins(y=0.14)
    for axes in right:
        if binned is not None:
            _curve(axes, *binned)
    legend(figure, [left, *right], width, columns=4)
    return figure


def _curve(axes: Axes, name: str, edges: np.ndarray, values: np.ndarray, found: np.ndarray) -> None:
    centres = (edges[1:] + edges[:-1]) / 2
    axes.stairs(values, edges, color=AFTER, linewidth=1.2, baseline=None)
    axes.plot(centres[found], values[found], "o", color=AFTER, markersize=5, label="found by the test")
    if not found.all():
        hollow = {"color": AFTER, "markerfacecolor": "none", "markersize": 5}
        axes.plot(centres[~found], values[~found], "o", label="not told from noise", **hollow)
    title = "That joint alone" if OF in name else "All joints"
    axes.set(title=title, xlabel=name, ylabel="√U [σ]", ylim=(0, None))


def located(cells: Sequence[Cell], joints: Sequence[str]) -> str:
    """The joint of the largest cell by joint and phase that the test finds, else of the largest at all."""
    known = [c for c in cells if c["variable"] == TIME and joint_phase(c["where"])[0] in joints]
    known.sort(key=lambda c: (c["found"], float("-inf") if c["discrepancy"] is None else c["discrepancy"]))
    return joint_phase(known[-1]["where"])[0] if known else joints[0]


def located_bins(cells: Sequence[Cell]) -> tuple[str, np.ndarray, np.ndarray, np.ndarray] | None:
    """The variable with bins that holds the largest found cell: name and unit, edges [B + 1], √U and found [B]."""
    found = [c for c in cells if c["found"] and c["discrepancy"] is not None and _span(c)]
    if not found:
        return None
    variable = max(found, key=lambda c: c["discrepancy"])["variable"]
    mine = [(span, c) for c in cells if c["variable"] == variable and (span := _span(c))]
    edges = np.array([float(mine[0][0][1]), *(float(span[2]) for span, _ in mine)])
    values = np.sqrt(np.maximum(as_floats([c["discrepancy"] for _, c in mine]), 0.0))
    return f"{variable_words(variable)} [{mine[0][0][3]}]", edges, values, np.array([c["found"] for _, c in mine])


def _span(cell: Cell) -> re.Match[str] | None:
    return re.fullmatch(r"(-?[\d.]+) to (-?[\d.]+) (.+)", cell["where"])
