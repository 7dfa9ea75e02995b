"""One policy of an experiment: trained, and tried in simulation and on the stand-in robot."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.common import origin
from droid_jax.policy.door_env import DoorEnv
from droid_jax.policy.network import save_policy
from droid_jax.policy.randomise import Randomise
from droid_jax.policy.simulated import simulated
from droid_jax.policy.train import PRESETS, TrainConfig, train
from droid_jax.policy.transfer import StandIn, transfer
from droid_jax.storage import write_json

TIMESTEP = 0.004  # s, of the simulation that trains
QUICK_STEPS = 20  # actions of an episode where nothing shall be learned


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

    @classmethod
    def of(cls, preset: str, steps: int | None, trials: int, quick: bool) -> Budget:
        """From an experiment's options."""
        config = PRESETS[preset] if steps is None else replace(PRESETS[preset], steps=steps)
        if not quick:
            return cls(config, trials)
        small = replace(config, steps=8192, envs=64, batch=16, minibatches=4, evaluations=2, eval_envs=8)
        return cls(small, 2, True)


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
