"""Which experiment would tell tied effects apart: what each of them predicts for it.

Every entry of the menu is within reach of whoever gave the fitted demonstration: the same motion on another clock
(slower, faster, there and back, with a stop half-way), opened further, with a known weight at the hand, or in the air,
away from what the hand held.
"""

from __future__ import annotations

import copy
import functools
import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import jax
import mujoco
import numpy as np

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.time_scaling import TIME_SCALINGS, time_scaled
from droid_jax.discrepancy.verdict import Experiment
from droid_jax.discrepancy.workspace_extrapolation import FURTHER, opened_further
from droid_jax.errors import reason
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

IN_THE_AIR = "the same motion in the air, away from what the hand held"
WEIGHT, CARRIED = 0.5, "payload_mass"  # kg, and the library's parameter that stands for it


def untouched(scene: Scene) -> Scene:
    """A scene whose hand grips by contact, without any contact: the robot moves as if nothing stood around it."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return replace(scene, model=model, grip=None)


def separating(case: Case, models: Sequence[FittedModel], recording: Recording) -> tuple[Experiment, ...]:
    """Experiments by how far apart they put the two models that they tell apart least, the best first.

    models: tied ones, each refitted.  recording: what the case was fitted to.  Empty for a log without
    commands, whose motion cannot be asked for again.  Experiments that cannot be made come last, and say why.
    """
    if len(models) < 2 or not recording.command.size:
        return ()
    values = np.stack([m.values for m in models])
    found = [_made(what, make) for what, make in _menu(case, values, recording)]
    return tuple(sorted(found, key=lambda e: -np.inf if e.distance is None else e.distance, reverse=True))


def _menu(case: Case, values: np.ndarray, recording: Recording) -> Iterator[tuple[str, Callable[[], Experiment]]]:
    """What there is to try in this scene, in words, and how each is made for models [K, D]."""
    known = case.train.cost
    config = known.comparisons[0].config

    def moved(what: str, motion: Callable[[], Recording]) -> Experiment:
        cost = make_cost(known.scene, case.full_space, [motion()], config=config, effects=case.effects, check=False)
        return _experiment(what, cost, values)

    for entry in TIME_SCALINGS:
        yield entry.what, functools.partial(moved, entry.what, functools.partial(time_scaled, recording, entry))
    if known.scene.grip is not None:
        yield FURTHER, functools.partial(moved, FURTHER, lambda: _further(known, recording, values[:1]))
    seen = {name: weight for name, weight in config.channels.items() if name != "object_angle"}
    if known.scene.grip is not None and seen:

        def in_the_air() -> Experiment:
            alone = replace(config, channels=seen)
            cost = make_cost(
                untouched(known.scene), case.full_space, [recording], config=alone, effects=case.effects, check=False
            )
            return _experiment(IN_THE_AIR, cost, values)

        yield IN_THE_AIR, in_the_air
    if CARRIED in case.full_space.names:
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


def _further(known: Cost, recording: Recording, values: np.ndarray) -> Recording:
    """The motion opened further, as a model [1, D] made it; ValueError where the hand does not get there."""
    longer = opened_further(known.scene, recording, jax.tree.map(lambda a: a[0], known.rollouts(values)[0]))
    if longer is None:
        raise ValueError("the hand does not hold the object where it is open most, or does not reach further")
    return longer


def _experiment(what: str, cost: Cost, values: np.ndarray) -> Experiment:
    """How far apart models [K, D] are that one experiment tells apart least; ValueError where a replay fails."""
    if cost.failed(values).any():
        raise ValueError("the simulation of one of the rivals fails on this motion")
    simulated = cost.whitened(values).astype(np.float64)
    apart = min(float(np.linalg.norm(a - b)) for a, b in itertools.combinations(simulated, 2))
    return Experiment(what, apart)


def _carrying(case: Case, values: np.ndarray) -> np.ndarray:
    """Models [K, D] with a known weight at the hand."""
    out, column = values.copy(), case.full_space.index(CARRIED)
    out[:, column] = np.minimum(out[:, column] + WEIGHT, case.full_space[CARRIED].high)
    return out
