"""Identification from recordings to a Gaussian: split, search, refine, calibrate, evaluate on held-out data."""

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
from droid_jax.identify.holdout import (
    WORTH,
    BeginningConfig,
    HeldoutDistance,
    beginning,
    heldout_distances,
    split_repeats,
)
from droid_jax.identify.identifiability import (
    Identifiability,
    IdentifiabilityConfig,
    identifiability,
    moved_by_step,
    not_judged,
    posterior,
    step_shift,
)
from droid_jax.identify.multistart import RefineConfig, Refined, RefineInCConfig, refine
from droid_jax.identify.search import CmaConfig, cma_search
from droid_jax.identify.solution_checks import SolutionCheck, SolutionCheckConfig, check_solution
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
        heldout: share of each recording's repeats that is held out (at least one of two).
        search: CMA-ES settings. It uses the first recording only, the refinement uses all of them.
        generations_in_c: largest number of generations before a refinement in plain C MuJoCo, of a scene without
            contact pairs.  It has few basins, and the refinement needs fewer replays.  None: `search.generations`.
        refine: refinement settings, or None: the search's covariance is the distribution, as in the paper.
        refine_in_c: settings of the refinement that are different in plain C MuJoCo.
        beginning: s of long recordings that the search and the first refinement use, and more until every command has
            covered half of its range. The last refinement uses the full recordings.
        beginning_rule: when a recording is long, and how much of it is used.
        sorting: iterations of the refinement that compare neutral effects with active ones (`fit.with_acting`).
        sorting_ratio: `RefineConfig.pruning_ratio` of these iterations.
        firm_grip: factor on the initial means of the friction of pads, for a start with a grip that does not slip.
        samples: draws of the initial and of the fitted Gaussian whose costs are compared, at most.
        sample_steps: time steps of all replays of these draws, at most; there are fewer draws for long recordings.
        least_samples: draws at least, also for long recordings, so that they show the spread.
        seed: of these draws (the search has its own).
        compare: how simulation and measurement are compared.
        channels: the measured channels to fit. Several are weighted by their noise (`channels.in_noise_units`). None:
            those of `compare` if it has other channels or weights than its default, else the informative ones
            (`channels.informative_channels`): torque, or without it position and the object's angle. Weights act in
            the distance and the search only; the refinement uses residuals in noise units.
        identifiability: settings of the calibrated width, and of when a parameter counts as identifiable.
        worth: share of the noise floor by which the distance before the fit must exceed it, else
            `HeldoutDistance.closed` is None.
        checks: measure the errors of the time step and of the engine at the fitted values (`solution_checks`), which
            takes one more compilation.
        solution: settings of these checks.

    Raises:
        ValueError: a setting is of the wrong type or out of its range.
    """

    engine: str = "auto"
    heldout: float = 0.3
    search: CmaConfig = field(default_factory=CmaConfig)
    generations_in_c: int | None = None
    refine: RefineConfig | None = field(default_factory=RefineConfig)
    refine_in_c: RefineInCConfig = field(default_factory=RefineInCConfig)
    beginning: float = 20.0
    beginning_rule: BeginningConfig = field(default_factory=BeginningConfig)
    sorting: int = 3
    sorting_ratio: tuple[float, ...] = (3.0, 1.3, 1.0)
    firm_grip: float = 4.0
    samples: int = 200
    sample_steps: int = 5_000_000
    least_samples: int = 16
    seed: int = 0
    compare: CompareConfig = field(default_factory=CompareConfig)
    channels: tuple[str, ...] | None = None
    identifiability: IdentifiabilityConfig = field(default_factory=IdentifiabilityConfig)
    worth: float = WORTH
    checks: bool = True
    solution: SolutionCheckConfig = field(default_factory=SolutionCheckConfig)

    def __post_init__(self) -> None:
        check_fields(
            self,
            engine=partial(one_of, valid=CHOICES),
            heldout=partial(number, least=0, below=1),
            search=partial(instance, kind=CmaConfig),
            generations_in_c=optional(partial(whole, least=1)),
            refine=optional(partial(instance, kind=RefineConfig)),
            refine_in_c=partial(instance, kind=RefineInCConfig),
            beginning=partial(number, above=0, infinite=True),
            beginning_rule=partial(instance, kind=BeginningConfig),
            sorting=partial(whole, least=0),
            sorting_ratio=several(partial(number, least=1)),
            firm_grip=partial(number, above=0),
            samples=partial(whole, least=0),
            sample_steps=partial(whole, least=1),
            least_samples=partial(whole, least=0),
            seed=partial(whole, least=0),
            compare=partial(instance, kind=CompareConfig),
            channels=optional(several(partial(one_of, valid=SIMULATED))),
            identifiability=partial(instance, kind=IdentifiabilityConfig),
            worth=partial(number, least=0),
            checks=flag,
            solution=partial(instance, kind=SolutionCheckConfig),
        )


@dataclass(frozen=True, eq=False)
class Identified:
    """The result of an identification.

    scene: what was simulated.  space: of the search.  full: the same with the nuisances, F parameters; equal to `space`
    without a refinement.
    best: [F] physical values over `full`.  gaussian: the resulting distribution over `space`.  full_gaussian: the same
    over `full`.
    search: result of CMA-ES.  refined: result of the refinement, or None.  identifiability: of each parameter of
    `full`.
    heldout_distances: by name of the recording with held-out data.  fit: cost over `full` of the fitted data.  heldout:
    the same of the held-out data.
    heldout_repeats: by recording name.  seconds: by stage.  checks: by name of recordings with commands.
    config: settings.  engine: of the replays, and why it was chosen.
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


Progress = Callable[[str, Any], None]  # name of a stage, and its progress value
_FIELDS = tuple(Rollout.__dataclass_fields__)


@dataclass(frozen=True, eq=False)
class Preparation:
    """Checked inputs of an identification, and its costs.

    scene, space, config, effects, recordings: as given.  full: `space` with the nuisances that are fitted.
    heldout_recordings: held-out repeats of each recording, or whole held-out recordings.  heldout_repeats: the numbers
    of the repeats.
    judges: whole held-out recordings; then no repeat is held out.
    fit: cost over `full` of the fitted data.  early: the same of the beginnings of long recordings.
    heldout: the same of the held-out data.
    fingerprint: of the search's cost, for checkpoints.  seconds: duration of the preparation.  engine: of the replays.
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
        recordings: to fit. By default their last repeats are held out.
        nuisances: parameters that the refinement fits too and marginalises over; None for none.
        config: settings; None for the defaults.
        effects: in the model in addition to the scene. Their parameters are in `space` or stay neutral.
        judge_on: whole recordings to evaluate the fit on; all repeats of `recordings` are then fitted. If empty, the
            last repeats are held out, or the last part in time of a log. A commanded recording of one repeat is
            evaluated on itself.
        checkpoints: folder to save the search to, and to resume it from.
        progress: called with a stage's name and its progress value.

    Returns:
        The result; its `gaussian` is the fitted distribution.

    Raises:
        ValueError: recordings of one name, no channel to compare, several recordings without the refinement (the
            search uses the first only), or initial means that cannot be simulated.
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
    """Check the inputs of `identify_parameters` and make its costs, without writing anything.

    It raises all errors about the inputs, before anything takes long.  For the arguments see `identify_parameters`.
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
    for recording in (*recordings, *judges):  # with all repeats: copies may be among the fitted and the held-out ones
        warn_of_log(scene, recording)
    # Here, so that errors in the held-out data are raised before anything takes long.
    plain = replace(config.compare, whitened=False)
    commanded = all(r.command.size for r in recordings)
    heldout = (
        base.against(held, plain)
        if commanded and not judges
        else make_cost(scene, full, held, engine=engine.engine, config=plain, effects=effects, check=False)
    )
    if judges:
        _check_start(heldout, full)
    begun = [beginning(recording, config.beginning, config.beginning_rule) for recording in fitted]
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
    """Search, refine, calibrate and evaluate: the part of `identify_parameters` after `prepare`.

    problem: from `prepare`.  checkpoints, progress: see `identify_parameters`.
    """
    report = progress or _silent
    config, space, full, base = problem.config, problem.space, problem.full, problem.fit
    seconds: dict[str, float] = {}

    began = time.monotonic() - problem.seconds
    first = problem.early.first()

    found = cma_search(
        search_cost(first, first.comparisons[0].penalty, full, space),
        space,
        _search_settings(config, problem.engine.engine, problem.scene),
        checkpoint_dir=checkpoints,
        fingerprint=problem.fingerprint,
        progress=lambda p: report("search", p),
    )
    seconds["search"] = time.monotonic() - began

    began = time.monotonic()
    refined = None
    if config.refine is not None:
        settings = config.refine if problem.engine.engine == "mjx" else config.refine_in_c.applied(config.refine)
        coefficients = [p.name for e in problem.effects for p in e.parameters if p.name in full.names]
        begin = starts(full, space, found, coefficients, firm_grip=config.firm_grip)
        base, refined = _refined(
            base, problem.early, begin, coefficients, config, settings, lambda p: report("refine", p)
        )
    best = found.best if refined is None else refined.best
    thresholds = config.identifiability
    full_gaussian = found.gaussian() if refined is None else posterior(refined, base.comparisons, thresholds)
    seconds["refine"] = time.monotonic() - began

    began = time.monotonic()
    report("judge", None)
    judges, whole_recordings = problem.judges or problem.recordings, bool(problem.judges)
    distances = heldout_distances(
        problem.heldout, judges, problem.heldout_recordings, full.mean, best, config.worth, whole_recordings
    )
    seconds["judge"] = time.monotonic() - began

    began = time.monotonic()
    checks = {}
    if config.checks:  # for a fit in C, MJX is compiled only if the user chose the engine
        engine, chosen = problem.engine.engine, config.engine != "auto"
        checks, change = check_solution(
            base, problem.recordings, best, engine, problem.effects, chosen or engine == "mjx", config.solution
        )
        if refined is not None:
            full_gaussian = moved_by_step(full_gaussian, step_shift(refined, change))
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
            not_judged(full_gaussian) if refined is None else identifiability(full_gaussian, refined.prior, thresholds)
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


def _search_settings(config: IdentifyConfig, engine: str, scene: Scene) -> CmaConfig:
    """The search's settings for an engine and a scene."""
    most = config.generations_in_c
    if engine == "mjx" or scene.has_contacts or config.refine is None or most is None:
        return config.search
    return replace(config.search, generations=min(config.search.generations, most))


def _silent(stage: str, value: Any) -> None:
    """Show no progress."""


def _check_names(names: Sequence[str], judges: Sequence[str], config: IdentifyConfig) -> None:
    """Raise ValueError for recordings that cannot be fitted together."""
    both = [*names, *judges]
    if len(set(both)) != len(both):
        raise ValueError(f"recordings need different names, got {', '.join(both)}")
    if config.refine is None and len(names) > 1:
        raise ValueError(
            f"without the refinement (as in preset paper) one recording is fitted, got {len(names)}: "
            f"{', '.join(names)}; give the first alone, or another preset"
        )


def _check_start(cost: Cost, space: Space) -> None:
    """Raise ValueError if the initial means cannot be simulated, since a fit is compared with them."""
    twice = np.stack([space.mean, space.mean])  # two rows as in the final evaluation, which share one compilation
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
    """Refine from starts [S, F]; return the cost with its final noise, and the result.

    Recordings with repeats need one refinement.  The noise of a single repeat is estimated from residuals, so there are
    up to three: on the beginnings of the recordings from all starts; if effects are neutral, a few iterations on the
    full recording that fits worst, with these effects active; and on all data.  The second is needed because the
    beginning of a chirp, for example, is slow and does not reach the limits that its end does.  The noise is estimated
    after the search and after the first two.  It is not estimated after the last one: logs that fit well would gain
    weight with every refinement (one fold of the XL330 went from 0.032 to 0.106 rad by it).

    Args:
        base: cost of the full recordings.
        early: cost of their beginnings, or `base`.
        begin: [S, F] physical values.
        coefficients: names of the effects' coefficients.
        config: settings of the identification.
        settings: of the refinement, for the engine.
        report: called with the refinement's progress.
    """

    def run(cost: Cost, cheap: Cost | None, begin: np.ndarray, settings: RefineConfig = settings) -> Refined:
        hypotheses, first = grip_hypotheses(cost.space), None if cheap is None else cheap.whitened
        return refine(cost.whitened, cost.space, begin, settings, first=first, hypotheses=hypotheses, progress=report)

    all_short = early is base
    if all(c.repeats > 1 for c in base.comparisons):
        return base, run(base, base.first() if all_short else early, begin)
    early = early.with_estimated_noise(begin[0])
    first = run(early, early.first(), begin)
    base, count = base.with_estimated_noise(first.best), first.evaluations
    # The first refinement has searched for other basins, and in plain C has had twice the patience.
    settled = replace(settings, basin_hops=0, patience=(config.refine or settings).patience)
    if acting := with_acting(base.space, first.best, coefficients):
        worst = base.alone(int(np.argmax(base.distances(first.best[None])[0])))
        short = replace(settled, iterations=config.sorting, spreads=0, pruning_ratio=config.sorting_ratio)
        first = run(worst, None, np.stack([first.best, *acting]), short)
        base, count = base.with_estimated_noise(first.best), count + first.evaluations
    cheap = base.first() if all_short or acting else early.with_estimated_noise(first.best)
    last = run(base, cheap, first.best, settled)
    return base, replace(last, evaluations=count + last.evaluations)


def _fingerprint(
    scene: Scene, full: Space, recording: Recording, config: IdentifyConfig, effects: Sequence[Effect]
) -> str:
    """Text of all inputs of the search's cost.  A checkpoint of another cost is refused."""
    made_from = {
        "recording": recording.sha256,
        "scene": scene.sha256,
        "measured": [scene.joints, scene.command_names, scene.object_joint, scene.grip and scene.grip.fingers],
        "space": space_to_json(full),
        "engine": config.engine,
        "beginning": [config.beginning, asdict(config.beginning_rule)],
        "compare": asdict(config.compare),
        "effects": [[e.name, *([p.name, p.mean, p.low, p.high] for p in e.parameters)] for e in effects],
    }
    return json.dumps(made_from, sort_keys=True)


def _possible(scene: Scene, gaussian: Gaussian, seed: int, count: int) -> np.ndarray:
    """[count, D] draws with physically possible inertias."""
    rng = np.random.default_rng(seed)
    return possible_draws(scene, gaussian.space, lambda n: gaussian.sample(rng, n), count)


def cost_samples(found: Identified, count: int, seed: int) -> dict[str, np.ndarray]:
    """Return costs on held-out data of draws from the initial and from the fitted Gaussian.

    Args:
        found: the result of an identification.
        count: number of draws, at most.
        seed: of the draws.

    Returns:
        initial, fitted: [n, D] values.  initial_cost, fitted_cost: [n] N m, with the penalty of failed replays.
        names: [D] of the parameters.
    """
    steps = 2 * sum(len(drive.time) for drive in found.heldout.drives)
    count = min(count, max(found.config.least_samples, found.config.sample_steps // steps))
    first, last = (_possible(found.scene, g, seed, count) for g in (prior(found.space), found.full_gaussian))
    return {
        "initial": first,
        "fitted": last[:, found.full.columns(found.space)],
        "initial_cost": found.heldout(found.full.embed(found.space, first)),
        "fitted_cost": found.heldout(last),
        "names": np.array(found.space.names),
    }
