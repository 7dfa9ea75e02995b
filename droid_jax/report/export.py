"""Figures as files and as parts of an HTML page.

`inline_svg` replaces the colours of `report.style` by the page's CSS variables, so that the same
drawing is readable on a dark page.
"""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from droid_jax.report.style import CSS, STYLE
from droid_jax.storage import write_bytes

SVG_LIMIT = 300_000  # bytes; a larger drawing goes into the page as PNG


def settled(figure: Figure) -> Figure:
    """The figure with its panels arranged for good: saving it several times need not arrange them again."""
    with matplotlib.rc_context(STYLE):
        figure.draw_without_rendering()
    figure.set_layout_engine("none")
    return figure


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
