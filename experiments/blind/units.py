"""Between newton metres and units of noise, for evidence of torques alone."""

from __future__ import annotations

import numpy as np

from droid_jax.discrepancy.residual_set import ResidualSet


def whitened(evidence: ResidualSet, torque: np.ndarray) -> np.ndarray:
    """[K, M] N m, column after column on the coarse clock -> [K, M] in units of one repeat's noise."""
    whitener = _whitener(evidence)
    parts = torque.reshape(len(torque), len(whitener), -1)
    return np.einsum("ckl,ncl->nck", whitener, parts).reshape(torque.shape)


def torques(evidence: ResidualSet, columns: np.ndarray) -> np.ndarray:
    """[K, M] units of one repeat's noise -> [K, M] N m."""
    whitener = _whitener(evidence)
    parts = columns.reshape(len(columns), len(whitener), -1)
    return np.linalg.solve(whitener, parts.transpose(1, 2, 0)).transpose(2, 0, 1).reshape(columns.shape)


def _whitener(evidence: ResidualSet) -> np.ndarray:
    """[C, K, K]."""
    (channel,) = evidence.cost.comparisons[0].channels
    return channel.noise.whitener / np.sqrt(evidence.repeats)
