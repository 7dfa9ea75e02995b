"""What errors of several rooms say alike."""

from __future__ import annotations

from collections.abc import Collection, Mapping


def faults(found: Mapping[str, Collection[str]]) -> str:
    """ "missing: a, b; unknown: c": what is wrong and the names it is wrong with; empty where no names are."""
    return "; ".join(f"{what} {', '.join(names)}" for what, names in found.items() if names)
