"""The largest t under sign flips as the textbook has it, beside which the search's own tests are put."""

from __future__ import annotations

import numpy as np

from droid_jax.discrepancy.statistics import sign_flips, t_values


def largest_t(scores: np.ndarray) -> tuple[np.ndarray, float]:
    """[K] t of each of K directions with scores [K, N], and the p-value of the largest |t| among them."""
    t = t_values(scores, sign_flips(scores.shape[1]))
    largest = np.max(np.abs(t), axis=1)
    return t[0], float(np.mean(largest >= largest[0] * (1 - 1e-12)))
