"""Speed of policy training on this machine: actions and simulation steps per second, time to 95 % success.

    python benchmarks/training.py [--quick] [--out DIR] [--preset quick] [--seed 0]

One policy on doors drawn from the prior, on all devices, from an empty compilation cache; then it is tried in the
simulation and on the synthetic robot (Table I's door without a spring).  Writes DIR/training.json by preset
and device; other entries of the file are kept.  The policy and the Gaussian of its doors are written to
DIR/training_policy/PRESET (PRESET_gpu on a GPU), for experiments/policy_parity.py.
"""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

from droid_jax import runtime  # noqa: E402

CACHE = tempfile.TemporaryDirectory()
os.environ[runtime.CACHE_VARIABLE] = CACHE.name  # compilation counts

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402
import time  # noqa: E402
from dataclasses import asdict, replace  # noqa: E402

import jax  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import origin, stem  # noqa: E402
from droid_jax.door.environment import DoorEnv  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_nuisances, door_space  # noqa: E402
from droid_jax.door.task import Task  # noqa: E402
from droid_jax.files import GAUSSIAN, POLICY  # noqa: E402
from droid_jax.identify.gaussian import prior  # noqa: E402
from droid_jax.policy.evaluate import simulated  # noqa: E402
from droid_jax.policy.network import save_policy  # noqa: E402
from droid_jax.policy.randomise import randomised  # noqa: E402
from droid_jax.policy.train import PRESETS, TrainProgress, train  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from droid_jax.synthetic.policy_trials import TransferConfig, synthetic_robot, transfer  # noqa: E402
from droid_jax.synthetic.robot import synthetic_truth  # noqa: E402
from experiments.policies.cases import TIMESTEP, Options  # noqa: E402

ENOUGH = 0.95  # success in the evaluations during training
TRUTH = (0, 0)  # springs and seed of the synthetic robot


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """A few actions: shows that it runs; its numbers mean nothing."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of training.json."""
    preset: Literal["quick", "paper", "gpu"] = "quick"
    """Preset of the training."""
    seed: int = 0
    """Seed of the policy."""
    trials: int = 100
    """Episodes in simulation, and trials on the synthetic robot."""


def measured(arguments: Arguments) -> dict[str, Any]:
    """One training and its results; the policy is saved."""
    often = PRESETS[arguments.preset].evaluations  # the preset as it is
    asked = Options(quick=arguments.quick, preset=arguments.preset, trials=arguments.trials, evaluations=often)
    budget = asked.budget
    scene = door_scene(timestep=TIMESTEP, limits=True)
    began = time.perf_counter()
    env = DoorEnv(scene, budget.task(Task()))
    gaussian, config = prior(door_space(scene) + door_nuisances(scene)), replace(budget.config, seed=arguments.seed)
    doors = randomised(scene, gaussian)
    found = train(env, doors, config, progress=_tell)
    seconds = time.perf_counter() - began
    platform = jax.default_backend()
    place = arguments.preset if platform == "cpu" else f"{arguments.preset}_{platform}"  # as its figures: apart
    left = arguments.out / stem("training_policy", arguments.quick) / place
    save_policy(left / POLICY, found.policy)
    gaussian.save(left / GAUSSIAN)
    physics = round(env.task.control / TIMESTEP)  # steps of the simulation in an action
    # Evaluations included, which brax's own rate leaves out; the first part compiles.
    rates = [now.rate for now in found.history[2:]] or [found.history[-1].rate]
    reached = [now for now in found.history if now.success >= ENOUGH]
    robot = synthetic_robot(
        door_scene(limits=True), env.start, synthetic_truth(door_scene(), *TRUTH), (), env.task,
        TransferConfig(trials=budget.trials),
    )  # fmt: skip
    return {
        "seconds": seconds,
        "actions_per_s": sum(rates) / len(rates),
        "steps_per_s": physics * sum(rates) / len(rates),
        "seconds_to_95": reached[0].seconds if reached else None,
        "actions_to_95": reached[0].step if reached else None,
        "simulation": simulated(found.policy, env, doors, budget.trials, arguments.seed).to_json(),
        "synthetic_robot": transfer(found.policy, robot).to_json(),
        "history": [asdict(now) for now in found.history],
        "config": asdict(config),
    }


def _tell(now: TrainProgress) -> None:
    print(f"{now.step} of {now.of} actions, {now.seconds:.0f} s: success {now.success:.0%}", flush=True)


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    code = origin(arguments.seed)
    result = {**measured(arguments), **code}
    path = arguments.out / f"{stem('training', arguments.quick)}.json"
    known = json.loads(path.read_text()) if path.is_file() else {}
    write_json(path, {**known, f"{arguments.preset}, {code['device']}": result})
    rates = {where: result[where]["success_rate"] for where in ("simulation", "synthetic_robot")}
    figures = {name: result[name] for name in ("seconds", "actions_per_s", "steps_per_s", "seconds_to_95")}
    print(json.dumps({**figures, **rates, "devices": jax.local_device_count()}))


if __name__ == "__main__":
    main()
