"""mujoco.sysid and this program on the same recordings of the built-in door.

Both fit the same parameters from the same start, all but the last three of ten repeats of demonstrations A and C.
Nuisances are drawn from priors that this program's fit knows; sysid has no word for a prior, so one of its fits gets
them as further rows of its residual (`peer_problems/sysid.py`).
Judge of both is plain C MuJoCo at half a millisecond, on the three repeats that neither has seen.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from identify_suite import recordings, settings

from benchmarks.peer_problems import sysid as peer
from benchmarks.peer_problems.gap import run_gap
from droid_jax.cost.cost import make_cost
from droid_jax.door.demonstration import demonstration_path
from droid_jax.door.scene import door_scene
from droid_jax.door.space import JOINT_DAMPING, door_nuisances, door_space
from droid_jax.identify.holdout import split_repeats
from droid_jax.identify.pipeline import identify_parameters
from droid_jax.model.parameters import Space
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Recording
from droid_jax.storage import finite
from droid_jax.synthetic.hidden_effects import record_hidden
from droid_jax.synthetic.robot import synthetic_truth

OURS, THEIRS, JUDGE = 0.004, 0.002, 0.0005  # s, time steps; ours is of second order
WAYS: dict[str, dict[str, Any]] = {
    "sysid": {},
    "sysid, off the bounds": {"off_bounds": True},  # follows its own warning about the start
    "sysid, told the priors": {"off_bounds": True, "priors": True},  # of the nuisances, as ours is
}
HINGE = ("hinge_stiffness", "hinge_frictionloss", "hinge_damping")


def door(springs: int, quick: bool) -> dict[str, Any]:
    """A door of Table I: what is left on held-out repeats, errors of parameters, intervals, time."""
    scene = door_scene(timestep=OURS)
    truth = synthetic_truth(scene, springs, springs)
    data = recordings(scene, truth, "A" if quick else "AC", springs)
    space, nuisances = door_space(scene), door_nuisances(scene)
    full = space + nuisances
    began = time.perf_counter()
    found = identify_parameters(scene, space, data, nuisances=nuisances, config=settings(quick, springs))
    seconds = time.perf_counter() - began
    assert found.refined is not None
    told = [t.identifiable and not p.nuisance for t, p in zip(found.identifiability, full.parameters, strict=True)]
    at = np.array([truth[n] for n in full.names])
    fits = {"ours": _figures(full, at, found.best, found.full_gaussian.interval(0.95), np.array(told), seconds)}
    fits["ours"]["says"] = [f"{int(sum(told))} of {len(space)} parameters are told by this motion"]
    fits["ours"]["converged"] = found.refined.converged
    best = {"start": full.mean, "truth": at, "ours": found.best}
    for name, theirs in _theirs(full, data, quick).items():
        best[name] = theirs.values
        fits[name] = _figures(full, at, theirs.values, theirs.interval, np.array(told), theirs.seconds)
        fits[name]["says"] = list(theirs.says)
    return {"gap": heldout_gap(full, data, best), "fits": fits, "parameters": len(full)}


def _theirs(full: Space, data: Sequence[Recording], quick: bool) -> dict[str, peer.PeerFit]:
    """Its fits by name: from our start, from where its own warning advises, and with the priors of the nuisances."""
    fitted = [split_repeats(r, 0.3)[0] for r in data]
    scene = door_scene(timestep=THEIRS)
    out = {}
    for name, way in WAYS.items():
        out[name] = peer.fit(scene, full, fitted, **way, max_iters=2 if quick else 200)
    return out


def _figures(
    space: Space,
    truth: np.ndarray,
    best: np.ndarray,
    interval: tuple[np.ndarray, np.ndarray],
    told: np.ndarray,
    seconds: float,
) -> dict[str, Any]:
    """A fit's errors against the truth [D], and how many of its 95 % intervals hold it.

    told: [D] bool, what this program calls identifiable, nuisances left out.
    """
    error = dict(zip(space.names, (best - truth).tolist(), strict=True))
    inside = (interval[0] <= truth) & (truth <= interval[1])
    main = np.array([not p.nuisance for p in space.parameters])
    half = 0.5 * (interval[1] - interval[0])
    return {
        "hinge_errors": {n: error[n] for n in HINGE},
        "largest_joint_damping_error": max(abs(error[n] / truth[space.index(n)]) for n in JOINT_DAMPING),
        "inside_95": {"of_table_i": [int(inside[main].sum()), int(main.sum())],
                      "of_identifiable": [int(inside[told].sum()), int(told.sum())]},
        "half_width_95": {n: finite(h) for n, h in zip(space.names, half, strict=True)},
        "values": dict(zip(space.names, best.tolist(), strict=True)),
        "seconds": seconds,
    }  # fmt: skip


def heldout_gap(space: Space, data: Sequence[Recording], values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Equation 1 without penalties, N m, of each vector on the repeats that no fit has seen, by recording."""
    return distances_on(space, [split_repeats(r, 0.3)[1] for r in data], values)


def distances_on(space: Space, held: Sequence[Recording], values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The same on all repeats of recordings."""
    judge = make_cost(door_scene(timestep=JUDGE), space, held, engine="mujoco")
    rows = np.stack(list(values.values()))
    distances = judge.distances(rows) - judge.penalties(rows)
    return {
        name: dict(zip([r.name for r in held], row.tolist(), strict=True))
        for name, row in zip(values, distances, strict=True)
    }


def hidden(effect: str, amplitude: float, quick: bool) -> dict[str, Any]:
    """A door with something hidden in it: what each program says, and the gap on motions that were not fitted."""
    scene = door_scene(timestep=OURS)
    truth = synthetic_truth(scene, 1, 1)
    data = {
        n: record_hidden(scene, load_recording(demonstration_path(n)), truth, {effect: amplitude}, seed=i, name=n)
        for i, n in enumerate("CBA")
    }
    full = door_space(scene) + door_nuisances(scene)
    theirs = _theirs(full, [data["C"]], quick)
    best = {"start": full.mean, **{name: f.values for name, f in theirs.items()}}
    with tempfile.TemporaryDirectory() as folder:
        ours = run_gap(list(data.values()), Path(folder))
    return {
        "hidden": {effect: amplitude},
        "says": {name: list(f.says) for name, f in theirs.items()},
        "seconds": {name: f.seconds for name, f in theirs.items()},
        "gap": heldout_gap(full, list(data.values()), best),
        "ours": ours,
    }
