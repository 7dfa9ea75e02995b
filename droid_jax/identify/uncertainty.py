"""From a refined fit to a calibrated Gaussian, and what the demonstration tells about each parameter.

Rule of the width.  Gauss-Newton around the best gives the covariance H^-1 with nuisances
marginalised; it believes that the residuals are nothing but the noise of the repeats.  What is
left over is more than that (discretisation, small unmodelled effects) and correlated in time, so
the scores J^T r of contiguous blocks of time, per column, are compared with what noise alone would
give: the sandwich H^-1 (sum_b g_b g_b^T + P) H^-1 (Huber 1967; blocks as in Kuensch 1989).  Each
deviation becomes the larger of the two, correlations stay those of H^-1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.refine import Refined

IDENTIFIABLE = 0.25  # posterior deviation over prior deviation below which the data have spoken
PARTNER = 0.7  # absolute correlation from which two parameters are called partners


@dataclass(frozen=True)
class Identifiability:
    """What the data tell about one parameter: identifiable or not, why, and who it trades with."""

    name: str
    identifiable: bool
    shrinkage: float
    partners: tuple[tuple[str, float], ...]
    reason: str


def calibrated(refined: Refined, block_ids: np.ndarray) -> Gaussian:
    """The calibrated Gaussian in search coordinates over the refined space.

    block_ids: [M] integer block of each residual (see `time_blocks`).
    """
    plain = np.linalg.inv(refined.hessian)
    wide = np.sqrt(np.maximum(np.diag(_sandwich(refined, plain, block_ids)), np.diag(plain)))
    factor = wide / np.sqrt(np.diag(plain))
    cov = plain * np.outer(factor, factor)
    main = ~refined.space.nuisance
    rule = (
        "Gauss-Newton around the best, nuisances marginalised, deviations widened to the block scores of the "
        f"residuals (x{np.median(factor[main]):.2f} in the median)"
    )
    return Gaussian(refined.space, refined.x, 0.5 * (cov + cov.T), rule, "search")


def _sandwich(refined: Refined, inverse: np.ndarray, block_ids: np.ndarray) -> np.ndarray:
    scores = np.zeros((int(block_ids.max()) + 1, refined.jacobian.shape[1]))
    np.add.at(scores, block_ids, refined.jacobian * refined.residual[:, None])
    prior = np.diag(refined.prior**-2)
    return inverse @ (scores.T @ scores + prior) @ inverse


def time_blocks(shapes: Sequence[tuple[int, int]], seconds: Sequence[float], block: float = 1.0) -> np.ndarray:
    """[M] block of each whitened residual: per recording and column, contiguous stretches of `block` s.

    shapes: (columns C, coarse samples K) of each compared channel, in the order of the residuals
    (column by column); seconds: its duration.
    """
    ids, start = [], 0
    for (columns, samples), duration in zip(shapes, seconds, strict=True):
        per_column = max(1, round(duration / block))
        within = np.minimum((np.arange(samples) * per_column) // samples, per_column - 1)
        for _ in range(columns):
            ids.append(start + within)
            start += per_column
    return np.concatenate(ids)


def not_judged(gaussian: Gaussian) -> tuple[Identifiability, ...]:
    """For a search's own covariance, which is no posterior: nothing is called identifiable from it."""
    reason = "not judged: the search's covariance depends on when it stopped"
    return tuple(Identifiability(name, False, 1.0, (), reason) for name in gaussian.space.names)


def identifiability(gaussian: Gaussian, prior: np.ndarray) -> tuple[Identifiability, ...]:
    """What the demonstration tells about each parameter of a calibrated Gaussian.

    prior: [D] prior deviations, search units.
    """
    deviation = np.sqrt(np.diag(gaussian.cov))
    correlation = gaussian.cov / np.outer(deviation, deviation)
    space = gaussian.space
    out = []
    for i, name in enumerate(space.names):
        shrinkage = float(deviation[i] / prior[i])
        others = [(space.names[j], float(correlation[i, j])) for j in np.argsort(-np.abs(correlation[i])) if j != i]
        partners = tuple((n, c) for n, c in others if abs(c) > PARTNER)[:3]
        known = shrinkage < IDENTIFIABLE
        out.append(Identifiability(name, known, shrinkage, partners, _reason(known, shrinkage, partners)))
    return tuple(out)


def _reason(known: bool, shrinkage: float, partners: tuple[tuple[str, float], ...]) -> str:
    trade = f"; trades with {', '.join(n for n, _ in partners)}" if partners else ""
    if known:
        return f"the data narrow the prior to {shrinkage:.0%}{trade}"
    if shrinkage > 0.9:
        return f"this demonstration does not tell: it leaves {shrinkage:.0%} of the prior's width{trade}"
    return f"this demonstration tells little: it leaves {shrinkage:.0%} of the prior's width{trade}"
