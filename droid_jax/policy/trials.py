"""What came of letting a policy try: success, angle, grip, with intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats

BLOWN_UP = "the simulation blew up"  # in `Trials.stopped`: says nothing of the policy


@dataclass(frozen=True, eq=False)
class Trials:
    """One entry for each trial, N of them.

    A trial goes on after success until its time is up, as a trial of the paper does.
    success: [N] bool.  angle: [N] rad, the largest; steps: [N] actions until success, or all that were made;
    grip: [N] share of actions with the knob gripped.  stopped: [N] why a trial was stopped, "" where it was not.
    """

    success: np.ndarray
    angle: np.ndarray
    steps: np.ndarray
    grip: np.ndarray
    stopped: np.ndarray

    @property
    def rate(self) -> float:
        """Share of trials that succeeded."""
        return float(np.mean(self.success))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Of the success rate.  Wilson, JASA 1927."""
        count = scipy.stats.binomtest(int(np.sum(self.success)), len(self.success))
        span = count.proportion_ci(level, method="wilson")
        return float(span.low), float(span.high)

    def to_json(self) -> dict[str, Any]:
        """As plain data, angles in degrees; trial by trial and in sum.

        Steps in sum are those of successes, None where there were none; why trials stopped, without its numbers.
        """
        degrees, steps = np.rad2deg(self.angle), self.steps[self.success.astype(bool)]
        short = [str(why).partition(":")[0] for why in self.stopped]
        reasons, counts = np.unique([why for why in short if why], return_counts=True)
        return {
            "trials": len(self.success),
            "success_rate": self.rate,
            "interval_95": list(self.interval()),
            "angle_deg": {"mean": float(degrees.mean()), "std": float(degrees.std()), "all": degrees.round(2).tolist()},
            "steps": {
                "mean": float(steps.mean()) if len(steps) else None,
                "std": float(steps.std()) if len(steps) else None,
                "all": self.steps.tolist(),
            },
            "grip": {"mean": float(self.grip.mean()), "all": self.grip.round(3).tolist()},
            "success": self.success.astype(bool).tolist(),
            "stopped": dict(zip(reasons.tolist(), counts.tolist(), strict=True)),
            "stopped_each": short,
        }
