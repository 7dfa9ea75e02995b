"""A normal distribution inside a box: quantiles of one variable, and draws of many where rejection would take for ever.

Gibbs sampling draws one variable after the other from its distribution given the others, a truncated
normal again: exact at once for independent variables, and for others as close as SWEEPS rounds bring it.
Source: C. Robert, Simulation of Truncated Normal Variables, Statistics and Computing 5, 1995.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

SWEEPS = 200  # rounds over all variables; a pair of correlation r forgets its start as r^(2 SWEEPS)
_RIDGE = 1e-12  # relative: keeps a singular covariance invertible


def quantiles(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Quantiles at levels q of standard normals truncated to [low, high], arrays that broadcast.

    In logarithms of the tail on whose side the box lies, so that boxes far out keep their digits.
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
    """[n, D] draws of a normal distribution (mean [D], cov [D, D]) inside a box (low, high [D], infinite for none).

    Each row is the end of a chain of its own, so rows are independent.
    """
    std = np.sqrt(np.diag(cov))
    cut = np.flatnonzero((np.isfinite(low) | np.isfinite(high)) & (std > 0))
    centre, inner = mean[cut], cov[np.ix_(cut, cut)] + np.diag(_RIDGE * std[cut] ** 2)
    precision = np.linalg.inv(inner)
    spread = 1.0 / np.sqrt(np.diag(precision))

    def drawn(at: np.ndarray, scale: np.ndarray, i: Any) -> np.ndarray:
        bounds = ((b[cut[i]] - at) / scale for b in (low, high))
        return np.clip(at + scale * quantiles(rng.random(at.shape), *bounds), low[cut[i]], high[cut[i]])

    x = drawn(np.tile(centre, (n, 1)), std[cut], np.arange(len(cut)))
    for _ in range(SWEEPS):
        for i in range(len(cut)):
            pull = (x - centre) @ precision[i] - precision[i, i] * (x[:, i] - centre[i])
            x[:, i] = drawn(centre[i] - pull / precision[i, i], spread[i], i)
    return _completed(rng, x, cut, precision, mean, cov)


def _completed(
    rng: np.random.Generator, x: np.ndarray, cut: np.ndarray, precision: np.ndarray, mean: np.ndarray, cov: np.ndarray
) -> np.ndarray:
    """[n, D] rows whose entries `cut` are x [n, C]; the others, which have no bounds, are normal given these."""
    rest = np.setdiff1d(np.arange(len(mean)), cut)
    slope = cov[np.ix_(rest, cut)] @ precision
    variance, axes = np.linalg.eigh(cov[np.ix_(rest, rest)] - slope @ cov[np.ix_(cut, rest)])
    noise = rng.standard_normal((len(x), len(rest))) * np.sqrt(variance.clip(0))
    out = np.empty((len(x), len(mean)))
    out[:, cut] = x
    out[:, rest] = mean[rest] + (x - mean[cut]) @ slope.T + noise @ axes.T
    return out
