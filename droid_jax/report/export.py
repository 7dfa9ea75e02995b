"""Figures as files and as parts of an HTML page.

`inline_svg` replaces the colours of `report.style` by the page's CSS variables, so that the same
drawing is readable on a dark page.
"""

from __future__ import annotations

import base64
import io
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import ScalarFormatter

from droid_jax.report.style import CSS, STYLE
from droid_jax.storage import write_bytes

SVG_LIMIT = 300_000  # bytes; a larger drawing goes into the page as PNG


def settled(figure: Figure) -> Figure:
    """The figure with its panels arranged for good: saving it several times need not arrange them again.

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
    """No text but the numbers of logarithmic axes is mathematics."""
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
    with matplotlib.rc_context(STYLE), io.StringIO() as buffer:
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
        svg = buffer.getvalue()
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
    dates = {"pdf": {"CreationDate": None}, "png": {"Software": None}}[kind]
    with matplotlib.rc_context(STYLE), io.BytesIO() as buffer:
        figure.savefig(buffer, format=kind, facecolor="white", metadata=dates)
        return buffer.getvalue()


def _two_digits(match: re.Match[str]) -> str:
    return f"{float(match[0]):.2f}".rstrip("0").rstrip(".")
