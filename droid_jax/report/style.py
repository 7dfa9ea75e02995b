"""How all figures look: colours, settings, and the arrangement of panels and legends.

Colours: measured is black, before the fit is vermillion, after the fit is blue, a known true
value is green (Okabe and Ito's palette, which colour-blind readers can tell apart); each
also has its own line style or marker.

Every figure takes its width in inches, because the page shows a wide drawing on a desk and on
paper and a narrow one, with its panels below each other, on a phone.

Nothing here touches pyplot or any other global state: figures are drawn through the object
interface and can be made in any thread and without a display.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ParamSpec

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDE = 9.2  # inches: a desk, paper
NARROW = 4.4  # inches: a phone

MEASURED = "#0b0b0b"
BEFORE = "#d55e00"
AFTER = "#0072b2"
TRUTH = "#009e73"
INK = "#1b1f24"
MUTED = "#6b7280"
LINE = "#d9dde3"

# What a colour is called in the page's style sheet.
CSS = {
    MEASURED: "var(--measured)",
    BEFORE: "var(--before)",
    AFTER: "var(--after)",
    TRUTH: "var(--truth)",
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    LINE: "var(--line)",
}

STYLE: dict[Any, Any] = {
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


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Draw under the house style, whatever the caller's own matplotlib settings are."""

    @wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> Figure:
        style: dict[Any, Any] = {**matplotlib.rcParamsDefault, **STYLE}
        del style["backend"]  # the one setting that rc_context would not put back
        with matplotlib.rc_context(style):
            return draw(*args, **kwargs)

    return inner


def panel_columns(width: float) -> int:
    """How many panels stand side by side in a figure of this width, inches."""
    return 2 if width > 6 else 1


def panel_grid(n: int, width: float, height: float, sharex: bool = True) -> tuple[Figure, list[Axes]]:
    """A figure with n panels of `height` inches in one or two columns, and the panels in reading order."""
    columns = panel_columns(width)
    rows = math.ceil(n / columns)
    figure = Figure(figsize=(width, 0.55 + height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=sharex, squeeze=False).ravel()
    for axes in grid[n:]:
        axes.set_visible(False)
    return figure, list(grid[:n])


def label_bottom(panels: Sequence[Axes], width: float, text: str) -> None:
    """The x label on the lowest visible panel of each column, with its tick labels."""
    for axes in panels[-panel_columns(width) :]:
        axes.set_xlabel(text)
        axes.tick_params(labelbottom=True)


def legend(figure: Figure, source: Axes | Sequence[Axes], width: float, columns: int) -> None:
    """One legend above all panels, each entry once."""
    entries: dict[str, Any] = {}
    for axes in [source] if isinstance(source, Axes) else source:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    figure.legend(entries.values(), entries.keys(), loc="outside upper left", ncols=columns if width > 6 else 1)
