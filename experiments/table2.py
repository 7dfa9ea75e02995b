"""Table II of the paper: three ways to choose the doors that a policy is trained on, judged on a robot it never saw.

    python experiments/table2.py [--quick] [--out DIR] [--settings paper hard] [--seeds 5] [--trials 100]

For each setting: the stand-in robot is recorded and fitted once; then policies are trained on draws of the prior, on
the fitted mean alone and on draws of the fitted Gaussian, alike in everything else, and tried in simulation and on the
stand-in robot.  Every policy is one JSON file under DIR/table2_cases and is not trained again: the experiment can be
stopped and goes on where it was.  DIR/table2.json sums them up, with intervals by bootstrap over policies;
DIR/table2.png has the histograms.  docs/paper.md says what was fixed before the runs.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import tyro  # noqa: E402

from benchmarks.common import origin  # noqa: E402
from droid_jax.identify.gaussian import Gaussian, prior  # noqa: E402
from droid_jax.identify.gaussian import load as load_gaussian  # noqa: E402
from droid_jax.identify.pipeline import IdentifyConfig, identify  # noqa: E402
from droid_jax.identify.refine import RefineConfig  # noqa: E402
from droid_jax.identify.search import SearchConfig  # noqa: E402
from droid_jax.measure.demonstration import demonstration_path  # noqa: E402
from droid_jax.measure.formats import load  # noqa: E402
from droid_jax.measure.surrogate import record, stand_in_truth  # noqa: E402
from droid_jax.model.door import door_nuisances, door_space  # noqa: E402
from droid_jax.model.door_scene import door_scene  # noqa: E402
from droid_jax.policy.door_env import DoorEnv  # noqa: E402
from droid_jax.policy.network import save_policy  # noqa: E402
from droid_jax.policy.randomise import Randomise, fixed, randomised  # noqa: E402
from droid_jax.policy.simulated import simulated  # noqa: E402
from droid_jax.policy.task import Task  # noqa: E402
from droid_jax.policy.train import PRESETS, TrainConfig, train  # noqa: E402
from droid_jax.policy.transfer import TransferConfig, stand_in, transfer  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.policies.settings import SETTINGS, Setting  # noqa: E402
from experiments.policies.table import summed_up  # noqa: E402

METHODS = ("prior", "mean", "fitted")
TIMESTEP = 0.004  # s
Method = Literal["prior", "mean", "fitted"]


@dataclass(frozen=True)
class Arguments:
    """Options of the experiment."""

    quick: bool = False
    """One small policy of each method: shows that it runs, says nothing about quality."""
    out: Path = ROOT / "experiments" / "results"
    """Folder of table2.json and of the cases."""
    settings: tuple[str, ...] = ("paper", "hard")
    """Which doors."""
    methods: tuple[Method, ...] = METHODS
    """Which methods."""
    seeds: int = 5
    """Policies of each method."""
    first: int = 0
    """Seed of the first policy: pilots use others than the runs that are reported."""
    trials: int = 100
    """Trials of each policy on the stand-in robot, and episodes in simulation."""
    steps: int | None = None
    """Actions of each training; default: the preset's."""
    preset: Literal["quick", "paper", "gpu"] = "quick"
    """Of training."""
    at_most: int = 1_000_000
    """Stop after so many policies."""


def fitted(setting: Setting, folder: Path, quick: bool) -> Gaussian:
    """What identification makes of the setting's robot; kept in the folder."""
    path = folder / "gaussian.json"
    if not path.is_file():
        scene = door_scene(timestep=TIMESTEP)
        truth = truth_of(setting)
        recordings = [
            record(scene, load(demonstration_path(name)), truth, seed=setting.robot + k, name=name)
            for k, name in enumerate("A" if quick else "AC")
        ]
        config = IdentifyConfig(
            search=SearchConfig(population=30, parents=None, generations=3 if quick else 20, seed=setting.robot),
            refine=RefineConfig(iterations=2 if quick else 30),
            seed=setting.robot,
        )
        found = identify(scene, door_space(scene), recordings, nuisances=door_nuisances(scene), config=config)
        found.gaussian.save(path)
    return load_gaussian(path)


def truth_of(setting: Setting) -> dict[str, float]:
    """The stand-in's hidden values."""
    return {**stand_in_truth(door_scene(), setting.springs, setting.robot), **setting.truth}


def doors(method: Method, setting: Setting, folder: Path, quick: bool, env: DoorEnv) -> Randomise:
    """What a method trains on: the one thing in which methods differ."""
    scene = env.scene
    if method == "prior":
        return randomised(scene, prior(door_space(scene)))
    gaussian = fitted(setting, folder, quick)
    return fixed(scene, gaussian.space, gaussian.physical_mean) if method == "mean" else randomised(scene, gaussian)


def case(
    method: Method, seed: int, setting: Setting, folder: Path, config: TrainConfig, arguments: Arguments
) -> dict[str, Any]:
    """One policy: trained, and tried in the simulation it was trained in and on the stand-in robot."""
    task = Task(**setting.task)
    env = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), replace(task, steps=20) if arguments.quick else task)
    randomise = doors(method, setting, folder, arguments.quick, env)
    place = folder / f"{method}_{seed}"
    found = train(env, randomise, config, checkpoints=place / "checkpoints", fingerprint={"method": method})
    save_policy(place / "policy.npz", found.policy)
    robot = stand_in(
        door_scene(limits=True), env.start, truth_of(setting), (), env.task,
        TransferConfig(trials=arguments.trials, seed=setting.robot),
    )  # fmt: skip
    return {
        "setting": setting.name,
        "method": method,
        "seed": seed,
        "simulation": simulated(found.policy, env, randomise, arguments.trials, seed).to_json(),
        "stand_in": transfer(found.policy, robot).to_json(),
        "history": [asdict(now) for now in found.history],
        **origin(seed),
    }


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    cases = arguments.out / ("table2_cases_quick" if arguments.quick else "table2_cases")
    config, done = PRESETS[arguments.preset], 0
    if arguments.steps is not None:
        config = replace(config, steps=arguments.steps)
    if arguments.quick:
        config = replace(config, steps=8192, envs=64, batch=16, minibatches=4, evaluations=2, eval_envs=8)
        arguments = replace(arguments, seeds=1, trials=2, settings=arguments.settings[:1])
    for name in arguments.settings:
        if name not in SETTINGS:
            raise SystemExit(f"error: unknown setting {name!r}; valid: {', '.join(SETTINGS)}")
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            for method in arguments.methods:
                path = cases / name / f"{method}_{seed}.json"
                if path.is_file() or done >= arguments.at_most:
                    continue
                result = case(method, seed, SETTINGS[name], cases / name, replace(config, seed=seed), arguments)
                write_json(path, result)
                done += 1
                rates = {where: result[where]["success_rate"] for where in ("simulation", "stand_in")}
                print(f"{name}, {method}, seed {seed}: {rates}", flush=True)
    found = [json.loads(path.read_text()) for path in sorted(cases.glob("*/*_*.json"))]
    summary = summed_up(found, {name: SETTINGS[name] for name in arguments.settings})
    write_json(arguments.out / ("table2_quick.json" if arguments.quick else "table2.json"), {**summary, **origin(0)})
    print(json.dumps(summary["line"]))


if __name__ == "__main__":
    main()
