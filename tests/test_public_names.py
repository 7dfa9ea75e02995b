"""Public names are unique, and have docstrings for `pdoc` and editors."""

from __future__ import annotations

import ast
import inspect
from collections import defaultdict
from pathlib import Path

import pytest

import droid_jax as dj

PACKAGE = Path(dj.__file__).parent
# Name that several modules define -> why.
SHARED = {"run": "every command has one, of one interface: the parsed command, nothing back (`droid_jax.run`)"}


def defined(source: str) -> list[str]:
    """Public functions and classes at the top of a module."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    return [n.name for n in ast.parse(source).body if isinstance(n, kinds) and not n.name.startswith("_")]


def homes() -> dict[str, list[str]]:
    """Public name -> the modules that define it."""
    found: dict[str, list[str]] = defaultdict(list)
    for file in sorted(PACKAGE.rglob("*.py")):
        for name in defined(file.read_text()):
            found[name].append(file.relative_to(PACKAGE).as_posix())
    return found


def test_one_name_is_one_thing():
    several = {name: files for name, files in homes().items() if len(files) > 1 and name not in SHARED}
    assert several == {}
    assert len(SHARED) <= 5


def test_private_names_and_methods_are_no_public_ones():
    source = "def a(): pass\ndef _b(): pass\nclass C:\n    def d(self): pass\nasync def e(): pass\nf = 1"
    assert defined(source) == ["a", "C", "e"]


def test_every_module_says_what_it_holds():
    first = {f: (ast.get_docstring(ast.parse(f.read_text())) or "").split("\n")[0] for f in PACKAGE.rglob("*.py")}
    assert [f.relative_to(PACKAGE).as_posix() for f, line in first.items() if len(line.split()) < 4] == []


@pytest.mark.parametrize("name", dj.__all__)
def test_a_public_name_says_what_it_takes_and_gives(name: str):
    """Google style, as pdoc and editors read it: arguments, return value, errors."""
    public = getattr(dj, name)
    text = inspect.getdoc(public) or ""
    first, *rest = text.split("\n")
    assert first.endswith((".", ")")) and (not rest or rest[0] == "")
    if inspect.isclass(public):
        listed = [f for f in getattr(public, "__dataclass_fields__", ()) if not f.startswith("_")]
        heading = "Attributes:"
    else:
        listed = list(inspect.signature(public).parameters)
        heading = "Args:"
        assert "\nReturns:\n" in text and "\nRaises:\n" in text
    assert not listed or f"\n{heading}\n" in text
    block = text.partition(f"{heading}\n")[2].partition("\n\n")[0]
    told = {n for line in block.split("\n") if ":" in line for n in line.split(":")[0].replace(" ", "").split(",")}
    assert set(listed) <= told


def test_type_checkers_read_the_package():
    assert (PACKAGE / "py.typed").is_file()
    assert len(dj.__all__) <= 30
