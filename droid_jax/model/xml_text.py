"""An MJCF as its author wrote it: every start tag with its place in its file, included files among them.

`read_tree` gives the tags as a tree in which an include stands for what it includes.  `with_edits` puts new attribute
values into the text and leaves all else as it is: layout, comments, the order of attributes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

_TAG = re.compile(rb"""<([^\s/>]+)((?:\s+[^\s=]+\s*=\s*(?:"[^"]*"|'[^']*'))*)\s*(/?)>""")
_ATTRIBUTE = re.compile(rb"""(\s+)([^\s=]+)(\s*=\s*)("[^"]*"|'[^']*')""")


@dataclass(eq=False)
class Tag:
    """A start tag.

    file: where it stands.  line: from 1.  start, end: bytes in the file, `end` behind its ">".  attributes: as written.
    parent: the tag around it; of an included one that around the include.  empty: it closes itself.
    """

    name: str
    attributes: dict[str, str]
    file: Path
    line: int
    start: int
    end: int
    empty: bool
    parent: Tag | None = None
    children: list[Tag] = field(default_factory=list["Tag"])

    def walk(self) -> Iterator[Tag]:
        """It and all below, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.walk()

    def within(self) -> Iterator[Tag]:
        """The tags around it, from the nearest on."""
        tag = self.parent
        while tag is not None:
            yield tag
            tag = tag.parent


@dataclass(frozen=True, eq=False)
class Tree:
    """root: of the main file.  texts: content of every file.  includes: the tags <include>, which the tree is without,
    and the file that each names."""

    root: Tag
    texts: Mapping[Path, bytes]
    includes: tuple[tuple[Tag, Path], ...]


def read_tree(path: Path) -> Tree:
    """The tags of an MJCF and of what it includes.

    Raises:
        ValueError: a file is missing, is no XML in UTF-8, or includes itself.
    """
    texts: dict[Path, bytes] = {}
    includes: list[tuple[Tag, Path]] = []
    root = _read(path.resolve(), path.resolve().parent, texts)

    def expand(tag: Tag) -> None:
        children: list[Tag] = []
        for child in tag.children:
            if child.name != "include":
                expand(child)
                children.append(child)
                continue
            named = child.attributes.get("file", "")
            beside = [folder / named for folder in (path.resolve().parent, child.file.parent)]
            found = next((p.resolve() for p in beside if p.is_file()), None)
            if found is None or found in texts:
                raise ValueError(f"{child.file}, line {child.line}: {named!r} is {'twice' if found else 'not'} there")
            includes.append((child, found))
            inner = _read(found, path.resolve().parent, texts)
            expand(inner)
            for each in inner.children:
                each.parent = tag
            children += inner.children
        tag.children = children

    expand(root)
    return Tree(root, texts, tuple(includes))


def _read(path: Path, main: Path, texts: dict[Path, bytes]) -> Tag:
    """The root of one file, includes as they stand."""
    text = path.read_bytes()
    try:
        text.decode("utf-8-sig")
        texts[path] = text
        return _parse(path, text)
    except (UnicodeDecodeError, expat.ExpatError) as error:
        raise ValueError(f"{path}: {error}") from None


def _parse(path: Path, text: bytes) -> Tag:
    parser = expat.ParserCreate("utf-8")
    stack: list[Tag] = []
    roots: list[Tag] = []

    def begin(name: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        match = _TAG.match(text, at)
        if match is None:
            raise ValueError(f"{path}, line {parser.CurrentLineNumber}: <{name}> is written in a way not known here")
        tag = Tag(name, attributes, path, parser.CurrentLineNumber, at, match.end(), bool(match[3]))
        if stack:
            tag.parent = stack[-1]
            stack[-1].children.append(tag)
        else:
            roots.append(tag)
        stack.append(tag)

    def finish(_: str) -> None:
        stack.pop()

    parser.StartElementHandler, parser.EndElementHandler = begin, finish
    parser.Parse(text, True)
    return roots[0]


Edits = Mapping[Tag, Mapping[str, str | None]]  # new attribute values; None takes the attribute away


def with_edits(tree: Tree, edits: Edits, inserted: Mapping[Tag, str]) -> dict[Path, str]:
    """The texts of the files that differ from the tree's: attributes changed, and lines put in behind start tags."""
    replaced: dict[Path, list[tuple[int, int, bytes]]] = {}
    for tag, changes in edits.items():
        new = _with_attributes(tree.texts[tag.file][tag.start : tag.end], changes)
        replaced.setdefault(tag.file, []).append((tag.start, tag.end, new))
    for tag, line in inserted.items():
        text = tree.texts[tag.file]
        own = text[text.rfind(b"\n", 0, tag.start) + 1 : tag.start]
        first = next((c for c in tag.children if c.file == tag.file), None)
        before = b"" if first is None else text[text.rfind(b"\n", 0, first.start) + 1 : first.start]
        indent = before if before and not before.strip() else (own if not own.strip() else b"") + b"  "
        alone = text[tag.end :].lstrip(b" \t")[:1] in (b"\n", b"\r")
        new = b"\n" + indent + line.encode() + (b"" if alone else b"\n" + indent)
        replaced.setdefault(tag.file, []).append((tag.end, tag.end, new))
    out: dict[Path, str] = {}
    for file, changes in replaced.items():
        text = tree.texts[file]
        for start, end, new in sorted(changes, reverse=True):
            text = text[:start] + new + text[end:]
        if text != tree.texts[file]:
            out[file] = text.decode("utf-8")
    return out


def _with_attributes(tag: bytes, changes: Mapping[str, str | None]) -> bytes:
    """A start tag with attributes replaced where they stand, taken away, or put behind the last one."""
    left = dict(changes)

    def attribute(match: re.Match[bytes]) -> bytes:
        name = match[2].decode()
        if name not in left:
            return match[0]
        value = left.pop(name)
        quote = match[4][:1]
        return b"" if value is None else match[1] + match[2] + match[3] + quote + value.encode() + quote

    whole = _TAG.match(tag)
    assert whole is not None
    middle = _ATTRIBUTE.sub(attribute, whole[2])
    middle += b"".join(f' {name}="{value}"'.encode() for name, value in left.items() if value is not None)
    return tag[: whole.start(2)] + middle + tag[whole.end(2) :]
