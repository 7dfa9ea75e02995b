"""Texts that error messages of several layers share."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Iterable, Mapping

from droid_jax.arguments import shown


def faults(found: Mapping[str, Collection[str]]) -> str:
    """Kinds of faults with the names concerned: "missing: a, b; unknown: c"; empty where there are no names."""
    return "; ".join(f"{what} {named(names)}" for what, names in found.items() if names)


def named(names: Iterable[str], most: int = 20) -> str:
    """A list of names for a message: "a, b and 3 more"; printable, and cut where it is long."""
    texts = [shown(name).strip("'") for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def lacking(what: str, extra: str, *packages: str) -> str:
    """A message that names the packages that are not installed and how to install them; empty where all are.

    Args:
        what: beginning of the message, "export needs".
        extra: the project's extra that installs the packages.
        packages: names of the packages.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    how = f"in the checkout, pip install -c constraints.txt -e '.[{extra}]'"
    return f"{what} {' and '.join(missing)}: {how}" if missing else ""


def needs(what: str, extra: str, *packages: str) -> None:
    """ValueError with the message of `lacking` where a package is not installed."""
    if message := lacking(what, extra, *packages):
        raise ValueError(message)


def reason(error: BaseException) -> str:
    """An error's message in one line; with its type, except for ValueError and OSError.

    Messages of ValueError and OSError are sentences.  Those of other errors are often a mere name.
    """
    lines = str(error).strip().splitlines()
    said = lines[0].strip() if lines else ""
    if isinstance(error, ValueError | OSError) and said:
        return said
    return f"{type(error).__name__}: {said}" if said else type(error).__name__
