"""Does a policy gain from finding a missing effect? Policies trained on the prior, the base fit and the extended model.

    python experiments/hidden_effect_policy.py [--quick] [--out DIR] [--hide magnetic_catch=12] [--seeds 5]

The synthetic robot hides an effect.  It is recorded in three motions and searched once (`gap`); the verdict, right or
wrong, is used unchanged.  Then policies are trained on draws of the base model's Gaussian, of the extended model's
and of the prior, with all else equal, and tried on the robot that hides the effect.  Where the search names no
effect, nothing is compared.  Every policy is one JSON file under DIR/hidden_effect_cases and is not trained
again; DIR/hidden_effect_policy.json summarises them.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import functools  # noqa: E402
import itertools  # noqa: E402
import json  # noqa: E402

import tyro  # noqa: E402

from benchmarks.common import origin  # noqa: E402
from benchmarks.sharing import claimed, code_name  # noqa: E402
from droid_jax.commands.gap_search import searched  # noqa: E402
from droid_jax.commands.synthetic import hidden_effects, record_synthetic  # noqa: E402
from droid_jax.discrepancy.config import DiscrepancyConfig  # noqa: E402
from droid_jax.discrepancy.log_case import case_of  # noqa: E402
from droid_jax.discrepancy.results import extended  # noqa: E402
from droid_jax.discrepancy.verdict import Conclusion  # noqa: E402
from droid_jax.door.environment import DoorEnv  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_nuisances, door_space  # noqa: E402
from droid_jax.door.task import Task  # noqa: E402
from droid_jax.files import EXTENDED  # noqa: E402
from droid_jax.identify.extended_model import load_extended, save_extended  # noqa: E402
from droid_jax.identify.gaussian import load_gaussian, prior  # noqa: E402
from droid_jax.identify.identifiability import posterior  # noqa: E402
from droid_jax.identify.multistart import RefineConfig  # noqa: E402
from droid_jax.identify.search import CmaConfig  # noqa: E402
from droid_jax.model.effects.registry import library  # noqa: E402
from droid_jax.recordings.split import Split  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from droid_jax.synthetic.hidden_effects import as_applied  # noqa: E402
from droid_jax.synthetic.policy_trials import TransferConfig, check_playable, synthetic_robot  # noqa: E402
from droid_jax.synthetic.robot import synthetic_truth  # noqa: E402
from experiments.policies.cases import TIMESTEP, Case, Options, finish, found_of, made_by, run_all, tried  # noqa: E402
from experiments.policies.store import Doors  # noqa: E402
from experiments.policies.table import better_than, columns, line_of  # noqa: E402

MODELS = ("prior", "base", "extended")
BASE, SETUP = "base.json", "setup.json"
SPRINGS, ROBOT = (
    0,
    21,
)  # the synthetic robot's column of Table I, and the seed of its hidden errors unless --robot is given


@dataclass(frozen=True)
class Arguments(Options):
    """Options of the experiment."""

    hide: tuple[str, ...] = ("magnetic_catch=12",)
    """Effect that the synthetic robot hides, name=amplitude."""
    steps_allowed: int = 512
    """Actions of an episode."""

    @property
    def seed_of_robot(self) -> int:
        """Of the synthetic robot's hidden errors."""
        return ROBOT if self.robot is None else self.robot

    @property
    def task(self) -> Task:
        """Of every policy."""
        return self.budget.task(Task(steps=self.steps_allowed))


def search(arguments: Arguments, folder: Path, code: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict on the robot that hides an effect; base.json and extended.json are in the folder then.

    A stopped search is continued only by the same code.
    """
    with claimed(folder / "verdict.json", wait=True):
        return _searched(arguments, folder, code)


def _searched(arguments: Arguments, folder: Path, code: Mapping[str, Any]) -> dict[str, Any]:
    robot = arguments.seed_of_robot
    asked = {"hide": list(arguments.hide), "springs": SPRINGS, "robot": robot, "quick": arguments.quick}
    known = json.loads((folder / SETUP).read_text()) if (folder / SETUP).is_file() else asked
    if known != asked:
        raise SystemExit(f"error: {folder} is of another robot: {known}, now {asked}; choose another --out")
    write_json(folder / SETUP, asked)
    if (folder / "verdict.json").is_file():
        return json.loads((folder / "verdict.json").read_text())
    scene = door_scene(timestep=TIMESTEP)
    base = door_space(scene) + door_nuisances(scene)
    roles = record_synthetic(scene, hidden_effects(arguments.hide, scene), folder, SPRINGS, robot, again=False)
    config = DiscrepancyConfig()
    if arguments.quick:
        small = RefineConfig(iterations=1, basin_hops=0, spreads=0)
        config = DiscrepancyConfig(
            search=CmaConfig(population=8, parents=None, generations=1),
            refine=small,
            refit=small,
            one_step_fits=1,
            full_refits=1,
            max_effects=1,
        )
    checkpoints = folder / "checkpoints" / code_name(code["commit"])
    case = case_of(Split.RECORDINGS, scene, base, library(scene), roles, config)
    case, verdict, handed, _ = searched(Split.RECORDINGS, case, roles, checkpoints)
    posterior(verdict.base.refined, case.train.cost.comparisons).save(folder / BASE)
    save_extended(folder, extended(case, handed))
    if verdict.conclusion is Conclusion.UNCONVERGED and not arguments.quick:  # no verdict: nothing is kept of it
        raise SystemExit(f"error: {verdict.sentence}")
    found = {
        "hidden": list(arguments.hide),
        "verdict": verdict.conclusion.value,
        "sentence": verdict.sentence,
        "effects": list(map(str, verdict.effects)),
        "searched_by": dict(code),
    }
    write_json(folder / "verdict.json", found)
    return found


def playable(arguments: Arguments) -> None:
    """Ends the program, before the search of hours, where no policy can be tried with the hidden effect."""
    scene = door_scene()
    try:
        check_playable(scene, as_applied(hidden_effects(arguments.hide, scene)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None


def case(model: str, seed: int, folder: Path, arguments: Arguments, code: Mapping[str, Any]) -> dict[str, Any]:
    """One policy, trained on the prior or on one of the two models that the search wrote to the folder.

    All three are over the parameters and nuisances of the search, the extended model's over its effects too.
    """
    budget, robot = arguments.budget, arguments.seed_of_robot
    scene, task = door_scene(timestep=TIMESTEP, limits=True), arguments.task
    if model != "extended":
        env = DoorEnv(scene, task)
        space = door_space(env.scene) + door_nuisances(env.scene)
        gaussian = load_gaussian(folder / BASE) if model == "base" else prior(space)
    else:
        known = load_extended(folder / EXTENDED, scene)
        env, gaussian = DoorEnv(known.scene, task, known.effects), known.gaussian
    hidden, config = as_applied(hidden_effects(arguments.hide, scene)), TransferConfig(trials=budget.trials, seed=robot)
    truth = synthetic_truth(door_scene(), SPRINGS, robot)
    robots = {"synthetic_robot": synthetic_robot(door_scene(limits=True), env.start, truth, hidden, task, config)}
    return tried(arguments, env, Doors(gaussian), robots, seed, code)


def planned_case(model: str, seed: int, arguments: Arguments, code: Mapping[str, Any]) -> Case:
    """A policy of a model, and the content that its file must have."""
    folder = arguments.cases("hidden_effect")
    of = {
        "model": model,
        "seed": seed,
        "hide": list(arguments.hide),
        "robot": arguments.seed_of_robot,
        "task": asdict(arguments.task),
        "budget": arguments.budget.to_json(),
    }
    make = functools.partial(case, model, seed, folder, arguments, code)
    return Case(folder / f"{model}_{seed}.json", make, of, model)


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    playable(arguments)
    every = itertools.product(arguments.policies, MODELS)
    planned = [planned_case(model, seed, arguments, code) for seed, model in every]
    found_of(planned)  # ends here, and not after the search, where they were made with something else
    verdict = search(arguments, arguments.cases("hidden_effect"), code)
    if verdict["effects"] or arguments.quick:  # quick: a search this short seldom names one, and policies shall run too
        failed = run_all(planned, arguments.at_most, code)
    else:
        print(f"{verdict['sentence']} Both models are the same, and no policy is trained.", file=sys.stderr)
        failed, planned = [], []
    found = found_of(planned)
    of = {model: [c for c in found if c["model"] == model] for model in MODELS}
    table, better = columns(of), better_than("extended", ("base", "prior"), of)
    summary = {**verdict, "models": table, "extended_better_than": better, **made_by(found), **code}
    write_json(arguments.summary("hidden_effect_policy"), summary)
    print(json.dumps(line_of(table)))
    finish(failed)


if __name__ == "__main__":
    main()
