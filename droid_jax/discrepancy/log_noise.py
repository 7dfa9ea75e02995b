"""The noise of one log, estimated from what the base model and the best candidates leave of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from droid_jax.cost.lone_log import LoneLog
from droid_jax.cost.noise import stated_deviation
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import Proposal, ScoreTest, directions_of, proposals, rows_of, score_test
from droid_jax.discrepancy.case import Case, ResidualSet, block_residual_set
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FittedModel, base_model, refit
from droid_jax.discrepancy.statistics import OUTSIDE, block_length, fewest_blocks
from droid_jax.identify.multistart import RefineProgress
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import candidates
from droid_jax.model.parameters import Space
from droid_jax.recordings.split import FEWEST_REPEATS

Log: TypeAlias = LoneLog | WindowedLog
Report: TypeAlias = Callable[[RefineProgress], None] | None


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """Noise of one log.

    deviation: [C] to state.  block: s, length of the blocks.  values: [D] of the base fitted meanwhile.
    """

    deviation: np.ndarray
    block: float
    values: np.ndarray


def noise_of(
    log: Log,
    base: Space,
    effects: Sequence[Effect],
    end: float,
    config: DiscrepancyConfig,
    start: np.ndarray | None,
    progress: Report = None,
) -> NoiseEstimate:
    """What to state as the noise of a log, and how long its blocks are, from what lies before `end`.

    One recording does not tell its noise.  What is stated, and sets the blocks' length, is the smallest residual that
    an extended model leaves, the base and up to `max_effects` candidates chosen and fitted linearly, in columns where
    that is less than a fifth of what the base leaves (in squares, `BlocksConfig.noise_share`); else what the base
    leaves.  Of a commanded log a candidate that takes much of a column is fitted in full too: in a replay a strong
    effect is not linear.
    The fifth is there because the best of many candidates takes noise too, and what it leaves is correlated for too
    short a time.  It is asked of each column: a clock at another rate shows in positions, and a torque sensor's noise
    stays whatever explains them.
    So with something missing that the library explains in part only, noise is stated too large and blocks are long:
    intervals are wide and less is named.  A discrepancy in these units is no absolute size, but ratios of
    discrepancies are free of the unit.
    """
    inside = log.clock < end
    block = fewest_blocks(log.clock[inside], log.clock[0])
    block = np.r_[block, np.full(len(log.clock) - len(block), OUTSIDE)]
    if start is None:  # what the prior's mean leaves is no noise
        start = _rough_fit(log, base, effects, log.space.mean, block, config, progress)[1].values
    case, model, deviation = _rough_fit(log, base, effects, start, block, config, progress)
    found = score_test(case.train, model, directions_of(candidates(effects)), config.seed)
    common = model.residuals.mean(axis=0)

    def by_column(residual: np.ndarray) -> np.ndarray:
        """[K, C] in physical units of [M] in units of the stated deviation, of what is inside."""
        return (residual.reshape(len(deviation), -1).T * deviation)[inside]

    whole, rest = by_column(common), by_column(least_residual(found, common, log.space, config))
    # Inverse dynamics is nearly linear in what an effect adds; a replay is not.
    refitted = None
    if isinstance(log, WindowedLog):
        refitted = refitted_residual(case, model, found, len(deviation), progress)
    if refitted is not None:
        other = by_column(refitted)
        rest = np.where(np.sum(other**2, axis=0) < np.sum(rest**2, axis=0), other, rest)
    left = noise_left(whole, rest, config.blocks.noise_share)
    rate = config.compare.noise.rate
    stated = stated_deviation(left, log.moves[inside], rate)
    # Each window begins at its own measured state, so that what they leave of slow noise is short.
    lasting = rest if isinstance(log, WindowedLog) else left
    return NoiseEstimate(stated, block_length(lasting, config.blocks, rate), model.values)


def refitted_residual(
    case: Case, model: FittedModel, found: ScoreTest, columns: int, progress: Report = None
) -> np.ndarray | None:
    """[M] what the candidate that takes most of any one column leaves once it is fitted in full; None where none takes
    `BlocksConfig.refit_share` of a column.

    Of many columns an effect at one joint explains few, and so a small share of all.
    """
    space, common = case.full_space, model.residuals.mean(axis=0)
    whole = np.sum(common.reshape(columns, -1) ** 2, axis=1)

    def share(proposal: Proposal) -> float:
        """Of the column in which it leaves least."""
        rows = rows_of(found, proposal.parts)
        sizes = [proposal.sizes[found.directions[k].coefficient] for k in rows]
        left = common - sizes @ found.sensitivities[rows]
        return float(np.min(np.sum(left.reshape(columns, -1) ** 2, axis=1) / np.maximum(whole, 1e-30)))

    ranked = [(share(proposal), k, proposal) for k, proposal in enumerate(proposals(found, common[None], space))]
    least, _, best = min(ranked)
    if least > 1 - case.config.blocks.refit_share:
        return None
    try:
        start = best.start(space, model.values)[None]
        fitted = refit(case.train, case.base, best.parts, start, case.config.refit, progress=progress)
    except NotReplayed:
        return None
    return fitted.residuals.mean(axis=0)


def noise_left(whole: np.ndarray, least: np.ndarray, share: float) -> np.ndarray:
    """[K, C] what counts as noise of each column: what the best candidates leave, where that is less than a share of
    the base model's residual `whole` [K, C], in squares.
    """
    return np.where(np.sum(least**2, axis=0) < share * np.sum(whole**2, axis=0), least, whole)


def _rough_fit(
    log: Log,
    base: Space,
    effects: Sequence[Effect],
    values: np.ndarray,
    block: np.ndarray,
    config: DiscrepancyConfig,
    progress: Report,
) -> tuple[Case, FittedModel, np.ndarray]:
    """The base fitted with the noise [C] stated that `values` [D] leave."""
    noise, inside = config.compare.noise, block >= 0
    left = stated_deviation(log.residual(values)[inside], log.moves[inside], noise.rate)
    deviation = np.maximum(left, log.least_noise())
    rows = with_blocks(log, deviation, block, config)
    case = Case(rows, rows, None, base, tuple(effects), config)
    return case, base_model(case, values, progress), deviation


def least_residual(found: ScoreTest, left: np.ndarray, space: Space, config: DiscrepancyConfig) -> np.ndarray:
    """[M] what the best `max_effects` candidates leave of residuals `left` [M], one after the other, linearly.

    One that takes less than an effect must is left out: it would take noise.
    """
    for _ in range(config.max_effects):
        best = proposals(found, left[None], space)[0]
        if best.explained < config.selection.least_gain:
            break
        taken, _ = np.linalg.qr(found.sensitivities[rows_of(found, best.parts)].T)
        left = left - taken @ (taken.T @ left)
        found = replace(found, sensitivities=found.sensitivities - (found.sensitivities @ taken) @ taken.T)
    return left


def with_blocks(
    log: Log, deviation: np.ndarray, block: np.ndarray, config: DiscrepancyConfig, least: int = FEWEST_REPEATS
) -> ResidualSet:
    """Its instants in blocks [K], with noise of a deviation [C]; least: blocks that there must be."""
    return block_residual_set(log.with_noise(deviation, block >= 0), block, config, least)
