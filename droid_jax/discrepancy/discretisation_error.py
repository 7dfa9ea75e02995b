"""U0, the numerical floor: the gap that the simulation's own time step leaves.

The base model is replayed at a quarter of the time step and taken for data.  What the base parameters
cannot absorb of the difference would be called a gap though nothing is missing.
"""

from __future__ import annotations

import numpy as np

from droid_jax.cost.cost import Cost, make_cost
from droid_jax.discrepancy.refit import FittedModel
from droid_jax.discrepancy.residual_set import ResidualSet
from droid_jax.discrepancy.screen import project
from droid_jax.identify.search import NotReplayed
from droid_jax.model.parameters import Space
from droid_jax.model.scene import with_options
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.replay import Drive

FINER = 4
WORST = (FINER / (FINER - 1)) ** 2  # the step's whole U over U0, of an error that falls no faster than the step


def above(gap: float, floor: float) -> bool:
    """Whether U is more than the time step could leave.

    U0 is what a quarter of the step changes.  Of an error of second order that is nearly all of it; where joints stick,
    or where a motion begins with a jolt, the error falls with the step itself, and a quarter of it stays.
    """
    return gap > WORST * floor


def with_finer_step(residual_set: ResidualSet, base: Space, recording: Recording) -> Cost | None:
    """The cost of the base model at a quarter of the time step; None in inverse mode, which has no time step."""
    cost = residual_set.cost
    if not isinstance(cost.drives[0], Drive):
        return None
    scene = with_options(cost.scene, timestep=float(cost.scene.model.opt.timestep) / FINER)
    return make_cost(scene, base, [recording], config=cost.comparisons[0].config, check=False)


def discretisation_error(
    residual_set: ResidualSet, model: FittedModel, recording: Recording, fine: Cost | None = None
) -> float:
    """U0 of a fitted base model on the recording it was fitted to; zero in inverse mode.

    fine: what `finer` made, of this recording or of another with the same commands, to spare a compilation.
    Raises NotReplayed where the finer replay blows up.
    """
    cost = residual_set.cost
    fine = with_finer_step(residual_set, model.space, recording) if fine is None else fine.against([recording])
    if fine is None:
        return 0.0
    values = model.values[cost.space.columns(model.space)]
    count = residual_set.repeats
    off = (fine.whitened(values[None])[0] - cost.whitened(model.values[None])[0]).astype(np.float64) / np.sqrt(count)
    if not np.isfinite(off).all():
        raise NotReplayed(f"the simulation of {recording.name!r} blows up at a quarter of its time step")
    left = project(off[None], model.refined.jacobian / np.sqrt(count), model.refined.prior * np.sqrt(count))[0]
    return float(left @ left / len(left))
