"""Truncated normal distributions: quantiles of one variable, and Gibbs sampling of many.

Rejection sampling is slow if hardly any draw is inside the bounds.  Gibbs sampling draws one variable after the other
from its conditional distribution, which is a truncated normal.  It is exact after one sweep for independent variables,
and converges with the number of sweeps for others.
Source: C. Robert, Simulation of Truncated Normal Variables, Statistics and Computing 5, 1995.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

SWEEPS = 200  # over all variables; for two variables of correlation r the start's influence is r^(2 SWEEPS)
_RIDGE = 1e-12  # relative, makes a singular covariance invertible


def quantiles(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return quantiles at levels q of standard normals truncated to [low, high]; the arrays broadcast.

    It computes with logarithms of tail probabilities, on the side of the box, so that boxes far out are accurate.
    """
    upper = low > 0
    a, b = np.where(upper, -high, low), np.where(upper, -low, high)
    levels = np.where(upper, 1.0 - q, q)
    with np.errstate(divide="ignore"):  # log(0) at the levels 0 and 1
        below = np.log(levels + (1.0 - levels) * np.exp(special.log_ndtr(a) - special.log_ndtr(b)))
        x = np.clip(special.ndtri_exp(special.log_ndtr(b) + below), a, b)
    return np.where(upper, -x, x)


def gibbs(
    rng: np.random.Generator, n: int, mean: np.ndarray, cov: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return draws [n, D] of a normal distribution inside a box.

    Each row is the end of a separate chain, so rows are independent.

    Args:
        rng: source of randomness.
        n: number of draws.
        mean: [D].
        cov: [D, D].
        low: [D] bounds, -inf for none.
        high: [D] bounds, inf for none.
    """
    std = np.sqrt(np.diag(cov))
    bounded = np.flatnonzero((np.isfinite(low) | np.isfinite(high)) & (std > 0))
    centre, inner = mean[bounded], cov[np.ix_(bounded, bounded)] + np.diag(_RIDGE * std[bounded] ** 2)
    precision = np.linalg.inv(inner)
    conditional_std = 1.0 / np.sqrt(np.diag(precision))

    def drawn(at: np.ndarray, scale: np.ndarray, i: Any) -> np.ndarray:
        bounds = ((b[bounded[i]] - at) / scale for b in (low, high))
        return np.clip(at + scale * quantiles(rng.random(at.shape), *bounds), low[bounded[i]], high[bounded[i]])

    x = drawn(np.tile(centre, (n, 1)), std[bounded], np.arange(len(bounded)))
    for _ in range(SWEEPS):
        for i in range(len(bounded)):
            shift = (x - centre) @ precision[i] - precision[i, i] * (x[:, i] - centre[i])
            x[:, i] = drawn(centre[i] - shift / precision[i, i], conditional_std[i], i)
    return _completed(rng, x, bounded, precision, mean, cov)


def _completed(
    rng: np.random.Generator,
    x: np.ndarray,
    bounded: np.ndarray,
    precision: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
) -> np.ndarray:
    """[n, D] rows with entries `bounded` of x [n, B]; the unbounded ones are drawn from their conditional normal."""
    unbounded = np.setdiff1d(np.arange(len(mean)), bounded)
    slope = cov[np.ix_(unbounded, bounded)] @ precision
    variance, axes = np.linalg.eigh(cov[np.ix_(unbounded, unbounded)] - slope @ cov[np.ix_(bounded, unbounded)])
    noise = rng.standard_normal((len(x), len(unbounded))) * np.sqrt(variance.clip(0))
    out = np.empty((len(x), len(mean)))
    out[:, bounded] = x
    out[:, unbounded] = mean[unbounded] + (x - mean[bounded]) @ slope.T + noise @ axes.T
    return out
