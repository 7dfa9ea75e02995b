"""The text of an MJCF with the position of every start tag, also in included files.

`read_tree` gives the tags as a tree, with includes replaced by their content.  `with_edits` changes attributes in the
text.  Layout, comments and the order of attributes are unchanged.
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

    Attributes:
        name: of the element.
        attributes: as written.
        file: that contains it.
        line: number, from 1.
        start, end: byte positions in the file; `end` is after its ">".
        empty: whether it closes itself.
        parent: the enclosing tag; for an included tag the one that encloses the include.
        children: tags inside it.
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
        """Yield the tag and all tags inside it, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.walk()

    def within(self) -> Iterator[Tag]:
        """Yield the enclosing tags, from the innermost."""
        tag = self.parent
        while tag is not None:
            yield tag
            tag = tag.parent


@dataclass(frozen=True, eq=False)
class Tree:
    """The tags of an MJCF and its includes.

    Attributes:
        root: of the main file.
        texts: content of each file.
        includes: <include> tags, which are not in the tree, and the files that they name.
    """

    root: Tag
    texts: Mapping[Path, bytes]
    includes: tuple[tuple[Tag, Path], ...]


def read_tree(path: Path) -> Tree:
    """The tags of an MJCF and of the files that it includes.

    Raises:
        ValueError: a file is missing, is no XML in UTF-8, or includes itself.
    """
    texts: dict[Path, bytes] = {}
    includes: list[tuple[Tag, Path]] = []
    root = _read(path.resolve(), texts)

    def expand(tag: Tag) -> None:
        children: list[Tag] = []
        for child in tag.children:
            if child.name != "include":
                expand(child)
                children.append(child)
                continue
            named = child.attributes.get("file", "")
            candidates = [folder / named for folder in (path.resolve().parent, child.file.parent)]
            file = next((p.resolve() for p in candidates if p.is_file()), None)
            if file is None or file in texts:
                raise ValueError(f"{child.file}, line {child.line}: {named!r} is {'twice' if file else 'not'} there")
            includes.append((child, file))
            inner = _read(file, texts)
            expand(inner)
            for each in inner.children:
                each.parent = tag
            children += inner.children
        tag.children = children

    expand(root)
    return Tree(root, texts, tuple(includes))


def _read(path: Path, texts: dict[Path, bytes]) -> Tag:
    """The root of one file, with its includes unresolved; adds the file's content to `texts`."""
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
            raise ValueError(f"{path}, line {parser.CurrentLineNumber}: the text of <{name}> is not understood")
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


Edits = Mapping[Tag, Mapping[str, str | None]]  # new attribute values; None removes the attribute


def with_edits(tree: Tree, edits: Edits, inserted: Mapping[Tag, str]) -> dict[Path, str]:
    """File -> new text, of the files that change; attributes are edited, and lines inserted after start tags."""
    replaced: dict[Path, list[tuple[int, int, bytes]]] = {}
    for tag, changes in edits.items():
        new = _with_attributes(tree.texts[tag.file][tag.start : tag.end], changes)
        replaced.setdefault(tag.file, []).append((tag.start, tag.end, new))
    for tag, line in inserted.items():
        text = tree.texts[tag.file]
        of_tag = text[text.rfind(b"\n", 0, tag.start) + 1 : tag.start]
        first = next((c for c in tag.children if c.file == tag.file), None)
        of_child = b"" if first is None else text[text.rfind(b"\n", 0, first.start) + 1 : first.start]
        indent = of_child if of_child and not of_child.strip() else (of_tag if not of_tag.strip() else b"") + b"  "
        ends_line = text[tag.end :].lstrip(b" \t")[:1] in (b"\n", b"\r")
        new = b"\n" + indent + line.encode() + (b"" if ends_line else b"\n" + indent)
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
    """A start tag with attributes replaced, removed, or added after the last one."""
    remaining = dict(changes)

    def attribute(match: re.Match[bytes]) -> bytes:
        name = match[2].decode()
        if name not in remaining:
            return match[0]
        value = remaining.pop(name)
        quote = match[4][:1]
        return b"" if value is None else match[1] + match[2] + match[3] + quote + value.encode() + quote

    match = _TAG.match(tag)
    assert match is not None
    middle = _ATTRIBUTE.sub(attribute, match[2])
    middle += b"".join(f' {name}="{value}"'.encode() for name, value in remaining.items() if value is not None)
    return tag[: match.start(2)] + middle + tag[match.end(2) :]
