"""The noise of a log, estimated from the residuals of the base model and of the best candidates."""

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
    """The noise of one log.

    deviation: [C] standard deviation of each column, in its unit.
    block: s, length of the blocks.
    values: [D] of the base model, which is fitted for the estimate.
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
    """The noise of a log and the length of its blocks, from its instants before `end`.

    One recording does not separate noise from discrepancy.  The estimate is the residual of the base model with up to
    `max_effects` candidates, which are selected and fitted linearly.  It is used in columns where it is less than
    `BlocksConfig.noise_share` of the base model's squared residual.  In other columns the base model's residual is
    used: the best of many candidates fits noise too, and its residual is correlated for too short a time.  Columns are
    compared one by one, since a wrong clock rate shows in positions while a torque sensor's noise remains.

    Replays are not linear in a strong effect.  For a commanded log a candidate that explains much of a column is
    therefore refitted in full.

    If the library explains a missing effect only in part, the noise is overestimated and blocks are long.  Intervals
    are then wide, and fewer effects are named.  Discrepancies of a log have no absolute size in these noise units, but
    their ratios do not depend on the unit.

    Args:
        log: the cost of the log.
        base: the base parameters.
        effects: candidates.
        end: s on the log's clock.
        config: settings of the search.
        start: [D] where the base fit begins; None: it is fitted first from the prior's mean.
        progress: called with each iteration.
    """
    inside = log.clock < end
    block = fewest_blocks(log.clock[inside], log.clock[0])
    block = np.r_[block, np.full(len(log.clock) - len(block), OUTSIDE)]
    if start is None:  # the residual at the prior's mean is no estimate of the noise
        start = _rough_fit(log, base, effects, log.space.mean, block, config, progress)[1].values
    case, model, deviation = _rough_fit(log, base, effects, start, block, config, progress)
    found = score_test(case.train, model, directions_of(candidates(effects)), config.seed)
    common = model.residuals.mean(axis=0)

    def by_column(residual: np.ndarray) -> np.ndarray:
        """[K, C] residual before `end`, in physical units, of one in units of the stated deviation [M]."""
        return (residual.reshape(len(deviation), -1).T * deviation)[inside]

    of_base, least = by_column(common), by_column(least_residual(found, common, log.space, config))
    # Inverse dynamics is nearly linear in the coefficients of an effect; a replay is not.
    refitted = None
    if isinstance(log, WindowedLog):
        refitted = refitted_residual(case, model, found, len(deviation), progress)
    if refitted is not None:
        other = by_column(refitted)
        least = np.where(np.sum(other**2, axis=0) < np.sum(least**2, axis=0), other, least)
    noise = noise_residual(of_base, least, config.blocks.noise_share)
    rate = config.compare.noise.rate
    stated = stated_deviation(noise, log.moves[inside], rate)
    # Each window begins at its own measured state, which shortens the correlation of slow noise.
    correlated = least if isinstance(log, WindowedLog) else noise
    return NoiseEstimate(stated, block_length(correlated, config.blocks, rate), model.values)


def refitted_residual(
    case: Case, model: FittedModel, found: ScoreTest, columns: int, progress: Report = None
) -> np.ndarray | None:
    """[M] residual after a full refit of the candidate that explains most of a single column.

    Columns are compared one by one, since an effect at one joint explains few of them and a small share of all.

    Args:
        case: a case whose training set is the log.
        model: the base model.
        found: its score test.
        columns: number of columns C.
        progress: called with each iteration.

    Returns:
        None if no candidate explains `BlocksConfig.refit_share` of a column, or if the replay blows up.
    """
    space, common = case.full_space, model.residuals.mean(axis=0)
    squares = np.sum(common.reshape(columns, -1) ** 2, axis=1)

    def smallest_share(proposal: Proposal) -> float:
        """Smallest share of a column's squared residual that remains with the proposal."""
        rows = rows_of(found, proposal.parts)
        sizes = [proposal.sizes[found.directions[k].coefficient] for k in rows]
        remaining = common - sizes @ found.sensitivities[rows]
        return float(np.min(np.sum(remaining.reshape(columns, -1) ** 2, axis=1) / np.maximum(squares, 1e-30)))

    ranked = [(smallest_share(p), k, p) for k, p in enumerate(proposals(found, common[None], space))]
    least, _, best = min(ranked)
    if least > 1 - case.config.blocks.refit_share:
        return None
    try:
        start = best.start(space, model.values)[None]
        fitted = refit(case.train, case.base, best.parts, start, case.config.refit, progress=progress)
    except NotReplayed:
        return None
    return fitted.residuals.mean(axis=0)


def noise_residual(base: np.ndarray, least: np.ndarray, share: float) -> np.ndarray:
    """[K, C] residual that counts as noise in each column.

    Args:
        base: [K, C] residual of the base model.
        least: [K, C] residual of the best candidates.
        share: of the base model's squared residual below which the column of `least` is taken.
    """
    return np.where(np.sum(least**2, axis=0) < share * np.sum(base**2, axis=0), least, base)


def _rough_fit(
    log: Log,
    base: Space,
    effects: Sequence[Effect],
    values: np.ndarray,
    block: np.ndarray,
    config: DiscrepancyConfig,
    progress: Report,
) -> tuple[Case, FittedModel, np.ndarray]:
    """The case, the fitted base model and its stated noise [C], which is that of the residuals at `values` [D]."""
    noise, inside = config.compare.noise, block >= 0
    stated = stated_deviation(log.residual(values)[inside], log.moves[inside], noise.rate)
    deviation = np.maximum(stated, log.least_noise())
    rows = with_blocks(log, deviation, block, config)
    case = Case(rows, rows, None, base, tuple(effects), config)
    return case, base_model(case, values, progress), deviation


def least_residual(found: ScoreTest, residual: np.ndarray, space: Space, config: DiscrepancyConfig) -> np.ndarray:
    """[M] residual after the best `max_effects` candidates, one after the other, by linear regression.

    A candidate that explains less than `SelectionConfig.least_gain` ends the selection, since it would fit noise.

    Args:
        found: score test of the base model.
        residual: [M] common residual of the base model.
        space: of all parameters.
        config: settings of the search.
    """
    for _ in range(config.max_effects):
        best = proposals(found, residual[None], space)[0]
        if best.explained < config.selection.least_gain:
            break
        basis, _ = np.linalg.qr(found.sensitivities[rows_of(found, best.parts)].T)
        residual = residual - basis @ (basis.T @ residual)
        found = replace(found, sensitivities=found.sensitivities - (found.sensitivities @ basis) @ basis.T)
    return residual


def with_blocks(
    log: Log, deviation: np.ndarray, block: np.ndarray, config: DiscrepancyConfig, least: int = FEWEST_REPEATS
) -> ResidualSet:
    """The residual set of a log in blocks.

    Args:
        log: the cost of the log.
        deviation: [C] noise of each column, in its unit.
        block: [K] block number of each instant.
        config: settings of the search.
        least: least number of blocks.
    """
    return block_residual_set(log.with_noise(deviation, block >= 0), block, config, least)
