"""Figures of the search: parameters and cost over generations, and the costs of the two Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from droid_jax.report.style import (
    AFTER,
    BEFORE,
    INK,
    MEASURED,
    TRUTH,
    WIDE,
    label_bottom,
    legend,
    panel_grid,
    styled,
)
from droid_jax.report.words import label


@styled
def parameter_history(
    history: Mapping[str, Any],
    parameters: Sequence[Mapping[str, Any]],
    names: Sequence[str] | None = None,
    width: float = WIDE,
) -> Figure:
    """Search mean and deviation of some parameters over generations, with the final fit at the right.

    history: names [D], generation [G], mean and std [G, D] in physical units.
    parameters: entries of fit.json (units, final mean and deviation, truth).
    names: which to draw; None takes the three to six that the demonstration tells best.
    """
    of = {p["name"]: p for p in parameters}
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
        axes.errorbar(end, p["mean"], p["std"], fmt="o", color=INK, ms=4, capsize=3, label="final fit")
        if p["truth"] is not None:
            axes.axhline(p["truth"], color=TRUTH, linestyle=(0, (5, 2)), label="truth")
        axes.set_title(label(name))
        axes.set_ylabel(f"[{p['unit'] or '–'}]")
        axes.locator_params(axis="y", nbins=5)
    label_bottom(panels, width, "Generation")
    legend(figure, panels, width, columns=4)
    return figure


@styled
def cost_history(history: Mapping[str, Any], cost: Mapping[str, Any], width: float = WIDE) -> Figure:
    """Best and median cost per generation [G] in N m; the axis is logarithmic over more than a decade.

    cost: "best" and "noise_floor" (or None) of fit.json, drawn as lines.
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
    if cost.get("best") is not None:
        axes.axhline(cost["best"], color=INK, linewidth=0.9, linestyle=(0, (1, 1.5)), label="final fit")
    if cost.get("noise_floor") is not None:
        axes.axhline(cost["noise_floor"], color=MEASURED, linewidth=1.1, linestyle=(0, (5, 2)), label="floor")
    both = np.concatenate(list(series.values()))
    both = both[np.isfinite(both)]
    if both.size and both.min() > 0 and both.max() > 10 * both.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="Generation", ylabel=f"Cost [{cost.get('unit', 'N m')}]")
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


def most_identifiable(parameters: Sequence[Mapping[str, Any]], names: Mapping[str, Any]) -> list[str]:
    """Three to six names among `names`: those the demonstration tells, the most narrowed first.

    Nuisances and parameters that it does not tell come only if fewer than three are left.
    """
    known = [p for p in parameters if p["name"] in names]

    def rank(p: Mapping[str, Any]) -> tuple[bool, float]:
        return (p["nuisance"] or not p["identifiable"], p["std"] / p["initial_std"])

    ranked = sorted(known, key=rank)
    told = sum(not rank(p)[0] for p in ranked)
    return [p["name"] for p in ranked[: min(6, max(3, told))]]


def _finite(values: Any) -> np.ndarray:
    """The values as floats, with gaps where they are not finite."""
    values = np.asarray(values, dtype=float)
    return np.where(np.isfinite(values), values, np.nan)
