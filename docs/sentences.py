"""Words per sentence of README.md and docs/, file by file, and the mean over all of them.

python docs/sentences.py [--out DIR]

Counted is prose: paragraphs, list items, quotes. Code blocks, tables, headings and pictures are left out; a code span
or a link's text counts as its words. Generated pages and docs/history/ are left out too.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = ("docs/history/", "docs/command-line.md")
FENCE = re.compile(r"^ *```.*?^ *```[^\n]*$", re.MULTILINE | re.DOTALL)
NO_PROSE = re.compile(r"^ *(?:\||#|!\[|<|-{3,}$).*$", re.MULTILINE)
LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
NEW_BLOCK = re.compile(r"\n\s*\n|\n(?= *(?:[-*]|\d+\.) )")
END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'`(*_\[]*[A-Z`])")


def documents() -> list[Path]:
    """README.md and the written pages of docs/."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [page for page in pages if not str(page.relative_to(ROOT)).startswith(LEFT_OUT)]


def sentences(text: str) -> list[str]:
    """The sentences of a Markdown text, without its code, tables, headings and pictures."""
    prose = LINK.sub(r"\1", NO_PROSE.sub("", FENCE.sub("\n", text)))
    blocks = (re.sub(r"^\s*(?:[-*]|\d+\.)\s+", "", block) for block in NEW_BLOCK.split(prose))
    found = (sentence for block in blocks for sentence in END.split(" ".join(block.split())))
    return [sentence for sentence in found if words(sentence)]


def words(sentence: str) -> int:
    """Parts between spaces that hold a letter or a digit."""
    return sum(any(c.isalnum() for c in part) for part in sentence.split())


def counts() -> dict[str, list[int]]:
    """File -> words of each of its sentences."""
    return {str(p.relative_to(ROOT)): [words(s) for s in sentences(p.read_text("utf-8"))] for p in documents()}


def mean(numbers: list[int]) -> float:
    """Of words; 0 of no sentence."""
    return sum(numbers) / max(len(numbers), 1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder to which sentences.json is written")
    out = parser.parse_args().out
    by_file = counts()
    result = {
        "mean": round(mean([n for lengths in by_file.values() for n in lengths]), 2),
        "sentences": sum(map(len, by_file.values())),
        "by_file": {name: round(mean(lengths), 2) for name, lengths in by_file.items()},
    }
    for name, lengths in by_file.items():
        print(f"{mean(lengths):5.1f} words in each of {len(lengths):4d} sentences, {max(lengths):3d} at most: {name}")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "sentences.json").write_text(json.dumps({**result, "words": by_file}, indent=1) + "\n", "utf-8")
    print(json.dumps(result))
