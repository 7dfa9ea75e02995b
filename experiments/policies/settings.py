"""The doors on which methods are compared; nothing here changes after a run.

Their reasons: docs/history/policy-experiments.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class Setting:
    """A robot and its door, and what is asked for.

    springs: column of Table I for the hidden values; truth: what differs from it; robot: seed of the hidden errors.
    task: what differs from the usual task.  times: how many times --seeds policies there are of each method.
    """

    name: str
    springs: int
    robot: int
    truth: Mapping[str, float] = field(default_factory=dict)
    task: Mapping[str, Any] = field(default_factory=dict)
    times: int = 1


SETTINGS = {
    "paper": Setting("paper", springs=0, robot=11),
    "dry": Setting(
        "dry",
        springs=1,
        robot=12,
        truth={
            "hinge_stiffness": 2.0,
            "hinge_frictionloss": 4.5,
            "hinge_damping": 6.0,
            "sliding_friction_left": 1.5,
            "sliding_friction_right": 1.5,
            "torsional_friction_left": 1.0,
            "torsional_friction_right": 1.0,
        },
        times=2,  # policies differ more there
    ),
}


def setting_of(name: str, robot: int | None) -> Setting:
    """A setting, with another robot's hidden errors where one is asked for (pilots)."""
    return SETTINGS[name] if robot is None else replace(SETTINGS[name], robot=robot)
