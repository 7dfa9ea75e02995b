"""Options of an experiment with policies, and one of its policies: trained, tried in simulation and on the robot."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from benchmarks.common import origin, stem
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
        if self.seeds < 1:
            raise SystemExit(f"error: --seeds must be 1 or more, got {self.seeds}")
        return range(self.first, self.first + (1 if self.quick else self.seeds))

    @property
    def budget(self) -> Budget:
        """What a policy costs."""
        if self.trials < 1:
            raise SystemExit(f"error: --trials must be 1 or more, got {self.trials}")
        config = PRESETS[self.preset] if self.steps is None else replace(PRESETS[self.preset], steps=self.steps)
        if not self.quick:
            return Budget(config, self.trials)
        small = replace(config, steps=8192, envs=64, batch=16, minibatches=4, evaluations=2, eval_envs=8)
        return Budget(small, 2, True)

    def cases(self, name: str) -> Path:
        """Folder of the cases."""
        return self.out / stem(f"{name}_cases", self.quick)

    def summary(self, name: str, kind: str = ".json") -> Path:
        """File of the summary; that of pilots has a name of its own."""
        pilot = f"_from_{self.first}" if self.first else ""
        return self.out / f"{stem(f'{name}{pilot}', self.quick)}{kind}"


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
    config, code = replace(budget.config, seed=seed), origin(seed)  # of now: hours later the commit may be another
    found = train(env, randomise, config, checkpoints=place / "checkpoints", fingerprint={"doors": origin_of})
    save_policy(place / "policy.npz", found.policy)
    return {
        "doors_sha256": hashlib.sha256(origin_of.encode()).hexdigest(),
        "simulation": simulated(found.policy, env, randomise, budget.trials, seed).to_json(),
        "stand_in": transfer(found.policy, robot).to_json(),
        "history": [asdict(now) for now in found.history],
        **code,
    }


class Case(NamedTuple):
    """A policy's file, what makes its content, and what the file must say of it to count as done (plain data)."""

    path: Path
    make: Callable[[], dict[str, Any]]
    of: Mapping[str, Any]


def run_all(cases: Sequence[Case], at_most: int) -> None:
    """Make what has no file yet, and say what came of it.

    Ends the program, before anything is made, where a file is there that was made with something else.
    """
    found_of(cases)
    for case in [c for c in cases if not c.path.is_file()][:at_most]:
        result = case.make()
        write_json(case.path, {**case.of, **result})
        rates = {where: result[where]["success_rate"] for where in ("simulation", "stand_in")}
        print(f"{case.path.parent.name}/{case.path.stem}: {rates}", flush=True)


def found_of(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Those of these cases that there are."""
    found = []
    for path, _, of in cases:
        if not path.is_file():
            continue
        known = json.loads(path.read_text())
        for name, value in json.loads(json.dumps(of)).items():
            if known.get(name) != value:
                raise SystemExit(
                    f"error: {path} was made with another {name}: {known.get(name)}, now {value}; choose another --out"
                )
        found.append(known)
    return found
