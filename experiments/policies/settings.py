"""The doors on which methods are compared.  docs/paper.md gives their reasons; nothing here changes after a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Setting:
    """A robot and its door, and what is asked for.

    springs: column of Table I for the hidden values; truth: what differs from it; robot: seed of the hidden errors.
    task: what differs from the usual task.
    """

    name: str
    springs: int
    robot: int
    truth: Mapping[str, float] = field(default_factory=dict)
    task: Mapping[str, Any] = field(default_factory=dict)


SETTINGS = {"paper": Setting("paper", springs=0, robot=11)}
