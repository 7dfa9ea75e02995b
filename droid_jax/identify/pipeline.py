"""Identification from recordings to a Gaussian: split, search, refine, calibrate, judge on held-out repeats."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.arguments import check_fields, flag, instance, number, one_of, optional, several, whole
from droid_jax.cost.channels import SIMULATED, check_channels, chosen_channels, in_noise_units
from droid_jax.cost.cost import Cost, check_known, make_cost
from droid_jax.cost.residuals import CompareConfig
from droid_jax.identify.divergence import blow_up
from droid_jax.identify.fit import Fit, grip_hypotheses, search_cost, starts, with_acting
from droid_jax.identify.gaussian import Gaussian, prior, space_to_json
from droid_jax.identify.holdout import WORTH, HeldoutDistance, beginning, heldout_distances, split_repeats
from droid_jax.identify.identifiability import (
    Identifiability,
    IdentifiabilityConfig,
    identifiability,
    moved_by_step,
    not_judged,
    posterior,
    step_shift,
)
from droid_jax.identify.multistart import RefineConfig, Refined, refine
from droid_jax.identify.search import CmaConfig, cma_search
from droid_jax.identify.solution_checks import SolutionCheck, check_solution
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.fields import check_space
from droid_jax.model.inertia import possible_draws
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.preflight.check_log import warn_of_log
from droid_jax.recordings.recording import Recording, recordings_of
from droid_jax.simulate.engine import CHOICES, EngineChoice, choose_engine
from droid_jax.simulate.repeat_starts import own_starts


@dataclass(frozen=True)
class IdentifyConfig:
    """Settings of an identification.

    Attributes:
        engine: "mjx", "mujoco" (plain C, all cores), or "auto": `simulate.engine.choose_engine` chooses.
        heldout: share of each recording's repeats that the fit does not see (at least one where there are two).
        search: CMA-ES settings; it sees the first recording alone, the refinement sees all of them.
        refine: refinement settings, or None: the search's own covariance is the distribution, as in the paper.
        beginning: s of long recordings that the search and the first refinement see, and more until every joint has
            moved through half of its range; the last refinement sees all.
        sorting: iterations of the refinement that tell whether effects that do not act would (`fit.with_acting`),
        sorting_ratio: and their `RefineConfig.pruning_ratio`.
        samples: replays drawn from the initial and from the fitted Gaussian to compare their costs, at most.
        sample_steps: time steps that these replays may take together; of long recordings there are fewer of them.
        seed: of those samples (the search has its own).
        compare: how simulation and measurement are compared.
        channels: the measured channels to fit. Several are weighted by their noise (`channels.in_noise_units`). None:
            those of `compare` where it names other ones, or weights, than its default, else what is informative
            (`channels.informative_channels`): torque, or without it position and the object's angle. Weights act in
            the distance and the search alone; the refinement counts every channel by its noise.
        identifiability: what decides the calibrated width, and when a parameter counts as identifiable.
        worth: share of the noise floor by which the distance before the fit must exceed it, else there was nothing to
            close and `HeldoutDistance.closed` is None.
        checks: measure what the time step and the engine leave at the fitted values (`solution_checks`), which takes
            one more compilation.

    Raises:
        ValueError: a setting is of the wrong type or out of its range.
    """

    engine: str = "auto"
    heldout: float = 0.3
    search: CmaConfig = field(default_factory=CmaConfig)
    refine: RefineConfig | None = field(default_factory=RefineConfig)
    beginning: float = 20.0
    sorting: int = 3
    sorting_ratio: tuple[float, ...] = (3.0, 1.3, 1.0)
    samples: int = 200
    sample_steps: int = 5_000_000
    seed: int = 0
    compare: CompareConfig = field(default_factory=CompareConfig)
    channels: tuple[str, ...] | None = None
    identifiability: IdentifiabilityConfig = field(default_factory=IdentifiabilityConfig)
    worth: float = WORTH
    checks: bool = True

    def __post_init__(self) -> None:
        check_fields(
            self,
            engine=partial(one_of, valid=CHOICES),
            heldout=partial(number, least=0, below=1),
            search=partial(instance, kind=CmaConfig),
            refine=optional(partial(instance, kind=RefineConfig)),
            beginning=partial(number, above=0, infinite=True),
            sorting=partial(whole, least=0),
            sorting_ratio=several(partial(number, least=1)),
            samples=partial(whole, least=0),
            sample_steps=partial(whole, least=1),
            seed=partial(whole, least=0),
            compare=partial(instance, kind=CompareConfig),
            channels=optional(several(partial(one_of, valid=SIMULATED))),
            identifiability=partial(instance, kind=IdentifiabilityConfig),
            worth=partial(number, least=0),
            checks=flag,
        )


@dataclass(frozen=True, eq=False)
class Identified:
    """Everything an identification found.

    space: what was searched; full: with the nuisances (the same where nothing was refined).
    best: [F] physical values over `full`.  gaussian: over `space`, the one to hand on; full_gaussian
    over `full`.  search: the CMA-ES part.  refined: or None.  identifiability: per parameter of `full`.
    heldout_distances: by name of the recording that judges.  fit, heldout: costs over `full` on what was fitted and on
    what judges.
    heldout_repeats: by recording name.  seconds: by stage.  checks: by recording name, of those with commands.
    config: the settings it was found with.  engine: that replayed, and why.
    """

    scene: Scene
    space: Space
    full: Space
    best: np.ndarray
    gaussian: Gaussian
    full_gaussian: Gaussian
    search: Fit
    refined: Refined | None
    identifiability: tuple[Identifiability, ...]
    heldout_distances: dict[str, HeldoutDistance]
    fit: Cost
    heldout: Cost
    heldout_repeats: dict[str, tuple[int, ...]]
    seconds: dict[str, float]
    checks: dict[str, SolutionCheck] = field(default_factory=dict[str, SolutionCheck])
    config: IdentifyConfig = field(default_factory=IdentifyConfig)
    engine: EngineChoice = field(default_factory=lambda: EngineChoice("mjx", "as asked for"))

    @property
    def start(self) -> np.ndarray:
        """[F] the initial means over `full`."""
        return self.full.mean


Progress = Callable[[str, Any], None]
# In plain C no block of trials is filled up with copies, nothing sticks or slips beside an optimum (contact pairs are
# MJX's), and in double precision the first slopes already tell the posterior's axes.
IN_C = {"dampings": (0.1, 1.0, 10.0, 1e3), "lengths": (1.0,), "patience": 2, "basin_hops": 0, "spreads": 1}
FEWEST = 16  # samples of a Gaussian that show its spread
_FIELDS = tuple(Rollout.__dataclass_fields__)


@dataclass(frozen=True, eq=False)
class Preparation:
    """What is to be identified, checked: costs over `full`, which is `space` with the nuisances that are fitted.

    heldout_recordings: the repeats of each recording that the fit does not see; heldout_repeats: their numbers.
    judges: whole recordings that judge instead; then no repeat is held out.  fit, heldout: costs on what is fitted and
    on what judges.
    early: as fit, of the beginnings of long recordings.  seconds: that this took.  engine: that replays.
    """

    scene: Scene
    space: Space
    full: Space
    config: IdentifyConfig
    effects: tuple[Effect, ...]
    recordings: tuple[Recording, ...]
    heldout_recordings: tuple[Recording, ...]
    heldout_repeats: tuple[tuple[int, ...], ...]
    judges: tuple[Recording, ...]
    fit: Cost
    early: Cost
    heldout: Cost
    fingerprint: str
    seconds: float
    engine: EngineChoice


def identify_parameters(
    scene: Scene,
    space: Space,
    recordings: Recording | Sequence[Recording],
    *,
    nuisances: Space | None = None,
    config: IdentifyConfig | None = None,
    effects: Sequence[Effect] = (),
    judge_on: Sequence[Recording] = (),
    checkpoints: Path | None = None,
    progress: Progress | None = None,
) -> Identified:
    """Fit `space` to one or several recordings of the same robot and object.

    Args:
        scene: what is simulated.
        space: the D parameters that the search moves.
        recordings: to fit and, of their last repeats, to judge the fit.
        nuisances: fitted and marginalised beside it in the refinement; None for none.
        config: settings; None for the defaults.
        effects: in the model beside what the scene has; their parameters are in `space` or stay at neutral.
        judge_on: whole recordings to judge the fit; all repeats of `recordings` are then fitted. None: the last repeats
            judge, or the last part in time of a log; a commanded recording of one repeat is judged on itself.
        checkpoints: folder where the search saves itself and from which it resumes.
        progress: called with a stage's name and its progress value.

    Returns:
        Everything found; its `gaussian` is the distribution to hand on.

    Raises:
        ValueError: recordings of one name, no channel to compare, several recordings without the refinement (the
            search sees the first alone), or initial means that cannot be simulated.
    """
    problem = prepare(scene, space, recordings, nuisances=nuisances, config=config, effects=effects, judge_on=judge_on)
    return run_fit(problem, checkpoints=checkpoints, progress=progress)


def prepare(
    scene: Scene,
    space: Space,
    recordings: Recording | Sequence[Recording],
    *,
    nuisances: Space | None = None,
    config: IdentifyConfig | None = None,
    effects: Sequence[Effect] = (),
    judge_on: Sequence[Recording] = (),
) -> Preparation:
    """The part of `identify_parameters` before the search: whatever is wrong with the input is told here, and
    nothing written.
    """
    began = time.monotonic()
    config = instance(IdentifyConfig() if config is None else config, "config", IdentifyConfig)
    recordings, judges = recordings_of(recordings), recordings_of(judge_on) if judge_on else ()
    _check_names([r.name for r in recordings], [r.name for r in judges], config)
    instance(space, "space", Space)
    if nuisances is not None:
        instance(nuisances, "nuisances", Space)
    check_space(instance(scene, "scene", Scene), space)
    recordings = [own_starts(recording, config.compare.start) for recording in recordings]
    judges = tuple(own_starts(recording, config.compare.start) for recording in judges)
    chosen = chosen_channels(scene, [*recordings, *judges], config.channels, config.compare)
    if chosen:
        config = replace(config, compare=replace(config.compare, channels=dict.fromkeys(chosen, 1.0)))
    check_channels([*recordings, *judges], config.compare.channels)
    if judges:
        fitted, held, numbers = recordings, judges, tuple(() for _ in recordings)
    else:
        fitted, held, numbers = zip(*(split_repeats(r, config.heldout) for r in recordings), strict=True)
    full = space if nuisances is None or config.refine is None else space + nuisances
    engine = EngineChoice(config.engine, "as asked for")
    if config.engine == "auto":
        rows = config.search.population * config.search.restarts
        engine = choose_engine(scene, full, [*recordings, *judges], effects, rows)
    check_known(full, recordings)
    base = make_cost(scene, full, fitted, engine=engine.engine, config=config.compare, effects=effects, check=False)
    _check_start(base, full)
    if len(chosen) > 1:
        config = replace(config, compare=replace(config.compare, channels=in_noise_units(base, full.mean)))
        base = base.against(fitted, config.compare)
    for recording in (*recordings, *judges):  # whole: copies among its repeats may be fitted and held out
        warn_of_log(scene, recording)
    # now, since what is held out may have faults of its own, and those are to be told before anything long
    plain = replace(config.compare, whitened=False)
    commanded = all(r.command.size for r in recordings)
    heldout = (
        base.against(held, plain)
        if commanded and not judges
        else make_cost(scene, full, held, engine=engine.engine, config=plain, effects=effects, check=False)
    )
    if judges:
        _check_start(heldout, full)
    begun = [beginning(recording, config.beginning) for recording in fitted]
    early = base
    if any(short is not recording for short, recording in zip(begun, fitted, strict=True)):
        comparing = base.comparisons[0].config
        early = make_cost(scene, full, begun, engine=engine.engine, config=comparing, effects=effects, check=False)
    return Preparation(
        scene=scene,
        space=space,
        full=full,
        config=config,
        effects=tuple(effects),
        recordings=tuple(recordings),
        heldout_recordings=held,
        heldout_repeats=numbers,
        judges=judges,
        fit=base,
        early=early,
        heldout=heldout,
        fingerprint=_fingerprint(scene, full, fitted[0], replace(config, engine=engine.engine), effects),
        seconds=time.monotonic() - began,
        engine=engine,
    )


def run_fit(problem: Preparation, *, checkpoints: Path | None = None, progress: Progress | None = None) -> Identified:
    """The rest of `identify_parameters`: search, refine, calibrate, judge."""
    report = progress or _silent
    config, space, full, base = problem.config, problem.space, problem.full, problem.fit
    seconds: dict[str, float] = {}

    began = time.monotonic() - problem.seconds
    first = problem.early.first()

    found = cma_search(
        search_cost(first, first.comparisons[0].penalty, full, space),
        space,
        config.search,
        checkpoint_dir=checkpoints,
        fingerprint=problem.fingerprint,
        progress=lambda p: report("search", p),
    )
    seconds["search"] = time.monotonic() - began

    began = time.monotonic()
    refined = None
    if config.refine is not None:
        settings = config.refine if problem.engine.engine == "mjx" else replace(config.refine, **IN_C)
        asked = [p.name for e in problem.effects for p in e.parameters if p.name in full.names]
        begin = starts(full, space, found, asked)
        base, refined = _refined(base, problem.early, begin, asked, config, settings, lambda p: report("refine", p))
    best = found.best if refined is None else refined.best
    judging = config.identifiability
    full_gaussian = found.gaussian() if refined is None else posterior(refined, base.comparisons, judging)
    seconds["refine"] = time.monotonic() - began

    began = time.monotonic()
    report("judge", None)
    judges, apart = problem.judges or problem.recordings, bool(problem.judges)
    distances = heldout_distances(
        problem.heldout, judges, problem.heldout_recordings, full.mean, best, config.worth, apart
    )
    seconds["judge"] = time.monotonic() - began

    began = time.monotonic()
    checks = {}
    if config.checks:  # the other engine is compiled for the comparison only where this one was asked for
        engine, compiles = problem.engine.engine, config.engine != "auto"
        checks, off = check_solution(
            base, problem.recordings, best, engine, problem.effects, compiles or engine == "mjx"
        )
        if refined is not None:
            full_gaussian = moved_by_step(full_gaussian, step_shift(refined, off))
    seconds["checks"] = time.monotonic() - began
    names = [r.name for r in problem.recordings]
    return Identified(
        scene=problem.scene,
        space=space,
        full=full,
        best=best,
        gaussian=full_gaussian.marginal(space.names),
        full_gaussian=full_gaussian,
        search=found,
        refined=refined,
        identifiability=(
            not_judged(full_gaussian) if refined is None else identifiability(full_gaussian, refined.prior, judging)
        ),
        heldout_distances=dict(zip((r.name for r in judges), distances, strict=True)),
        fit=base,
        heldout=problem.heldout,
        heldout_repeats=dict(zip(names, problem.heldout_repeats, strict=True)),
        seconds=seconds,
        checks=checks,
        config=config,
        engine=problem.engine,
    )


def _silent(stage: str, value: Any) -> None:
    """No progress is shown."""


def _check_names(names: Sequence[str], judges: Sequence[str], config: IdentifyConfig) -> None:
    """ValueError for recordings that cannot be fitted together."""
    both = [*names, *judges]
    if len(set(both)) != len(both):
        raise ValueError(f"recordings need different names, got {', '.join(both)}")
    if config.refine is None and len(names) > 1:
        raise ValueError(
            f"without the refinement (as in preset paper) one recording is fitted, got {len(names)}: "
            f"{', '.join(names)}; give the first alone, or another preset"
        )


def _check_start(cost: Cost, space: Space) -> None:
    """ValueError where the means cannot be simulated: nothing could be said of what the fit gained."""
    twice = np.stack([space.mean, space.mean])  # as many rows as are judged at the end: compiled once
    for comparison, rollout in zip(cost.comparisons, cost.rollouts(twice), strict=True):
        if not np.all(rollout.finite):
            why = blow_up(cost.scene, type(rollout)(**{f: np.asarray(getattr(rollout, f))[0] for f in _FIELDS}))
            raise ValueError(
                f"the simulation of {comparison.name!r} blows up at the parameters' initial means"
                f"{f' ({why})' if why else ''}: shorten the scene's time step, give light joints armature, or begin at "
                "other means (stiff servos on light links are the usual cause)"
            )


def _refined(
    base: Cost,
    early: Cost,
    begin: np.ndarray,
    coefficients: Sequence[str],
    config: IdentifyConfig,
    settings: RefineConfig,
    report: Callable[[Any], None],
) -> tuple[Cost, Refined]:
    """The refinement from starts [S, F], and the cost it ended on; early: of the recordings' beginnings, or the same.

    coefficients: of effects, by name.  The beginning of a chirp is slow and does not show what limits its end, so that
    where some do not act, a few iterations on the whole of the recording that is fitted worst tell whether they would.

    The noise of a single repeat is not known: it is stated from what the search, a first refinement and these
    iterations leave unexplained.  Not from the last one too: logs that fit well would then count for ever more (one
    fold of the XL330 fell from 0.032 to 0.106 rad by it).
    """

    def run(cost: Cost, rough: Cost | None, begin: np.ndarray, settings: RefineConfig = settings) -> Refined:
        hypotheses, first = grip_hypotheses(cost.space), None if rough is None else rough.whitened
        return refine(cost.whitened, cost.space, begin, settings, first=first, hypotheses=hypotheses, progress=report)

    whole = early is base
    if all(c.repeats > 1 for c in base.comparisons):
        return base, run(base, base.first() if whole else early, begin)
    early = early.with_estimated_noise(begin[0])
    first = run(early, early.first(), begin)
    base, count = base.with_estimated_noise(first.best), first.evaluations
    # The first one has looked for other basins, and in plain C twice where nothing was found.
    settled = replace(settings, basin_hops=0, patience=(config.refine or settings).patience)
    if acting := with_acting(base.space, first.best, coefficients):
        worst = base.alone(int(np.argmax(base.distances(first.best[None])[0])))
        short = replace(settled, iterations=config.sorting, spreads=0, pruning_ratio=config.sorting_ratio)
        first = run(worst, None, np.stack([first.best, *acting]), short)
        base, count = base.with_estimated_noise(first.best), count + first.evaluations
    last = run(base, base.first() if whole or acting else early.with_estimated_noise(first.best), first.best, settled)
    return base, replace(last, evaluations=count + last.evaluations)


def _fingerprint(
    scene: Scene, full: Space, recording: Recording, config: IdentifyConfig, effects: Sequence[Effect]
) -> str:
    """All that the search's cost is made from: a search of another cost is not gone on with."""
    made_from = {
        "recording": recording.sha256,
        "scene": scene.sha256,
        "measured": [scene.joints, scene.command_names, scene.object_joint, scene.grip and scene.grip.fingers],
        "space": space_to_json(full),
        "engine": config.engine,
        "beginning": config.beginning,
        "compare": asdict(config.compare),
        "effects": [[e.name, *([p.name, p.mean, p.low, p.high] for p in e.parameters)] for e in effects],
    }
    return json.dumps(made_from, sort_keys=True)


def _possible(scene: Scene, gaussian: Gaussian, seed: int, count: int) -> np.ndarray:
    """[count, D] draws with inertias that bodies can have."""
    rng = np.random.default_rng(seed)
    return possible_draws(scene, gaussian.space, lambda n: gaussian.sample(rng, n), count)


def cost_samples(found: Identified, count: int, seed: int) -> dict[str, np.ndarray]:
    """Costs on held-out repeats of samples from the initial and from the fitted Gaussian, `count` of them at most.

    initial, fitted: [n, D] values; initial_cost, fitted_cost: [n] N m, failed replays carry their penalty;
    names: [D] of the parameters.
    """
    steps = 2 * sum(len(drive.time) for drive in found.heldout.drives)
    count = min(count, max(FEWEST, found.config.sample_steps // steps))
    first, last = (_possible(found.scene, g, seed, count) for g in (prior(found.space), found.full_gaussian))
    return {
        "initial": first,
        "fitted": last[:, found.full.columns(found.space)],
        "initial_cost": found.heldout(found.full.embed(found.space, first)),
        "fitted_cost": found.heldout(last),
        "names": np.array(found.space.names),
    }
