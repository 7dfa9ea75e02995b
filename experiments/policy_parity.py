"""Do policies open the door as far in plain C MuJoCo as in the simulation that trained them?

    python experiments/policy_parity.py [--policies runs/train/policy.npz ...] [--quick] [--out DIR]

Each policy is run without noise on doors drawn from the Gaussian beside it (gaussian.json, without effects), on which
it was trained (a policy of the method "mean": on its mean).  Each door is simulated once in MJX with the training's
time step and once in C at 1 ms with a converged solver.  Start pose and physics are the same, so that only the
simulation differs.  The target is a difference of the largest opening angle below 3 degrees on every door.  Writes
DIR/policy_parity.json and .png, with the hashes of policy and distribution.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from benchmarks.common import origin, stem  # noqa: E402
from droid_jax.door.environment import DoorEnv  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_nuisances, door_space  # noqa: E402
from droid_jax.door.task import Task  # noqa: E402
from droid_jax.files import GAUSSIAN  # noqa: E402
from droid_jax.identify.gaussian import (  # noqa: E402
    Gaussian,
    load_gaussian,
    prior,
)
from droid_jax.policy.control import Policy, load_policy  # noqa: E402
from droid_jax.policy.evaluate import simulated  # noqa: E402
from droid_jax.policy.randomise import axes, physics_of, randomised  # noqa: E402
from droid_jax.policy.train import train  # noqa: E402
from droid_jax.policy.trials import Trials  # noqa: E402
from droid_jax.report.style import (  # noqa: E402
    AFTER,
    INK,
    png_bytes,
    styled,
)
from droid_jax.storage import file_sha256, write_bytes, write_json  # noqa: E402
from droid_jax.synthetic.policy_trials import TransferConfig, synthetic_robot, transfer  # noqa: E402
from experiments.policies.cases import QUICK_STEPS, RESULTS, TIMESTEP, Options  # noqa: E402

WITHIN = 3.0  # degrees
EXACT = TransferConfig(trials=1, timestep=0.001, position_noise=0.0, velocity_noise=0.0, knob_noise=0.0)


@dataclass(frozen=True)
class Arguments:
    """Options."""

    policies: tuple[Path, ...] = (ROOT / "runs" / "train" / "policy.npz",)
    """Policies of `train` or of an experiment, each with its distribution beside it."""
    quick: bool = False
    """An untrained policy on two doors: shows that it runs."""
    out: Path = RESULTS
    """Folder of the results."""
    doors: int = 50
    """Doors of each policy, one episode each."""
    seed: int = 0
    """Seed of the first policy's doors; each further policy has the next seed, so that no door is counted twice."""


def trained(policy: Path, gaussian: Path) -> tuple[Policy, DoorEnv, Gaussian]:
    """Policy, environment without spread of the start pose, and distribution."""
    scene, drawn = door_scene(timestep=TIMESTEP, limits=True), load_gaussian(gaussian)
    known = door_space(scene) + door_nuisances(scene)
    strange = [n for n in drawn.space.names if n not in known.names]
    if strange:
        raise SystemExit(f"error: {gaussian} has effects that plain C MuJoCo does not have: {', '.join(strange)}")
    return load_policy(policy), DoorEnv(scene, Task(spread=0.0)), drawn


def untrained() -> tuple[Policy, DoorEnv, Gaussian]:
    """The same for a training without updates."""
    scene = door_scene(timestep=TIMESTEP, limits=True)
    env, gaussian = DoorEnv(scene, Task(steps=QUICK_STEPS, spread=0.0)), prior(door_space(scene))
    return train(env, randomised(scene, gaussian), Options(quick=True).budget.config).policy, env, gaussian


def named(path: Path) -> dict[str, str]:
    """Path of a file in the project (elsewhere its name alone) and its hash."""
    own = path.resolve()
    where = own.relative_to(ROOT).as_posix() if own.is_relative_to(ROOT) else own.name
    return {"file": where, "sha256": file_sha256(own)}


def in_mjx(policy: Policy, env: DoorEnv, gaussian: Gaussian, values: np.ndarray) -> Trials:
    """An episode on each door [N, D]."""
    space = gaussian.space
    return simulated(
        policy, env, lambda sys, rng: (physics_of(env.scene, space, values), axes(env.scene, space)), len(values)
    )


def in_c(policy: Policy, env: DoorEnv, gaussian: Gaussian, values: np.ndarray) -> Trials:
    """The same in plain C, door by door."""
    rows = [dict(zip(gaussian.space.names, row.tolist(), strict=True)) for row in values]
    made = [transfer(policy, synthetic_robot(env.scene, env.start, truth, (), env.task, EXACT)) for truth in rows]
    return Trials(
        *(np.concatenate([getattr(t, f) for t in made]) for f in ("success", "angle", "steps", "grip", "stopped"))
    )


@styled
def scatter(angles: Sequence[Mapping[str, np.ndarray]]) -> Figure:
    """Largest angles [N] in degrees in either engine, one against the other, with the band of the target."""
    figure = Figure(figsize=(3.6, 3.4), layout="constrained")
    axes_ = figure.add_subplot()
    mjx, c = (np.concatenate([a[engine] for a in angles]) for engine in ("mjx", "c"))
    line = np.array([0.0, 1.05 * max(mjx.max(), c.max())])
    axes_.fill_between(line, line - WITHIN, line + WITHIN, color=INK, alpha=0.12, linewidth=0)
    axes_.plot(mjx, c, "o", color=AFTER, ms=4, alpha=0.4, markeredgewidth=0)
    axes_.set(xlabel="MJX, 4 ms [degrees]", ylabel="C, 1 ms [degrees]", xlim=line, ylim=line, aspect="equal")
    return figure


def compared(policy: Policy, env: DoorEnv, gaussian: Gaussian, doors: int, seed: int) -> dict[str, Any]:
    """Opening angles of a policy on each of some doors in either engine, and their difference."""
    values = gaussian.sample(seed, doors)
    both = {"mjx": in_mjx(policy, env, gaussian, values), "c": in_c(policy, env, gaussian, values)}
    angle = {name: np.rad2deg(trials.angle) for name, trials in both.items()}
    apart = np.abs(angle["mjx"] - angle["c"])
    whole = (both["mjx"].stopped == "") & (both["c"].stopped == "")
    return {
        "doors": doors,
        "seed": seed,
        "difference_deg": {
            "median": float(np.median(apart)),
            "quantile_90": float(np.quantile(apart, 0.9)),
            "largest": float(apart.max()),
            "within_target": float(np.mean(apart <= WITHIN)),
        },
        "neither_stopped": int(whole.sum()),
        "median_of_these_deg": float(np.median(apart[whole])) if whole.any() else None,
        "mean_angle_deg": {name: float(a.mean()) for name, a in angle.items()},
        "success_rate": {name: trials.rate for name, trials in both.items()},
        "stopped": {name: trials.to_json()["stopped"] for name, trials in both.items()},  # C runs the robot's own loop
        "angles_deg": {n: a.round(3).tolist() for n, a in angle.items()},
    }


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    results: list[dict[str, Any]] = []
    if arguments.quick:
        results.append({"policy": "untrained", "gaussian": "prior", **compared(*untrained(), 2, arguments.seed)})
    for number, policy in enumerate(() if arguments.quick else arguments.policies):
        beside = policy.with_name(GAUSSIAN)
        of = {"policy": named(policy), "gaussian": named(beside)}
        results.append({**of, **compared(*trained(policy, beside), arguments.doors, arguments.seed + number)})
    name = stem("policy_parity", arguments.quick)
    every = [r["difference_deg"] for r in results]
    worst = {"largest_deg": max(d["largest"] for d in every), "within_target": min(d["within_target"] for d in every)}
    write_json(arguments.out / f"{name}.json", {**worst, "policies": results, **code, "seed": arguments.seed})
    angles = [{engine: np.array(a) for engine, a in r["angles_deg"].items()} for r in results]
    write_bytes(arguments.out / f"{name}.png", png_bytes(scatter(angles)))
    print(json.dumps({**worst, "policies": [{k: v for k, v in r.items() if k != "angles_deg"} for r in results]}))


if __name__ == "__main__":
    main()
