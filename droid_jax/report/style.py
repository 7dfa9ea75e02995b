"""How all figures look, and how they become files and parts of an HTML page.

Colours: measured is black, before the fit is vermillion, after the fit is blue, a known true
value is green (Okabe and Ito's palette, which colour-blind readers can tell apart); each
also has its own line style or marker.

Every figure takes its width in inches, because the page shows a wide drawing on a desk and on
paper and a narrow one, with its panels below each other, on a phone.

Nothing here touches pyplot or any other global state: figures are drawn through the object
interface and can be made in any thread and without a display.  `inline_svg` replaces the colours by the page's CSS
variables, so that the same drawing is readable on a dark page.
"""

from __future__ import annotations

import base64
import hashlib
import io
import itertools
import math
import pickle
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypedDict, cast

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import ScalarFormatter

from droid_jax.read_json import read_json, typed
from droid_jax.storage import write_bytes, write_json

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
    """Decorator: draw with STYLE, independent of the caller's matplotlib settings."""

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


def settled(figure: Figure) -> Figure:
    """The figure with its layout fixed, so that saving it several times does not compute the layout again.

    A name's dollar signs are no mathematics, and names below an axis that would overlap are turned.
    """
    with matplotlib.rc_context(STYLE):
        _read_as_written(figure)
        figure.draw_without_rendering()
        if crowded := [axes for axes in figure.axes if _overlap(axes)]:
            _turn_names(figure, crowded)
            figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return figure


def _read_as_written(figure: Figure) -> None:
    """Switch mathematical notation off in all texts except the numbers of logarithmic axes."""
    logarithmic = [axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis) if axis.get_scale() != "linear"]
    powers = {id(text) for axis in logarithmic for text in axis.findobj(Text)}
    for text in figure.findobj(Text):
        if id(text) not in powers:
            cast(Text, text).set_parse_math(False)


def _turn_names(figure: Figure, crowded: Sequence[Axes]) -> None:
    """Turn the names below these panels; the figure grows by what they then need below each row of panels."""
    needed: dict[int, float] = {}
    for axes in crowded:
        texts = axes.get_xticklabels()
        flat = max(text.get_window_extent().height for text in texts)
        for text in texts:
            text.set(rotation=60, ha="right", rotation_mode="anchor")
        place = axes.get_subplotspec()
        row = place.rowspan.start if place else 0
        more = max(text.get_window_extent().height for text in texts) - flat
        needed[row] = max(needed.get(row, 0.0), more / figure.dpi)
    figure.set_figheight(figure.get_figheight() + sum(needed.values()))


def _overlap(axes: Axes) -> bool:
    """Whether two neighbours of the names below an axis touch."""
    if not axes.get_visible() or isinstance(axes.xaxis.get_major_formatter(), ScalarFormatter):
        return False
    shown = [text for text in axes.get_xticklabels() if text.get_visible() and text.get_text()]
    upright = [text for text in shown if text.get_rotation() == 0]
    boxes = [text.get_window_extent() for text in upright]
    return any(left.x1 > right.x0 for left, right in itertools.pairwise(sorted(boxes, key=lambda box: box.x0)))


def inline_svg(figure: Figure, prefix: str) -> str:
    """The figure as an <svg> element for an HTML page, its colours replaced by CSS variables.

    prefix: put before every id, so that several drawings can share one page.
    """
    svg = _bytes(figure, "svg").decode()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)
    svg = re.sub(r'\bd="[^"]*"', lambda m: re.sub(r"\d+\.\d{3,}", _two_digits, m[0]), svg)
    for colour, name in CSS.items():
        svg = svg.replace(colour, name)
    return svg


def data_uri(image: bytes, kind: str = "png") -> str:
    """An image's bytes as a data URI; kind: png or webp."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode('ascii')}"


def png_bytes(figure: Figure) -> bytes:
    """The figure as PNG on white."""
    return _bytes(figure, "png")


def save(figure: Figure, folder: Path, stem: str) -> None:
    """Write folder/stem.png and folder/stem.pdf."""
    for kind in ("png", "pdf"):
        write_bytes(folder / f"{stem}.{kind}", _bytes(figure, kind))


def _bytes(figure: Figure, kind: str) -> bytes:
    """The figure in a format: SVG without a background, the others on white.

    By its canvas, since `savefig` would draw all of a settled figure once more to arrange it.
    """
    canvas: type[FigureCanvasBase]
    if kind == "pdf":
        from matplotlib.backends.backend_pdf import FigureCanvasPdf as canvas  # only here: it imports fontTools

        background, metadata = "white", {"CreationDate": None}
    elif kind == "svg":
        canvas, background, metadata = FigureCanvasSVG, "none", {"Date": None, "Creator": None}
    else:
        canvas, background, metadata = FigureCanvasAgg, "white", {"Software": None}
    with matplotlib.rc_context(STYLE), io.BytesIO() as buffer:
        figure.set_facecolor(background)
        figure.set_dpi(STYLE["savefig.dpi"])
        getattr(canvas(figure), f"print_{kind}")(buffer, metadata=metadata)
        return buffer.getvalue()


def _two_digits(match: re.Match[str]) -> str:
    return f"{float(match[0]):.2f}".rstrip("0").rstrip(".")


@dataclass(frozen=True)
class Drawing:
    """One figure as the page shows it: HTML for a wide and for a narrow screen.

    folder: where its PNG and PDF copies lie, as STEM.png and STEM.pdf.
    """

    folder: Path
    stem: str
    title: str
    wide: Markup
    narrow: Markup


def drawing(folder: Path, stem: str, title: str, make: Callable[..., Figure], *args: Any) -> Drawing:
    """The figure `make(*args, width=...)` draws, for the page; PNG and PDF copies go to FOLDER/figures/STEM.*.

    STEM.json there keeps the page's HTML, which is used again as long as the data and the modules that draw are the
    same.
    """
    of, path = _content(title, make, args), folder / "figures" / f"{stem}.json"
    if of and (kept := _kept(path, of)):
        return Drawing(path.parent, stem, title, *map(Markup, kept))
    wide, narrow = (settled(make(*args, width=width)) for width in (WIDE, NARROW))
    save(wide, folder / "figures", stem)
    html = [_inline(f, stem, kind, title) for kind, f in (("wide", wide), ("narrow", narrow))]
    if of:
        write_json(path, {"of": of, "whole": _whole(path, html), "html": html})
    return Drawing(path.parent, stem, title, *html)


def _content(title: str, make: Callable[..., Figure], args: tuple[Any, ...]) -> str | None:
    """A hash of all that a drawing depends on; None for data that cannot be pickled."""
    with io.BytesIO() as buffer:
        pickler = pickle.Pickler(buffer)
        pickler.fast = True  # else equal data would differ by which of their parts are one object
        try:
            pickler.dump((title, make, args))
        except (pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError):
            return None
        return hashlib.sha256(_sources() + buffer.getvalue()).hexdigest()


@cache
def _sources() -> bytes:
    """A hash of the modules that draw, and of matplotlib's version."""
    texts = [path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))]
    return hashlib.sha256(b"".join([matplotlib.__version__.encode(), *texts])).digest()


class _Kept(TypedDict):
    """STEM.json: hashes of what was drawn, and of the drawing with its copies."""

    of: str
    whole: str
    html: tuple[str, str]


def _kept(path: Path, of: str) -> tuple[str, str] | None:
    """HTML of an earlier drawing of the same content; None if there is none, or it or its copies are damaged."""
    try:
        kept = typed(read_json(path), _Kept, path.name)
        same = (kept["of"], kept["whole"]) == (of, _whole(path, kept["html"]))
    except (OSError, ValueError):
        return None
    return kept["html"] if same else None


def _whole(path: Path, html: Sequence[str]) -> str:
    """A hash of a drawing's HTML and of its copies."""
    copies = [path.with_suffix(kind).read_bytes() for kind in (".png", ".pdf")]
    return hashlib.sha256(b"".join([*(text.encode() for text in html), *copies])).hexdigest()


def _inline(figure: Figure, stem: str, kind: str, title: str) -> Markup:
    """SVG, or PNG on a white card where the SVG would be too long; the caption describes it."""
    svg = inline_svg(figure, f"{stem}-{kind}")
    points = 72 * figure.get_figwidth()
    if len(svg) <= SVG_LIMIT:
        # Fixed points would not shrink on a phone; the viewBox keeps the proportions.
        svg = re.sub(r'(<svg [^>]*?) ?\bheight="[^"]*"', r"\1", svg, count=1)
        svg = re.sub(r'(<svg [^>]*?)\bwidth="[^"]*"', rf'\1style="max-width:{1.45 * points:.0f}px"', svg, count=1)
        head = Markup('<svg role="img" aria-label="{}" aria-describedby="{}-caption"').format(title, stem)
        return Markup(head + Markup(svg.removeprefix("<svg")))
    card = Markup('<img class="card" alt="{}" aria-describedby="{}-caption" src="{}">')
    return card.format(title, stem, data_uri(png_bytes(figure)))
