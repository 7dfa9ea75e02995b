"""What the simulation's own time step changes: replays at a finer step, and U0, the U that it leaves."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import ScoreTest, project
from droid_jax.discrepancy.case import Case, ResidualSet
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.identify.search import NotReplayed
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, with_options
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.replay import Drive

FINER = 4  # parts of a time step
# The step's whole U over U0, of an error that falls no faster than the step: what `beyond_step_error` allows for.
WORST = (FINER / (FINER - 1)) ** 2


def with_finer_step(residual_set: ResidualSet, base: Space, recording: Recording) -> Cost | None:
    """The cost of the base model at a quarter of the time step; None where the time step is no error: without commands,
    which has none, and of data that were made with this very step (`CompareConfig.mj_step`).
    """
    cost = residual_set.cost
    if not isinstance(cost.drives[0], Drive) or residual_set.comparison.config.mj_step:
        return None
    scene = _finer(cost.scene)
    if isinstance(cost, WindowedLog):
        return cost.finer(scene, base)
    compared = until(recording, cost.drives[0])
    return make_cost(scene, base, [compared], config=residual_set.comparison.config, check=False)


def until(recording: Recording, drive: Drive) -> Recording:
    """What was measured before a replay ends: one of finer steps may go on for a part of a step."""
    end = float(recording.time[0]) + float(drive.time[-1]) + 1e-9  # as `observation.prepared` has it
    channels = {
        name: replace(c, time=c.time[seen], values=c.values[:, seen], mask=c.mask[:, seen])
        for name, c in recording.channels.items()
        for seen in (c.time <= end,)
    }
    return replace(recording, channels=channels)


@functools.lru_cache(maxsize=4)
def _finer(scene: Scene) -> Scene:
    """The same scene each time, so that its program is compiled once."""
    return with_options(scene, timestep=float(scene.model.opt.timestep) / FINER)


def with_step_difference(residual_set: ResidualSet, model: FittedModel, fine: Cost | None) -> ResidualSet:
    """The same residual set, knowing what a quarter of the time step changes.

    Args:
        residual_set: of the recording that the model was fitted to.
        model: the base model.
        fine: what `with_finer_step` made of the same recording; None leaves the set unchanged.

    Raises:
        NotReplayed: the finer replay blows up.
    """
    if fine is None:
        return residual_set
    values = model.values[residual_set.cost.space.columns(model.space)]
    coarse = residual_set.whitened(model.values[None])[0]
    off = (fine.whitened(values[None])[0] - coarse).astype(np.float64) / np.sqrt(residual_set.repeats)
    if not np.isfinite(off).all():
        name = residual_set.comparison.name
        raise NotReplayed(f"the simulation of {name!r} blows up at a quarter of its time step")
    return replace(residual_set, step_difference=off)


def with_step_differences(case: Case, model: FittedModel, fine: Cost | None) -> Case:
    """The case, its training recording and the blocks of both parts knowing what a quarter of the time step changes.

    fine: what `with_finer_step` made of the training recording.
    """
    both = case.both
    if both is not None:
        same = fine
        if isinstance(fine, WindowedLog) and isinstance(both.cost, WindowedLog):
            same = replace(fine, whitener=both.cost.whitener, instants=both.cost.instants)
        both = with_step_difference(both, model, same)
    return replace(case, train=with_step_difference(case.train, model, fine), both=both)


def discretisation_error(residual_set: ResidualSet, model: FittedModel) -> float:
    """U0, the U that the simulation's own time step leaves; zero where no finer step was measured.

    The base model is replayed at a quarter of the time step and taken for data.  What the base parameters cannot absorb
    of the difference would be called a discrepancy though nothing is missing.

    Args:
        residual_set: of the recording that the model was fitted to (`with_step_difference`).
        model: the base model.
    """
    if residual_set.step_difference is None:
        return 0.0
    off, count = residual_set.step_difference, residual_set.repeats
    left = project(off[None], model.refined.jacobian / np.sqrt(count), model.refined.prior * np.sqrt(count))[0]
    return float(left @ left / residual_set.resampling.counted.sum())


def beyond_step_error(discrepancy: float, discretisation_error: float) -> bool:
    """Whether U is more than the time step could leave.

    U0 is what a quarter of the step changes.  Of an error of second order that is nearly all of it; where joints stick,
    or where a motion begins with a jolt, the error falls with the step itself, and a quarter of it stays.
    """
    return discrepancy > WORST * discretisation_error


def more_than_step_error(case: Case, model: FittedModel, found: ScoreTest, discretisation_error: float) -> bool:
    """Whether what a score test found is more than the time step could leave, U0.

    U of blocks holds their noise too: there it is what the best direction takes of it.
    """
    share = 1.0 if case.train.resampling.repeated else float(np.max(found.explained))
    return beyond_step_error(share * model.discrepancy, discretisation_error)
