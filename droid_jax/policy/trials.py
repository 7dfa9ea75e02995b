"""Outcomes of a policy's trials: success, angle, grip, with intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats

# Success rate that a training must reach in one evaluation.  Of 80 trainings three did not; two of their policies were
# tried on a robot and opened no door.
LEARNED = 0.95
BLOWN_UP = "the simulation blew up"  # in `Trials.stopped`; such trials are not counted


def wilson(hits: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson's interval (JASA 1927) of a proportion, `hits` of `count`; ValueError for a count of 0."""
    span = scipy.stats.binomtest(hits, count).proportion_ci(level, method="wilson")
    return float(span.low), float(span.high)


@dataclass(frozen=True, eq=False)
class Trials:
    """Outcomes of N trials.

    A trial continues after success until its time is up, as in the paper.  Trials whose simulation diverged are not
    counted in rates and means, since they do not depend on the policy.

    Attributes:
        success: [N] bool.
        angle: [N] rad, largest angle of the door.
        steps: [N] actions until success, or all actions without success.
        grip: [N] share of actions with the knob gripped.
        stopped: [N] why a trial was stopped; "" if it was not.
    """

    success: np.ndarray
    angle: np.ndarray
    steps: np.ndarray
    grip: np.ndarray
    stopped: np.ndarray

    @property
    def counted(self) -> np.ndarray:
        """[N] bool, trials whose simulation did not diverge."""
        return self.stopped != BLOWN_UP

    def check(self) -> None:
        """Raise ValueError if the simulations of all trials diverged."""
        if not self.counted.any():
            raise ValueError(f"the simulation blew up in all {len(self.success)} trials: the policy has no result")

    @property
    def rate(self) -> float:
        """Success rate of the counted trials; ValueError if there are none."""
        self.check()
        return float(np.mean(self.success[self.counted]))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Wilson's interval of the success rate; ValueError if no trial is counted."""
        self.check()
        success = self.success[self.counted]
        return wilson(int(np.sum(success)), len(success), level)

    def to_json(self) -> dict[str, Any]:
        """Plain data: each trial, and statistics of the counted ones; angles in degrees.

        Statistics of steps are those of successful trials.  Statistics without any trial are None.  Reasons of stops
        are given without their numbers.
        """
        counted, degrees = self.counted, np.rad2deg(self.angle)
        some = bool(counted.any())
        short = [str(why).partition(":")[0] for why in self.stopped]
        reasons, counts = np.unique([why for why in short if why], return_counts=True)
        return {
            "trials": len(self.success),
            "success_rate": self.rate if some else None,
            "interval_95": list(self.interval()) if some else None,
            "angle_deg": {**_spread(degrees[counted]), "all": degrees.round(2).tolist()},
            "steps": {**_spread(self.steps[counted & self.success.astype(bool)]), "all": self.steps.tolist()},
            "grip": {"mean": _spread(self.grip[counted])["mean"], "all": self.grip.round(3).tolist()},
            "success": self.success.astype(bool).tolist(),
            "stopped": dict(zip(reasons.tolist(), counts.tolist(), strict=True)),
            "stopped_each": short,
        }


def _spread(values: np.ndarray) -> dict[str, float | None]:
    """Mean and standard deviation; None without values."""
    return {"mean": float(values.mean()), "std": float(values.std())} if len(values) else {"mean": None, "std": None}
