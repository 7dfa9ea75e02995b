"""The search for missing effects as one call, and the amendments of its verdict: experiments and the final refit.

The command `gap` makes the same search.  It also continues after a stop and writes a folder and a page.
"""

from __future__ import annotations

import copy
import functools
import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import jax
import mujoco
import numpy as np

from droid_jax.arguments import instance, instances
from droid_jax.cost.cost import make_cost
from droid_jax.discrepancy.candidates import observable_effects
from droid_jax.discrepancy.case import AnyCost, Case, comparing
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.fitting import FinalModel, FittedModel, base_fit, base_model, final_refit, final_refit_due
from droid_jax.discrepancy.log_case import case_of
from droid_jax.discrepancy.results import extended
from droid_jax.discrepancy.search import search_effects
from droid_jax.discrepancy.step_error import discretisation_error, with_finer_step, with_step_differences
from droid_jax.discrepancy.verdict import Experiment, Verdict
from droid_jax.errors import reason
from droid_jax.files import NOT_MADE, TO_BE_MADE
from droid_jax.identify.extended_model import Extended
from droid_jax.identify.pipeline import Progress
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.candidate import candidates
from droid_jax.model.effects.registry import checked
from droid_jax.model.fields import check_space
from droid_jax.model.parameters import Role, Space
from droid_jax.model.scene import Scene
from droid_jax.preflight.search_inputs import assigned_roles
from droid_jax.recordings.recording import Recording, recordings_of
from droid_jax.recordings.split import Split
from droid_jax.recordings.time_scaling import TIME_SCALINGS, time_scaled
from droid_jax.simulate.workspace_extrapolation import FURTHER, opened_further

EXPERIMENTS, REFIT = "experiments", "final_refit"  # names of the amendments in gap.json
MADE, NOT_NEEDED = "made", "not needed"
IN_THE_AIR = "the same motion in the air, away from what the hand held"
WEIGHT = 0.5  # kg, of the known weight in a candidate experiment


def find_missing_effects(
    scene: Scene,
    space: Space,
    recordings: Sequence[Recording],
    *,
    effects: Sequence[Effect] | None = None,
    start: np.ndarray | None = None,
    config: DiscrepancyConfig | None = None,
    progress: Progress | None = None,
    judge_on: Sequence[Recording] = (),
) -> tuple[Verdict, Extended]:
    """Find the physical effects that a model lacks, and return the model with them (docs/discrepancy-search.md).

    Args:
        scene: the robot.
        space: base parameters with nuisances, e.g. `found.full` of an identification.
        recordings: for training, validation and optionally test, each with eight repeats or more.  Or one recording
            with sixteen repeats or more, whose second half is for validation.  Or a log of one repeat without commands,
            optionally with a second one as test data.  Or commanded logs with fewer repeats, whose windows are for
            training and validation in turns.
        effects: to test; None for all effects of the library (`droid_jax.model.effects.registry`) that can change the
            compared channels.
        start: [D] physical values over `space`, e.g. `found.best`, where the base fit begins; None: CMA-ES searches for
            a start.  Logs without repeats need neither.
        config: thresholds and settings.
        progress: called with a stage's name and its progress value.
        judge_on: commanded logs as test data, for `recordings` with few repeats.

    Returns:
        The verdict, whose discrepancies are in squared noise units of one repeat, and the extended model.  A model with
        effects is fitted to both motions (`fitting.final_refit`); if that fit fails, it is that of the training motion.
        Effects that act alike in these motions are distinguished by other motions alone (`Split.limits`).

    Raises:
        ValueError: recordings that no search can use, or effects that they cannot show.
    """
    config = instance(DiscrepancyConfig() if config is None else config, "config", DiscrepancyConfig)
    check_space(instance(scene, "scene", Scene), instance(space, "space", Space))
    recordings, judges = recordings_of(recordings), recordings_of(judge_on) if judge_on else ()
    split, roles = assigned_roles(scene, recordings, judges)
    given = None if effects is None else instances(effects, "effects", Effect)
    compared = comparing(scene, recordings, config).compare.channels
    asked = observable_effects(scene, recordings, channels=compared) if given is None else tuple(map(checked, given))
    if not asked:
        raise ValueError("effects: there is none to test; None tests all of the library")
    candidates(asked)  # raises for effects without a location, before the base fit
    start = None if start is None else space.check(start)
    case = case_of(split, scene, space, asked, roles, config, start)
    for limit in case.limits:
        warnings.warn(limit, stacklevel=2)
    report = progress or (lambda stage, value: None)
    fine = with_finer_step(case.train, case.base, roles["train"])
    case, verdict = search(split, case, fine, start, report)
    *_, whole = amended(case, verdict, roles["train"], report)
    return whole.verdict, extended(case, whole.final)


def search(
    split: Split,
    case: Case,
    fine: AnyCost | None,
    start: np.ndarray | None = None,
    progress: Progress | None = None,
) -> tuple[Case, Verdict]:
    """The verdict on a case (see `case_of`), without its amendments (see `amended`).

    Args:
        split: how recordings are split into training, validation and test data.
        case: the case; with a replay cache (`Case.with_replay_cache`) a search continues after a stop.
        fine: cost of the training recording from `with_finer_step`.
        start: [F] values of the base parameters where their fit begins; None: CMA-ES searches for a start.  Not used
            for logs in blocks, whose case holds a start.
        progress: called with a stage's name and its progress value.

    Returns:
        The case with the error of the time step (`with_step_differences`), which is in the intervals, and the verdict.
    """
    report = progress or (lambda stage, value: None)
    if split in (Split.BLOCKS, Split.WINDOWS):
        model = base_model(case, progress=lambda now: report("refine", now))
    else:
        model = base_fit(case.train, case.base, case.config, report, start)
    if split is not Split.BLOCKS:
        report("discretisation_error", None)
        case = with_step_differences(case, model, fine)
    verdict = search_effects(case, model, discretisation_error(case.train, model), report)
    report("verdict", None)
    return case, verdict


@dataclass(frozen=True, eq=False)
class Amended:
    """A verdict with its amendments so far.

    verdict: the verdict.
    final: the model to return; that of the search until the final refit is made.
    states: amendment -> `MADE`, `NOT_NEEDED`, `TO_BE_MADE`, or "not made: " and the reason.
    """

    verdict: Verdict
    final: FinalModel
    states: dict[str, str] = field(default_factory=dict)


def amended(
    case: Case, verdict: Verdict, recording: Recording, progress: Progress = lambda stage, value: None
) -> Iterator[Amended]:
    """Yield the verdict unchanged, and again after each amendment; the last one is complete.

    Both amendments take minutes and neither changes the conclusion.  A caller can write the verdict first and each
    amendment when it is made.  If an amendment raises, its state holds the reason and the verdict stays as before.

    Args:
        case: the recordings.
        verdict: of the search.
        recording: the training recording.
        progress: called with a stage's name and its progress value.
    """
    states = {
        EXPERIMENTS: TO_BE_MADE if verdict.indistinguishable_models and case.train.resampling.repeated else NOT_NEEDED,
        REFIT: TO_BE_MADE if final_refit_due(case.train, verdict.model) else NOT_NEEDED,
    }
    now = Amended(verdict, FinalModel(verdict.model, (case.train,)), states)
    yield now
    if states[EXPERIMENTS] == TO_BE_MADE:
        now = _with_experiments(now, case, recording)
        yield now
    if states[REFIT] == TO_BE_MADE:
        now = _refitted(now, case, progress)
        yield now


def _with_experiments(now: Amended, case: Case, recording: Recording) -> Amended:
    verdict = now.verdict
    try:
        experiments = separating_experiments(case, verdict.indistinguishable_models, recording)
    except Exception as error:  # of any kind: the verdict does not depend on it
        return _state(now, EXPERIMENTS, f"{NOT_MADE}: {reason(error)}")
    return _state(replace(now, verdict=replace(verdict, experiments=experiments)), EXPERIMENTS, MADE)


def _refitted(now: Amended, case: Case, progress: Progress) -> Amended:
    try:
        final = final_refit(case.train, case.validation, now.verdict.model, case.config.refine, progress)
        extended(case, final)  # raises here if its posterior cannot be computed
    except Exception as error:  # as above; the search's model stays
        final = replace(now.final, not_made=reason(error))
    state = f"{NOT_MADE}: {final.not_made}" if final.not_made else MADE
    return _state(replace(now, final=final), REFIT, state)


def _state(now: Amended, name: str, state: str) -> Amended:
    return replace(now, states={**now.states, name: state})


def separating_experiments(
    case: Case, groups: Sequence[Sequence[FittedModel]], recording: Recording
) -> tuple[Experiment, ...]:
    """Candidate experiments by the distance of the two models that they distinguish least, the largest first.

    They are variants of the training motion that can be recorded on the same set-up: another time scaling (slower,
    faster, there and back, with a stop half-way), opened further, with a known weight at the hand, or in the air, away
    from the object.

    Args:
        case: the recordings.
        groups: of indistinguishable models, each refitted.  Models of different groups are not compared.
        recording: the training recording.

    Returns:
        The experiments.  Those that cannot be simulated come last, with the reason.  Empty for a log without commands,
        whose motion cannot be repeated.
    """
    models = [model for group in groups for model in group]
    of_group = [number for number, group in enumerate(groups) for _ in group]
    pairs = [(i, j) for i, j in itertools.combinations(range(len(models)), 2) if of_group[i] == of_group[j]]
    if not pairs or not recording.command.size:
        return ()
    values = np.stack([m.values for m in models])
    experiments = [_simulated(what, make) for what, make in _possible(case, values, pairs, recording)]
    return tuple(sorted(experiments, key=lambda e: -np.inf if e.distance is None else e.distance, reverse=True))


def _possible(
    case: Case, values: np.ndarray, pairs: Sequence[tuple[int, int]], recording: Recording
) -> Iterator[tuple[str, Callable[[], Experiment]]]:
    """Experiments in this scene: a description, and a function that simulates the models [K, D] of these pairs."""
    known = case.train.cost
    config = case.train.comparison.config

    def moved(what: str, motion: Callable[[], Recording]) -> Experiment:
        cost = make_cost(known.scene, case.full_space, [motion()], config=config, effects=case.effects, check=False)
        return _experiment(what, cost, values, pairs)

    for entry in TIME_SCALINGS:
        yield entry.what, functools.partial(moved, entry.what, functools.partial(time_scaled, recording, entry))
    if known.scene.grip is not None:
        yield FURTHER, functools.partial(moved, FURTHER, lambda: _further(known, recording, values[:1]))
    channels = {name: weight for name, weight in config.channels.items() if name != "object_angle"}
    if known.scene.grip is not None and channels:

        def in_the_air() -> Experiment:
            alone, scene = replace(config, channels=channels), untouched(known.scene)
            cost = make_cost(
                scene, case.full_space, [recording], config=alone, effects=case.effects, check=False, few=True
            )
            return _experiment(IN_THE_AIR, cost, values, pairs)

        yield IN_THE_AIR, in_the_air
    if case.full_space.of_role(Role.PAYLOAD_MASS):
        what = f"the same motion with {WEIGHT:g} kg more, weighed, at the hand"
        yield what, lambda: _experiment(what, known, _carrying(case, values), pairs)


def _simulated(what: str, make: Callable[[], Experiment]) -> Experiment:
    """An experiment, or the reason of its failure, which must not end a finished search."""
    with warnings.catch_warnings():  # the same warnings were issued for the recording itself
        warnings.simplefilter("ignore", UserWarning)
        try:
            return make()
        except Exception as error:
            return Experiment(what, None, reason(error))


def untouched(scene: Scene) -> Scene:
    """The scene without contacts and without a grip: the robot moves in free space."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return replace(scene, model=model, grip=None)


def _further(known: AnyCost, recording: Recording, values: np.ndarray) -> Recording:
    """The motion opened further, as simulated with a model [1, D].

    Raises:
        ValueError: the hand does not reach there.
    """
    longer = opened_further(known.scene, recording, jax.tree.map(lambda a: a[0], known.rollouts(values)[0]))
    if longer is None:
        raise ValueError("the hand does not hold the object where it is open most, or does not reach further")
    return longer


def _experiment(what: str, cost: AnyCost, values: np.ndarray, pairs: Sequence[tuple[int, int]]) -> Experiment:
    """The distance of that pair of the models [K, D] that an experiment distinguishes least.

    Raises:
        ValueError: a replay fails.
    """
    if cost.failed(values).any():
        raise ValueError("the simulation of one of the models fails on this motion")
    simulated = cost.whitened(values).astype(np.float64)
    least = min(float(np.linalg.norm(simulated[i] - simulated[j])) for i, j in pairs)
    return Experiment(what, least)


def _carrying(case: Case, values: np.ndarray) -> np.ndarray:
    """Models [K, D] with a known weight at the hand."""
    carried = case.full_space.of_role(Role.PAYLOAD_MASS)[0]
    out, column = values.copy(), case.full_space.index(carried.name)
    out[:, column] = np.minimum(out[:, column] + WEIGHT, carried.high)
    return out
