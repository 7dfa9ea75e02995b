"""Figures of the fitted parameters: what is known about each, and which cannot be told apart."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib.lines
import numpy as np
from matplotlib.figure import Figure

from droid_jax.report.style import AFTER, BEFORE, MUTED, TRUTH, WIDE, styled
from droid_jax.report.words import label


@styled
def intervals(parameters: Sequence[Mapping[str, Any]], width: float = WIDE) -> Figure:
    """Every parameter's 90 % interval in units of its initial deviation, 0 being its initial mean.

    parameters: entries of fit.json; a known truth is a green diamond, a parameter that the
    demonstration does not tell is grey, one on a bound carries a square.
    """
    n = len(parameters)
    figure = Figure(figsize=(width, 0.9 + 0.27 * n), layout="constrained")
    axes = figure.add_subplot()
    axes.axvline(0, color=BEFORE, linewidth=1, linestyle=(0, (4, 1.5)))
    reach = 3.0
    for y, p in enumerate(parameters):
        at = _prior_units(p)
        low, high = (at(v) for v in p["interval"])
        assumed = [at(v) for v in p["initial_interval"]] if "initial_interval" in p else [-1.645, 1.645]
        axes.plot(assumed, [y, y], color=BEFORE, linewidth=8, alpha=0.25, solid_capstyle="butt")
        colour = AFTER if p["identifiable"] else MUTED
        axes.plot([low, high], [y, y], color=colour, linewidth=3.2, alpha=0.55, solid_capstyle="butt")
        axes.plot(at(p["mean"]), y, "s" if p["on_bound"] else "o", color=colour, markersize=5)
        if p["truth"] is not None:
            axes.plot(at(p["truth"]), y, "D", markersize=5.5, color=TRUTH, markerfacecolor="none")
        marks = [*assumed, low, high, at(p["mean"]), *([] if p["truth"] is None else [at(p["truth"])])]
        reach = max(reach, *(abs(m) for m in marks if math.isfinite(m)))
    if reach > 12:
        axes.set_xscale("symlog", linthresh=3)
    axes.set(xlim=(-1.12 * reach, 1.12 * reach), ylim=(n - 0.4, -0.6))
    axes.set_yticks(range(n), [label(p["name"]) for p in parameters])
    axes.set_xlabel("Initial deviations from the initial mean")
    axes.grid(axis="y", visible=False)
    _interval_legend(figure, parameters, width)
    return figure


@styled
def correlation_map(names: Sequence[str], correlation: np.ndarray, width: float = WIDE) -> Figure:
    """Correlation [D, D] of the fitted parameters, from -1 to 1; numbers are written where they fit."""
    n = len(names)
    roomy = width > 6
    side = min(width, 2.4 + 0.36 * n) if roomy else width
    figure = Figure(figsize=(side + (0.6 if roomy else 0), side), layout="constrained")
    # A vector file's text is some points wider than the layout's measure: without more room labels are cut.
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)  # type: ignore[union-attr]  # named one line above
    axes = figure.add_subplot()
    values = np.ma.masked_invalid(np.asarray(correlation, dtype=float))
    mesh = axes.pcolormesh(values, cmap="PuOr_r", vmin=-1, vmax=1, edgecolors="white", linewidth=0.5, antialiased=True)
    text = 7.5 if roomy else 6.5
    if n <= (16 if roomy else 8):
        for i, j in np.ndindex(n, n):
            if i != j and abs(values[i, j]) >= 0.1:
                light = abs(values[i, j]) < 0.62
                colour = "#111111" if light else "white"
                axes.text(
                    j + 0.5,
                    i + 0.5,
                    f"{values[i, j]:.1f}",
                    ha="center",
                    va="center",
                    fontsize=text - 0.5,
                    color=colour,
                )
    ticks = np.arange(n) + 0.5
    names = [label(str(m)) for m in names]
    axes.set_xticks(ticks, names, rotation=60, ha="right", rotation_mode="anchor", fontsize=text)
    axes.set_yticks(ticks, names, fontsize=text)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set(aspect="equal", anchor="NW", ylim=(n, 0))
    bar = figure.colorbar(mesh, ax=axes, shrink=0.7, aspect=30, location="right" if roomy else "top")
    bar.set_ticks([-1, -0.5, 0, 0.5, 1])
    bar.set_label("Correlation [–]")
    bar.outline.set_visible(False)  # type: ignore[operator]  # an Artist, typed as a method
    return figure


def _prior_units(p: Mapping[str, Any]) -> Callable[[float], float]:
    return lambda value: (value - p["initial_mean"]) / p["initial_std"]


def _interval_legend(figure: Figure, parameters: Sequence[Mapping[str, Any]], width: float) -> None:
    """The forest plot's legend: only what the drawing holds."""
    entries = [("initial 90 %", {"color": BEFORE, "alpha": 0.25, "linewidth": 8})]
    bar = {"linewidth": 3.2, "marker": "o", "markersize": 5}
    if any(p["identifiable"] for p in parameters):
        entries.append(("fitted, 90 % interval", {"color": AFTER, **bar}))
    if any(not p["identifiable"] for p in parameters):
        judged = not all(p["reason"].startswith("not judged") for p in parameters)
        entries.append(("not told by this demonstration" if judged else "fitted, not judged", {"color": MUTED, **bar}))
    if any(p["on_bound"] for p in parameters):
        entries.append(("on a bound", {"color": AFTER, "marker": "s", "linestyle": "none", "markersize": 5}))
    if any(p["truth"] is not None for p in parameters):
        diamond = {"marker": "D", "linestyle": "none", "markersize": 5.5, "markerfacecolor": "none"}
        entries.append(("truth", {"color": TRUTH, **diamond}))
    handles = [matplotlib.lines.Line2D([], [], **style) for _, style in entries]
    figure.legend(handles, [n for n, _ in entries], loc="outside upper left", ncols=5 if width > 6 else 1, fontsize=8)
