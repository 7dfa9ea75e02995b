"""Parses a written page."""

from __future__ import annotations

import html.parser
import re
from pathlib import Path

VOID = {"meta", "link", "img", "br"}


class Page(html.parser.HTMLParser):
    """A page's visible text, the cells of its tables, its labelled elements, and what it would load or link.

    cells: (data-name of the row, data-field) -> text and numbers.  ids: id -> attributes and text.  doubts: all
    data-doubt.  keys: data-field of a labelled number -> its data-value.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.cells: dict[tuple[str, str], dict] = {}
        self.rows: dict[str, dict[str, str | None]] = {}
        self.ids: dict[str, dict[str, str]] = {}
        self.doubts: dict[str, str] = {}
        self.keys: dict[str, str] = {}
        self.loads: list[str] = []
        self.links: list[str] = []
        self._row = self._field = ""
        self._open: list[tuple[str, str, str]] = []
        self._silent = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        a = {name: value or "" for name, value in attrs}
        self._silent += tag in ("style", "title")
        if tag in ("img", "script", "iframe", "source"):
            self.loads.append(a.get("src", ""))
        if tag == "link":
            self.loads.append(a.get("href", ""))
        if tag == "a":
            self.links.append(a["href"])
        if tag == "tr":
            self._row = a.get("data-name", "")
            self.rows[self._row] = a
        if tag == "td" and self._row:
            self._field = a.get("data-field", "")
            self.cells[self._row, self._field] = {"text": "", "values": [], **a}
        if tag == "data" and self._field:
            self.cells[self._row, self._field]["values"].append(float(a["value"] or "nan"))
        if "data-value" in a and "data-field" in a:
            self.keys.setdefault(a["data-field"], a["data-value"])
        if "id" in a:
            self.ids[a["id"]] = {**a, "text": ""}
        if "data-doubt" in a:
            self.doubts[a["data-doubt"]] = ""
        if tag not in VOID:
            self._open.append((tag, a.get("id", ""), a.get("data-doubt", "")))

    def handle_endtag(self, tag: str) -> None:
        self._silent -= tag in ("style", "title")
        if tag == "td":
            self._field = ""
        while self._open and self._open.pop()[0] != tag:
            pass

    def handle_data(self, data: str) -> None:
        if self._silent:
            return
        self.words.append(data)
        if self._field:
            self.cells[self._row, self._field]["text"] += data
        for _, name, doubt in self._open:
            if name:
                self.ids[name]["text"] += data
            if doubt:
                self.doubts[doubt] += data

    @property
    def text(self) -> str:
        return spaced(" ".join(self.words))


def spaced(text: str) -> str:
    """A text with single spaces, unbroken ones too."""
    return re.sub(r"\s+", " ", text.replace("\u00a0", " "))


def read_page(path: Path) -> Page:
    """The page in a file."""
    return Page(path.read_text(encoding="utf-8"))
