"""Figures of where the gap lives: by joint and phase of the motion, and over the door's state."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from droid_jax.report.gap_figures import LOGARITHMIC, U_LABEL, as_floats, scale
from droid_jax.report.gap_words import TIME, joint_phase, span_words, variable_words
from droid_jax.report.style import AFTER, BEFORE, LINE, MUTED, WIDE, panel_columns, panel_grid, styled
from droid_jax.report.words import label, number

Cell = Mapping[str, Any]
DIRECTION, POSITION, LOAD = "direction of ", "position of ", "load of "  # a joint
_BLANK: dict[str, Any] = {"facecolor": "none", "edgecolor": LINE, "hatch": "////", "linewidth": 0}


@styled
def cell_maps(before: Sequence[Cell], after: Sequence[Cell] | None, width: float = WIDE) -> Figure:
    """U by joint (down) and phase (across), base model and extended model on one colour scale.

    before, after: cells of gap.json, `after` None where no effect entered the model.  A cell that the
    test does not find is hatched and has no colour.
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
    for axes, title in zip(panels, ("Base model", "With what was missing"), strict=False):
        axes.set_title(title)
        axes.set_xticks(np.arange(len(phases)) + 0.5, ticks, fontsize=7.5, **tilt)
        axes.set_yticks(np.arange(len(joints)) + 0.5, [label(j) for j in joints])
    bar = figure.colorbar(
        images[0], ax=panels.tolist(), aspect=25, location="right" if wide else "bottom", format="{x:g}"
    )
    bar.set_label(U_LABEL)
    bar.outline.set_visible(False)  # type: ignore[operator]  # an Artist, typed as a method
    if any(np.isnan(table).any() for table in tables):
        figure.legend(handles=[Patch(**_BLANK, label="not told from noise")], loc="outside upper left")
    return figure


def _phase_label(name: str, start: str, between: str) -> str:
    return "whole motion" if name == "all" else f"{name}{between}{start} s"


def joints_and_phases(cells: Sequence[Cell]) -> tuple[list[str], list[tuple[str, str]]]:
    """Joints [J], and phases [F] as (name, start in s), in the order of the cells."""
    places = [joint_phase(c["where"]) for c in cells if c["variable"] == TIME]
    return list(dict.fromkeys(j for j, *_ in places)), list(dict.fromkeys((name, start) for _, name, start in places))


def cell_table(cells: Sequence[Cell], joints: Sequence[str], phases: Sequence[tuple[str, str]]) -> np.ndarray:
    """U [J, F], NaN where the test finds nothing."""
    found = {joint_phase(c["where"]): c["discrepancy"] for c in cells if c["variable"] == TIME and c["found"]}
    return as_floats([[found.get((joint, *phase)) for phase in phases] for joint in joints])


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
        axes.text(f + 0.5, j + 0.5, number(float(values[j, f]), 2), ha="center", va="center", fontsize=7.5, color=ink)
    axes.set_ylim(len(values), 0)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return image


@dataclass(frozen=True)
class Bins:
    """Cells of one variable as bars: its name with a unit, a label and U of each bin, and whether it is found."""

    name: str
    labels: tuple[str, ...]
    gaps: np.ndarray
    found: np.ndarray


def state_bins(cells: Sequence[Cell], joints: Sequence[str] = ()) -> list[Bins]:
    """The variables that are not joint by phase, in order; both directions of all joints are one variable.

    joints: whose position and load are shown.
    """
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        name = cell["variable"]
        of = next((name.removeprefix(what) for what in (POSITION, LOAD) if name.startswith(what)), None)
        if name != TIME and (of is None or of in joints):
            groups.setdefault(DIRECTION if name.startswith(DIRECTION) else name, []).append(cell)
    return [_bins(name, group) for name, group in groups.items()]


def most_at(cells: Sequence[Cell]) -> str:
    """The joint at whose position most is found; empty where there is none."""
    known = [c for c in cells if c["variable"].startswith(POSITION) and c["discrepancy"] is not None]
    known.sort(key=lambda c: (c["found"], c["discrepancy"]))
    return known[-1]["variable"].removeprefix(POSITION) if known else ""


def _bins(name: str, cells: Sequence[Cell]) -> Bins:
    gaps, found = as_floats([c["discrepancy"] for c in cells]), np.array([c["found"] for c in cells])
    if name == DIRECTION:
        signs = {"forward": "+", "back": "−"}
        joints = [label(c["variable"].removeprefix(DIRECTION)).removeprefix("Joint ") for c in cells]
        labels = [f"{j}\n{signs.get(c['where'], c['where'])}" for j, c in zip(joints, cells, strict=True)]
        return Bins("Joint, moving forward (+) and back (−)", tuple(labels), gaps, found)
    spans = [re.fullmatch(r"(\S+) to (\S+)(?: (.+))?", span_words(c["where"])) for c in cells]
    labels = [f"{s[1]} to\n{s[2]}" if s else c["where"] for s, c in zip(spans, cells, strict=True)]
    unit = next((f" [{s[3]}]" for s in spans if s and s[3]), "")
    return Bins(variable_words(name, cells[0]["where"]) + unit, tuple(labels), gaps, found)


@styled
def state_bars(before: Sequence[Cell], after: Sequence[Cell] | None, width: float = WIDE) -> Figure:
    """U over the door's angle, direction and speed, each joint's direction, and position and load of the joint where
    the base model leaves most; one panel each, one scale.

    before, after: cells of gap.json, `after` None where no effect entered the model.  A bin that the
    test does not find is hatched.
    """
    joints = (most_at(before),)
    models = [state_bins(cells, joints) for cells in (before, after) if cells is not None]
    figure, panels = panel_grid(len(models[0]), width, height=1.9, sharex=False)
    everything = np.concatenate([b.gaps[b.found] for bins in models for b in bins])
    step, size = (0.4, 0.36) if len(models) == 2 else (0.0, 0.5)
    for i, (bins, colour) in enumerate(zip(models, (BEFORE, AFTER), strict=False)):
        for axes, one in zip(panels, bins, strict=True):
            x = np.arange(len(one.labels)) + (i - 0.5) * step
            _bars(axes, x, one, size, colour)
    for k, (axes, one) in enumerate(zip(panels, models[0], strict=True)):
        scale(axes, everything.tolist())
        axes.set_xticks(range(len(one.labels)), one.labels, fontsize=7.5)
        axes.set_xlabel(one.name)
        axes.set_ylabel(U_LABEL if k % panel_columns(width) == 0 else "")
        axes.grid(axis="x", visible=False)
    names = ("base model", "with what was missing")
    looks = [Patch(color=c, label=n) for n, c in zip(names[: len(models)], (BEFORE, AFTER), strict=False)]
    if not all(b.found.all() for bins in models for b in bins):
        looks.append(Patch(facecolor="none", edgecolor=MUTED, hatch="////", linewidth=0.6, label="not told from noise"))
    figure.legend(handles=looks, loc="outside upper left", ncols=3 if width > 6 else 1)
    return figure


def _bars(axes: Axes, x: np.ndarray, bins: Bins, size: float, colour: str) -> None:
    heights = np.nan_to_num(np.maximum(bins.gaps, 0.0))
    axes.bar(x[bins.found], heights[bins.found], size, color=colour)
    hidden = ~bins.found
    axes.bar(x[hidden], heights[hidden], size, facecolor="none", edgecolor=colour, hatch="////", linewidth=0.6)
