"""The linear model of a search, made from recordings: parameter values, Jacobian, sensitivities, noise.

The search's case is made from the recordings, or from a simulation of their commands with a stated noise.  The
parameters have stated values or their means.  Each candidate effect is simulated once with a small coefficient.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from droid_jax.cost.channels import SIMULATED
from droid_jax.cost.cost import Cost, make_cost, without_unused
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import ScoreDirection, directions_of, project, scored, sensitivities
from droid_jax.discrepancy.case import AnyCost, Case, ResidualSet, comparing
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FittedModel, base_model, model_at
from droid_jax.discrepancy.log_case import case_of
from droid_jax.discrepancy.log_noise import least_residual, refitted_residual
from droid_jax.discrepancy.step_error import until, with_finer_step, with_step_difference
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.effects.candidate import candidates
from droid_jax.model.effects.registry import beside, joined, ready
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, with_options
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import FEWEST_REPEATS, Split, roles_of, split_of
from droid_jax.rehearsal.config import DEFAULT_REHEARSAL, RehearsalConfig
from droid_jax.rehearsal.linear import LinearModel, LinearPart
from droid_jax.rehearsal.plan import ColumnNoise, RehearsalPlan, noise_of_log, planned_recording, simulated_channels
from droid_jax.simulate.replay import Drive

ReportStage = Callable[[str], None]  # called with the name of a stage


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """A linear model and its origin.

    split, case, roles: of the search.  base: the base model at the stated values.
    model: of all measured or assumed channels.  compared: channels that the search compares.  noise: of each column.
    seconds: by stage.
    """

    split: Split
    case: Case
    roles: Mapping[str, Recording]
    base: FittedModel
    model: LinearModel
    compared: tuple[str, ...]
    noise: tuple[ColumnNoise, ...]
    seconds: Mapping[str, float]


def rehearsed(
    scene: Scene,
    space: Space,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    plan: RehearsalPlan,
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
    report: ReportStage = lambda stage: None,
    *,
    step_error: bool = True,
    train_only: bool = False,
) -> Rehearsed:
    """Return the linear model of a search in these recordings.

    Args:
        scene: the robot.
        space: all parameters that are fitted without any effect.
        effects: that could be hidden.
        recordings: as given to the search.
        plan: what replaces the measurement.
        config: of the search.
        rehearsal: settings of the rehearsal.
        report: called with each stage's name.
        step_error: whether to measure the error of the time step.
        train_only: use the training part for validation too, and one shape of each coefficient; for recordings with
            repeats.

    Raises:
        ValueError: the search refuses the inputs too, or a simulation blows up.
    """
    clock = Stopwatch(report)
    clock("compile")
    space = without_unused(space, recordings[:1] if train_only else recordings)
    effects = beside(space, effects)
    start = space.values(dict(plan.values or {}))
    full = joined(space, effects)
    at = full.embed(space, start[None])[0]
    windows = replace(config.windows, samples=rehearsal.samples, sample_length=rehearsal.sample_length)
    config = replace(config, channels=plan.channels or config.channels, windows=windows)
    clean = clean_channels(scene, space, full, effects, at, plan, config)
    planned, noise = _planned(clean, scene, recordings[:1] if train_only else recordings, plan, rehearsal)
    compared = _compared(scene, recordings, planned, plan, config)
    halves = Split.RECORDINGS if len(recordings) > 1 else Split.REPEATS
    split = halves if train_only else split_of(planned)
    roles = roles_of(split, planned)
    is_log = split in (Split.WINDOWS, Split.BLOCKS) or not planned[0].command.size
    channels = compared if is_log else _common_channels(planned)
    clock("case")
    needed = {k: r for k, r in roles.items() if split is not Split.RECORDINGS or k != "test"}
    if train_only:
        needed = {"train": roles["train"], "validation": roles["train"]}
    # Only the base model of windows is fitted here.
    refine = replace(config.refine, iterations=min(config.refine.iterations, rehearsal.base_iterations))
    case = case_of(split, scene, space, effects, needed, replace(config, channels=channels, refine=refine))
    values = full.embed(space, start[None])[0] if case.start is None or plan.values or plan.simulated else case.start
    clock("base")
    if split is Split.BLOCKS:
        base = base_model(case)
        values, jacobian = base.values, base.refined.jacobian
    else:
        base, jacobian = model_at(case.train, case.base, values)
    clock("sensitivities")
    directions = directions_of(candidates(case.effects))
    if train_only:
        directions = tuple(directions[k] for k in one_shape_each(directions))
    free = base.refined.free
    train = part_of(case.train, base, jacobian[:, free], directions)
    validation = train
    if split is not Split.REPEATS and not train_only:
        validation_base, jacobian = model_at(case.validation, case.base, values, spreads=0)
        validation = part_of(case.validation, validation_base, jacobian[:, free], directions)
    if not train.rows.repeated:
        share = unexplained_share(case, base, train, directions)
        train, validation = train.quieter(share), validation.quieter(share)
    elif step_error:
        clock("step error")
        with contextlib.suppress(NotReplayed):
            step = fine_steps(case.train, base, case.base, roles["train"], rehearsal.step_divisors)
            train = replace(train, step=step)
    clock("")
    model = linear_model(case, base, directions, train, validation)
    return Rehearsed(split, case, roles, base, model, compared, tuple(noise), clock.seconds)


Clean = Callable[[Recording], Rollout]  # simulates a recording's commands without noise


def clean_channels(
    scene: Scene,
    space: Space,
    full: Space,
    effects: Sequence[Effect],
    at: np.ndarray,
    plan: RehearsalPlan,
    config: DiscrepancyConfig,
) -> Clean:
    """Return a function that simulates a recording's commands without noise, at values `at` [D] of `full`.

    It uses plain C if there are repeats.  The engine's error in the mean of the repeats does not matter then: the
    linear model uses the noise of the repeats, and sensitivities.
    """

    def simulated(recording: Recording) -> Rollout:
        if (plan.repeats or recording.repeats) >= FEWEST_REPEATS:
            with contextlib.suppress(ValueError):  # plain C does not support the model
                return simulated_channels(scene, space, (), recording, at[full.columns(space)], config, "mujoco")
        return simulated_channels(ready(scene), full, effects, recording, at, config)

    return simulated


def fine_steps(
    residual_set: ResidualSet,
    model: FittedModel,
    base: Space,
    recording: Recording,
    divisors: Sequence[int] = DEFAULT_REHEARSAL.step_divisors,
) -> np.ndarray | None:
    """Return the change [M] of the base model's residual with a vanishing time step; None without commands.

    Plain C, which needs no compilation, replays with two fine time steps.  The error is of first order in the time
    step, so the two are extrapolated to zero (Richardson).  If plain C does not support the model, it is replayed at a
    quarter of the time step, as in the search.

    Args:
        residual_set: of the training part.
        model: the base model.
        base: its space.
        recording: of the training part.
        divisors: two increasing divisors of the time step.
    """

    def difference(finer: AnyCost | None) -> np.ndarray | None:
        return with_step_difference(residual_set, model, finer).step_difference

    cost, costs = residual_set.cost, list[Cost]()
    if isinstance(cost.drives[0], Drive) and not isinstance(cost, WindowedLog):
        config, timestep = residual_set.comparison.config, float(cost.scene.model.opt.timestep)
        scenes = [with_options(cost.scene, timestep=timestep / divisor) for divisor in divisors]
        with contextlib.suppress(ValueError):  # plain C does not support the model
            compared = until(recording, cost.drives[0])
            costs = [make_cost(s, base, [compared], engine="mujoco", config=config, check=False) for s in scenes]
    if not costs:
        return difference(with_finer_step(residual_set, base, recording))
    coarse, fine = map(difference, costs)
    assert coarse is not None and fine is not None
    return fine + (fine - coarse) / (divisors[1] / divisors[0] - 1)


def _planned(
    clean: Clean, scene: Scene, recordings: Sequence[Recording], plan: RehearsalPlan, rehearsal: RehearsalConfig
) -> tuple[list[Recording], list[ColumnNoise]]:
    """The recordings to rehearse, and the noise of the first one's columns.

    Logs that are cut in time are unchanged: their noise is the residual of fits.
    """
    commanded = all(r.command.size for r in recordings)
    if not commanded and plan.simulated:
        raise ValueError("a log without commands prescribes its motion: its noise and repeats are measured, not stated")
    if not plan.simulated and (not commanded or split_of(recordings) is Split.WINDOWS):
        return list(recordings), noise_of_log(recordings[0])
    planned = list[Recording]()
    noise = list[ColumnNoise]()
    for i, recording in enumerate(recordings):
        one, of_columns = planned_recording(scene, recording, clean(recording), plan, rehearsal, rehearsal.seed + i)
        planned.append(one)
        noise = noise or of_columns
    return planned, noise


def _compared(
    scene: Scene,
    given: Sequence[Recording],
    planned: Sequence[Recording],
    plan: RehearsalPlan,
    config: DiscrepancyConfig,
) -> tuple[str, ...]:
    """The channels that the search would compare: the configured ones, or those of the measurement."""
    if config.channels:
        return tuple(n for n in SIMULATED if n in config.channels)
    if plan.noise:  # channels with a stated noise will be measured
        named = [n for n in SIMULATED if n in plan.noise and all(n in r.channels for r in planned)]
        if named:
            with_named = [replace(r, channels={n: r.channels[n] for n in named}) for r in planned]
            return tuple(comparing(scene, with_named, config).compare.channels)
    return tuple(comparing(scene, given, config).compare.channels)


def _common_channels(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Channels that all recordings have."""
    return tuple(n for n in SIMULATED if all(n in r.channels for r in recordings))


def part_of(
    residual_set: ResidualSet, base: FittedModel, jacobian: np.ndarray, directions: Sequence[ScoreDirection]
) -> LinearPart:
    """Return a part of the recordings in the linear model, at the values of `base`.

    residual_set: of the part.  jacobian: [M, D] of its residual.  directions: K coefficients.
    """
    names = [c.name for c in residual_set.comparison.channels for _ in range(len(c.columns))]
    channel = np.array(names)[residual_set.column]
    raw = sensitivities(residual_set, base.values, directions)
    rows, jacobian = residual_set.resampling, jacobian / residual_set.repeats**0.5
    if rows.repeated:
        return LinearPart(raw, jacobian, rows, channel)
    residual = base.residuals.mean(axis=0)
    return LinearPart(raw, jacobian, rows, channel, base.discrepancy, residual=residual, column=residual_set.column)


def unexplained_share(case: Case, base: FittedModel, train: LinearPart, directions: Sequence[ScoreDirection]) -> float:
    """Return the share of a log's root mean square residual that the best candidates do not explain.

    The base model's residual of a real log contains the effects that are looked for.  Used as noise in full, it hid a
    servo's friction that the search then named.  For commanded logs the strongest candidate is fitted in full, as the
    search does before it states the noise: the linear model explains only a sixth of soft friction.
    """
    raw, prior = np.nan_to_num(train.raw), base.refined.prior[base.refined.free] * case.train.prior_slack
    projected = project(raw, train.base, prior)
    rows = case.train.resampling
    scores = scored(
        base.residuals, directions, raw, projected, lambda s: rows.largest_score(s, projected, train.base, prior)
    )
    residual = base.residuals.mean(axis=0)
    least = np.linalg.norm(least_residual(scores, residual, case.full_space, case.config))
    if isinstance(case.train.cost, WindowedLog):
        columns = len(np.unique(case.train.column))
        if (refitted := refitted_residual(case, base, scores, columns)) is not None:
            least = min(least, np.linalg.norm(refitted))
    return float(least / max(np.linalg.norm(residual), 1e-30))


def linear_model(
    case: Case,
    base: FittedModel,
    directions: Sequence[ScoreDirection],
    train: LinearPart,
    validation: LinearPart,
) -> LinearModel:
    """Return the linear model of a case; a direction whose replay blew up has sensitivity zero."""
    space, minimum, refined = case.full_space, case.minimum_sizes, base.refined
    low, high = (base.space.to_search(end) - refined.x for end in (base.space.low, base.space.high))
    coefficients = [space[d.coefficient] for d in directions]
    share = case.config.selection.bound_margin
    return LinearModel(
        directions=tuple(directions),
        train=replace(train, raw=np.nan_to_num(train.raw)),
        validation=replace(validation, raw=np.nan_to_num(validation.raw)),
        prior=refined.prior[refined.free],
        slack=case.train.prior_slack,
        repeats=case.train.resampling.units if case.train.resampling.repeated else 1,
        minimum=np.array([minimum.get(d.coefficient, 0.0) for d in directions]),
        low=np.array([p.low - p.mean for p in coefficients]),
        high=np.array([p.high - p.mean for p in coefficients]),
        base_low=low[refined.free],
        base_high=high[refined.free],
        bound_margin=np.array(
            [0.0 if p.name in case.natural_bounds else share * (p.high - p.low) for p in coefficients]
        ),
    )


def one_shape_each(directions: Sequence[ScoreDirection]) -> list[int]:
    """Return the number of one direction of each coefficient: that with the middle one of its shapes."""
    groups: dict[str, list[int]] = {}
    for k, direction in enumerate(directions):
        groups.setdefault(direction.coefficient, []).append(k)
    return [rows[len(rows) // 2] for rows in groups.values()]


class Stopwatch:
    """Measures the seconds of each stage; call it with the name of the stage that begins, "" for none."""

    def __init__(self, report: ReportStage) -> None:
        self.report, self.seconds = report, dict[str, float]()
        self._stage, self._since = "", time.monotonic()

    def __call__(self, stage: str) -> None:
        now = time.monotonic()
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        if stage:
            self.report(stage)
