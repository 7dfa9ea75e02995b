"""Options of an experiment with policies, and one of its policies: trained, tried in simulation and on the robot."""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
from matplotlib.figure import Figure

from benchmarks.common import commits, stem
from benchmarks.sharing import claimed
from droid_jax.commands.source import TIMESTEP as TIMESTEP
from droid_jax.door.environment import DoorEnv
from droid_jax.door.task import Task
from droid_jax.files import POLICY
from droid_jax.policy.control import load_policy
from droid_jax.policy.evaluate import simulated
from droid_jax.policy.randomise import of_method
from droid_jax.policy.train import PRESETS, TrainConfig
from droid_jax.policy.trials import LEARNED
from droid_jax.report.style import save
from droid_jax.storage import write_json
from droid_jax.synthetic.policy_trials import PolicyRobot, transfer
from experiments.policies.store import Doors, sha256, trained
from experiments.policies.table import PLACES

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
    robot: int | None = None
    """Seed of the synthetic robot's hidden errors and of its trials; default: the setting's. Pilots use another."""
    trials: int = 100
    """Trials of each policy on the synthetic robot, and episodes in simulation."""
    steps: int | None = None
    """Actions of each training; default: the preset's."""
    preset: Literal["quick", "paper", "gpu"] = "quick"
    """Of training."""
    again: int = 0
    """Times that a training that has not learned to open (95 % in one of its evaluations) is made anew, with twice the
    actions of the one before."""
    evaluations: int = 8
    """Times that a policy is tried while it trains; 16 would cost a quarter of the training's own actions."""
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
        preset = replace(PRESETS[self.preset], evaluations=self.evaluations, held=0)  # all cost alike
        config = preset if self.steps is None else replace(preset, steps=self.steps)
        if not self.quick:
            return Budget(config, self.trials, self.again)
        small = replace(config, steps=8192, envs=64, batch=16, minibatches=4, evaluations=2, eval_envs=8)
        return Budget(small, 2, self.again, quick=True)

    def cases(self, name: str) -> Path:
        """Folder of the cases; those of another robot have a name of their own."""
        return self.out / stem(f"{name}{self._of_robot}_cases", self.quick)

    @property
    def trained(self) -> Path:
        """Folder of the policies, which experiments share: one that two of them need is trained once."""
        return self.out / stem("trained_cases", self.quick)

    def summary(self, name: str, kind: str = ".json") -> Path:
        """File of the summary; that of pilots has a name of its own."""
        pilot = f"_from_{self.first}" if self.first else ""
        return self.out / f"{stem(f'{name}{self._of_robot}{pilot}', self.quick)}{kind}"

    def draw(self, name: str, figure: Figure) -> None:
        """Write the figure that belongs to a summary, as PNG and PDF."""
        path = self.summary(name, "")
        save(figure, path.parent, path.name)

    @property
    def _of_robot(self) -> str:
        return "" if self.robot is None else f"_robot_{self.robot}"


@dataclass(frozen=True)
class Budget:
    """How much a policy costs.  trials: on the synthetic robot, and episodes in simulation; again: see `Options`."""

    config: TrainConfig
    trials: int
    again: int = 0
    quick: bool = False

    def to_json(self) -> dict[str, Any]:
        """As plain data; the seed is each policy's own."""
        config = json.loads(json.dumps(asdict(replace(self.config, seed=0))))
        return {**config, "trials": self.trials, **({"again": self.again} if self.again else {})}

    def task(self, task: Task) -> Task:
        """The task, in short where nothing shall be learned."""
        return replace(task, steps=QUICK_STEPS) if self.quick else task


def tried(
    arguments: Options,
    env: DoorEnv,
    doors: Doors,
    robots: Mapping[str, PolicyRobot],
    seed: int,
    code: Mapping[str, Any],
) -> dict[str, Any]:
    """Train (where no experiment has done so), and try in simulation and on robots by name: a policy's figures."""
    budget = arguments.budget
    place, made = learned(budget, seed, lambda config: trained(arguments.trained, env, doors, config, code))
    policy, drawn = load_policy(place / POLICY), of_method(doors.method, env.scene, doors.gaussian)
    return {
        "doors_sha256": sha256(json.dumps(doors.gaussian.to_json())),
        "simulation": simulated(policy, env, drawn, budget.trials, seed).to_json(),
        **{name: transfer(policy, robot).to_json() for name, robot in robots.items()},
        **made,
    }


def learned(
    budget: Budget, seed: int, training: Callable[[TrainConfig], tuple[Path, dict[str, Any]]]
) -> tuple[Path, dict[str, Any]]:
    """What a training comes to; one that has not learned is made anew with twice the actions (`Options.again`)."""
    place, made = training(config := replace(budget.config, seed=seed))
    for _ in range(budget.again):
        if max(now["success"] for now in made["history"]) >= LEARNED:
            break
        place, made = training(config := replace(config, steps=2 * config.steps))
    return place, made


class Case(NamedTuple):
    """A policy's file, what makes its content, and what the file must say of it to count as done (plain data).

    doors: name of the distribution of the doors that it is trained on; cases of one name must come from one fit.
    """

    path: Path
    make: Callable[[], dict[str, Any]]
    of: Mapping[str, Any]
    doors: str


def run_all(cases: Sequence[Case], at_most: int, code: Mapping[str, Any]) -> list[str]:
    """Make what has no file yet, and say what came of it; returns the names of those that failed, which hold up none.

    Processes that run the same command share the cases: each takes those that no other is making.
    code: `origin` when the program started: what it imported then made all cases, whatever was committed since.
    Ends the program, before anything is made, where a file is there that was made with something else.
    """
    found_of(cases)
    failed = list[str]()
    for case in cases:
        if case.path.is_file():
            continue
        if not at_most:
            break
        with claimed(case.path, wait=False) as mine:
            if mine and not case.path.is_file():  # which another process may have made meanwhile
                at_most -= 1
                failed += _make(case, code)
    return failed


def _make(case: Case, code: Mapping[str, Any]) -> list[str]:
    """Write a case's file; its name where that failed."""
    name = f"{case.path.parent.name}/{case.path.stem}"
    try:
        result = case.make()
    except Exception:
        print(f"{name} failed:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
        return [name]
    else:
        write_json(case.path, {**case.of, **result, "origin": dict(code)})
        print(f"{name}: { {where: result[where]['success_rate'] for where in PLACES} }", flush=True)
        return []
    finally:
        jax.clear_caches()  # no other case uses these programs, and what takes long to compile is kept on disk


def made_by(found: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """The commits that tried the policies, and those that trained them, which may have been another experiment's."""
    return {
        "cases_from_commits": commits(found),
        "policies_from_commits": commits([{"origin": case["trained_by"]} for case in found]),
    }


def finish(failed: Sequence[str]) -> None:
    """Ends the program with an error where cases failed."""
    if failed:
        raise SystemExit(f"error: {len(failed)} failed and can be tried again: {', '.join(failed)}")


def found_of(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Those of these cases that there are.  Ends the program where they do not go together."""
    found, fits = [], dict[str, tuple[str, Path]]()
    for path, _, of, doors in cases:
        if not path.is_file():
            continue
        known = json.loads(path.read_text())
        for name, value in json.loads(json.dumps(of)).items():
            if known.get(name) != value:
                raise SystemExit(
                    f"error: {path} was made with another {name}: {known.get(name)}, now {value}; choose another --out"
                )
        fit, first = fits.setdefault(doors, (known["doors_sha256"], path))
        if known["doors_sha256"] != fit:
            raise SystemExit(
                f"error: {path} and {first} were trained on different fits; remove one, or choose another --out"
            )
        found.append(known)
    return found
