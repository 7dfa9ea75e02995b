"""Options of an experiment with policies, and one of its policies: trained, tried in simulation and on the robot."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from benchmarks.common import origin
from droid_jax.policy.door_env import DoorEnv
from droid_jax.policy.network import save_policy
from droid_jax.policy.randomise import Randomise
from droid_jax.policy.simulated import simulated
from droid_jax.policy.task import Task
from droid_jax.policy.train import PRESETS, TrainConfig, train
from droid_jax.policy.transfer import StandIn, transfer
from droid_jax.storage import write_json

TIMESTEP = 0.004  # s, of the simulation that trains
QUICK_STEPS = 20  # actions of an episode where nothing shall be learned
RESULTS = Path(__file__).resolve().parents[1] / "results"


@dataclass(frozen=True)
class Options:
    """What every experiment with policies can be told."""

    quick: bool = False
    """One small policy of each kind: shows that it runs, says nothing about quality."""
    out: Path = RESULTS
    """Folder of the summary and of the cases."""
    seeds: int = 5
    """Policies of each kind."""
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

    @property
    def policies(self) -> range:
        """Seeds of the policies."""
        return range(self.first, self.first + (1 if self.quick else self.seeds))

    @property
    def budget(self) -> Budget:
        """What a policy costs."""
        config = PRESETS[self.preset] if self.steps is None else replace(PRESETS[self.preset], steps=self.steps)
        if not self.quick:
            return Budget(config, self.trials)
        small = replace(config, steps=8192, envs=64, batch=16, minibatches=4, evaluations=2, eval_envs=8)
        return Budget(small, 2, True)

    def cases(self, name: str) -> Path:
        """Folder of the cases."""
        return self.out / f"{name}_cases{'_quick' if self.quick else ''}"

    def summary(self, name: str) -> Path:
        """File of the summary."""
        return self.out / f"{name}{'_quick' if self.quick else ''}.json"


@dataclass(frozen=True)
class Budget:
    """How much a policy costs.  trials: on the stand-in robot, and episodes in simulation."""

    config: TrainConfig
    trials: int
    quick: bool = False

    def to_json(self) -> dict[str, Any]:
        """As plain data; the seed is each policy's own."""
        config = asdict(replace(self.config, seed=0))
        return {**json.loads(json.dumps(config)), "trials": self.trials}

    def task(self, task: Task) -> Task:
        """The task, in short where nothing shall be learned."""
        return replace(task, steps=QUICK_STEPS) if self.quick else task


def tried(
    place: Path, env: DoorEnv, randomise: Randomise, robot: StandIn, seed: int, budget: Budget, origin_of: str
) -> dict[str, Any]:
    """Train with checkpoints in a folder, and try: the figures of one policy.

    origin_of: what the doors that it is trained on are made of, in words; checkpoints of others are refused.
    """
    config = replace(budget.config, seed=seed)
    found = train(env, randomise, config, checkpoints=place / "checkpoints", fingerprint={"doors": origin_of})
    save_policy(place / "policy.npz", found.policy)
    return {
        "seed": seed,
        "budget": budget.to_json(),
        "simulation": simulated(found.policy, env, randomise, budget.trials, seed).to_json(),
        "stand_in": transfer(found.policy, robot).to_json(),
        "history": [asdict(now) for now in found.history],
        **origin(seed),
    }


def run_all(cases: Mapping[Path, Callable[[], dict[str, Any]]], budget: Budget, at_most: int) -> list[dict[str, Any]]:
    """Run what has no file yet, write it, and say what came of it; all of these cases that there are.

    Raises ValueError for a file that was made with another budget.
    """
    for path, make in [(p, m) for p, m in cases.items() if not p.is_file()][:at_most]:
        result = make()
        write_json(path, result)
        rates = {where: result[where]["success_rate"] for where in ("simulation", "stand_in")}
        print(f"{path.parent.name}/{path.stem}: {rates}", flush=True)
    found = {path: json.loads(path.read_text()) for path in cases if path.is_file()}
    for path, result in found.items():
        if result["budget"] != budget.to_json():
            raise ValueError(f"{path} was made with another budget: {result['budget']}; choose another --out")
    return list(found.values())
