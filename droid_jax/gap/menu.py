"""Which experiment would tell tied effects apart: what each of them predicts for it.

Every entry of the menu is within reach of whoever gave the fitted demonstration: the same motion on another clock
(slower, faster, there and back, with a stop half-way), opened further, with a known weight at the hand, or in the air,
away from what the hand held.
"""

from __future__ import annotations

import copy
import itertools
import warnings
from collections.abc import Sequence
from dataclasses import replace

import jax
import mujoco
import numpy as np

from droid_jax.compare.cost import Cost, make_cost
from droid_jax.compare.measured import TooLong
from droid_jax.gap.case import Case
from droid_jax.gap.reach import opened_further
from droid_jax.gap.refit import Model
from droid_jax.gap.verdict import Experiment
from droid_jax.gap.warp import MENU, warped
from droid_jax.measure.recording import Recording
from droid_jax.model.scene import Scene

IN_THE_AIR = "the same motion in the air, away from what the hand held"
WEIGHT, CARRIED = 0.5, "payload_mass"  # kg, and the library's parameter that stands for it


def untouched(scene: Scene) -> Scene:
    """A scene whose hand grips by contact, without any contact: the robot moves as if nothing stood around it."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return replace(scene, model=model, grip=None)


def separating(case: Case, models: Sequence[Model], recording: Recording) -> tuple[Experiment, ...]:
    """Experiments by how far apart they put the two models that they tell apart least, the best first.

    models: tied ones, each refitted.  recording: what the case was fitted to.  Empty for a log without
    commands, whose motion cannot be asked for again.  Entries that a model cannot be replayed on, and
    those too long for the memory, are left out.
    """
    if len(models) < 2 or not recording.command.size:
        return ()
    values = np.stack([m.values for m in models])
    known = case.fit.cost
    config = known.comparisons[0].config
    found = list[Experiment]()
    for motion in (*(warped(recording, entry) for entry in MENU), *_further(known, recording, values[:1])):
        with warnings.catch_warnings():  # what there is to warn of was said of the recording itself
            warnings.simplefilter("ignore", UserWarning)
            try:
                cost = make_cost(known.scene, case.whole, [motion], config=config, effects=case.effects)
            except TooLong:  # the search is done, and other entries are left
                continue
        found += _experiment(motion.name, cost, values)
    seen = {name: weight for name, weight in config.channels.items() if name != "object_angle"}
    if known.scene.grip is not None and seen:
        alone = replace(config, channels=seen)
        cost = make_cost(untouched(known.scene), case.whole, [recording], config=alone, effects=case.effects)
        found += _experiment(IN_THE_AIR, cost, values)
    if CARRIED in case.whole.names:
        what = f"the same motion with {WEIGHT:g} kg more, weighed, at the hand"
        found += _experiment(what, known, _carrying(case, values))
    return tuple(sorted(found, key=lambda e: -e.apart))


def _further(known: Cost, recording: Recording, values: np.ndarray) -> list[Recording]:
    """The motion opened further, as a model [1, D] made it; none where nothing grips or the hand does not get there."""
    if known.scene.grip is None:
        return []
    longer = opened_further(known.scene, recording, jax.tree.map(lambda a: a[0], known.rollouts(values)[0]))
    return [] if longer is None else [longer]


def _experiment(what: str, cost: Cost, values: np.ndarray) -> list[Experiment]:
    """How far apart models [K, D] are that one experiment tells apart least; none where one cannot be replayed."""
    if cost.failed(values).any():
        return []
    simulated = cost.whitened(values).astype(np.float64)
    apart = min(float(np.linalg.norm(a - b)) for a, b in itertools.combinations(simulated, 2))
    return [Experiment(what, apart)]


def _carrying(case: Case, values: np.ndarray) -> np.ndarray:
    """Models [K, D] with a known weight at the hand."""
    out, column = values.copy(), case.whole.index(CARRIED)
    out[:, column] = np.minimum(out[:, column] + WEIGHT, case.whole[CARRIED].high)
    return out
