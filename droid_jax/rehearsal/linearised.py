"""The linear model of a search, made from the recordings to rehearse: known parameters, slopes, sensitivities, noise.

The search's own case is made of the recordings, or of what the replay and a stated noise make of their commands.
Parameters stand where they are known; each candidate effect is simulated once with a small coefficient.
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
from droid_jax.rehearsal.linear import LinearModel, LinearPart, RehearsalConfig
from droid_jax.rehearsal.plan import ColumnNoise, RehearsalPlan, noise_of_log, planned_recording, simulated_channels
from droid_jax.simulate.replay import Drive

ROUGHLY = 5  # iterations of a base fit whose residual is taken for noise
FINE = (8, 32)  # parts of a time step
Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """A linear model with what it came from.

    split, case, roles: of the search.  base: the base parameters where they are known, with their slopes.
    model: of all channels that are known or assumed.  compared: those that the search compares.  noise: of each column.
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
    tell: Tell = lambda stage: None,
    *,
    step_error: bool = True,
    train_only: bool = False,
) -> Rehearsed:
    """The linear model of a search in these recordings.

    Args:
        scene: the robot.
        space: all that is fitted without any effect.
        effects: that could be hidden.
        recordings: as given to the search.
        plan: what is planned beside what was measured.
        config: of the search.
        rehearsal: what is assumed.
        tell: called with each stage's name.
        step_error: whether to measure what the time step leaves.
        train_only: take the training part for the validation part too, and of each coefficient one shape; of recordings
            with repeats.

    Raises:
        ValueError: what the search refuses too, or a simulation that blows up.
    """
    clock = Stopwatch(tell)
    clock("compile")
    space = without_unused(space, recordings[:1] if train_only else recordings)
    effects = beside(space, effects)
    start = space.values(dict(plan.values or {}))
    whole = joined(space, effects)
    at = whole.embed(space, start[None])[0]
    fewer = replace(config.windows, samples=rehearsal.samples, sample_length=rehearsal.sample_length)
    config = replace(config, channels=plan.channels or config.channels, windows=fewer)
    clean = clean_channels(scene, space, whole, effects, at, plan, config)
    made, noise = _made(clean, scene, recordings[:1] if train_only else recordings, plan, rehearsal)
    chosen = _compared(scene, recordings, made, plan, config)
    halves = Split.RECORDINGS if len(recordings) > 1 else Split.REPEATS
    split = halves if train_only else split_of(made)
    roles = roles_of(split, made)
    every = chosen if split in (Split.WINDOWS, Split.BLOCKS) or not made[0].command.size else _alike(made)
    clock("case")
    needed = {k: r for k, r in roles.items() if split is not Split.RECORDINGS or k != "test"}
    if train_only:
        needed = {"train": roles["train"], "validation": roles["train"]}
    refine = replace(config.refine, iterations=min(config.refine.iterations, ROUGHLY))  # of windows, which are fitted
    case = case_of(split, scene, space, effects, needed, replace(config, channels=every, refine=refine))
    values = whole.embed(space, start[None])[0] if case.start is None or plan.values or plan.simulated else case.start
    clock("base")
    if split is Split.BLOCKS:
        base = base_model(case)
        values, slopes = base.values, base.refined.jacobian
    else:
        base, slopes = model_at(case.train, case.base, values)
    clock("sensitivities")
    directions = directions_of(candidates(case.effects))
    if train_only:
        directions = tuple(directions[k] for k in one_shape_each(directions))
    free = base.refined.free
    train = part_of(case.train, base, slopes[:, free], directions)
    validation = train
    if split is not Split.REPEATS and not train_only:
        beside_base, slopes = model_at(case.validation, case.base, values, spreads=0)
        validation = part_of(case.validation, beside_base, slopes[:, free], directions)
    if not train.rows.repeated:
        share = unexplained_share(case, base, train, directions)
        train, validation = train.quieter(share), validation.quieter(share)
    elif step_error:
        clock("step error")
        with contextlib.suppress(NotReplayed):
            train = replace(train, step=fine_steps(case.train, base, case.base, roles["train"]))
    clock("")
    model = linear_model(case, base, directions, train, validation)
    return Rehearsed(split, case, roles, base, model, chosen, tuple(noise), clock.seconds)


Clean = Callable[[Recording], Rollout]  # what a recording's commands make of the robot, without noise


def clean_channels(
    scene: Scene,
    space: Space,
    whole: Space,
    effects: Sequence[Effect],
    at: np.ndarray,
    plan: RehearsalPlan,
    config: DiscrepancyConfig,
) -> Clean:
    """The replay without noise at values `at` [D]: in plain C where only the noise of the repeats will count.

    A mean of the repeats that is a little off changes nothing then: what is missing is looked for along slopes.
    """

    def simulated(recording: Recording) -> Rollout:
        if (plan.repeats or recording.repeats) >= FEWEST_REPEATS:
            with contextlib.suppress(ValueError):  # of what plain C does not have
                return simulated_channels(scene, space, (), recording, at[whole.columns(space)], config, "mujoco")
        return simulated_channels(ready(scene), whole, effects, recording, at, config)

    return simulated


def fine_steps(residual_set: ResidualSet, model: FittedModel, base: Space, recording: Recording) -> np.ndarray | None:
    """[M] what far finer time steps change of the base model, in one repeat's noise; None without commands.

    In plain C, where nothing is compiled.  Its error is of first order in the step: of two steps' it is extrapolated
    to none (Richardson).  What plain C does not have is replayed at a quarter of the step, as the search does.
    """

    def difference(finer: AnyCost | None) -> np.ndarray | None:
        return with_step_difference(residual_set, model, finer).step_difference

    known, costs = residual_set.cost, list[Cost]()
    if isinstance(known.drives[0], Drive) and not isinstance(known, WindowedLog):
        config, timestep = residual_set.comparison.config, float(known.scene.model.opt.timestep)
        scenes = [with_options(known.scene, timestep=timestep / parts) for parts in FINE]
        with contextlib.suppress(ValueError):  # of what plain C does not have
            compared = until(recording, known.drives[0])
            costs = [make_cost(s, base, [compared], engine="mujoco", config=config, check=False) for s in scenes]
    if not costs:
        return difference(with_finer_step(residual_set, base, recording))
    near, nearer = map(difference, costs)
    assert near is not None and nearer is not None
    return nearer + (nearer - near) / (FINE[1] / FINE[0] - 1)


def _made(
    clean: Clean, scene: Scene, recordings: Sequence[Recording], plan: RehearsalPlan, rehearsal: RehearsalConfig
) -> tuple[list[Recording], list[ColumnNoise]]:
    """The recordings to rehearse, and the noise of the first one's columns.

    Logs that are cut in time stay as they are: their noise is what fits leave of them.
    """
    commanded = all(r.command.size for r in recordings)
    if not commanded and plan.simulated:
        raise ValueError("a log without commands prescribes its motion: its noise and repeats are measured, not stated")
    if not plan.simulated and (not commanded or split_of(recordings) is Split.WINDOWS):
        return list(recordings), noise_of_log(recordings[0])
    made = list[Recording]()
    noise = list[ColumnNoise]()
    for i, recording in enumerate(recordings):
        full, each = planned_recording(scene, recording, clean(recording), plan, rehearsal, rehearsal.seed + i)
        made.append(full)
        noise = noise or each
    return made, noise


def _compared(
    scene: Scene, given: Sequence[Recording], made: Sequence[Recording], plan: RehearsalPlan, config: DiscrepancyConfig
) -> tuple[str, ...]:
    """The channels that the search would compare: those asked for, else of what is measured."""
    if config.channels:
        return tuple(n for n in SIMULATED if n in config.channels)
    if plan.noise:  # what is stated is what will be measured
        named = [n for n in SIMULATED if n in plan.noise and all(n in r.channels for r in made)]
        if named:
            kept = [replace(r, channels={n: r.channels[n] for n in named}) for r in made]
            return tuple(comparing(scene, kept, config).compare.channels)
    return tuple(comparing(scene, given, config).compare.channels)


def _alike(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Channels that all of them have."""
    return tuple(n for n in SIMULATED if all(n in r.channels for r in recordings))


def part_of(
    residual_set: ResidualSet, base: FittedModel, slopes: np.ndarray, directions: Sequence[ScoreDirection]
) -> LinearPart:
    """A part of the recordings in the linear model, at the values of `base`; slopes: [M, D] of its residual."""
    names = [c.name for c in residual_set.comparison.channels for _ in range(len(c.columns))]
    channel = np.array(names)[residual_set.column]
    raw = sensitivities(residual_set, base.values, directions)
    rows, slopes = residual_set.resampling, slopes / residual_set.repeats**0.5
    if rows.repeated:
        return LinearPart(raw, slopes, rows, channel)
    left = base.residuals.mean(axis=0)
    return LinearPart(raw, slopes, rows, channel, base.discrepancy, residual=left, column=residual_set.column)


def unexplained_share(case: Case, base: FittedModel, train: LinearPart, directions: Sequence[ScoreDirection]) -> float:
    """How much of a log's residual stays where the best candidates have taken theirs, of its root mean square.

    What the base model leaves of a real log holds the very effects that are looked for.  Taken whole for noise, it hid
    a servo's friction that the search then named.  Of commanded logs the strongest candidate is fitted in full, as the
    search does before it states the noise: of soft friction the linear model sees a sixth.
    """
    raw, held = np.nan_to_num(train.raw), base.refined.prior[base.refined.free] * case.train.prior_slack
    projected = project(raw, train.base, held)
    rows = case.train.resampling
    found = scored(
        base.residuals, directions, raw, projected, lambda s: rows.largest_score(s, projected, train.base, held)
    )
    left = base.residuals.mean(axis=0)
    least = np.linalg.norm(least_residual(found, left, case.full_space, case.config))
    if isinstance(case.train.cost, WindowedLog):
        columns = len(np.unique(case.train.column))
        if (fitted := refitted_residual(case, base, found, columns)) is not None:
            least = min(least, np.linalg.norm(fitted))
    return float(least / max(np.linalg.norm(left), 1e-30))


def linear_model(
    case: Case,
    base: FittedModel,
    directions: Sequence[ScoreDirection],
    train: LinearPart,
    validation: LinearPart,
) -> LinearModel:
    """The linear model of a case; a direction whose replay blew up has sensitivity zero."""
    space, minimum, refined = case.full_space, case.minimum_sizes, base.refined
    low, high = (base.space.to_search(end) - refined.x for end in (base.space.low, base.space.high))
    of = [space[d.coefficient] for d in directions]
    share = case.config.selection.bound_margin
    return LinearModel(
        directions=tuple(directions),
        train=replace(train, raw=np.nan_to_num(train.raw)),
        validation=replace(validation, raw=np.nan_to_num(validation.raw)),
        prior=refined.prior[refined.free],
        slack=case.train.prior_slack,
        repeats=case.train.resampling.units if case.train.resampling.repeated else 1,
        minimum=np.array([minimum.get(d.coefficient, 0.0) for d in directions]),
        low=np.array([p.low - p.mean for p in of]),
        high=np.array([p.high - p.mean for p in of]),
        base_low=low[refined.free],
        base_high=high[refined.free],
        bound_margin=np.array([0.0 if p.name in case.natural_bounds else share * (p.high - p.low) for p in of]),
    )


def one_shape_each(directions: Sequence[ScoreDirection]) -> list[int]:
    """Of each coefficient at each place one direction: in the middle of the shapes that are tried."""
    groups: dict[str, list[int]] = {}
    for k, direction in enumerate(directions):
        groups.setdefault(direction.coefficient, []).append(k)
    return [rows[len(rows) // 2] for rows in groups.values()]


class Stopwatch:
    """Seconds of each stage."""

    def __init__(self, tell: Tell) -> None:
        self.tell, self.seconds = tell, dict[str, float]()
        self._stage, self._since = "", time.monotonic()

    def __call__(self, stage: str) -> None:
        now = time.monotonic()
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        if stage:
            self.tell(stage)
