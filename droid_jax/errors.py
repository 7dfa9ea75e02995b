"""What errors of several layers say alike."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Iterable, Mapping

from droid_jax.arguments import shown


def faults(found: Mapping[str, Collection[str]]) -> str:
    """ "missing: a, b; unknown: c": what is wrong and the names it is wrong with; empty where no names are."""
    return "; ".join(f"{what} {named(names)}" for what, names in found.items() if names)


def named(names: Iterable[str], most: int = 20) -> str:
    """ "a, b and 3 more": names of a file or a caller, printable and cut where they are long."""
    texts = [shown(name).strip("'") for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def lacking(what: str, extra: str, *packages: str) -> str:
    """ "export needs onnx and what to type" where one of the packages is not installed; empty where all are.

    what: with its verb, "export needs".  extra: of this project, which brings the packages.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    how = f"in the checkout, pip install -c constraints.txt -e '.[{extra}]'"
    return f"{what} {' and '.join(missing)}: {how}" if missing else ""


def needs(what: str, extra: str, *packages: str) -> None:
    """ValueError that says so where something is `lacking`."""
    if told := lacking(what, extra, *packages):
        raise ValueError(told)


def reason(error: BaseException) -> str:
    """Why something was not made, in one line: an error's message; with its type where that says no more than a name.

    Of ours (ValueError, OSError) the message is a sentence; of others the type says what it is about.
    """
    lines = str(error).strip().splitlines()
    said = lines[0].strip() if lines else ""
    if isinstance(error, ValueError | OSError) and said:
        return said
    return f"{type(error).__name__}: {said}" if said else type(error).__name__
