"""Figures of a fit: its parameters and their correlation, and the search that found them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.lines
import numpy as np
from matplotlib.figure import Figure

from droid_jax.report.identify_folder import CostEntry, FittedParameter
from droid_jax.report.style import (
    AFTER,
    BEFORE,
    INK,
    MEASURED,
    MUTED,
    TRUTH,
    WIDE,
    label_bottom,
    legend,
    panel_grid,
    styled,
)
from droid_jax.report.text import label


@styled
def interval_figure(parameters: Sequence[FittedParameter], width: float = WIDE) -> Figure:
    """Every parameter's 90 % interval in units of its initial deviation, 0 being its initial mean.

    A known truth is a green diamond, a parameter that is not identifiable is grey, one on a bound carries a square.
    """
    n = len(parameters)
    figure = Figure(figsize=(width, 0.9 + 0.27 * n), layout="constrained")
    axes = figure.add_subplot()
    axes.axvline(0, color=BEFORE, linewidth=1, linestyle=(0, (4, 1.5)))
    reach = 3.0
    for y, p in enumerate(parameters):
        at = p.standardised
        assumed = [at(v) for v in p.initial_interval] if p.initial_interval else [-1.645, 1.645]
        low, high = (at(v) for v in p.interval)
        axes.plot(assumed, [y, y], color=BEFORE, linewidth=8, alpha=0.25, solid_capstyle="butt")
        colour = AFTER if p.identifiable else MUTED
        axes.plot([low, high], [y, y], color=colour, linewidth=3.2, alpha=0.55, solid_capstyle="butt")
        axes.plot(at(p.mean), y, "s" if p.on_bound else "o", color=colour, markersize=5)
        if p.truth is not None:
            axes.plot(at(p.truth), y, "D", markersize=5.5, color=TRUTH, markerfacecolor="none")
        marks = [*assumed, low, high, at(p.mean), *([] if p.truth is None else [at(p.truth)])]
        reach = max(reach, *(abs(m) for m in marks if math.isfinite(m)))
    if reach > 12:
        axes.set_xscale("symlog", linthresh=3)
    axes.set(xlim=(-1.12 * reach, 1.12 * reach), ylim=(n - 0.4, -0.6))
    axes.set_yticks(range(n), [label(p.name) for p in parameters])
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


def _interval_legend(figure: Figure, parameters: Sequence[FittedParameter], width: float) -> None:
    """The forest plot's legend: only what the drawing holds."""
    entries = [("initial 90 %", {"color": BEFORE, "alpha": 0.25, "linewidth": 8})]
    bar = {"linewidth": 3.2, "marker": "o", "markersize": 5}
    if any(p.identifiable for p in parameters):
        entries.append(("fitted, 90 % interval", {"color": AFTER, **bar}))
    if any(not p.identifiable for p in parameters):
        judged = not all(p.reason.startswith("not judged") for p in parameters)
        entries.append(("not identifiable" if judged else "fitted, not judged", {"color": MUTED, **bar}))
    if any(p.on_bound for p in parameters):
        entries.append(("on a bound", {"color": AFTER, "marker": "s", "linestyle": "none", "markersize": 5}))
    if any(p.truth is not None for p in parameters):
        diamond = {"marker": "D", "linestyle": "none", "markersize": 5.5, "markerfacecolor": "none"}
        entries.append(("truth", {"color": TRUTH, **diamond}))
    handles = [matplotlib.lines.Line2D([], [], **style) for _, style in entries]
    figure.legend(handles, [n for n, _ in entries], loc="outside upper left", ncols=5 if width > 6 else 1, fontsize=8)


@styled
def parameter_history(
    history: Mapping[str, Any],
    parameters: Sequence[FittedParameter],
    names: Sequence[str] | None = None,
    width: float = WIDE,
) -> Figure:
    """Search mean and deviation of some parameters over generations, with the final fit at the right.

    history: names [D], generation [G], mean and std [G, D] in physical units.
    names: which to draw; None takes the three to six that are best identified.
    """
    of = {p.name: p for p in parameters}
    column = {str(n): i for i, n in enumerate(history["names"])}
    chosen = list(names) if names is not None else most_identifiable(parameters, column)
    generation = np.asarray(history["generation"], dtype=float)
    figure, panels = panel_grid(len(chosen), width, height=1.8)
    end = generation[-1] + 0.04 * (generation[-1] - generation[0] + 1)
    for axes, name in zip(panels, chosen, strict=True):
        p, d = of[name], column[name]
        mean, std = np.asarray(history["mean"])[:, d], np.asarray(history["std"])[:, d]
        axes.fill_between(generation, mean - std, mean + std, color=AFTER, alpha=0.2, linewidth=0, label="± deviation")
        axes.plot(generation, mean, color=AFTER, label="search mean")
        axes.errorbar(end, p.mean, p.std, fmt="o", color=INK, ms=4, capsize=3, label="final fit")
        if p.truth is not None:
            axes.axhline(p.truth, color=TRUTH, linestyle=(0, (5, 2)), label="truth")
        axes.set_title(label(name))
        axes.set_ylabel(f"[{p.unit or '–'}]")
        axes.locator_params(axis="y", nbins=5)
    label_bottom(panels, width, "Generation")
    legend(figure, panels, width, columns=4)
    return figure


@styled
def cost_history(history: Mapping[str, Any], cost: CostEntry, width: float = WIDE) -> Figure:
    """Best and median cost per generation [G] in N m; the axis is logarithmic over more than a decade.

    cost: its best value and its noise floor are drawn as lines.
    """
    figure = Figure(figsize=(width, 2.7), layout="constrained")
    axes = figure.add_subplot()
    generation = np.asarray(history["generation"])
    series = {k: _finite(history[k]) for k in ("median_cost", "best_cost")}
    axes.plot(
        generation,
        series["median_cost"],
        color=BEFORE,
        linestyle=(0, (4, 1.5)),
        label="median of a generation",
    )
    axes.plot(generation, series["best_cost"], color=AFTER, label="best of a generation")
    if cost.best is not None:
        axes.axhline(cost.best, color=INK, linewidth=0.9, linestyle=(0, (1, 1.5)), label="final fit")
    if cost.noise_floor is not None:
        axes.axhline(cost.noise_floor, color=MEASURED, linewidth=1.1, linestyle=(0, (5, 2)), label="noise floor")
    both = np.concatenate(list(series.values()))
    both = both[np.isfinite(both)]
    if both.size and both.min() > 0 and both.max() > 10 * both.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="Generation", ylabel=f"Cost [{cost.unit}]")
    legend(figure, axes, width, columns=4)
    return figure


@styled
def cost_histograms(initial: np.ndarray, fitted: np.ndarray, unit: str = "N m", width: float = WIDE) -> Figure:
    """Costs [n] in N m of parameter sets drawn from the initial and from the fitted Gaussian."""
    figure = Figure(figsize=(width, 2.7), layout="constrained")
    axes = figure.add_subplot()
    initial, fitted = (np.asarray(c, dtype=float) for c in (initial, fitted))
    both = np.concatenate([initial, fitted])
    both = both[np.isfinite(both)]
    if both.size == 0:
        raise ValueError("cost_histograms: no finite cost in 'initial' or 'fitted', nothing to draw")
    low, high = float(both.min()), float(both.max())
    logarithmic = low > 0 and high > 8 * low
    if high <= low:
        low, high = low - 0.5, high + 0.5
    bins = np.geomspace(low, high, 41) if logarithmic else np.linspace(low, high, 41)
    for costs, colour, name in ((initial, BEFORE, "initial"), (fitted, AFTER, "fitted")):
        finite = costs[np.isfinite(costs)]
        lost = f", {costs.size - finite.size} without a finite cost" if finite.size < costs.size else ""
        axes.hist(
            finite,
            bins=list(bins),
            color=colour,
            alpha=0.75,
            label=f"drawn from the {name} Gaussian{lost}",
        )
        if finite.size:
            axes.axvline(float(np.median(finite)), color=colour, linewidth=1.4, linestyle=(0, (5, 2)))
    if logarithmic:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
    axes.set(xlabel=f"Cost [{unit}]", ylabel="Samples")
    legend(figure, axes, width, columns=2)
    return figure


def most_identifiable(parameters: Sequence[FittedParameter], names: Mapping[str, Any]) -> list[str]:
    """Three to six names among `names`: the identifiable ones, the most narrowed first.

    Nuisances and parameters that are not identifiable come only if fewer than three are left.
    """
    known = [p for p in parameters if p.name in names]

    def rank(p: FittedParameter) -> tuple[bool, float]:
        return (p.nuisance or not p.identifiable, p.std / p.initial_std)

    ranked = sorted(known, key=rank)
    identifiable = sum(not rank(p)[0] for p in ranked)
    return [p.name for p in ranked[: min(6, max(3, identifiable))]]


def _finite(values: Any) -> np.ndarray:
    """The values as floats, with gaps where they are not finite."""
    values = np.asarray(values, dtype=float)
    return np.where(np.isfinite(values), values, np.nan)
