"""Does something change from repeat to repeat?  A gear that warms up, a sensor that drifts, a screw that comes loose.

Repeats are taken for draws of the same thing, so what changes between them counts as noise and is in no gap.  This
test asks about it: the score of each candidate's mark, repeat by repeat, against the repeats' order.  If the order
says nothing, every other order is as likely.  Source: R. A. Fisher, The Design of Experiments, 1935, section 21.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from droid_jax.discrepancy.screen import ScoreTest

ORDERS = 4096


@dataclass(frozen=True)
class Trend:
    """What changes most steadily over the repeats.

    candidate, amplitude: whose mark; per_repeat: by how much the amplitude changes from one repeat to the next,
    in its unit; p: of a trend as strong in any candidate where the order of the repeats says nothing.
    """

    candidate: str
    amplitude: str
    per_repeat: float
    p: float


def trend(found: ScoreTest, residuals: np.ndarray, seed: int = 0) -> Trend | None:
    """The strongest trend of residuals [N, M] over their order; None for fewer than three repeats."""
    count = len(residuals)
    if count < 3 or not found.directions:
        return None
    size = np.maximum(np.linalg.norm(found.sensitivities, axis=1), 1e-30)
    scores = (found.sensitivities @ residuals.T) / size[:, None]  # [K, N], noise of one
    order = np.arange(count) - 0.5 * (count - 1)
    order /= np.linalg.norm(order)
    others = np.random.default_rng(seed).permuted(np.tile(order, (ORDERS - 1, 1)), axis=1)
    orders = np.concatenate([order[None], others])
    slopes = np.abs(orders @ scores.T)  # [F, K]
    largest = slopes.max(axis=1)
    best = int(np.argmax(slopes[0]))
    question = found.directions[best]
    steps = float(order @ scores[best]) / size[best] * (order[1] - order[0])
    return Trend(
        question.candidate.name, question.coefficient, steps, float(np.mean(largest >= largest[0] * (1 - 1e-12)))
    )
