"""What came of letting a policy try: success, angle, grip, with intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats

# Success in one of a training's evaluations: of 80 trainings three never had it; the two that were tried on a robot all
# the same opened no door.
LEARNED = 0.95
BLOWN_UP = "the simulation blew up"  # in `Trials.stopped`: says nothing of the policy


def wilson(hits: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Interval of a share, `hits` of `count`.  Wilson, JASA 1927.  ValueError for a count of 0."""
    span = scipy.stats.binomtest(hits, count).proportion_ci(level, method="wilson")
    return float(span.low), float(span.high)


@dataclass(frozen=True, eq=False)
class Trials:
    """One entry for each trial, N of them.

    A trial goes on after success until its time is up, as a trial of the paper does.
    success: [N] bool.  angle: [N] rad, the largest; steps: [N] actions until success, or all that were made;
    grip: [N] share of actions with the knob gripped.  stopped: [N] why a trial was stopped, "" where it was not.
    Trials whose simulation blew up say nothing of the policy: they are in no rate and in no mean.
    """

    success: np.ndarray
    angle: np.ndarray
    steps: np.ndarray
    grip: np.ndarray
    stopped: np.ndarray

    @property
    def counted(self) -> np.ndarray:
        """[N] bool: all but those that blew up."""
        return self.stopped != BLOWN_UP

    def check(self) -> None:
        """ValueError where all trials blew up."""
        if not self.counted.any():
            raise ValueError(f"the simulation blew up in all {len(self.success)} trials: they say nothing of a policy")

    @property
    def rate(self) -> float:
        """Share of trials that succeeded; ValueError where all of them blew up."""
        self.check()
        return float(np.mean(self.success[self.counted]))

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Of the success rate (`wilson`).  ValueError where all trials blew up."""
        self.check()
        success = self.success[self.counted]
        return wilson(int(np.sum(success)), len(success), level)

    def to_json(self) -> dict[str, Any]:
        """As plain data, angles in degrees; trial by trial and in sum.

        Steps in sum are those of successes; sums are None where nothing is left to count; why trials stopped, without
        its numbers.
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
    """Mean and deviation, None where there are no values."""
    return {"mean": float(values.mean()), "std": float(values.std())} if len(values) else {"mean": None, "std": None}
