"""A written page, taken apart."""

from __future__ import annotations

import html.parser
import re
from pathlib import Path


class Page(html.parser.HTMLParser):
    """A page's visible text, the cells of its parameter tables, and what it would load or link."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.cells: dict[tuple[str, str], dict] = {}
        self.loads: list[str] = []
        self.links: list[str] = []
        self._row = self._field = ""
        self._silent = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        a = dict(attrs)
        self._silent += tag in ("style", "title")
        if tag in ("img", "script", "iframe", "source"):
            self.loads.append(a.get("src") or "")
        if tag == "link":
            self.loads.append(a.get("href") or "")
        if tag == "a":
            self.links.append(a["href"] or "")
        if tag == "tr":
            self._row = a.get("data-name") or ""
        if tag == "td" and self._row:
            self._field = a.get("data-field") or ""
            self.cells[self._row, self._field] = {"text": "", "values": []}
        if tag == "data":
            self.cells[self._row, self._field]["values"].append(float(a["value"] or "nan"))

    def handle_endtag(self, tag: str) -> None:
        self._silent -= tag in ("style", "title")
        if tag == "td":
            self._field = ""

    def handle_data(self, data: str) -> None:
        if self._silent:
            return
        self.words.append(data)
        if self._field:
            self.cells[self._row, self._field]["text"] += data

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def read_page(path: Path) -> Page:
    """The page in a file."""
    return Page(path.read_text(encoding="utf-8"))
