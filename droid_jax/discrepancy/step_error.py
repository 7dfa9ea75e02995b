"""The error of the simulation's time step: replays at a finer step, and U0, its part of U."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from droid_jax.cost.cost import make_cost
from droid_jax.cost.windowed_log import WindowedLog
from droid_jax.discrepancy.candidates import ScoreTest, project
from droid_jax.discrepancy.case import AnyCost, Case, ResidualSet
from droid_jax.discrepancy.fitting import FittedModel
from droid_jax.identify.search import NotReplayed
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene, with_options
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.replay import Drive

FINER = 4  # finer steps in a time step
# Largest ratio of the time step's U to U0: that of an error of first order in the step (see `beyond_step_error`).
FIRST_ORDER_RATIO = (FINER / (FINER - 1)) ** 2


def with_finer_step(residual_set: ResidualSet, base: Space, recording: Recording) -> AnyCost | None:
    """The cost of the base model at a quarter of the time step.

    None if there is no discretisation error: inverse dynamics of a recording without commands takes no steps, and
    `CompareConfig.mj_step` states that the data were simulated with this very step.
    """
    cost = residual_set.cost
    if not isinstance(cost.drives[0], Drive) or residual_set.comparison.config.mj_step:
        return None
    scene = _finer(cost.scene)
    if isinstance(cost, WindowedLog):
        return cost.finer(scene, base)
    compared = until(recording, cost.drives[0])
    return make_cost(scene, base, [compared], config=residual_set.comparison.config, check=False, few=True)


def until(recording: Recording, drive: Drive) -> Recording:
    """The recording up to the end of a replay.  A replay with finer steps may last for a part of a step longer."""
    end = float(recording.time[0]) + float(drive.time[-1]) + 1e-9  # as in `observation.prepared`
    channels = {
        name: replace(c, time=c.time[inside], values=c.values[:, inside], mask=c.mask[:, inside])
        for name, c in recording.channels.items()
        for inside in (c.time <= end,)
    }
    return replace(recording, channels=channels)


@functools.lru_cache(maxsize=4)
def _finer(scene: Scene) -> Scene:
    """The scene with a finer step.  Cached, so that its program is compiled once."""
    return with_options(scene, timestep=float(scene.model.opt.timestep) / FINER)


def with_step_difference(residual_set: ResidualSet, model: FittedModel, fine: AnyCost | None) -> ResidualSet:
    """The residual set with `step_difference`, the change of its residuals at a quarter of the time step.

    Args:
        residual_set: of the recording that the model was fitted to.
        model: the base model.
        fine: cost of the same recording from `with_finer_step`; None returns the set unchanged.

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


def with_step_differences(case: Case, model: FittedModel, fine: AnyCost | None) -> Case:
    """The case with the step difference (`with_step_difference`) of its training set and of `Case.both`.

    fine: cost of the training recording from `with_finer_step`.
    """
    both = case.both
    if both is not None:
        fine_both = fine
        if isinstance(fine, WindowedLog) and isinstance(both.cost, WindowedLog):
            fine_both = replace(fine, whitener=both.cost.whitener, instants=both.cost.instants)
        both = with_step_difference(both, model, fine_both)
    return replace(case, train=with_step_difference(case.train, model, fine), both=both)


def discretisation_error(residual_set: ResidualSet, model: FittedModel) -> float:
    """U0, the part of U that comes from the time step.

    A replay at a quarter of the time step takes the place of the data.  The difference that the base parameters cannot
    absorb would count as a discrepancy although nothing is missing.

    Args:
        residual_set: of the recording that the model was fitted to, see `with_step_difference`.
        model: the base model.

    Returns:
        U0 in squared noise units; zero if there is no step difference.
    """
    if residual_set.step_difference is None:
        return 0.0
    difference, root = residual_set.step_difference, np.sqrt(residual_set.repeats)
    projected = project(difference[None], model.refined.jacobian / root, model.refined.prior * root)[0]
    return float(projected @ projected / residual_set.resampling.counted.sum())


def beyond_step_error(discrepancy: float, discretisation_error: float) -> bool:
    """Whether U is larger than the time step can make it.

    U0 comes from the difference to a quarter of the step.  For an error of second order this is nearly the whole error.
    Where joints stick, or where a motion begins with a jolt, the error is of first order and a quarter of it remains.
    """
    return discrepancy > FIRST_ORDER_RATIO * discretisation_error


def more_than_step_error(case: Case, model: FittedModel, found: ScoreTest, discretisation_error: float) -> bool:
    """Whether a significant score test shows more than the error of the time step (`beyond_step_error`).

    U of blocks includes the noise.  There the part of U that the best direction explains is compared instead.
    """
    share = 1.0 if case.train.resampling.repeated else float(np.max(found.explained))
    return beyond_step_error(share * model.discrepancy, discretisation_error)
