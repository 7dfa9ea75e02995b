"""The quick form: what would be found and recovered, from sensitivities alone, without a search.

The search's own case is made of the recordings, or of what the replay and a stated noise make of their commands.
Parameters stand where they are known; each candidate effect is simulated once with a small coefficient.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from droid_jax import runtime
from droid_jax.cost.channels import SIMULATED
from droid_jax.cost.cost import make_cost
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import ScoreDirection, directions_of, project, scored, sensitivities
from droid_jax.discrepancy.case import Case, ResidualSet, comparing
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FittedModel, with_finer_step, with_step_difference
from droid_jax.discrepancy.log_case import base_model, case_of, least_residual
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.identifiability import Identifiability, calibrated, identifiability, with_stated_prior
from droid_jax.identify.levenberg_marquardt import DampedProblem
from droid_jax.identify.multistart import RefineConfig, Refined
from droid_jax.identify.search import NotReplayed
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.effects.candidate import candidates
from droid_jax.model.effects.registry import beside, joined, ready
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, with_options
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import FEWEST_REPEATS, Split, roles_of, split_of
from droid_jax.rehearsal.linear import (
    LinearModel,
    LinearPart,
    RehearsalConfig,
    distinguishable,
    leftover_of,
    rivals_of,
    taken_by,
)
from droid_jax.rehearsal.plan import (
    ColumnNoise,
    HiddenCase,
    RehearsalPlan,
    faster_motion,
    hidden_form,
    noise_of_log,
    planned_recording,
    robot_trace,
    simulated_channels,
)
from droid_jax.rehearsal.power import smallest_sizes
from droid_jax.simulate.replay import Drive

AT_REST = RefineConfig(iterations=0, basin_hops=0)  # slopes at the known parameters, and no step
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
    clock = _Stopwatch(tell)
    clock("compile")
    effects = beside(space, effects)
    start = space.values(dict(plan.values or {}))
    whole = joined(space, effects)
    at = whole.embed(space, start[None])[0]
    config = replace(config, channels=plan.channels or config.channels)
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
        base, slopes = known_base(case.train, case.base, values)
    clock("sensitivities")
    directions = directions_of(candidates(case.effects))
    if train_only:
        directions = tuple(directions[k] for k in one_shape_each(directions))
    free = base.refined.free
    train = part_of(case.train, base, slopes[:, free], directions)
    validation = train
    if split is not Split.REPEATS and not train_only:
        beside_base, slopes = known_base(case.validation, case.base, values, spreads=0)
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


def known_base(
    residual_set: ResidualSet, base: Space, values: np.ndarray, spreads: int = 1
) -> tuple[FittedModel, np.ndarray]:
    """The base model at known values [D], with the slopes that a fit has; and [M, D] slopes along each axis.

    A fit's slopes are of steps along its posterior's axes (`wide_jacobian`), in which several parameters move together
    by so much that sticking joints let go.  There the slope of a delay was no longer the delay's own: what a parameter
    may absorb of an effect is told by the steps along one axis.

    spreads: see `LevenbergMarquardtConfig.spreads`.
    """
    whole, config = residual_set.cost.space, replace(AT_REST, spreads=spreads)

    def residuals(rows: np.ndarray) -> np.ndarray:
        return residual_set.whitened(whole.embed(base, rows, values))

    problem = DampedProblem(residuals, base, config)
    state, slopes = problem.start_with_slopes(problem.inside(base.to_search(values[None, whole.columns(base)])))
    if not np.isfinite(state.objective[0]):
        name = residual_set.comparison.name
        raise NotReplayed(f"the simulation of {name!r} blows up at the parameters' values: begin at other ones")
    x = state.x[0]
    refined = Refined(
        base, x, base.from_search(x), float(state.objective[0]), state.residual[0],
        problem.wide_jacobian(state, slopes[0]), problem.prior, state.objective, problem.evaluations, 0, True,
    )  # fmt: skip
    rows = residual_set.resampling
    left = rows.residuals(-refined.residual / np.sqrt(residual_set.repeats))
    at = whole.embed(base, refined.best[None], values)[0]
    return FittedModel((), at, base, refined, left, rows.discrepancy(left)), slopes[0]


def fine_steps(residual_set: ResidualSet, model: FittedModel, base: Space, recording: Recording) -> np.ndarray | None:
    """[M] what far finer time steps change of the base model, in one repeat's noise; None in inverse mode.

    In plain C, where nothing is compiled.  Its error is of first order in the step: of two steps' it is extrapolated
    to none (Richardson).  What plain C does not have is replayed at a quarter of the step, as the search does.
    """
    known = residual_set.cost
    if not isinstance(known.drives[0], Drive) or isinstance(known, WindowedLog):
        return with_step_difference(residual_set, model, with_finer_step(residual_set, base, recording)).step_difference
    config, timestep = residual_set.comparison.config, float(known.scene.model.opt.timestep)
    try:
        coarse, fine = (
            make_cost(
                with_options(known.scene, timestep=timestep / parts), base, [recording], engine="mujoco", config=config,
                check=False,
            )
            for parts in FINE
        )  # fmt: skip
    except ValueError:
        return with_step_difference(residual_set, model, with_finer_step(residual_set, base, recording)).step_difference
    near, nearer = (with_step_difference(residual_set, model, cost).step_difference for cost in (coarse, fine))
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
    a servo's friction that the search then named.
    """
    raw, held = np.nan_to_num(train.raw), base.refined.prior[base.refined.free] * case.train.prior_slack
    projected = project(raw, train.base, held)
    rows = case.train.resampling
    found = scored(
        base.residuals, directions, raw, projected, lambda s: rows.largest_score(s, projected, train.base, held)
    )
    left = base.residuals.mean(axis=0)
    least = least_residual(found, left, case.full_space, case.config)
    return float(np.linalg.norm(least) / max(np.linalg.norm(left), 1e-30))


def linear_model(
    case: Case,
    base: FittedModel,
    directions: Sequence[ScoreDirection],
    train: LinearPart,
    validation: LinearPart,
) -> LinearModel:
    """The linear model of a case; a direction whose replay blew up has sensitivity zero."""
    space, minimum, refined = case.full_space, case.minimum_sizes, base.refined
    room = [base.space.to_search(end) - refined.x for end in (base.space.low, base.space.high)]
    of = [space[d.coefficient] for d in directions]
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
        base_low=room[0][refined.free],
        base_high=room[1][refined.free],
    )


def hidden_directions(model: LinearModel) -> list[int]:
    """Of each coefficient at each place one direction (`one_shape_each`)."""
    return one_shape_each(model.directions)


def one_shape_each(directions: Sequence[ScoreDirection]) -> list[int]:
    """Of each coefficient at each place one direction: in the middle of the shapes that are tried."""
    groups: dict[str, list[int]] = {}
    for k, direction in enumerate(directions):
        groups.setdefault(direction.coefficient, []).append(k)
    return [rows[len(rows) // 2] for rows in groups.values()]


def parameter_identifiability(found: Rehearsed, model: LinearModel, more: float = 1.0) -> tuple[Identifiability, ...]:
    """What the recordings would say of each base parameter; more: times as many of them."""
    refined, train = found.base.refined, found.case.train
    seen = np.isin(found.model.train.channel, np.unique(model.train.channel))
    if not found.model.repeated:  # the validation blocks are fitted by `identify` too
        more = 2 * more
    jacobian = refined.jacobian[seen] * np.sqrt(more * model.repeats / max(found.model.repeats, 1))
    part = replace(refined, jacobian=jacobian, residual=refined.residual[seen])
    gaussian = with_stated_prior(_posterior(part, model, train), part)
    return identifiability(gaussian, part.prior, train.identifiability)


def _posterior(refined: Refined, model: LinearModel, train: ResidualSet) -> Gaussian:
    rows = model.train.rows
    # Of the mean of the repeats, as the slopes are.
    deviations = [rows.deviations * rows.units**0.5] if model.repeated else [np.zeros((1, len(refined.jacobian)))]  # type: ignore[attr-defined]
    return calibrated(refined, deviations, None, train.identifiability.pooling)


def answers(found: Rehearsed, config: DiscrepancyConfig, rehearsal: RehearsalConfig) -> list[dict[str, Any]]:
    """Of each coefficient at each place: the smallest size that is found, and what it is taken for."""
    model, space = found.model.of(found.compared), found.case.full_space
    wanted = hidden_directions(model)
    out = []
    for k, size in zip(wanted, smallest_sizes(model, wanted, rehearsal, config.selection), strict=True):
        direction, p = model.directions[k], space[model.directions[k].coefficient]
        rivals = rivals_of(model, k, size.size, config, rehearsal.share)
        out.append(
            {
                "effect": direction.candidate.effect,
                "location": direction.candidate.location,
                "coefficient": direction.coefficient,
                "unit": p.unit,
                "shape": dict(direction.candidate.shape_parameters),
                "smallest": size.size,
                "limit": size.limit,
                "limits": dict(size.limits),
                "minimum": float(model.minimum[k]),
                "bound": float(model.room[k]),
                "noncentrality": size.noncentrality,
                "taken_for": [
                    {"effect": r.key.effect, "location": r.key.location, "share": r.share, "below": r.apart}
                    for r in rivals
                ],
            }
        )
    return out


def robot_whitened(
    found: Rehearsed, space: Space, recording: Recording, cases: Sequence[HiddenCase], config: DiscrepancyConfig
) -> list[np.ndarray | None]:
    """[M] of each case what the synthetic robot measures of the training motion, in one repeat's noise.

    None where its simulation blows up.  MuJoCo's steps leave Python to the other threads.
    """
    comparison, scene = found.case.train.comparison, found.case.train.cost.scene
    known = found.base.values[found.case.full_space.columns(space)]
    clock = comparison.clock - comparison.clock[0]

    def simulated(case: HiddenCase) -> Rollout | None:
        try:
            return robot_trace(scene, space, recording, known, case, config, 0)
        except ValueError:
            return None

    def whitened(trace: Rollout) -> np.ndarray:
        fields = {n: interpolate(clock, trace.time, getattr(trace, n)) for n in ("torque", "position", "velocity")}
        angle = np.interp(clock, trace.time, trace.object_angle)
        on_clock = replace(trace, time=clock, object_angle=angle, contact=np.zeros((len(clock), 0), bool), **fields)
        return np.asarray(comparison.whitened(on_clock), float) / comparison.repeats**0.5

    with ThreadPoolExecutor(runtime.cores()) as pool:
        traces = list(pool.map(simulated, cases))
    return [None if trace is None else whitened(trace) for trace in traces]


def law_checks(
    found: Rehearsed,
    space: Space,
    known: Sequence[Mapping[str, Any]],
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
) -> list[dict[str, Any] | None]:
    """Of each answer whether an effect of that size would be known for what it is; None where none is found.

    The linear model takes effects to be small and the robot's law to be the library's.  Here each is simulated at the
    size that was found.  One whose law has a shape is simulated at its best place once more with the law of the
    synthetic robot, which has another.  Of the two the worse counts: `own` is the share of what the base parameters
    leave of it that the library's effect takes, `other` a candidate that takes clearly more.
    """
    out: list[dict[str, Any] | None] = [None] * len(known)
    sizes = [e["smallest"] for e in known]
    asked = [i for i, size in enumerate(sizes) if np.isfinite(size)]
    if not found.model.repeated or not asked:
        return out
    train, wanted, model = found.case.train, hidden_directions(found.model), found.model.of(found.compared)
    seen = np.isin(found.model.train.channel, found.compared)

    def check(i: int, difference: np.ndarray, law: str) -> None:
        if not np.isfinite(difference).all():
            return
        left = leftover_of(model, difference[seen], np.zeros(len(model.validation.base)), 1.0)
        taken = taken_by(model, left.at(1.0)[0], left.free[-1])
        own = max(v for key, v in taken.items() if (key.effect, key.location) == _place(known[i]))
        rival = max(taken, key=taken.__getitem__)
        apart = known[i]["noncentrality"] ** 2 * (taken[rival] - own)
        confused = apart > distinguishable(model, config, rehearsal.share)
        confused &= 1 - own > config.selection.equivalence_factor * (1 - taken[rival])
        other = {"effect": rival.effect, "location": rival.location, "share": taken[rival]} if confused else None
        before, sure = out[i], bool(own >= rehearsal.known and not confused)
        if before is None or (own < before["own"] and not (before["sure"] is False and sure)):
            out[i] = {"law": law, "own": own, "other": other, "sure": sure}

    far = [sizes[i] * float(found.model.sign[wanted[i]]) for i in asked]
    slopes = sensitivities(train, found.base.values, [found.model.directions[wanted[i]] for i in asked], far)
    for i, slope, size in zip(asked, slopes, far, strict=True):
        check(i, slope * size, "the library's")
    for i, difference in _other_laws(found, space, known, config):
        check(i, difference, "the synthetic robot's")
    return out


def _other_laws(
    found: Rehearsed, space: Space, known: Sequence[Mapping[str, Any]], config: DiscrepancyConfig
) -> Iterator[tuple[int, np.ndarray]]:
    """Of each effect with a shape, at its best place, what the synthetic robot's law adds to the training part, [M]."""
    recording, scene = found.roles["train"], found.case.train.cost.scene
    if not recording.command.size:
        return
    best = [entry for entry, _ in _one_each(known, range(len(known)))]
    asked, cases = list[int](), [HiddenCase(0)]
    shaped = {effect.name for effect in found.case.effects if effect.shape_parameters}
    for i, entry in enumerate(known):
        if entry["effect"] not in shaped:
            continue
        name, joint = hidden_form(scene, entry["effect"], entry["location"], entry["unit"])
        if name and np.isfinite(entry["smallest"]) and any(entry is one for one in best):
            asked.append(i)
            cases.append(HiddenCase(0, hidden=name, joint=joint, amplitude=entry["smallest"]))
    if not asked:
        return
    plain, *others = robot_whitened(found, space, recording, cases, config)
    for i, other in zip(asked, others, strict=True):
        if plain is not None and other is not None:
            yield i, other - plain


def _place(entry: Mapping[str, Any]) -> tuple[str, str]:
    return entry["effect"], entry["location"]


def improvements(
    found: Rehearsed,
    known: Sequence[Mapping[str, Any]],
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
    faster: Rehearsed | None = None,
) -> list[dict[str, Any]]:
    """What more repeats, another channel or another motion would change, the most helpful first."""
    model, every = found.model.of(found.compared), hidden_directions(found.model)
    known, wanted = zip(*_one_each(known, every), strict=True)
    before = np.array([e["smallest"] for e in known])
    recovered = _recovered(found, model, rehearsal)
    out = []

    def helped(what: str, before: np.ndarray, after: np.ndarray, now: int) -> None:
        both = np.isfinite(before) & np.isfinite(after)
        ratio = float(np.exp(np.mean(np.log(before[both] / after[both])))) if both.any() else 1.0
        out.append(
            {
                "what": what,
                "times_smaller": ratio,
                "newly_found": int(np.sum(~np.isfinite(before) & np.isfinite(after))),
                "lost": int(np.sum(np.isfinite(before) & ~np.isfinite(after))),
                "recovered_more": now - recovered,
            }
        )

    def sizes(of: LinearModel, rows: Sequence[int]) -> np.ndarray:
        return np.array([s.size for s in smallest_sizes(of, rows, rehearsal, config.selection)])

    for what, other, more in _variants(found):
        if not other.repeated and more > 1:
            needed = np.array([max(e["limits"].values(), default=np.inf) for e in known]) / np.sqrt(more)
            after = np.where(needed <= [e["bound"] for e in known], needed, np.inf)
        else:
            after = sizes(other, wanted)
        helped(what, before, after, _recovered(found, other, rehearsal, more))
    if faster is not None:  # of the training motion alone, as this one
        moved, here = faster.model.of(found.compared), model.alone(every)
        rows = [every.index(k) for k in wanted]
        helped("the faster motion", sizes(here, rows), sizes(moved, rows), _recovered(faster, moved, rehearsal))
    return sorted(out, key=lambda o: -(o["newly_found"] - o["lost"] + 10 * np.log(o["times_smaller"])))


def _one_each(known: Sequence[Mapping[str, Any]], wanted: Sequence[int]) -> list[tuple[Mapping[str, Any], int]]:
    """Of each effect the place and coefficient that is found at the smallest share of its bound."""
    best: dict[str, tuple[Mapping[str, Any], int]] = {}
    for entry, k in zip(known, wanted, strict=True):
        other = best.get(entry["effect"])
        if other is None or entry["smallest"] / entry["bound"] < other[0]["smallest"] / other[0]["bound"]:
            best[entry["effect"]] = entry, k
    return list(best.values())


def _variants(found: Rehearsed) -> Iterator[tuple[str, LinearModel, float]]:
    """What could be changed of the same motion, its linear model, and how many times as long a log is."""
    model = found.model.of(found.compared)
    for factor in (2, 4):
        if model.repeated:
            yield f"{factor} times as many repeats", replace(model, repeats=factor * model.repeats), 1.0
        else:
            yield f"a log {factor} times as long", model, float(factor)
    for name in dict.fromkeys(found.model.train.channel.tolist()):
        if name not in found.compared:
            yield f"{name.replace('_', ' ')} compared too", found.model.of((*found.compared, name)), 1.0


def _recovered(found: Rehearsed, model: LinearModel, rehearsal: RehearsalConfig, more: float = 1.0) -> int:
    verdicts = parameter_identifiability(found, model, more)
    limit = rehearsal.recovered or found.case.train.identifiability.identifiable
    nuisance = dict(zip(found.base.space.names, found.base.space.nuisance, strict=True))
    return sum(t.shrinkage < limit for t in verdicts if not nuisance[t.name])


def quick_rehearsal(
    scene: Scene,
    space: Space,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    plan: RehearsalPlan | None = None,
    config: DiscrepancyConfig | None = None,
    rehearsal: RehearsalConfig | None = None,
    tell: Tell = lambda stage: None,
    *,
    faster: bool = True,
    step_error: bool = True,
) -> tuple[Rehearsed, dict[str, Any]]:
    """What a search in these recordings would find.

    Args:
        scene: the robot.
        space: all that is fitted without any effect.
        effects: that could be hidden.
        recordings: as given to the search.
        plan: repeats, noise, channels and parameter values that are stated; None: as measured.
        config: of the search.
        rehearsal: what counts as found.
        tell: called with each stage's name.
        faster: whether a faster motion is looked at too.
        step_error: whether to measure what the time step leaves.

    Returns:
        The linear model of the search, and its answers as plain data (rehearsal.json).

    Raises:
        ValueError: what the search refuses too, or a simulation that blows up.
    """
    began, used = time.monotonic(), time.process_time()
    plan, config = plan or RehearsalPlan(), config or DiscrepancyConfig()
    rehearsal = rehearsal or RehearsalConfig()
    found = rehearsed(scene, space, effects, recordings, plan, config, rehearsal, tell, step_error=step_error)
    tell("tests")
    known = answers(found, config, rehearsal)
    tell("laws")
    checks = law_checks(found, space, known, config, rehearsal)
    known = [{**entry, "law": check} for entry, check in zip(known, checks, strict=True)]
    model = found.model.of(found.compared)
    other = None
    if faster and found.model.repeated and all(r.command.size for r in recordings):
        tell("a faster motion")
        moved = [faster_motion(r, rehearsal.faster) for r in recordings]
        other_plan = replace(plan, repeats=found.model.repeats * (2 if found.split is Split.REPEATS else 1))
        try:
            with warnings.catch_warnings():  # what there is to warn of was said of the motion itself
                warnings.simplefilter("ignore", UserWarning)
                other = rehearsed(
                    scene, space, effects, moved, other_plan, config, rehearsal, tell, step_error=False, train_only=True
                )
        except ValueError as error:
            warnings.warn(f"the faster motion was not looked at: {error}", stacklevel=2)
    tell("improvements")
    helps = improvements(found, known, config, rehearsal, other)
    limit = rehearsal.recovered or config.identifiability.identifiable
    verdicts = parameter_identifiability(found, model)
    of = {p.name: p for p in found.base.space.parameters}
    at = dict(zip(found.case.full_space.names, found.base.values, strict=True))
    answer = {
        "format": "droid_jax rehearsal 1",
        "form": "quick",
        "recordings": [r.name for r in recordings],
        "split": found.split.value,
        "limits": [*filter(None, (found.split.limits, *found.case.limits))],
        "how": {
            "compared": list(found.compared),
            "repeats": found.model.repeats if found.model.repeated else None,
            "blocks": None if found.model.repeated else found.model.train.rows.units,
            "simulated": plan.simulated,
            "noise": [
                dict(zip(("channel", "column", "unit", "deviation", "source"), row, strict=True))
                for row in found.noise
                if row[0] in found.compared
            ],
            "step_error": model.step_error,
            "level": model.train.level,
            "directions": len(model.directions),
            "rehearsal": asdict(rehearsal),
            "significance": config.selection.significance,
            "confirmation": config.selection.confirmation,
            "recovered_below": limit,
        },
        "parameters": [
            {
                "name": t.name,
                "unit": of[t.name].unit,
                "value": float(at[t.name]),
                "nuisance": bool(of[t.name].nuisance),
                "shrinkage": t.shrinkage,
                "recovered": bool(t.shrinkage < limit),
                "partners": [list(p) for p in t.partners],
            }
            for t in verdicts
        ],
        "effects": known,
        "helps": helps,
        "seconds": {**dict(found.seconds), "whole": time.monotonic() - began, "cpu": time.process_time() - used},
    }
    return found, answer


class _Stopwatch:
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
