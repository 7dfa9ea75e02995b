"""Writes docs/command-line.md, the page of all commands and options, from the commands' own dataclasses.

python docs/command_line.py
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import sys
import types
import typing
from pathlib import Path
from typing import Any

import tyro

from droid_jax.run import _ACTIONS

PAGE = Path(__file__).with_name("command-line.md")
WORDS = {Path: "PATH", str: "TEXT", int: "INT", float: "NUMBER"}
HEAD = """# The command line

Written by `python docs/command_line.py` from the commands' own descriptions, which `--help` behind a command shows too.

```sh
python -m droid_jax.run [COMMAND] [OPTIONS]
```

Without a command: [`all`](#all). `droid-jax` is the same program. `--version` says which version it is, `--help` what \
there is, `--tyro-print-completion bash` (`zsh`, `tcsh`) completes it in a shell. An option shown with `...` takes \
several values; a switch `--film` is turned off by `--no-film`. Bad input ends with exit code 2 and, on stderr, one \
sentence (of an option that does not exist, a box with those that resemble it); Ctrl-C ends with exit code 130.
"""


def page() -> str:
    """The page's text."""
    return "\n".join([HEAD, *(_command(command) for command in _ACTIONS)])


def name_of(command: type) -> str:
    """What is typed to run it."""
    name = command.__name__.removesuffix("Command")
    return "-".join(part.lower() for part in re.findall("[A-Z][a-z]*", name))


def _command(command: type) -> str:
    """A command's section: what it does, and a row for each option."""
    hints, told = typing.get_type_hints(command, include_extras=True), _meanings(command)
    rows = [_row(field, hints[field.name], told[field.name]) for field in dataclasses.fields(command)]
    what = "\n\n".join(" ".join(part.split()) for part in (command.__doc__ or "").split("\n\n"))
    return "\n".join(
        [f"## {name_of(command)}\n\n{what}\n", "| option | default | meaning |", "|---|---|---|", *rows, ""]
    )


def _row(field: dataclasses.Field[Any], hint: Any, meaning: str) -> str:
    """A field as a row of the table."""
    annotated = typing.get_origin(hint) is typing.Annotated
    values = _values(typing.get_args(hint)[0] if annotated else hint)
    renamed = (getattr(each, "name", None) for each in hint.__metadata__) if annotated else ()
    name = next(filter(None, renamed), field.name.replace("_", "-"))
    if annotated and tyro.conf.Positional in hint.__metadata__:
        option = name.upper() + " ..." * values.endswith("...")
    else:
        option = f"--{name} {values}".strip()
    cells = (f"`{option}`", _default(field.default), meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(value: Any) -> str:
    """A default as it is typed; empty where there is none, or where the meaning says it."""
    if value is dataclasses.MISSING or value is None or value is False or value == ():
        return ""
    values = value if isinstance(value, tuple) else ("on",) if value is True else (value,)
    return f"`{' '.join(map(str, values))}`"


def _values(kind: Any) -> str:
    """What an option takes: "INT", "quick, paper or gpu", "PATH ..."; empty for a switch."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        kind = next(one for one in typing.get_args(kind) if one is not type(None))
    if typing.get_origin(kind) is typing.Literal:
        return "|".join(map(str, typing.get_args(kind)))
    if typing.get_origin(kind) is tuple:
        return f"{_values(typing.get_args(kind)[0])} ..."
    return WORDS.get(kind, "")


def _meanings(command: type) -> dict[str, str]:
    """Field -> the text below it in the source, on one line."""
    module = ast.parse(inspect.getsource(sys.modules[command.__module__]))
    (body,) = (node.body for node in module.body if isinstance(node, ast.ClassDef) and node.name == command.__name__)
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
