"""Cases of logs, in blocks of time instead of repeats, and the case of any recordings (`case_of`).

Logs without commands are cut into blocks, commanded logs with few repeats into windows.  The length of windows is a
setting.  The number of windows in a block depends on the noise.  If a log is too short for eight blocks in each part,
the search makes do with less, and `Case.limits` lists the consequences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from droid_jax.cost.cost import check_known
from droid_jax.cost.lone_log import LoneLog, lone_log
from droid_jax.cost.windowed_log import WindowedLog, windowed_log
from droid_jax.discrepancy.case import Case, comparing, make_case, per_recording_nuisances, restrained, unbounded
from droid_jax.discrepancy.config import FEWER_TRIALS, BlocksConfig, DiscrepancyConfig
from droid_jax.discrepancy.fitting import refit
from droid_jax.discrepancy.log_noise import Report, noise_of, with_blocks
from droid_jax.discrepancy.statistics import OUTSIDE, fewest_blocks, in_turns, interleaved
from droid_jax.identify.evaluation import evaluate_on, evaluation_json
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import beside, joined, ready
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import FEWEST_REPEATS, Split, pooled
from droid_jax.simulate.windows import fully_servoed, why_no_windows

PARTS = 2  # training and validation


def make_log(
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    recording: Recording,
    config: DiscrepancyConfig | None = None,
    known: Sequence[Effect] = (),
) -> LoneLog:
    """The cost of a recording of one repeat without commands, with all effects in its replay, at neutral.

    Args:
        scene: the robot.
        base: the base parameters.
        effects: to test.
        recording: the log.
        config: settings of the search.
        known: effects of the base model, whose parameters are in `base`.

    Raises:
        ValueError: several repeats, or commands (see `lone_log`).
    """
    config = config or DiscrepancyConfig()
    whole = joined(restrained(base, config.selection.nuisance_bound, recording.known), effects)
    return lone_log(ready(scene), whole, recording, config.compare, [*known, *effects])


def single_case(
    log: LoneLog,
    base: Space,
    effects: Sequence[Effect],
    test: LoneLog | None = None,
    config: DiscrepancyConfig | None = None,
    start: np.ndarray | None = None,
) -> Case:
    """The case of one log, or of two logs of which the second is test data.

    The last third of the log is test data, unless a second log is.  The rest is cut into blocks that train and validate
    in turns.  They alternate because a log holds a motion once or twice: a base model fitted to its first half does not
    fit motions of the second half, and the error would look like an effect.  The validation blocks therefore
    distinguish an effect from noise, but not from another form of it.  Test data of other motions do.

    Args:
        log: the cost of the log (`make_log`).
        base: the base parameters.
        effects: to test.
        test: the cost of a second log.  Its torque offsets are fitted to it.
        config: settings of the search.
        start: [D] where fits begin; None: the prior's mean.

    Raises:
        ValueError: the log has fewer than eight blocks of its residual's correlation time.
    """
    config = config or DiscrepancyConfig()
    clock = log.clock
    share = 1.0 if test is not None else config.blocks.fitted_share
    end = clock[-1] + 1e-6 if test is not None else clock[0] + share * (clock[-1] - clock[0])
    noise = noise_of(log, base, effects, end, config, start)
    deviation, length = noise.deviation, noise.block
    blocks = interleaved(clock, clock[0], end, length, PARTS, share, FEWEST_REPEATS // PARTS)
    train, validation = (
        with_blocks(log.part(f"{log.comparisons[0].name}, {which}"), deviation, part, config, FEWEST_REPEATS // PARTS)
        for which, part in zip(("every other block", "the blocks between"), blocks, strict=True)
    )
    nuisances = [] if test is None else per_recording_nuisances(base)  # the last third of a log has those of the log
    rest = log.part(f"{log.comparisons[0].name}, last third") if test is None else test
    judged = with_blocks(
        replace(rest, space=unbounded(rest.space, nuisances)) if nuisances else rest,
        deviation[[log.columns.index(c) for c in rest.columns]],
        fewest_blocks(rest.clock, end if test is None else rest.clock[0]),
        config,
    )
    if nuisances:
        judged = judged.with_nuisances(nuisances)
    base = restrained(base, config.selection.nuisance_bound)
    both = with_blocks(log, deviation, in_turns(list(blocks)), config)
    few = train.resampling.units
    limits = (f"Only {few} blocks train and as many validate: small effects are not found.",)
    return Case(
        train, validation, judged, base, tuple(effects), config, both=both,
        limits=limits if few < FEWEST_REPEATS else (),
    )  # fmt: skip


def case_of(
    split: Split,
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    roles: Mapping[str, Recording],
    config: DiscrepancyConfig,
    start: np.ndarray | None = None,
    progress: Report = None,
) -> Case:
    """The case of recordings by role.

    Sensor gains and encoder offsets that the base has as parameters are not tested as effects of the same joints.

    Args:
        split: how recordings are split into training, validation and test data.
        scene: the robot.
        base: the base parameters.
        effects: to test.
        roles: role -> recording (`preflight.search_inputs.assigned_roles`).
        config: settings of the search.
        start: [F] values of the base parameters from an earlier fit, where the fits of windows begin.
        progress: called with each iteration of the fits that estimate the noise of windows.

    Raises:
        ValueError: invalid recordings, recordings of another scene, parameters stated in a recording (`known`) that the
            base model does not have, or a channel that cannot be compared.
    """
    check_known(base, pooled(roles, "train"))
    for recording in roles.values():
        if unknown := base.unknown_names(recording.known):
            raise ValueError(
                f"recording {recording.name!r} states {', '.join(unknown)}, which the base model of a search does not "
                f"have; it has: {', '.join(base.names)}"
            )
    effects, config = beside(base, effects), comparing(scene, tuple(roles.values()), config)
    if split is Split.WINDOWS:
        return windowed_case(
            scene, base, effects, pooled(roles, "train"), pooled(roles, "test"), config, start, progress
        )
    if split is not Split.BLOCKS:
        return make_case(scene, base, effects, **roles, config=config)
    config = replace(config, refine=replace(config.refine, basin_hops=0, spreads=0))  # inverse dynamics is smooth
    logs = {role: make_log(scene, base, effects, recording, config) for role, recording in roles.items()}
    return single_case(logs["train"], base, effects, logs.get("test"), config)


def windowed_case(
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    train: Sequence[Recording],
    test: Sequence[Recording] = (),
    config: DiscrepancyConfig | None = None,
    start: np.ndarray | None = None,
    progress: Report = None,
) -> Case:
    """The case of pooled commanded logs, whose windows train and validate in turns, block by block.

    The last third of every log is test data, unless other recordings are.  (For logs of one window it is every third
    log.)  The torque offsets of other test recordings are fitted to them.  Recordings shorter than a window are left
    out (`Case.limits`).

    Args:
        scene: the robot.
        base: the base parameters.
        effects: to test.
        train: commanded recordings of the same channels, of one repeat or several.  Long recordings that would be
            replayed whole are sampled by windows (`WindowConfig.longest`).
        test: recordings that are test data.
        config: settings of the search.
        start: [F] values of the base parameters where its fit begins; None: the best of some draws.
        progress: called with each iteration of the fits that estimate the noise.

    Raises:
        ValueError: recordings of different channels or joints, or too short for two blocks in each part.
    """
    config = config or DiscrepancyConfig()
    config = replace(config, refine=replace(config.refine, basin_hops=0))  # windows are nearly smooth in parameters
    base = restrained(base, config.selection.nuisance_bound, {n for r in (*train, *test) for n in r.known})
    share = 1.0 if test else config.blocks.fitted_share
    at_once = config.replay == "whole" or (config.replay == "auto" and fully_servoed(scene))
    compare, windows, judging = config.compare, config.windows, config.windows
    if sampled := config.replay == "auto" and at_once and _seconds(train) > windows.longest:
        at_once, judging = False, windows.sampled(_seconds(test))
        windows = windows.sampled(share * _seconds(train))
        config = replace(
            config, **{name: replace(getattr(config, name), **FEWER_TRIALS) for name in ("refine", "refit", "polish")}
        )
    over_time = list[str]()
    if not at_once and not any(why_no_windows(scene, recording) for recording in train):
        over_time = [e.name for e in effects if e.over_time]
        effects = [e for e in effects if not e.over_time]
    not_tested = (
        f"Windows do not hold the time since their recording began, so {' and '.join(over_time)} cannot be tested "
        "(--replay whole tests all effects)."
    )
    if over_time and not effects:
        raise ValueError(not_tested)
    scene, whole = ready(scene), joined(base, effects)
    log = windowed_log(scene, whole, train, compare, windows, effects, share, whole=at_once)
    log = replace(log, instants=log.unit < log.fitted)  # test data are not replayed yet
    nuisances = per_recording_nuisances(base) if test else []
    judged = None
    if test:
        judged = windowed_log(scene, unbounded(whole, nuisances), test, compare, judging, effects, whole=at_once)
    end, rough = _end_of(log), replace(config, refine=replace(config.refine, spreads=0))  # no posterior is needed yet
    if start is None:
        first = _first_values(log, base, end, rough, progress)
    else:
        first = whole.embed(base, np.clip(start, base.low, base.high)[None])[0]
    # Whitened with the spread of the initial states, residuals of windows have the correlation time of the noise.
    noise = noise_of(log.about(first), base, effects, end, rough, first, progress)
    log = log.about(noise.values)
    plan = planned(log, noise.block, config.blocks, judged is None)
    sets = [
        with_blocks(log.part(f"{log.comparisons[0].name}, {which}"), noise.deviation, block, config, 1)
        for which, block in zip(("every other block", "the blocks between", "last third"), plan.blocks, strict=False)
    ]
    if judged is not None:
        deviation = noise.deviation[[log.columns.index(c) for c in judged.columns]]
        judged = judged.about(noise.values)
        blocks = _in_groups(judged.unit, 0, int(judged.unit.max()) + 1, FEWEST_REPEATS)
        sets.append(with_blocks(judged, deviation, blocks, config, 1).with_nuisances(nuisances))
    last = sets[2] if len(sets) > PARTS else None
    both = with_blocks(log, noise.deviation, in_turns(plan.blocks[:PARTS]), config, 1)
    limits = ([f"Motions were replayed whole: {log.whole}."] if log.whole and not at_once else []) + list(plan.limits)
    if over_time:
        limits.append(not_tested)
    if short := [*log.too_short, *(() if judged is None else judged.too_short)]:
        limits.append(f"Shorter than a window and left out: {', '.join(short)} (--replay whole takes them).")
    if sampled and not log.whole:
        limits.insert(
            0,
            f"{_seconds(train):.0f} s of motion take long to replay: {int(log.unit.max()) + 1} windows of "
            f"{windows.length:g} s, spread over it, stand for them (--replay whole replays all of it).",
        )
    return Case(sets[0], sets[1], last, base, tuple(effects), config, noise.values, tuple(limits), both)


def _seconds(recordings: Sequence[Recording]) -> float:
    """Duration of all repeats of some recordings [s]."""
    return sum(recording.duration * recording.repeats for recording in recordings)


def open_loop_errors(
    case: Case, roles: Mapping[str, Recording], before: np.ndarray, after: np.ndarray
) -> dict[str, Any]:
    """Open-loop errors of each recording, replayed whole at two vectors, as plain data (`evaluation.evaluation_json`).

    Windows alone do not show them.  Effects that are at neutral in both vectors are left out of the replays, so that
    plain C can make them if it has the others.

    Args:
        case: of the recordings.
        roles: role -> recording.
        before, after: [D] of the base model and of the final model.
    """
    cost = case.train.cost
    whole = replace(case.config.compare, channels={name: 1.0 for name in case.config.compare.channels})
    names, rows, neutral = cost.space.names, np.stack([before, after]), cost.space.mean
    changed = {n for n, column in zip(names, (rows != neutral).any(axis=0), strict=True) if column}
    acting = [e for e in case.effects if changed & {p.name for p in e.parameters}]
    space = cost.space.select([*case.base.names, *(p.name for e in acting for p in e.parameters)])
    before, after = rows[:, cost.space.columns(space)]
    replays = evaluate_on(
        cost.scene, space, list(roles.values()), before=before, after=after, effects=acting, engine="auto", config=whole
    )
    evaluation = evaluation_json(replays)
    return {name: evaluation[name] for name in ("errors", "mean_mae")}


def _end_of(log: WindowedLog) -> float:
    """End of the training and validation windows on the log's clock [s]."""
    clock, count = log.clock, int(np.sum(log.unit < log.fitted))
    return float(clock[count]) if count < len(clock) else float(clock[-1]) + 1e-6


def _first_values(
    log: WindowedLog,
    base: Space,
    end: float,
    config: DiscrepancyConfig,
    progress: Report = None,
) -> np.ndarray:
    """[D] of the base model, fitted from the prior's mean and from the best of some draws of the prior."""
    whole, inside = log.space, log.clock < end
    drawn = np.random.default_rng(config.seed).normal(size=(config.blocks.start_draws, len(base)))
    rows = whole.embed(base, np.concatenate([base.mean[None], base.from_search(drawn)]))
    residual = log.residual(whole.mean)[inside]
    if not np.isfinite(residual).all():
        raise ValueError(
            f"the simulation of {log.comparisons[0].name!r} blows up at the parameters' initial means: shorten the "
            "scene's time step, give light joints armature, or begin at other means"
        )
    block = fewest_blocks(log.clock[inside], log.clock[0])
    block = np.r_[block, np.full(len(log.clock) - len(block), OUTSIDE)]
    rough = with_blocks(log, np.sqrt(np.mean(residual**2, axis=0)), block, config, 1)
    cost = np.nan_to_num(np.sum(rough.whitened(rows) ** 2, axis=1), nan=np.inf)
    starts = np.concatenate([rows[:1], rows[1:][np.argsort(cost[1:])[: config.blocks.best_draws]]])
    return refit(rough, base, (), starts, config.refine, progress=progress).values


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """Block numbers [K] of the training, validation and perhaps test part.

    limits: consequences of a short log, in words.
    """

    blocks: tuple[np.ndarray, ...]
    limits: tuple[str, ...]


def planned(log: WindowedLog, length: float, config: BlocksConfig, with_test: bool) -> BlockPlan:
    """The blocks of a log's units (windows, or stretches of whole motions), at least eight in each part.

    If the log is too short, the blocks are shortened first; then the test part is given up, then some of the blocks.

    Args:
        log: the log.
        length: s, of a block.
        config: with the least length of a shortened block.
        with_test: whether the last units are test data.

    Raises:
        ValueError: fewer than two blocks in each part.
    """
    seconds, shortest, limits = log.unit_seconds, config.shortest, list[str]()
    fitted, total = log.fitted, int(log.unit.max()) + 1
    tested = with_test and total > fitted
    needed = PARTS * FEWEST_REPEATS * max(1, math.ceil(shortest / seconds - 1e-6))
    if tested and fitted < needed <= total - config.least_test:  # a smaller test part rather than none
        fitted = needed
    each = _each(fitted, length, seconds)
    if each < FEWEST_REPEATS and _each(fitted, shortest, seconds) >= FEWEST_REPEATS:
        each = FEWEST_REPEATS
    elif each < FEWEST_REPEATS:
        if tested:
            limits.append("The log is too short to keep a part of it as test data.")
        fitted, tested = total, False
        each = min(FEWEST_REPEATS, _each(total, shortest, seconds))
    if each < 2:
        raise ValueError(
            f"{log.comparisons[0].name!r}: {total * seconds:.3g} s are compared, too little to train and to validate "
            f"on; record for {math.ceil(needed * seconds)} s or longer, or more recordings"
        )
    made = fitted * seconds / (PARTS * each)
    if made < length * (1 - 1e-6):
        limits.append(
            f"Blocks of {made:.2g} s are shorter than the {length:.2g} s for which they would count as independent: "
            "p-values may be too small."
        )
    if PARTS * each < FEWEST_REPEATS:
        limits.append(
            f"Only {PARTS * each} blocks train and validate, and with fewer than {FEWEST_REPEATS} no effect stands "
            "out from chance, whatever its size: what the score test ranks first is a hint at most. Record for longer."
        )
    turns = _in_groups(log.unit, 0, fitted, PARTS * each)
    blocks = [np.where((turns != OUTSIDE) & (turns % PARTS == p), turns // PARTS, OUTSIDE) for p in range(PARTS)]
    if tested:
        blocks.append(_in_groups(log.unit, fitted, total, FEWEST_REPEATS))
    return BlockPlan(tuple(blocks), tuple(limits))


def _each(units: int, length: float, seconds: float) -> int:
    """Number of blocks in each part."""
    return units // max(1, math.ceil(length / seconds - 1e-6)) // PARTS


def _in_groups(unit: np.ndarray, first: int, end: int, groups: int) -> np.ndarray:
    """[K] group of each instant, with about equal numbers of units from `first` to `end`; at most one a unit."""
    groups = min(groups, end - first)
    found = (unit - first) * groups // max(end - first, 1)
    return np.where((unit >= first) & (unit < end), found, OUTSIDE)
