"""The figures of a report: one function per figure, numbers in, a matplotlib `Figure` out.

Nothing here touches pyplot or any other global state: figures are drawn through the object
interface and can be made in any thread and without a display.  Every figure takes its width
in inches, because the page shows a wide drawing on a desk and on paper and a narrow one,
with its panels below each other, on a phone.

Colours: measured is black, before the fit is vermillion, after the fit is blue, a known true
value is green (Okabe and Ito's palette, which colour-blind readers can tell apart); each
also has its own line style or marker.  `inline_svg` replaces these colours by the page's CSS
variables, so that the same drawing is readable on a dark page.
"""

from __future__ import annotations

import base64
import io
import math
import os
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import Any, ParamSpec

import matplotlib
import matplotlib.lines
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDE = 9.2  # inches: a desk, paper
NARROW = 4.4  # inches: a phone
SVG_LIMIT = 300_000  # bytes; a larger drawing goes into the page as PNG

MEASURED = "#0b0b0b"
BEFORE = "#d55e00"
AFTER = "#0072b2"
TRUTH = "#009e73"
INK = "#1b1f24"
MUTED = "#6b7280"
LINE = "#d9dde3"

# What a colour is called in the page's style sheet.
_CSS = {
    MEASURED: "var(--measured)",
    BEFORE: "var(--before)",
    AFTER: "var(--after)",
    TRUTH: "var(--truth)",
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    LINE: "var(--line)",
}

_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "axes.unicode_minus": True,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
    "savefig.dpi": 160,
    "svg.fonttype": "path",
    "svg.hashsalt": "droid_jax",
    "pdf.fonttype": 42,
}

P = ParamSpec("P")


def _styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draw under the house style, whatever the caller's own matplotlib settings are."""

    @wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> Figure:
        style: dict[Any, Any] = {**matplotlib.rcParamsDefault, **_STYLE}
        del style["backend"]  # the one setting that rc_context would not put back
        with matplotlib.rc_context(style):
            return draw(*args, **kwargs)

    return inner


def label(name: str) -> str:
    """A name as it is read: "hinge_stiffness" -> "Hinge stiffness", "panda_joint3" -> "Joint 3"."""
    joint = re.fullmatch(r"(?:\w+_)?joint_?(\d+)", name)
    if joint:
        return f"Joint {joint[1]}"
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


@_styled
def torque_traces(traces: Mapping[str, Any], phases: Sequence[Mapping[str, Any]] = (), width: float = WIDE) -> Figure:
    """Torque of every joint over time: the repeats' mean and 5 to 95 % band, before and after the fit.

    traces: time [T] s; measured_mean, measured_low, measured_high, before, after [T, J] N m;
    joints [J] names.  phases: parts of the motion, each with name, start and end in s.
    """
    time, joints = np.asarray(traces["time"]), [str(j) for j in traces["joints"]]
    figure, panels = _panels(len(joints), width, height=1.75)
    for j, (axes, joint) in enumerate(zip(panels, joints, strict=True)):
        line = {k: np.asarray(traces[k])[:, j] for k in _TRACES}
        _shade(axes, phases, named=j < _columns(width))
        axes.fill_between(
            *_band(time, line["measured_low"], line["measured_high"]),
            color=MEASURED,
            alpha=0.16,
            linewidth=0,
            label="measured, 5 to 95 % of held-out repeats",
        )
        axes.plot(*_thin(time, line["measured_mean"]), color=MEASURED, linewidth=2.4, label="measured, mean")
        axes.plot(*_thin(time, line["before"]), color=BEFORE, linestyle=(0, (4, 1.5)), label="before the fit")
        axes.plot(*_thin(time, line["after"]), color=AFTER, linewidth=1.0, label="after the fit")
        axes.set(title=label(joint), xlim=(time[0], time[-1]), ylim=_torque_limits(line))
        axes.set_ylabel("Torque [N m]" if j % _columns(width) == 0 else "")
    _label_bottom(panels, width, "Time [s]")
    _legend(figure, panels[0], width, columns=4)
    return figure


@_styled
def gap_per_joint(
    joints: Sequence[str],
    before: Sequence[float],
    after: Sequence[float],
    floor: float | None,
    floors: Sequence[float] | None = None,
    width: float = WIDE,
) -> Figure:
    """RMS torque difference of each joint [J] in N m on held-out repeats, before and after the fit.

    floor: what repeats differ among themselves over all joints, N m, a dashed line; floors [J]
    N m, the same joint by joint, small marks, where known.
    """
    figure = Figure(figsize=(width, 2.7), layout="constrained")
    axes = figure.add_subplot()
    x = np.arange(len(joints))
    axes.bar(x - 0.2, before, 0.36, color=BEFORE, label="before the fit")
    axes.bar(x + 0.2, after, 0.36, color=AFTER, label="after the fit")
    if floors is not None:
        axes.hlines(floors, x - 0.42, x + 0.42, color=MEASURED, linewidth=1.6, label="floor (repeats)")
    elif floor is not None:
        axes.axhline(floor, color=MEASURED, linestyle=(0, (3, 2)), linewidth=1.1, label="floor (repeats), all joints")
    names = [label(j) for j in joints]
    axes.set_xticks(x, names if width > 6 else [n.removeprefix("Joint ") for n in names])
    axes.set_xlabel("" if width > 6 else "Joint")
    axes.set_ylabel("RMS torque difference [N m]" if width > 6 else "RMS difference [N m]")
    axes.grid(axis="x", visible=False)
    _legend(figure, axes, width, columns=3)
    return figure


@_styled
def intervals(parameters: Sequence[Mapping[str, Any]], width: float = WIDE) -> Figure:
    """Every parameter's 90 % interval in units of its initial deviation, 0 being its initial mean.

    parameters: entries of fit.json; a known truth is a green diamond, a parameter that the
    demonstration does not tell is grey, one on a bound carries a square.
    """
    n = len(parameters)
    figure = Figure(figsize=(width, 0.9 + 0.27 * n), layout="constrained")
    axes = figure.add_subplot()
    axes.axvspan(-1.645, 1.645, color=BEFORE, alpha=0.13, linewidth=0, label="initial 90 %")
    axes.axvline(0, color=BEFORE, linewidth=1, linestyle=(0, (4, 1.5)))
    reach = 3.0
    for y, p in enumerate(parameters):
        at = _prior_units(p)
        low, high = (at(v) for v in p["interval"])
        colour = AFTER if p["identifiable"] else MUTED
        axes.plot([low, high], [y, y], color=colour, linewidth=3.2, alpha=0.55, solid_capstyle="butt")
        axes.plot(at(p["mean"]), y, "s" if p["on_bound"] else "o", color=colour, markersize=5)
        if p["truth"] is not None:
            axes.plot(at(p["truth"]), y, "D", markersize=5.5, color=TRUTH, markerfacecolor="none")
        marks = [low, high, at(p["mean"]), *([] if p["truth"] is None else [at(p["truth"])])]
        reach = max(reach, *(abs(m) for m in marks if math.isfinite(m)))
    if reach > 12:
        axes.set_xscale("symlog", linthresh=3)
    axes.set(xlim=(-1.12 * reach, 1.12 * reach), ylim=(n - 0.4, -0.6))
    axes.set_yticks(range(n), [label(p["name"]) for p in parameters])
    axes.set_xlabel("Initial deviations from the initial mean")
    axes.grid(axis="y", visible=False)
    _interval_legend(figure, parameters, width)
    return figure


@_styled
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
    figure, panels = _panels(len(chosen), width, height=1.8)
    end = generation[-1] + 0.04 * (generation[-1] - generation[0] + 1)
    for i, (axes, name) in enumerate(zip(panels, chosen, strict=True)):
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
        axes.set_xlabel("Generation" if i >= len(chosen) - _columns(width) else "")
    _legend(figure, panels, width, columns=4)
    return figure


@_styled
def cost_history(history: Mapping[str, Any], cost: Mapping[str, Any], width: float = WIDE) -> Figure:
    """Best and median cost per generation [G] in N m; the axis is logarithmic over more than a decade.

    cost: "best" and "floor" (or None) of fit.json, drawn as lines.
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
    if cost.get("floor") is not None:
        axes.axhline(cost["floor"], color=MEASURED, linewidth=1.1, linestyle=(0, (5, 2)), label="floor")
    both = np.concatenate(list(series.values()))
    both = both[np.isfinite(both)]
    if both.size and both.min() > 0 and both.max() > 10 * both.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="Generation", ylabel="Cost [N m]")
    _legend(figure, axes, width, columns=4)
    return figure


@_styled
def correlation_map(names: Sequence[str], correlation: np.ndarray, width: float = WIDE) -> Figure:
    """Correlation [D, D] of the fitted parameters, from -1 to 1; numbers are written where they fit."""
    n = len(names)
    roomy = width > 6
    side = min(width, 2.4 + 0.36 * n) if roomy else width
    figure = Figure(figsize=(side + (0.6 if roomy else 0), side), layout="constrained")
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


@_styled
def cost_histograms(initial: np.ndarray, fitted: np.ndarray, width: float = WIDE) -> Figure:
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
    axes.set(xlabel="Cost on repeats that the fit did not see [N m]", ylabel="Samples")
    _legend(figure, axes, width, columns=2)
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


def inline_svg(figure: Figure, prefix: str) -> str:
    """The figure as an <svg> element for an HTML page, its colours replaced by CSS variables.

    prefix: put before every id, so that several drawings can share one page.
    """
    with matplotlib.rc_context(_STYLE), io.StringIO() as buffer:
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)
    svg = re.sub(r'\bd="[^"]*"', lambda m: re.sub(r"\d+\.\d{3,}", _two_digits, m[0]), svg)
    for colour, name in _CSS.items():
        svg = svg.replace(colour, name)
    return svg


def data_uri(png: bytes) -> str:
    """PNG bytes as a data URI."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def png_bytes(figure: Figure) -> bytes:
    """The figure as PNG on white."""
    return _bytes(figure, "png")


def save(figure: Figure, folder: Path, stem: str) -> None:
    """Write folder/stem.png and folder/stem.pdf, each in one step, so a reader never sees half a file."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind in ("png", "pdf"):
        write_atomically(folder / f"{stem}.{kind}", _bytes(figure, kind))


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file next to its final name and move it there; an existing file is replaced."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o644)  # mkstemp keeps others out; a report is for others
        os.replace(temporary, path)
    except OSError:
        Path(temporary).unlink(missing_ok=True)
        raise


_TRACES = ("measured_mean", "measured_low", "measured_high", "before", "after")


def _bytes(figure: Figure, kind: str) -> bytes:
    dates = {"pdf": {"CreationDate": None}, "png": {"Software": None}}[kind]
    with matplotlib.rc_context(_STYLE), io.BytesIO() as buffer:
        figure.savefig(buffer, format=kind, facecolor="white", metadata=dates)
        return buffer.getvalue()


def _two_digits(match: re.Match[str]) -> str:
    return f"{float(match[0]):.2f}".rstrip("0").rstrip(".")


def _columns(width: float) -> int:
    return 2 if width > 6 else 1


def _panels(n: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with n panels of `height` inches in one or two columns, and the panels in reading order."""
    columns = _columns(width)
    rows = math.ceil(n / columns)
    figure = Figure(figsize=(width, 0.55 + height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for axes in grid[n:]:
        axes.set_visible(False)
    return figure, list(grid[:n])


def _label_bottom(panels: Sequence[Axes], width: float, text: str) -> None:
    """The x label on the lowest visible panel of each column, with its tick labels."""
    for axes in panels[-_columns(width) :]:
        axes.set_xlabel(text)
        axes.tick_params(labelbottom=True)


def _legend(figure: Figure, source: Axes | Sequence[Axes], width: float, columns: int) -> None:
    """One legend above all panels, each entry once."""
    entries: dict[str, Any] = {}
    for axes in [source] if isinstance(source, Axes) else source:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    figure.legend(entries.values(), entries.keys(), loc="outside upper left", ncols=columns if width > 6 else 1)


def _interval_legend(figure: Figure, parameters: Sequence[Mapping[str, Any]], width: float) -> None:
    """The forest plot's legend: only what the drawing holds."""
    entries = [("initial 90 %", {"color": BEFORE, "alpha": 0.3, "linewidth": 6})]
    bar = {"linewidth": 3.2, "marker": "o", "markersize": 5}
    if any(p["identifiable"] for p in parameters):
        entries.append(("fitted, 90 % interval", {"color": AFTER, **bar}))
    if any(not p["identifiable"] for p in parameters):
        entries.append(("not told by this demonstration", {"color": MUTED, **bar}))
    if any(p["on_bound"] for p in parameters):
        entries.append(("on a bound", {"color": AFTER, "marker": "s", "linestyle": "none", "markersize": 5}))
    if any(p["truth"] is not None for p in parameters):
        diamond = {"marker": "D", "linestyle": "none", "markersize": 5.5, "markerfacecolor": "none"}
        entries.append(("truth", {"color": TRUTH, **diamond}))
    handles = [matplotlib.lines.Line2D([], [], **style) for _, style in entries]
    figure.legend(handles, [n for n, _ in entries], loc="outside upper left", ncols=5 if width > 6 else 1, fontsize=8)


def _prior_units(p: Mapping[str, Any]) -> Callable[[float], float]:
    return lambda value: (value - p["initial_mean"]) / p["initial_std"]


def _shade(axes: Axes, phases: Sequence[Mapping[str, Any]], named: bool) -> None:
    """Every other phase of the motion shaded; names at the top where asked for."""
    for i, phase in enumerate(phases):
        if i % 2 == 0:
            axes.axvspan(phase["start"], phase["end"], color=MUTED, alpha=0.10, linewidth=0)
        if named:
            axes.text(
                (phase["start"] + phase["end"]) / 2,
                0.98,
                phase["name"],
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="top",
                fontsize=7,
                color=MUTED,
                clip_on=True,
            )


def _thin(time: np.ndarray, value: np.ndarray, buckets: int = 220) -> tuple[np.ndarray, np.ndarray]:
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


def _band(
    time: np.ndarray, low: np.ndarray, high: np.ndarray, buckets: int = 220
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The band's outline, one point per bucket, never inside the band itself."""
    if len(time) <= buckets:
        return time, low, high
    start = np.linspace(0, len(time), buckets, endpoint=False).astype(int)
    return time[start], np.minimum.reduceat(low, start), np.maximum.reduceat(high, start)


def _torque_limits(line: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Limits that show measurement and fit whole, and all but the extreme 2 % of the start."""
    whole = np.concatenate([line[k] for k in _TRACES if k != "before"])
    whole = whole[np.isfinite(whole)]
    start = line["before"][np.isfinite(line["before"])]
    marks = [*np.percentile(start, [1, 99])] if start.size else []
    marks += [whole.min(), whole.max()] if whole.size else [0.0]
    low, high = float(min(marks)), float(max(marks))
    room = 0.08 * (high - low) or 0.5
    return low - room, high + 2 * room  # the upper room holds the phases' names


def _finite(values: Any) -> np.ndarray:
    """The values as floats, with gaps where they are not finite."""
    values = np.asarray(values, dtype=float)
    return np.where(np.isfinite(values), values, np.nan)
