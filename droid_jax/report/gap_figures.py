"""Figures of a search for a missing effect: how large the discrepancy is, where it is, and how the base model moved.

U is the noise-corrected discrepancy in units of sigma^2, sigma being the deviation of one repeat's noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from droid_jax.report.gap_folder import CellEntry, Discrepancy, Shift, largest_shifts
from droid_jax.report.style import (
    AFTER,
    BEFORE,
    LINE,
    MEASURED,
    MUTED,
    WIDE,
    legend,
    panel_columns,
    panel_grid,
    styled,
)
from droid_jax.report.text import label, quantity, significant
from droid_jax.report.torque_figures import residuals, shade, torque_traces

LOGARITHMIC = 20.0  # ratio of the largest to the smallest value above which an axis is logarithmic
MOST_SHIFTS = 14
U_LABEL = "Discrepancy U [σ²]"
MODELS = ("base model", "final model")
BAND_WIDTH = 2.0  # half width of the band, in deviations of the repeats
POINTS = 60  # buckets of a line; so few because fourteen panels must fit into the page as SVG
SMALL_ERROR = 0.01  # share of the smallest bar below which the discretisation error is not drawn
BAND = "±2 deviations of the repeats"
_BLANK: dict[str, Any] = {"facecolor": "none", "edgecolor": LINE, "hatch": "////", "linewidth": 0}


@styled
def discrepancy_bars(
    names: Sequence[str],
    sizes: Sequence[Discrepancy],
    error: float | None,
    distance: tuple[str, str] = ("Torque distance", "N m"),
    extended: bool = True,
    width: float = WIDE,
) -> Figure:
    """U and the distance of equation 1 of each recording, before and after.

    names, sizes: [G].  error: the discretisation error U0 or None, a dashed line.  distance: its name and unit.
    extended: False where no effect entered the model: no "after".
    """
    wide = panel_columns(width) == 2
    figure = Figure(figsize=(width, 3.0 if wide else 5.2), layout="constrained")
    left, right = figure.subplots(1, 2) if wide else figure.subplots(2, 1)
    _pairs(left, names, [[d.before for d in sizes], [d.after for d in sizes]], extended, error)
    _pairs(right, names, [[d.torque_before for d in sizes], [d.torque_after for d in sizes]], extended)
    left.set_ylabel(U_LABEL)
    right.set_ylabel(f"{distance[0]} [{distance[1]}]")
    legend(figure, left, width, columns=3)
    return figure


def _pairs(
    axes: Axes,
    names: Sequence[str],
    values: Sequence[Sequence[float | None]],
    extended: bool,
    error: float | None = None,
) -> None:
    """Bars side by side, their numbers above them; a value at or below zero has its number at the bottom."""
    table = as_floats(values)[: 2 if extended else 1]
    least = np.min(table[table > 0], initial=np.inf)
    tiny = error is not None and np.isfinite(least) and error < SMALL_ERROR * least
    scale(axes, table.ravel().tolist() + ([] if error is None or tiny else [error]))
    step, size = (0.4, 0.36) if extended else (0.0, 0.5)
    for i, (row, name, colour) in enumerate(zip(table, MODELS, (BEFORE, AFTER), strict=False)):
        x = np.arange(len(names)) + (i - 0.5) * step
        axes.bar(x, np.nan_to_num(row), size, color=colour, label=name)
        for at, value in zip(x, row, strict=True):
            foot = max(value, axes.get_ylim()[0]) if np.isfinite(value) else axes.get_ylim()[0]
            axes.annotate(
                significant(value),
                (at, foot),
                (0, 2),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=7.5,
            )
    if error is not None:
        below = error < axes.get_ylim()[0]
        text = f"discretisation error {significant(error)}" + (" (below the axis)" if below else "")
        axes.axhline(error, color=MEASURED, linestyle=(0, (3, 2)), linewidth=1.1, label=text)
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.grid(axis="x", visible=False)


def scale(axes: Axes, values: Sequence[float]) -> None:
    """A y axis for these values: logarithmic where they span more than LOGARITHMIC, from 0 otherwise."""
    positive = [v for v in values if np.isfinite(v) and v > 0]
    if not positive:
        axes.set_ylim(0, 1)
    elif max(positive) > LOGARITHMIC * min(positive):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(min(positive) / 2.5, max(positive) * 2.5)
    else:
        axes.set_ylim(0, 1.18 * max(positive))


def as_floats(values: Any) -> np.ndarray:
    """An array of numbers, NaN for None."""
    return np.array(values, dtype=float)


@styled
def base_shifts(shifts: Sequence[Shift], width: float = WIDE) -> Figure:
    """Where the base parameters moved, in units of their posterior deviation before; the MOST_SHIFTS largest."""
    drawn = largest_shifts(shifts)[:MOST_SHIFTS]
    figure = Figure(figsize=(width, max(1.6, 0.8 + 0.38 * len(drawn))), layout="constrained")
    axes = figure.add_subplot()
    axes.axvspan(-1.645, 1.645, color=BEFORE, alpha=0.13, linewidth=0, label="90 % interval of the base model")
    axes.axvline(0, color=BEFORE, linewidth=1, linestyle=(0, (4, 1.5)), label="base model")
    for y, shift in enumerate(drawn):
        axes.plot([0, shift.deviations], [y, y], color=MUTED, linewidth=1.2, zorder=1)
        axes.plot(shift.deviations, y, "o", color=AFTER, markersize=6, label="final model", zorder=2)
    reach = max(3.0, *(abs(s.deviations) for s in drawn))
    if reach > 30:
        axes.set_xscale("symlog", linthresh=10)
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}".replace("-", "−"))
        reach *= 1.5
    axes.set(xlim=(-1.12 * reach, 1.12 * reach), ylim=(len(drawn) - 0.4, -0.6))
    names = [f"{label(s.name)}\n{significant(s.before)} → {quantity(s.after, s.unit)}" for s in drawn]
    axes.set_yticks(range(len(drawn)), names)
    axes.set_xlabel("Shift [posterior deviations before]")
    axes.grid(axis="y", visible=False)
    legend(figure, axes, width, columns=3)
    return figure


@styled
def cell_maps(before: Sequence[CellEntry], after: Sequence[CellEntry] | None, width: float = WIDE) -> Figure:
    """U by joint (down) and phase (across), base model and final model on one colour scale.

    after: None where no effect entered the model.  A cell that is not significant is hatched and has no colour.
    """
    joints, phases = joints_and_phases(before)
    tables = [cell_table(cells, joints, phases) for cells in (before, after) if cells is not None]
    wide = panel_columns(width) == 2
    rows, columns = (1, len(tables)) if wide else (len(tables), 1)
    size = (width if columns == 2 or not wide else 0.62 * width, 1.3 + rows * (0.6 + 0.3 * len(joints)))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    norm = _colours(np.concatenate([table.ravel() for table in tables]))
    images = [_map(axes, table, norm) for axes, table in zip(panels, tables, strict=True)]
    tilt = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"} if len(phases) > 5 else {}
    ticks = [_phase_label(*phase, " " if tilt else "\n") for phase in phases]
    for axes, title in zip(panels, MODELS, strict=False):
        axes.set_title(label(title))
        axes.set_xticks(np.arange(len(phases)) + 0.5, ticks, fontsize=7.5, **tilt)
        axes.set_yticks(np.arange(len(joints)) + 0.5, [label(j) for j in joints])
    bar = figure.colorbar(
        images[0], ax=panels.tolist(), aspect=25, location="right" if wide else "bottom", format="{x:g}"
    )
    bar.set_label(U_LABEL)
    bar.outline.set_visible(False)  # type: ignore[operator]  # an Artist, typed as a method
    if any(np.isnan(table).any() for table in tables):
        figure.legend(handles=[Patch(**_BLANK, label="not significant")], loc="outside upper left")
    return figure


def _phase_label(name: str, start: float, between: str) -> str:
    return "whole motion" if name == "all" else f"{name}{between}{start:.1f} s"


def joints_and_phases(cells: Sequence[CellEntry]) -> tuple[list[str], list[tuple[str, float]]]:
    """Joints [J], and phases [F] as (name, start in s), in the order of the cells."""
    mine = [c for c in cells if c.axis == "phase"]
    return list(dict.fromkeys(c.joint or "" for c in mine)), list(dict.fromkeys(c.phase for c in mine))


def cell_table(cells: Sequence[CellEntry], joints: Sequence[str], phases: Sequence[tuple[str, float]]) -> np.ndarray:
    """U [J, F], NaN where it is not significant."""
    found = {(c.joint or "", c.phase): c.discrepancy for c in cells if c.axis == "phase" and c.found}
    return as_floats([[found.get((joint, phase)) for phase in phases] for joint in joints])


def _colours(values: np.ndarray) -> Normalize:
    found = values[np.isfinite(values) & (values > 0)]
    low, high = (float(found.min()), float(found.max())) if found.size else (0.0, 1.0)
    return LogNorm(low, high) if low > 0 and high > LOGARITHMIC * low else Normalize(0.0, high)


def _map(axes: Axes, values: np.ndarray, norm: Normalize) -> QuadMesh:
    """One map, the number of each cell written into it."""
    shown = np.ma.masked_invalid(np.maximum(values, norm.vmin or 0.0))
    image = axes.pcolormesh(shown, cmap="YlOrBr", norm=norm, edgecolors="white", linewidth=0.5, antialiased=True)
    for j, f in np.ndindex(*values.shape):
        if math.isnan(values[j, f]):
            axes.add_patch(Rectangle((f + 0.04, j + 0.04), 0.92, 0.92, **_BLANK))
            continue
        ink = "white" if norm(values[j, f]) > 0.6 else "#111111"
        axes.text(
            f + 0.5, j + 0.5, significant(float(values[j, f]), 2), ha="center", va="center", fontsize=7.5, color=ink
        )
    axes.set_ylim(len(values), 0)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return image


@dataclass(frozen=True)
class Bins:
    """Cells of one axis as bars: the axis with its unit, and of each bin its label, U and whether U is significant."""

    name: str
    labels: tuple[str, ...]
    sizes: np.ndarray
    found: np.ndarray


def state_bins(cells: Sequence[CellEntry], joints: Sequence[str] = ()) -> list[Bins]:
    """The axes that are not joint by phase, in order; the directions of all joints are one axis.

    joints: whose position and load are shown.
    """
    groups: dict[tuple[str, str | None], list[CellEntry]] = {}
    for cell in cells:
        if cell.axis != "phase" and (cell.axis not in ("position", "load") or cell.joint in joints):
            groups.setdefault((cell.axis, None if cell.axis == "direction" else cell.joint), []).append(cell)
    return [_bins(group) for group in groups.values()]


def most_at(cells: Sequence[CellEntry]) -> str:
    """The joint with the largest cell by its position; empty where there is none."""
    return (best.joint or "") if (best := largest([c for c in cells if c.axis == "position"])) else ""


def largest(cells: Sequence[CellEntry]) -> CellEntry | None:
    """The largest significant cell, else the largest of all; None where no cell has a U."""
    known = [c for c in cells if c.discrepancy is not None]
    return max(known, key=lambda c: (c.found, c.discrepancy), default=None)


def _bins(cells: Sequence[CellEntry]) -> Bins:
    sizes, found = as_floats([c.discrepancy for c in cells]), np.array([c.found for c in cells])
    if cells[0].axis == "direction":
        signs = {"forward": "+", "back": "−"}
        labels = [
            f"{label(c.joint or '').removeprefix('Joint ')}\n{signs.get(c.label or '', c.label or '')}" for c in cells
        ]
        return Bins("Joint, moving forward (+) and back (−)", tuple(labels), sizes, found)
    labels = [c.label or f"{_edge(c.low)} to\n{_edge(c.high)}" for c in cells]
    unit = f" [{cells[0].unit}]" if cells[0].unit else ""
    return Bins(cells[0].name + unit, tuple(labels), sizes, found)


def _edge(value: float | None) -> str:
    """An edge of a bin, without a sign before a zero."""
    return "–" if value is None else f"{round(value, 2) + 0.0:.2f}"


@styled
def state_bars(before: Sequence[CellEntry], after: Sequence[CellEntry] | None, width: float = WIDE) -> Figure:
    """U over the object's angle, direction and speed, each joint's direction, and position and load of the joint where
    the base model leaves most; one panel each, one scale.

    after: None where no effect entered the model.  A bin that is not significant is hatched.
    """
    joints = (most_at(before),)
    models = [state_bins(cells, joints) for cells in (before, after) if cells is not None]
    figure, panels = panel_grid(len(models[0]), width, height=1.9, sharex=False)
    everything = np.concatenate([b.sizes[b.found] for bins in models for b in bins])
    step, size = (0.4, 0.36) if len(models) == 2 else (0.0, 0.5)
    for i, (bins, colour) in enumerate(zip(models, (BEFORE, AFTER), strict=False)):
        for axes, one in zip(panels, bins, strict=True):
            _bars(axes, np.arange(len(one.labels)) + (i - 0.5) * step, one, size, colour)
    for k, (axes, one) in enumerate(zip(panels, models[0], strict=True)):
        scale(axes, everything.tolist())
        axes.set_xticks(range(len(one.labels)), one.labels, fontsize=7.5)
        axes.set_xlabel(one.name)
        axes.set_ylabel(U_LABEL if k % panel_columns(width) == 0 else "")
        axes.grid(axis="x", visible=False)
    handles = [Patch(color=c, label=n) for n, c in zip(MODELS[: len(models)], (BEFORE, AFTER), strict=False)]
    if not all(b.found.all() for bins in models for b in bins):
        handles.append(Patch(facecolor="none", edgecolor=MUTED, hatch="////", linewidth=0.6, label="not significant"))
    figure.legend(handles=handles, loc="outside upper left", ncols=3 if width > 6 else 1)
    return figure


def _bars(axes: Axes, x: np.ndarray, bins: Bins, size: float, colour: str) -> None:
    heights = np.nan_to_num(np.maximum(bins.sizes, 0.0))
    axes.bar(x[bins.found], heights[bins.found], size, color=colour)
    hidden = ~bins.found
    axes.bar(x[hidden], heights[hidden], size, facecolor="none", edgecolor=colour, hatch="////", linewidth=0.6)


def torque_overlays(
    traces: Mapping[str, Any], unit: str, extended: bool = True, quantity: str = "Torque", width: float = WIDE
) -> Figure:
    """Every joint's torque, or another quantity, over time: `torque_figures.torque_traces` of the base and the final
    model.

    traces: of `gap_folder.Gap`.  extended: False where no effect entered the model: no "after".
    """
    models: dict[str, str] = dict(zip(("before", "after")[: 1 + extended], MODELS, strict=False))
    return torque_traces(_banded(traces), traces["phases"], unit, models, BAND, POINTS, quantity, width=width)


def _banded(traces: Mapping[str, Any]) -> dict[str, Any]:
    """Traces of `gap_folder.Gap` with the repeats' band, as `torque_figures` takes them."""
    mean, half = traces["measured"], BAND_WIDTH * traces["scatter"]
    return {**traces, "measured_mean": mean, "measured_low": mean - half, "measured_high": mean + half}


@styled
def remainder(traces: Mapping[str, Any], cells: Sequence[CellEntry], unit: str, width: float = WIDE) -> Figure:
    """The remaining residual: over time at the joint of the largest cell, and over the axis of the largest bin.

    traces: of the train recording.  cells: of the final model.
    """
    joint, binned = located(cells, traces["joints"]), located_bins(cells)
    wide, panels = panel_columns(width) == 2, 1 if binned is None else 2
    shape = (1, panels) if wide else (panels, 1)
    figure = Figure(figsize=(width, 2.8 if wide else 2.7 * panels), layout="constrained")
    left, *right = figure.subplots(*shape, squeeze=False).ravel()
    time, j = traces["time"], traces["joints"].index(joint)
    keys = ("measured_mean", "measured_low", "measured_high", "after")
    shade(left, traces["phases"], named=True)
    line = {key: values[:, j] for key, values in _banded(traces).items() if key in keys}
    residuals(left, time, line, {"after": "measured − simulated"}, BAND)
    left.set(title=label(joint), xlabel="Time [s]", ylabel=f"Residual [{unit}]", xlim=(time[0], time[-1]))
    left.margins(y=0.14)
    for axes in right:
        if binned is not None:
            _curve(axes, binned)
    legend(figure, [left, *right], width, columns=4)
    return figure


def _curve(axes: Axes, cells: Sequence[CellEntry]) -> None:
    """The root of U over the bins of one axis."""
    edges = as_floats([cells[0].low, *(c.high for c in cells)])
    values = np.sqrt(np.maximum(as_floats([c.discrepancy for c in cells]), 0.0))
    found, centres = np.array([c.found for c in cells]), (edges[1:] + edges[:-1]) / 2
    axes.stairs(values, edges, color=AFTER, linewidth=1.2, baseline=None)
    axes.plot(centres[found], values[found], "o", color=AFTER, markersize=5, label="significant")
    if not found.all():
        hollow = {"color": AFTER, "markerfacecolor": "none", "markersize": 5}
        axes.plot(centres[~found], values[~found], "o", label="not significant", **hollow)
    title = "That joint alone" if cells[0].joint else "All joints"
    axes.set(title=title, xlabel=f"{cells[0].name} [{cells[0].unit}]", ylabel="√U [σ]", ylim=(0, None))


def located(cells: Sequence[CellEntry], joints: Sequence[str]) -> str:
    """The joint of the largest significant cell by joint and phase, else of the largest cell."""
    best = largest([c for c in cells if c.axis == "phase" and c.joint in joints])
    return (best.joint or joints[0]) if best else joints[0]


def located_bins(cells: Sequence[CellEntry]) -> list[CellEntry] | None:
    """The bins of the axis with the largest significant bin; None where none is significant."""
    bins = [c for c in cells if c.axis != "phase" and c.high is not None]
    best = largest([c for c in bins if c.found])
    return [c for c in bins if (c.axis, c.joint) == (best.axis, best.joint)] if best else None
