"""One program's fit of one problem that lies in a folder, in a process of its own.

    python -m benchmarks.peer_problems.programs FOLDER PROGRAM

FOLDER/problem.json says what is fitted; FOLDER/PROGRAM.json is written: values, seconds of the fit, 90 % intervals
where the program has them.  The programs are "ours", "sysid" (mujoco.sysid) and "cma_es".

cma_es: the package `cmaes` over plain C on all cores, as PACE does it (L. Bjelonic et al.,
https://arxiv.org/abs/2509.06342; its repository's optim/cma_es.py): bounds scaled to [-1, 1], from their middle, with a
deviation of 0.5; the score is the mean squared residual; the answer is the mean of the last distribution.  PACE itself
simulates 4,096 robots at once in Isaac Lab on a GPU.  Here are fewer.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax import runtime

runtime.tune()

from droid_jax.cost.cost import make_cost  # noqa: E402
from droid_jax.cost.residuals import CompareConfig  # noqa: E402
from droid_jax.model.parameter_file import friction_joints, load_parameters  # noqa: E402
from droid_jax.model.parameters import Space  # noqa: E402
from droid_jax.model.scene import Scene, load_scene  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402

PROBLEM = "problem.json"
DOOR = "door"
# s, time steps of the door: ours is of second order.
DOOR_STEP = {"ours": 0.004, "sysid": 0.002, "cma_es": 0.002}
LEVEL = 0.9
END = 0.01  # PACE's: where a generation's scores differ by less than this share of the best


@dataclass(frozen=True, eq=False)
class Problem:
    """A robot, what is fitted of it, its logs; asked: problem.json."""

    scene: Scene
    space: Space
    nuisances: Space | None
    fit: list[Recording]
    asked: dict[str, Any]

    @property
    def full(self) -> Space:
        """All that is fitted."""
        return self.space if self.nuisances is None else self.space + self.nuisances

    @property
    def channels(self) -> dict[str, float]:
        """What is compared."""
        return dict.fromkeys(self.asked["channels"], 1.0)


def problem(folder: Path, program: str) -> Problem:
    """What lies in a folder."""
    asked = json.loads((folder / PROBLEM).read_text())
    fit = [load_recording(folder / f"{name}.npz") for name in asked["fit"]]
    if asked["scene"] == DOOR:
        from droid_jax.door.scene import door_scene
        from droid_jax.door.space import door_nuisances, door_space

        scene = door_scene(timestep=DOOR_STEP[program])
        return Problem(scene, door_space(scene), door_nuisances(scene), fit, asked)
    parameters = folder / asked["parameters"]
    scene = load_scene(folder / asked["scene"], joints=asked["joints"], friction_joints=friction_joints(parameters))
    return Problem(scene, load_parameters(parameters, scene), None, fit, asked)


def ours(task: Problem) -> dict[str, Any]:
    """This program: a search and a refinement, or the refinement alone where the others start there too."""
    if task.asked["refinement_only"]:
        from benchmarks.peer_problems import springs

        found = springs.refined(task.scene, task.space, task.fit[0], "mujoco")
        return {"values": found.best}
    from droid_jax.commands.options import quick_settings
    from droid_jax.identify.pipeline import IdentifyConfig, identify_parameters
    from droid_jax.identify.search import CmaConfig

    in_c = quick_settings("quick")["generations_in_c"]  # as `identify`
    search = CmaConfig(population=task.asked["population"], parents=None, generations=task.asked["generations"])
    found = identify_parameters(
        task.scene, task.space, task.fit, nuisances=task.nuisances,
        config=IdentifyConfig(search=search, generations_in_c=in_c, heldout=0.0, checks=False),
    )  # fmt: skip
    return {"values": found.best, "interval": found.full_gaussian.interval(LEVEL), "engine": found.engine.engine}


def theirs(task: Problem) -> dict[str, Any]:
    """mujoco.sysid, from our start moved off the bounds, as its own warning advises."""
    from benchmarks.peer_problems import sysid

    (channel,) = task.asked["channels"]
    found = sysid.fit(
        task.scene, task.full, task.fit, channel=channel, off_bounds=True, max_iters=task.asked["iterations"]
    )
    half = found.half_width / 1.96 * 1.645  # its intervals are of 95 %
    return {"values": found.values, "interval": (found.values - half, found.values + half)}


def cma_es(task: Problem) -> dict[str, Any]:
    """CMA-ES over plain C."""
    import cmaes

    config = CompareConfig(channels=task.channels, whitened=True, mj_step=True)
    cost = make_cost(task.scene, task.full, task.fit, engine="mujoco", config=config, check=False)
    low, high, rows = task.full.low, task.full.high, task.asked["samples"]
    search = cmaes.CMA(
        mean=np.zeros(len(low)), sigma=0.5, bounds=np.tile([-1.0, 1.0], (len(low), 1)), seed=0, population_size=rows
    )

    def physical(x: np.ndarray) -> np.ndarray:
        return low + 0.5 * (x + 1.0) * (high - low)

    for _ in range(task.asked["cma_generations"]):
        asked = np.stack([search.ask() for _ in range(rows)])
        scores = np.mean(cost.whitened(physical(asked)) ** 2, axis=1)
        scores = np.where(np.isfinite(scores), scores, 1e9)
        search.tell(list(zip(asked, scores.tolist(), strict=True)))
        if np.ptp(scores) < END * scores.min():
            break
    return {"values": physical(search.mean)}


PROGRAMS: dict[str, Callable[[Problem], dict[str, Any]]] = {"ours": ours, "sysid": theirs, "cma_es": cma_es}


def main(arguments: Sequence[str]) -> None:
    """FOLDER PROGRAM."""
    folder, program = Path(arguments[0]), arguments[1]
    task = problem(folder, program)
    began = time.perf_counter()
    found = PROGRAMS[program](task)
    seconds = time.perf_counter() - began
    lists = {key: np.asarray(value).tolist() for key, value in found.items()}
    (folder / f"{program}.json").write_text(json.dumps({**lists, "fit_seconds": seconds}))


if __name__ == "__main__":
    main(sys.argv[1:])
