"""A case of one log without commands, or of two: blocks of time in place of repeats, and what counts as noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from droid_jax.cost.lone_log import LoneLog, lone_log
from droid_jax.cost.noise import stated_deviation
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import ScoreTest, directions_of, proposals, score_test
from droid_jax.discrepancy.case import Case, per_recording_nuisances, restrained, unbounded
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FittedModel, refit
from droid_jax.discrepancy.residual_set import ResidualSet, block_residual_set
from droid_jax.discrepancy.statistics import OUTSIDE, block_length, fewest_blocks, interleaved
from droid_jax.identify.multistart import RefineProgress
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import candidates
from droid_jax.model.effects.registry import joined, ready
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import FEWEST_REPEATS

Log: TypeAlias = LoneLog | WindowedLog


def make_log(
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    recording: Recording,
    config: DiscrepancyConfig | None = None,
    known: Sequence[Effect] = (),
) -> LoneLog:
    """The cost of a recording of one repeat without commands, all effects in its replay, at neutral.

    known: effects that the base has already; their parameters are in `base`.
    Raises ValueError for repeats and for commands, see `lone_log`.
    """
    config = config or DiscrepancyConfig()
    whole = joined(restrained(base, config.selection.nuisance_bound), effects)
    return lone_log(ready(scene), whole, recording, config.compare, [*known, *effects])


def single_case(
    log: LoneLog,
    base: Space,
    effects: Sequence[Effect],
    test: LoneLog | None = None,
    config: DiscrepancyConfig | None = None,
    start: np.ndarray | None = None,
) -> Case:
    """A case from one log, or from two of which the second is test data, with its own torque offsets.

    The last third of the log is test data, or a second log is.  What comes before is cut into blocks that train and
    validate in turns.  In turns, because a log holds its motion once or twice: a base model fitted to one half of it
    misses what only the other half moves, and that would look like an effect.  So the validation blocks tell an effect
    from noise and not from another form of it; other motions are for what is test data.

    start: [D] where fits begin, fitted to this motion before; the prior's mean unless given.
    Raises ValueError where the log is too short for its residual's correlation time.
    """
    config = config or DiscrepancyConfig()
    clock = log.clock
    share = 1.0 if test is not None else config.blocks.fitted_share
    end = clock[-1] + 1e-6 if test is not None else clock[0] + share * (clock[-1] - clock[0])
    noise = noise_of(log, base, effects, end, config, start)
    deviation, length = noise.deviation, noise.block
    train, validation = (
        with_blocks(log.part(f"{log.comparisons[0].name}, {which}"), deviation, part, config)
        for which, part in zip(
            ("every other block", "the blocks between"),
            interleaved(clock, clock[0], end, length, 2, share),
            strict=True,
        )
    )
    own = [] if test is None else per_recording_nuisances(base)  # another day's; the rest of the same log has the same
    rest = log.part(f"{log.comparisons[0].name}, last third") if test is None else test
    judged = with_blocks(
        replace(rest, space=unbounded(rest.space, own)) if own else rest,
        deviation[[log.columns.index(c) for c in rest.columns]],
        fewest_blocks(rest.clock, end if test is None else rest.clock[0]),
        config,
    )
    if own:
        judged = judged.with_nuisances(own)
    base = restrained(base, config.selection.nuisance_bound)
    return Case(train, validation, judged, base, tuple(effects), config)


def base_model(
    case: Case, start: np.ndarray | None = None, progress: Callable[[RefineProgress], None] | None = None
) -> FittedModel:
    """The base parameters of a case in blocks fitted, from where the case says unless a start [D] is given.

    Inverse dynamics is smooth in them, and windows nearly are, so one start and no search will do.
    """
    known = case.full_space.mean if case.start is None else case.start
    start = known if start is None else start
    return refit(case.train, case.base, (), start[None], case.config.refine, progress=progress)


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
) -> NoiseEstimate:
    """What to state as the noise of a log, and how long its blocks are, from what lies before `end`.

    One recording does not tell its noise.  What is stated, and sets the blocks' length, is the smallest residual that
    an extended model leaves, the base and up to `max_effects` candidates chosen and fitted linearly, where that is less
    than a fifth of what the base leaves (in squares, `BlocksConfig.noise_share`); else what the base leaves.  The fifth
    is there because the best of many candidates takes noise too, and what it leaves is correlated for too short a time.
    So with something missing that the library explains in part only, noise is stated too large and blocks are long:
    intervals are wide and less is named.  A discrepancy in these units is no absolute size, but ratios of
    discrepancies are free of the unit.
    """
    inside = log.clock < end
    block = fewest_blocks(log.clock[inside], log.clock[0])
    block = np.r_[block, np.full(len(log.clock) - len(block), OUTSIDE)]
    if start is None:  # what the prior's mean leaves is no noise
        start = _rough_fit(log, base, effects, log.space.mean, block, config)[1].values
    case, model, deviation = _rough_fit(log, base, effects, start, block, config)
    found = score_test(case.train, model, directions_of(candidates(effects)), config.seed)
    whole = model.residuals.mean(axis=0)
    least = _least(found, whole, log.space, config)
    noise = least if least @ least < config.blocks.noise_share * (whole @ whole) else whole
    left, rest = ((of.reshape(len(deviation), -1).T * deviation)[inside] for of in (noise, least))
    rate = config.compare.noise.rate
    stated = stated_deviation(left, log.moves[inside], rate)
    # Each window begins at its own measured state, so that what they leave of slow noise is short.
    lasting = rest if isinstance(log, WindowedLog) else left
    return NoiseEstimate(stated, block_length(lasting, config.blocks, rate), model.values)


def _rough_fit(
    log: Log,
    base: Space,
    effects: Sequence[Effect],
    values: np.ndarray,
    block: np.ndarray,
    config: DiscrepancyConfig,
) -> tuple[Case, FittedModel, np.ndarray]:
    """The base fitted with the noise [C] stated that `values` [D] leave."""
    noise, inside = config.compare.noise, block >= 0
    left = stated_deviation(log.residual(values)[inside], log.moves[inside], noise.rate)
    deviation = np.maximum(left, log.least_noise())
    rows = with_blocks(log, deviation, block, config)
    case = Case(rows, rows, None, base, tuple(effects), config)
    return case, base_model(case, values), deviation


def _least(found: ScoreTest, left: np.ndarray, space: Space, config: DiscrepancyConfig) -> np.ndarray:
    """[M] what the best `max_effects` candidates leave of residuals `left` [M], one after the other, linearly.

    One that takes less than an effect must is left out: it would take noise.
    """
    for _ in range(config.max_effects):
        best = proposals(found, left[None], space)[0]
        if best.explained < config.selection.least_gain:
            break
        keys = {part.shaped_key for part in best.parts}
        rows = [k for k, d in enumerate(found.directions) if d.candidate.shaped_key in keys]
        taken, _ = np.linalg.qr(found.sensitivities[rows].T)
        left = left - taken @ (taken.T @ left)
        found = replace(found, sensitivities=found.sensitivities - (found.sensitivities @ taken) @ taken.T)
    return left


def with_blocks(
    log: Log, deviation: np.ndarray, block: np.ndarray, config: DiscrepancyConfig, least: int = FEWEST_REPEATS
) -> ResidualSet:
    """Its instants in blocks [K], with noise of a deviation [C]; least: blocks that there must be."""
    return block_residual_set(log.with_noise(deviation, block >= 0), block, config, least)
