"""The search for missing effects as one call, and what is added to its verdict: candidate experiments, the final refit.

The command `gap` makes the same search, goes on after a stop and leaves a folder and a page.
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
from droid_jax.cost.cost import Cost, make_cost
from droid_jax.discrepancy.candidates import observable_effects
from droid_jax.discrepancy.case import Case, comparing
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
WEIGHT = 0.5  # kg


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
    """Find the physical effect that a model lacks, and return the model with it (docs/discrepancy-search.md).

    Args:
        scene: the robot.
        space: all that is fitted without any effect, nuisances among it: `found.full` of an identification.
        recordings: train, validation and perhaps test, eight repeats or more of each; or one, sixteen repeats or more,
            whose second half validates; or a log of one repeat without commands, alone or with another one as test
            data; or any number of commanded logs with fewer repeats, whose windows train and validate in turns.
        effects: to test; None for all of the library (`droid_jax.model.effects.registry`) that could show in
            these recordings.
        start: [D] physical values over `space`, `found.best`, where the base fit begins instead of with a search; a
            log without repeats needs neither.
        config: all thresholds and settings.
        progress: called with a stage's name and its progress value.
        judge_on: commanded logs that are test data, beside others of few repeats.

    Returns:
        The verdict, whose discrepancies are in squared noise units of one repeat, and the extended model.  Only another
        motion distinguishes effects that act alike in this one (`Split.limits`).  With effects in it, the model is
        fitted to both motions (`fitting.final_refit`); where that fails it is the search's own, of the first motion.

    Raises:
        ValueError: recordings in which a search could not end well, effects that are none, or that a recording without
            commands cannot have.
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
    candidates(asked)  # refused before the base fit, and not after it
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
    fine: Cost | None,
    start: np.ndarray | None = None,
    progress: Progress | None = None,
) -> tuple[Case, Verdict]:
    """The verdict on a case of recordings by role (see `case_of`), without its amendments (see `amended`).

    The case is returned with what the time step does to its training recording, which is in the intervals.

    Args:
        split: how the recordings share the work.
        case: with a replay cache (`Case.with_replay_cache`) the search goes on after a stop.
        fine: what `with_finer_step` made of the training recording.
        start: [F] values of the base parameters from which their fit begins, instead of a search; of logs in blocks the
            case has it.
        progress: called with a stage's name and its progress value.
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
    """A verdict with what has been added to it so far.

    final: the model to hand on, the search's own until the final refit is made.  states: amendment -> MADE,
    NOT_NEEDED, TO_BE_MADE, or "not made: " and the reason.
    """

    verdict: Verdict
    final: FinalModel
    states: dict[str, str] = field(default_factory=dict)


def amended(
    case: Case, verdict: Verdict, recording: Recording, progress: Progress = lambda stage, value: None
) -> Iterator[Amended]:
    """The verdict unchanged, then again after each amendment; the last one is whole.

    Both amendments take minutes, and neither changes the answer.  So a caller writes the verdict first and each
    addition when it is made; one that raises is left out, its state says why, and nothing else is lost.

    recording: what the case was fitted to.
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
        experiments = separating_experiments(case, (verdict.model, *verdict.indistinguishable_models), recording)
    except Exception as error:  # whatever it is: the verdict stands
        return _state(now, EXPERIMENTS, f"{NOT_MADE}: {reason(error)}")
    return _state(replace(now, verdict=replace(verdict, experiments=experiments)), EXPERIMENTS, MADE)


def _refitted(now: Amended, case: Case, progress: Progress) -> Amended:
    try:
        final = final_refit(case.train, case.validation, now.verdict.model, case.config.refine, progress)
        extended(case, final)  # what is written of it can be made
    except Exception as error:  # as above; the search's own model stays
        final = replace(now.final, not_made=reason(error))
    state = f"{NOT_MADE}: {final.not_made}" if final.not_made else MADE
    return _state(replace(now, final=final), REFIT, state)


def _state(now: Amended, name: str, state: str) -> Amended:
    return replace(now, states={**now.states, name: state})


def separating_experiments(case: Case, models: Sequence[FittedModel], recording: Recording) -> tuple[Experiment, ...]:
    """Experiments by how far apart they put the two models that they distinguish least, the best first.

    Every one is within reach of whoever gave the training demonstration: the same motion on another clock (slower,
    faster, there and back, with a stop half-way), opened further, with a known weight at the hand, or in the air, away
    from what the hand held.

    Args:
        case: the recordings.
        models: indistinguishable ones, each refitted.
        recording: what the case was fitted to.

    Returns:
        Empty for a log without commands, whose motion cannot be asked for again.  Experiments that cannot be made come
        last, and say why.
    """
    if len(models) < 2 or not recording.command.size:
        return ()
    values = np.stack([m.values for m in models])
    found = [_made(what, make) for what, make in _possible(case, values, recording)]
    return tuple(sorted(found, key=lambda e: -np.inf if e.distance is None else e.distance, reverse=True))


def _possible(case: Case, values: np.ndarray, recording: Recording) -> Iterator[tuple[str, Callable[[], Experiment]]]:
    """What there is to try in this scene, in words, and how each is made for models [K, D]."""
    known = case.train.cost
    config = case.train.comparison.config

    def moved(what: str, motion: Callable[[], Recording]) -> Experiment:
        cost = make_cost(known.scene, case.full_space, [motion()], config=config, effects=case.effects, check=False)
        return _experiment(what, cost, values)

    for entry in TIME_SCALINGS:
        yield entry.what, functools.partial(moved, entry.what, functools.partial(time_scaled, recording, entry))
    if known.scene.grip is not None:
        yield FURTHER, functools.partial(moved, FURTHER, lambda: _further(known, recording, values[:1]))
    channels = {name: weight for name, weight in config.channels.items() if name != "object_angle"}
    if known.scene.grip is not None and channels:

        def in_the_air() -> Experiment:
            alone, scene = replace(config, channels=channels), untouched(known.scene)
            cost = make_cost(scene, case.full_space, [recording], config=alone, effects=case.effects, check=False)
            return _experiment(IN_THE_AIR, cost, values)

        yield IN_THE_AIR, in_the_air
    if case.full_space.of_role(Role.PAYLOAD_MASS):
        what = f"the same motion with {WEIGHT:g} kg more, weighed, at the hand"
        yield what, lambda: _experiment(what, known, _carrying(case, values))


def _made(what: str, make: Callable[[], Experiment]) -> Experiment:
    """An experiment, or why it cannot be made: the search is done, and one candidate must not end it."""
    with warnings.catch_warnings():  # what there is to warn of was said of the recording itself
        warnings.simplefilter("ignore", UserWarning)
        try:
            return make()
        except Exception as error:
            return Experiment(what, None, reason(error))


def untouched(scene: Scene) -> Scene:
    """A scene whose hand grips by contact, without any contact: the robot moves as if nothing stood around it."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return replace(scene, model=model, grip=None)


def _further(known: Cost, recording: Recording, values: np.ndarray) -> Recording:
    """The motion opened further, as a model [1, D] made it; ValueError where the hand does not get there."""
    longer = opened_further(known.scene, recording, jax.tree.map(lambda a: a[0], known.rollouts(values)[0]))
    if longer is None:
        raise ValueError("the hand does not hold the object where it is open most, or does not reach further")
    return longer


def _experiment(what: str, cost: Cost, values: np.ndarray) -> Experiment:
    """The distance of the models [K, D] that an experiment distinguishes least; ValueError where a replay fails."""
    if cost.failed(values).any():
        raise ValueError("the simulation of one of the models fails on this motion")
    simulated = cost.whitened(values).astype(np.float64)
    least = min(float(np.linalg.norm(a - b)) for a, b in itertools.combinations(simulated, 2))
    return Experiment(what, least)


def _carrying(case: Case, values: np.ndarray) -> np.ndarray:
    """Models [K, D] with a known weight at the hand."""
    carried = case.full_space.of_role(Role.PAYLOAD_MASS)[0]
    out, column = values.copy(), case.full_space.index(carried.name)
    out[:, column] = np.minimum(out[:, column] + WEIGHT, carried.high)
    return out
