"""Sign flips of whole repeats: what a statistic would be if nothing were common to all repeats.

Under "nothing is missing" the residuals of a repeat are as likely as their opposite.  Source:
R. A. Fisher, The Design of Experiments, 1935, section 21; Westfall and Young, Resampling-Based
Multiple Testing, 1993 (the largest statistic over many questions).
"""

from __future__ import annotations

import numpy as np
import scipy.stats

from droid_jax.cost.noise import detrend

EXACT = 12  # up to this many repeats all flips are tried
DRAWS = 4096
FEWEST_REPEATS = 8  # repeats; with six the smallest possible p is 0.03


def detrended(x: np.ndarray) -> np.ndarray:
    """x [N, ...] of repeats without its trend over their order: the same mean, the scatter of N - 2 degrees of freedom.

    What grows or fades steadily over the repeats (a friction or a sensor that warms up) is no noise.
    """
    if len(x) < 3:
        return x
    mean = x.mean(axis=0)
    return mean + (detrend(x) - mean) * np.sqrt((len(x) - 1) / (len(x) - 2))


def sign_flips(repeats: int, seed: int = 0, *, one_sided: bool = False) -> np.ndarray:
    """[F, N] of +1 and -1; the first row is the data as they are.

    Up to EXACT repeats all there are, of two opposite ones but one: for statistics that do not see the difference.
    one_sided: both, for those that do.
    """
    if repeats <= EXACT:
        bits = np.arange(2 ** (repeats if one_sided else repeats - 1))[:, None] >> np.arange(repeats) & 1
        return 1.0 - 2.0 * bits
    rng = np.random.default_rng(seed)
    drawn = rng.choice([-1.0, 1.0], size=(DRAWS, repeats))
    drawn[0] = 1.0
    return drawn


def t_values(scores: np.ndarray, flips: np.ndarray) -> np.ndarray:
    """[F, K] Student's t of scores [K, N] over the repeats, for every flip."""
    count = scores.shape[1]
    mean = flips @ scores.T / count
    variance = np.maximum(np.mean(scores**2, axis=1) - mean**2, 1e-30) * count / (count - 1)
    return mean / np.sqrt(variance / count)


def one_sided_p(gains: np.ndarray) -> float:
    """p-value of gains [N] being above zero on average."""
    t = t_values(gains[None], sign_flips(len(gains), one_sided=True))[:, 0]
    return float(np.mean(t >= t[0] - 1e-12))


def largest_detrended_t(scores: np.ndarray, seed: int = 0) -> tuple[np.ndarray, float]:
    """[K] t of each of K questions with scores [K, N], and the p-value of the largest |t| among them.

    Without what grows or fades steadily over the repeats (`steady`).

    A line taken out costs a degree of freedom, but not where rows were flipped after it: the unflipped t is compared as
    the quantile of theirs that it is of its own.  Without that 1.6 % of noise alone fell below p = 0.01 (ten repeats,
    forty independent questions; `tests/discrepancy/test_flips.py`).
    """
    count = scores.shape[1]
    t = t_values(detrended(scores.T).T, sign_flips(count, seed))
    own, flipped = scipy.stats.t(max(count - 2, 1)), scipy.stats.t(count - 1)
    found = flipped.isf(own.sf(np.max(np.abs(t[0]))))
    return t[0], float(np.mean(np.max(np.abs(t), axis=1) >= found * (1 - 1e-12)))


def detrended_discrepancy_p_values(residuals: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """[K] p-value of each cell's U being above zero, without what grows or fades steadily over the repeats (`steady`).

    residuals [N, M], cells [K, M] bool.  Where a line was taken out, the products of different repeats have a part of
    their own (`_taken_out`), which adds up to next to nothing as they are and to something under most flips: it is put
    back.  Without that hardly anything is found below U = M^-1/2 (U = 0.02 of 1400 residuals, eight repeats, p < 0.01:
    1 in 50, and now 2 in 3; `tests/discrepancy/test_flips.py`).
    """
    flips, rows, out = sign_flips(len(residuals)), detrended(residuals), []
    for cell in cells:
        gram = rows[:, cell] @ rows[:, cell].T
        gram -= _taken_out(gram)
        np.fill_diagonal(gram, 0.0)  # squares do not change sign
        products = np.einsum("fn,nm,fm->f", flips, gram, flips)
        out.append(float(np.mean(products >= products[0] - 1e-12 * abs(products[0]))))
    return np.array(out)


def _taken_out(gram: np.ndarray) -> np.ndarray:
    """[N, N] what taking the line out makes of the products [N, N] of repeats that share nothing.

    Each repeat has a noise of its own size, told by what the repeats' deviations from their mean hold of it.
    """
    count = len(gram)
    made = detrended(np.eye(count))
    apart = made - 1.0 / count
    centred = np.eye(count) - 1.0 / count
    squares = np.diag(centred @ gram @ centred)
    return made @ np.diag(np.maximum(np.linalg.lstsq(apart**2, squares)[0], 0.0)) @ made.T


def benjamini_hochberg(p: np.ndarray, level: float = 0.1) -> np.ndarray:
    """[K] bool, the hypotheses rejected at a false discovery rate.  Benjamini and Hochberg, JRSS B 1995."""
    return scipy.stats.false_discovery_control(p, method="bh") <= level
