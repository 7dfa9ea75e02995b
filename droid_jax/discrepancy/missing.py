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
from droid_jax.discrepancy.candidates import candidates, possible
from droid_jax.discrepancy.case import Case, GapConfig, make_case
from droid_jax.discrepancy.discretisation_error import numerical_floor
from droid_jax.discrepancy.extended import Extended, extended
from droid_jax.discrepancy.inputs import shared_out
from droid_jax.discrepancy.restart import base_fit
from droid_jax.discrepancy.resume import kept_model, kept_number, remembering
from droid_jax.discrepancy.single import base_model, make_log, single_case
from droid_jax.discrepancy.split import Split
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.discrepancy.workflow import find
from droid_jax.identify.pipeline import Progress
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import beside, checked
from droid_jax.model.fields import check_space
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording, recordings_of


def find_missing(
    scene: Scene,
    space: Space,
    recordings: Sequence[Recording],
    *,
    effects: Sequence[Effect] | None = None,
    start: np.ndarray | None = None,
    config: GapConfig | None = None,
    progress: Progress | None = None,
) -> tuple[Verdict, Extended]:
    """Which physical effect the model lacks, and the model with it (docs/method-gap.md).

    space: all that is fitted without any effect, nuisances among it: `found.full` of an identification.
    recordings: fit, confirm and perhaps sealed, eight repeats or more of each; or one, sixteen repeats or more, whose
    second half confirms; or a log of one repeat without commands, alone or with another one that is sealed.
    effects: to ask about; None for all of the library (`droid_jax.model.effects.registry`) that could show in these.
    start: [D] physical values over `space`, `found.best`, where the base fit begins instead of with a search; a log
    without repeats needs neither.
    progress: called with a stage's name and its progress value.

    The verdict's gaps are in squared noise units of one repeat.  Only another motion tells effects apart that act
    alike in this one (`Split.limits`).
    The model is handed on as `handed_on` says: with effects in it, it is fitted to both motions; where that fails it is
    the search's own, of the first motion.
    Raises ValueError for recordings in which a search could not end well, and for effects that are none or that a
    recording without commands cannot have.
    """
    config = instance(GapConfig() if config is None else config, "config", GapConfig)
    check_space(instance(scene, "scene", Scene), instance(space, "space", Space))
    recordings = recordings_of(recordings)
    split, roles = shared_out(scene, recordings)
    given = None if effects is None else instances(effects, "effects", Effect)
    asked = possible(scene, recordings) if given is None else tuple(map(checked, given))
    if not asked:
        raise ValueError("effects: there is none to ask about; None asks about all of the library")
    candidates(asked)  # refused before the base fit, and not after it
    start = None if start is None else space.check(start)
    case = case_of(split, scene, space, asked, roles, config)
    tell = progress or (lambda stage, value: None)
    case, verdict = answer(split, case, roles, start, tell)
    *_, whole = amended(case, verdict, roles["fit"], tell)
    return whole.verdict, extended(case, whole.handed)


def answer(
    split: Split,
    case: Case,
    roles: Mapping[str, Recording],
    start: np.ndarray | None = None,
    progress: Progress | None = None,
    checkpoints: Path | None = None,
) -> tuple[Case, Verdict]:
    """The verdict on a case of recordings by role (see `case_of`), and the case, which now remembers its replays.

    Without experiments for a tie: `amend.amended` adds them.
    start: [F] values of the base parameters from which their fit begins, instead of a search.
    checkpoints: folder of this search alone, from which it goes on after a stop; None keeps nothing.
    """
    tell = progress or (lambda stage, value: None)

    def at(name: str) -> Path | None:
        return None if checkpoints is None else checkpoints / name

    if checkpoints is not None:
        case = remembering(case, checkpoints / "replays")
    if split is Split.BLOCKS:
        floor = 0.0
        model = kept_model(
            at("base"), case.base, case.whole, lambda: base_model(case, progress=lambda now: tell("refine", now))
        )
    else:
        model = kept_model(at("base"), case.base, case.whole, lambda: base_fit(case, tell, start))
        tell("floor", None)
        floor = kept_number(at("floor"), lambda: numerical_floor(case.fit, model, roles["fit"]))
    verdict = find(case, model, floor, tell)
    tell("judge", None)
    return case, verdict


def case_of(
    split: Split,
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    roles: Mapping[str, Recording],
    config: GapConfig,
) -> Case:
    """Of recordings by role (see `shared_out`), which are one or two logs where the split is by blocks.

    Sensors' gains and encoders' offsets that the base has as parameters are not asked about there.
    Raises ValueError for what is wrong with them, or does not fit the scene.
    """
    effects = beside(base, effects)
    if split is not Split.BLOCKS:
        return make_case(scene, base, effects, **roles, config=config)
    config = replace(config, refine=replace(config.refine, hops=0, spreads=0))  # inverse dynamics is smooth
    logs = {role: make_log(scene, base, effects, recording, config) for role, recording in roles.items()}
    return single_case(logs["fit"], base, effects, logs.get("sealed"), config)
