"""The amplitudes that a verdict's model reaches without noise: what their intervals should hold.

A hidden effect has another equation than the library's, so no amplitude of the library is its true one.  What a
fit of a wrong form estimates is the value at which it settles without noise (White, Econometrica 1982), on the
same robot, the same motion and with the same weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from droid_jax.discrepancy.case import Case
from droid_jax.discrepancy.fitting import refit
from droid_jax.identify.multistart import RefineConfig
from droid_jax.model.effects.candidate import Candidate, candidates
from droid_jax.recordings.recording import Recording
from droid_jax.synthetic.hidden_effects import Applied
from droid_jax.synthetic.robot import SyntheticRobotConfig
from experiments.blind.make import Drawn, record
from experiments.blind.search import Bench

SETTLE = RefineConfig(iterations=20, basin_hops=0, spreads=0)
QUIET = SyntheticRobotConfig(
    torque_noise=(0.0, 0.0), torque_drift=(0.0, 0.0), position_noise=0.0, angle_noise=0.0,
    start_noise=0.0, pose_noise=0.0,
)  # fmt: skip


def settled(
    recordings: Mapping[str, Recording], truth: Mapping[str, Any], result: Mapping[str, Any], bench: Bench
) -> dict[str, float] | None:
    """Amplitude -> value at which the model of a result settles without noise.

    None where it named nothing, or where the fit or the robot without noise fails.
    """
    if not result.get("effects"):
        return None
    where = bench.setting(truth["scene"])
    drawn = Drawn(tuple(Applied(**h) for h in truth["hidden"]), truth["truths"], truth["seeds"])
    try:
        plain = record(where, drawn, ("train",), QUIET)["train"]
    except ValueError:  # it loses its door where a pose a little different kept it
        return None
    case = bench.case(truth["scene"], {**recordings, "train": around(plain, recordings["train"])}, result["without"])
    model = refit(
        case.train, case.base, _parts(case, result), _start(case, truth["truths"]["train"], result)[None], SETTLE
    )
    return (
        {n: float(model.values[case.full_space.index(n)]) for n in model.coefficients}
        if model.refined.converged
        else None
    )


def around(plain: Recording, noisy: Recording) -> Recording:
    """The noisy recording with its repeats moved so that their mean is the mean of the plain one's."""
    channels = {}
    for name, channel in noisy.channels.items():
        values = channel.values - channel.values.mean(axis=0) + plain.channels[name].values.mean(axis=0)
        channels[name] = replace(channel, values=values)
    return replace(noisy, channels=channels)


def _parts(case: Case, result: Mapping[str, Any]) -> list[Candidate]:
    known = {str(c.key): c for c in candidates(case.effects)}
    return [known[name] for name in result["effects"]]


def _start(case: Case, truth: Mapping[str, float], result: Mapping[str, Any]) -> np.ndarray:
    """[D] the truth of the base model, and what was found of the effects."""
    whole = case.full_space
    sizes = {name: found["value"] for name, found in result["coefficients"].items()}
    known = {**truth, **sizes, **result["shape_parameters"]}
    return np.clip(whole.values({n: v for n, v in known.items() if n in whole.names}), whole.low, whole.high)
