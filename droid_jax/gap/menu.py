"""Which experiment would tell tied effects apart: what each of them predicts for it.

Every entry of the menu is within reach of whoever gave the fitted demonstration: the same motion on another clock
(slower, faster, there and back, with a stop half-way), with a known weight at the hand, or in the air, away from
what the hand held.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from droid_jax.compare.cost import Cost, make_cost
from droid_jax.gap.case import Case
from droid_jax.gap.refit import Model
from droid_jax.gap.verdict import Experiment
from droid_jax.measure.recording import Channel, Recording
from droid_jax.model.scene import Scene

STOP = 2.0  # s
IN_THE_AIR = "the same motion in the air, away from what the hand held"
WEIGHT, CARRIED = 0.5, "payload_mass"  # kg, and the library's parameter that stands for it


@dataclass(frozen=True)
class Entry:
    """An experiment of the menu.

    what: in words.  seconds: duration of a motion of `duration` s on the new clock; clock: (new instants [K],
    duration) -> instants of the demonstration, s from its start.
    """

    what: str
    seconds: Callable[[float], float]
    clock: Callable[[np.ndarray, float], np.ndarray]


MENU = (
    Entry("the same motion three times slower", lambda d: 3 * d, lambda t, d: t / 3),
    Entry("the same motion twice as fast", lambda d: d / 2, lambda t, d: 2 * t),
    Entry("the same motion there and back again", lambda d: 2 * d, lambda t, d: np.minimum(t, 2 * d - t)),
    Entry(
        f"the same motion with a stop of {STOP:.0f} s half-way",
        lambda d: d + STOP,
        lambda t, d: np.where(t < d / 2, t, np.maximum(d / 2, t - STOP)),
    ),
)


def warped(recording: Recording, entry: Entry) -> Recording:
    """A recording as if its motion had been made on another clock; its noise comes along."""
    first, duration = recording.time[0], recording.duration

    def instants(clock: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step = np.median(np.diff(clock))
        new = np.arange(0.0, entry.seconds(duration) + 0.5 * step, step)
        return first + new, first + np.clip(entry.clock(new, duration), 0.0, duration)

    def channel(c: Channel) -> Channel:
        new, old = instants(c.time)
        near = np.clip(np.searchsorted(c.time, old), 0, len(c.time) - 1)
        values = np.nan_to_num(c.values)[:, near]
        return replace(c, time=new, values=values, mask=c.mask[:, near])

    time, old = instants(recording.time)
    command = np.stack([np.interp(old, recording.time, column) for column in recording.command.T], axis=1)
    channels = {name: channel(c) for name, c in recording.channels.items()}
    return replace(recording, name=entry.what, time=time, command=command, channels=channels, phases=())


def untouched(scene: Scene) -> Scene:
    """A scene whose hand grips by contact, without any contact: the robot moves as if nothing stood around it."""
    model = copy.copy(scene.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return replace(scene, model=model, grip=None)


def separating(case: Case, models: Sequence[Model], recording: Recording) -> tuple[Experiment, ...]:
    """Experiments by how far apart they put the two models that they tell apart least, the best first.

    models: tied ones, each refitted.  recording: what the case was fitted to.  Empty for a log without
    commands, whose motion cannot be asked for again.  Entries that a model cannot be replayed on are left out.
    """
    if len(models) < 2 or not recording.command.size:
        return ()
    values = np.stack([m.values for m in models])
    known = case.fit.cost
    config = known.comparisons[0].config
    found = []
    for entry in MENU:
        other = warped(recording, entry)
        cost = make_cost(known.scene, case.whole, [other], config=config, effects=case.effects)
        found += _experiment(entry.what, cost, values)
    seen = {name: weight for name, weight in config.channels.items() if name != "object_angle"}
    if known.scene.grip is not None and seen:
        alone = replace(config, channels=seen)
        cost = make_cost(untouched(known.scene), case.whole, [recording], config=alone, effects=case.effects)
        found += _experiment(IN_THE_AIR, cost, values)
    if CARRIED in case.whole.names:
        what = f"the same motion with {WEIGHT:g} kg more, weighed, at the hand"
        found += _experiment(what, known, _carrying(case, values))
    return tuple(sorted(found, key=lambda e: -e.apart))


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
