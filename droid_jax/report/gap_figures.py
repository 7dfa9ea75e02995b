"""Figures of how large the gap is, before and after, and of what the missing effect had done to the base parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from droid_jax.report.gap_words import deviations, largest_shifts, quantity
from droid_jax.report.style import AFTER, BEFORE, MEASURED, MUTED, WIDE, legend, panel_columns, styled
from droid_jax.report.words import label, number

LOGARITHMIC = 20.0  # ratio of largest to smallest from which an axis is logarithmic
MOST_SHIFTS = 14
U_LABEL = "Gap U [σ²]"  # σ: deviation of one repeat's noise


@styled
def gap_bars(
    names: Sequence[str],
    gaps: Sequence[Mapping[str, Any]],
    floor: float | None,
    unit: str,
    extended: bool = True,
    width: float = WIDE,
) -> Figure:
    """U and torque distance of each recording, before and after.

    names: [G]; gaps: [G] with before, after (dimensionless), torque_before, torque_after in `unit`.
    floor: U0 or None, a dashed line.  extended: False where no effect entered the model: no "after".
    """
    wide = panel_columns(width) == 2
    figure = Figure(figsize=(width, 3.0 if wide else 5.2), layout="constrained")
    left, right = figure.subplots(1, 2) if wide else figure.subplots(2, 1)
    _pairs(left, names, [[g["before"] for g in gaps], [g["after"] for g in gaps]], extended, floor)
    _pairs(right, names, [[g["torque_before"] for g in gaps], [g["torque_after"] for g in gaps]], extended)
    left.set_ylabel(U_LABEL)
    right.set_ylabel(f"Torque distance [{unit}]")
    legend(figure, left, width, columns=3)
    return figure


def _pairs(
    axes: Axes,
    names: Sequence[str],
    values: Sequence[Sequence[float | None]],
    extended: bool,
    floor: float | None = None,
) -> None:
    """Bars side by side, their numbers above them; a value at or below zero has its number at the bottom."""
    table = as_floats(values)[: 2 if extended else 1]
    scale(axes, table.ravel().tolist() + ([] if floor is None else [floor]))
    looks = (("base model", BEFORE), ("with what was missing", AFTER))
    step, size = (0.4, 0.36) if extended else (0.0, 0.5)
    for i, (row, (name, colour)) in enumerate(zip(table, looks, strict=False)):
        x = np.arange(len(names)) + (i - 0.5) * step
        axes.bar(x, np.nan_to_num(row), size, color=colour, label=name)
        for at, value in zip(x, row, strict=True):
            foot = max(value, axes.get_ylim()[0]) if np.isfinite(value) else axes.get_ylim()[0]
            axes.annotate(
                number(value), (at, foot), (0, 2), textcoords="offset points", ha="center", va="bottom", fontsize=7.5
            )
    if floor is not None:
        text = f"numerical floor {number(floor)}"
        axes.axhline(floor, color=MEASURED, linestyle=(0, (3, 2)), linewidth=1.1, label=text)
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
def base_shifts(shifts: Sequence[Mapping[str, Any]], width: float = WIDE) -> Figure:
    """Where the base parameters went, in units of what their posterior deviation was before.

    shifts: name, unit, before, after, deviation_before; the MOST_SHIFTS largest are drawn.
    """
    drawn = largest_shifts(shifts)[:MOST_SHIFTS]
    figure = Figure(figsize=(width, max(1.6, 0.8 + 0.38 * len(drawn))), layout="constrained")
    axes = figure.add_subplot()
    axes.axvspan(-1.645, 1.645, color=BEFORE, alpha=0.13, linewidth=0, label="90 % interval of the base model")
    axes.axvline(0, color=BEFORE, linewidth=1, linestyle=(0, (4, 1.5)), label="base model")
    for y, shift in enumerate(drawn):
        at = deviations(shift)
        axes.plot([0, at], [y, y], color=MUTED, linewidth=1.2, zorder=1)
        axes.plot(at, y, "o", color=AFTER, markersize=6, label="with what was missing", zorder=2)
    reach = max(3.0, *(abs(deviations(s)) for s in drawn))
    if reach > 30:
        axes.set_xscale("symlog", linthresh=10)
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}".replace("-", "−"))
        reach *= 1.5
    axes.set(xlim=(-1.12 * reach, 1.12 * reach), ylim=(len(drawn) - 0.4, -0.6))
    axes.set_yticks(range(len(drawn)), [_shift_label(s) for s in drawn])
    axes.set_xlabel("Shift [posterior deviations before]")
    axes.grid(axis="y", visible=False)
    legend(figure, axes, width, columns=3)
    return figure


def _shift_label(shift: Mapping[str, Any]) -> str:
    return f"{label(shift['name'])}\n{number(shift['before'])} → {quantity(shift['after'], shift['unit'])}"
