"""The search for a missing effect as one call, however recordings share its work.

The command `gap` makes the same search, goes on after a stop and leaves a folder and a page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from droid_jax.arguments import instance, instances
from droid_jax.discrepancy.amendments import amended
from droid_jax.discrepancy.candidates import candidates, observable_effects
from droid_jax.discrepancy.case import Case, DiscrepancyConfig, make_case
from droid_jax.discrepancy.discretisation_error import discretisation_error
from droid_jax.discrepancy.extended import Extended, extended
from droid_jax.discrepancy.inputs import assigned_roles
from droid_jax.discrepancy.restart import base_fit
from droid_jax.discrepancy.resume import cached_model, cached_number, with_replay_cache
from droid_jax.discrepancy.single import base_model, make_log, single_case
from droid_jax.discrepancy.split import Split
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.discrepancy.workflow import search_effects
from droid_jax.identify.pipeline import Progress
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import beside, checked
from droid_jax.model.fields import check_space
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording, recordings_of


def find_missing_effects(
    scene: Scene,
    space: Space,
    recordings: Sequence[Recording],
    *,
    effects: Sequence[Effect] | None = None,
    start: np.ndarray | None = None,
    config: DiscrepancyConfig | None = None,
    progress: Progress | None = None,
) -> tuple[Verdict, Extended]:
    """Which physical effect the model lacks, and the model with it (docs/discrepancy-search.md).

    space: all that is fitted without any effect, nuisances among it: `found.full` of an identification.
    recordings: train, validation and perhaps test, eight repeats or more of each; or one, sixteen repeats or more,
    whose second half validates; or a log of one repeat without commands, alone or with another one as test data.
    effects: to ask about; None for all of the library (`droid_jax.model.effects.registry`) that could show in these.
    start: [D] physical values over `space`, `found.best`, where the base fit begins instead of with a search; a log
    without repeats needs neither.
    progress: called with a stage's name and its progress value.

    The verdict's gaps are in squared noise units of one repeat.  Only another motion tells effects apart that act
    alike in this one (`Split.limits`).
    The model is handed on as `final_model` says: with effects in it, it is fitted to both motions; where that fails it
    is the search's own, of the first motion.
    Raises ValueError for recordings in which a search could not end well, and for effects that are none or that a
    recording without commands cannot have.
    """
    config = instance(DiscrepancyConfig() if config is None else config, "config", DiscrepancyConfig)
    check_space(instance(scene, "scene", Scene), instance(space, "space", Space))
    recordings = recordings_of(recordings)
    split, roles = assigned_roles(scene, recordings)
    given = None if effects is None else instances(effects, "effects", Effect)
    asked = observable_effects(scene, recordings) if given is None else tuple(map(checked, given))
    if not asked:
        raise ValueError("effects: there is none to ask about; None asks about all of the library")
    candidates(asked)  # refused before the base fit, and not after it
    start = None if start is None else space.check(start)
    case = case_of(split, scene, space, asked, roles, config)
    tell = progress or (lambda stage, value: None)
    case, verdict = search(split, case, roles, start, tell)
    *_, whole = amended(case, verdict, roles["train"], tell)
    return whole.verdict, extended(case, whole.final)


def search(
    split: Split,
    case: Case,
    roles: Mapping[str, Recording],
    start: np.ndarray | None = None,
    progress: Progress | None = None,
    checkpoints: Path | None = None,
) -> tuple[Case, Verdict]:
    """The verdict on a case of recordings by role (see `case_of`), and the case, which now remembers its replays.

    Without experiments for a tie: `amendments.amended` adds them.
    start: [F] values of the base parameters from which their fit begins, instead of a search.
    checkpoints: folder of this search alone, from which it goes on after a stop; None keeps nothing.
    """
    tell = progress or (lambda stage, value: None)

    def at(name: str) -> Path | None:
        return None if checkpoints is None else checkpoints / name

    if checkpoints is not None:
        case = with_replay_cache(case, checkpoints / "replays")
    if split is Split.BLOCKS:
        floor = 0.0
        model = cached_model(
            at("base"), case.base, case.full_space, lambda: base_model(case, progress=lambda now: tell("refine", now))
        )
    else:
        model = cached_model(at("base"), case.base, case.full_space, lambda: base_fit(case, tell, start))
        tell("floor", None)
        floor = cached_number(at("floor"), lambda: discretisation_error(case.train, model, roles["train"]))
    verdict = search_effects(case, model, floor, tell)
    tell("judge", None)
    return case, verdict


def case_of(
    split: Split,
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    roles: Mapping[str, Recording],
    config: DiscrepancyConfig,
) -> Case:
    """Of recordings by role (see `assigned_roles`), which are one or two logs where the split is by blocks.

    Sensors' gains and encoders' offsets that the base has as parameters are not asked about there.
    Raises ValueError for what is wrong with them, or does not fit the scene.
    """
    effects = beside(base, effects)
    if split is not Split.BLOCKS:
        return make_case(scene, base, effects, **roles, config=config)
    config = replace(config, refine=replace(config.refine, basin_hops=0, spreads=0))  # inverse dynamics is smooth
    logs = {role: make_log(scene, base, effects, recording, config) for role, recording in roles.items()}
    return single_case(logs["train"], base, effects, logs.get("test"), config)
