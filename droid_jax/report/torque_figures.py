"""Figures of torques or other channels: each joint over time with its residuals, and the RMS of each joint."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from droid_jax.report.reading import PhaseEntry
from droid_jax.report.style import (
    AFTER,
    BEFORE,
    LINE,
    MEASURED,
    MUTED,
    WIDE,
    label_bottom,
    legend,
    panel_columns,
    styled,
)
from droid_jax.report.text import label

BUCKETS = 140  # pieces of a drawn line, and points of a band
RESIDUAL_BUCKETS = 60  # of a line of residuals: the figure must fit into the page as SVG
SHORT_PHASE = 0.1  # share of the motion; the name of a shorter last phase is not drawn, it would be cut off
FITS = {"before": "before the fit", "after": "after the fit"}
_STYLES: dict[str, dict[str, Any]] = {
    "before": {"color": BEFORE, "linestyle": (0, (4, 1.5))},
    "after": {"color": AFTER, "linewidth": 1.0},
}


@styled
def torque_traces(
    traces: Mapping[str, Any],
    phases: Sequence[PhaseEntry] = (),
    unit: str = "N m",
    models: Mapping[str, str] = FITS,
    repeats: str = "5 to 95 % of repeats",
    buckets: int = BUCKETS,
    quantity: str = "Torque",
    width: float = WIDE,
) -> Figure:
    """Every joint's torque, or another quantity, over time with, below it, measurement minus simulation.

    Over a motion that the fit follows well the three lines are one; the lower panel shows what is left.

    Args:
        traces: time [T] s; measured_mean, measured_low, measured_high and the simulations [T, J] in `unit`; joints [J]
            names.
        phases: parts of the motion.
        unit: of the quantity.
        models: which of the simulations "before" and "after" are drawn, and their labels.
        repeats: what lies between measured_low and measured_high.
        buckets: pieces of a drawn line.
        quantity: what is drawn, for the axis.
        width: inches.

    Returns:
        The figure.
    """
    time, joints = np.asarray(traces["time"]), [str(j) for j in traces["joints"]]
    columns = panel_columns(width)
    figure, upper, lower = torque_grid(len(joints), width)
    for j, joint in enumerate(joints):
        line = {k: np.asarray(traces[k])[:, j] for k in ("measured_mean", "measured_low", "measured_high", *models)}
        _torques(upper[j], time, line, models, repeats, buckets)
        residuals(lower[j], time, line, models)
        for axes in (upper[j], lower[j]):
            shade(axes, phases, named=j < columns and axes is upper[j])
        upper[j].set(title=label(joint), xlim=(time[0], time[-1]))
        upper[j].set_ylabel(f"{quantity} [{unit}]" if j % columns == 0 else "")
        lower[j].set_ylabel(f"Residual [{unit}]" if j % columns == 0 else "")
    label_bottom(lower, width, "Time [s]")
    figure.align_ylabels([axes for j in range(0, len(joints), columns) for axes in (upper[j], lower[j])])
    legend(figure, upper[0], width, columns=4)
    return figure


def torque_grid(joints: int, width: float) -> tuple[Figure, list[Axes], list[Axes]]:
    """A figure with two panels a joint, in the joints' order: the upper for its torque, the lower for its residual."""
    columns = panel_columns(width)
    rows = math.ceil(joints / columns)
    figure = Figure(figsize=(width, 0.6 + 2.5 * rows), layout="constrained")
    axes = figure.subplots(2 * rows, columns, sharex=True, squeeze=False, height_ratios=[1.9, 1.0] * rows)
    upper, lower = axes[0::2].ravel(), axes[1::2].ravel()
    for spare in (*upper[joints:], *lower[joints:]):
        spare.set_visible(False)
    return figure, list(upper[:joints]), list(lower[:joints])


def _torques(
    axes: Axes, time: np.ndarray, line: Mapping[str, np.ndarray], models: Mapping[str, str], repeats: str, buckets: int
) -> None:
    repeated = fill(axes, time, line["measured_low"], line["measured_high"], f"measured, {repeats}", buckets)
    mean = "measured, mean" if repeated else "measured"
    axes.plot(*thin(time, line["measured_mean"], buckets), color=MEASURED, linewidth=2.4, label=mean)
    for key, name in models.items():
        axes.plot(*thin(time, line[key], buckets), label=name, **_STYLES[key])
    axes.set_ylim(_torque_limits(line))


def residuals(
    axes: Axes, time: np.ndarray, line: Mapping[str, np.ndarray], models: Mapping[str, str], band_name: str = ""
) -> None:
    """Measurement minus simulation over time, and the band of the repeats around zero."""
    mean = line["measured_mean"]
    fill(axes, time, line["measured_low"] - mean, line["measured_high"] - mean, band_name, RESIDUAL_BUCKETS)
    axes.axhline(0.0, color=LINE, linewidth=0.8)
    for key, name in models.items():
        axes.plot(*thin(time, mean - line[key], RESIDUAL_BUCKETS), label=name, **_STYLES[key])


@styled
def distance_per_joint(
    joints: Sequence[str],
    before: Sequence[float | None],
    after: Sequence[float | None],
    floor: float | None,
    floors: Sequence[float] | None = None,
    unit: str = "N m",
    quantity: str = "torque",
    width: float = WIDE,
) -> Figure:
    """RMS difference of each joint's torque, or another quantity, [J] in `unit`, before and after the fit.

    floor: difference between repeats over all joints, in `unit`, a dashed line; floors [J]
    N m, the same joint by joint, small marks, where known.
    """
    figure = Figure(figsize=(width, 2.7), layout="constrained")
    axes = figure.add_subplot()
    x = np.arange(len(joints))
    axes.bar(x - 0.2, np.array(before, float), 0.36, color=BEFORE, label="before the fit")
    axes.bar(x + 0.2, np.array(after, float), 0.36, color=AFTER, label="after the fit")
    if floors is not None:
        axes.hlines(floors, x - 0.42, x + 0.42, color=MEASURED, linewidth=1.6, label="noise floor (repeats)")
    elif floor is not None:
        axes.axhline(
            floor, color=MEASURED, linestyle=(0, (3, 2)), linewidth=1.1, label="noise floor (repeats), all joints"
        )
    names = [label(j) for j in joints]
    numbered = width <= 6 and all(re.fullmatch(r"Joint \d+", name) for name in names)
    axes.set_xticks(x, [name.removeprefix("Joint ") for name in names] if numbered else names)
    axes.set_xlabel("Joint" if numbered else "")
    axes.set_ylabel(f"RMS {quantity} difference [{unit}]" if width > 6 else f"RMS difference [{unit}]")
    axes.grid(axis="x", visible=False)
    legend(figure, axes, width, columns=3)
    return figure


def fill(
    axes: Axes, time: np.ndarray, low: np.ndarray, high: np.ndarray, name: str = "", buckets: int = BUCKETS
) -> bool:
    """A band of the repeats, of so many `buckets`; none, and False, for one repeat, whose scatter is zero."""
    if not np.any(high > low):
        return False
    axes.fill_between(*band(time, low, high, buckets), color=MEASURED, alpha=0.16, linewidth=0, label=name or None)
    return True


def shade(axes: Axes, phases: Sequence[PhaseEntry], named: bool) -> None:
    """Every other phase of the motion shaded; names at the top where asked for."""
    for i, phase in enumerate(phases):
        start, end = phase.start, phase.end
        if i % 2 == 0:
            axes.axvspan(start, end, color=MUTED, alpha=0.10, linewidth=0)
        if named:
            cut = phase is phases[-1] and end - start < SHORT_PHASE * (end - phases[0].start)
            axes.text(
                end if cut else (start + end) / 2,
                0.98,
                phase.name,
                transform=axes.get_xaxis_transform(),
                ha="right" if cut else "center",
                va="top",
                fontsize=7,
                color=MUTED,
                clip_on=True,
            )


def thin(time: np.ndarray, value: np.ndarray, buckets: int = BUCKETS) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and largest sample of each bucket, in order of time: short, and no spike is lost."""
    if len(time) <= 2 * buckets:
        return time, value
    ranked = np.where(np.isfinite(value), value, 0.0)
    edges = np.linspace(0, len(time), buckets + 1).astype(int)
    keep = {0, len(time) - 1}
    for a, b in pairwise(edges):
        keep |= {a + int(ranked[a:b].argmin()), a + int(ranked[a:b].argmax())}
    index = np.array(sorted(keep))
    return time[index], value[index]


def band(
    time: np.ndarray, low: np.ndarray, high: np.ndarray, buckets: int = BUCKETS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The band's outline, one point per bucket and one at the end, never inside the band itself."""
    if len(time) <= buckets:
        return time, low, high
    start = np.linspace(0, len(time), buckets, endpoint=False).astype(int)
    low, high = np.minimum.reduceat(low, start), np.maximum.reduceat(high, start)
    return np.append(time[start], time[-1]), np.append(low, low[-1]), np.append(high, high[-1])


def _torque_limits(line: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Limits that show measurement and fit whole, and all but the extreme 2 % of the start."""
    whole = np.concatenate([values for key, values in line.items() if key != "before"])
    whole = whole[np.isfinite(whole)]
    start = line["before"][np.isfinite(line["before"])]
    marks = [*np.percentile(start, [1, 99])] if start.size else []
    marks += [whole.min(), whole.max()] if whole.size else [0.0]
    low, high = float(min(marks)), float(max(marks))
    room = 0.08 * (high - low) or 0.5
    return low - room, high + 2 * room  # the upper room holds the phases' names
