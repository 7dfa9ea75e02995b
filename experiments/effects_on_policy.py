"""Which missing effects impair a policy?  One policy trained without effects, on robots that hide one effect each.

    python experiments/effects_on_policy.py [--quick] [--out DIR] [--springs 0] [--trials 12]
    python experiments/effects_on_policy.py --policy runs/train/policy.npz --hide closer=2 payload=0.5 --out runs/felt

A policy is trained on draws of the prior, unless one is given.  Then the synthetic robot hides each effect of the blind
suite in turn, at its largest usual amplitude and at three times that, and the policy is tried on it.  The experiment
also checks whether the demonstration keeps its grasp on that robot, since a search needs its recording.  This is a
pilot: its robot and seeds differ from those of the reported runs.  The effect of hidden_effect_policy.py was chosen
with it.  DIR/effects_on_policy_robot_100_from_100.json is the table.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import functools  # noqa: E402
import json  # noqa: E402

import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.progress import track  # noqa: E402

from benchmarks.common import origin  # noqa: E402
from benchmarks.sharing import claimed  # noqa: E402
from droid_jax.commands.synthetic import hidden_effects  # noqa: E402
from droid_jax.door.demonstration import demonstration_path  # noqa: E402
from droid_jax.door.environment import DoorEnv  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.task import Task  # noqa: E402
from droid_jax.files import POLICY  # noqa: E402
from droid_jax.model.scene import Scene  # noqa: E402
from droid_jax.policy.control import Policy, load_policy  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.storage import file_sha256, write_json  # noqa: E402
from droid_jax.synthetic.hidden_effects import HIDDEN, LONGEST_STEP, Applied, as_applied, possible, record_hidden  # noqa: E402
from droid_jax.synthetic.policy_trials import TransferConfig, check_playable, synthetic_robot, transfer  # noqa: E402
from droid_jax.synthetic.robot import SyntheticRobotConfig  # noqa: E402
from experiments.policies.cases import RESULTS, TIMESTEP, Case, Options, finish, run_all  # noqa: E402
from experiments.policies.robots import truth_of  # noqa: E402
from experiments.policies.settings import Setting, setting_of  # noqa: E402
from experiments.policies.table import column  # noqa: E402
from experiments.table2 import case as policy_case  # noqa: E402

FACTORS = (1.0, 3.0)  # of the largest amplitude that is usual
PILOT = 100  # seed of the policy, and of the robot's hidden errors


@dataclass(frozen=True)
class Arguments(Options):
    """Options of the experiment."""

    springs: int = 0
    """The synthetic robot's column of Table I."""
    policy: Path | None = None
    """A policy.npz of any run, instead of training one."""
    hide: tuple[str, ...] = ()
    """name=amplitude or name[joint]=amplitude; default: every effect that a policy can be tried with."""
    first: int = PILOT
    """Seed of the policy."""
    robot: int | None = PILOT
    """Seed of the synthetic robot's hidden errors and of its trials."""
    trials: int = 12
    """Trials with each effect."""


def applicable(scene: Scene, arguments: Arguments) -> list[Applied]:
    """The effects asked for, or all that a policy can be tried with, also on the hinge where possible."""
    if arguments.hide:
        return [one for entry in arguments.hide for one in as_applied(hidden_effects([entry], scene))]
    found = []
    for name in possible(scene):
        try:
            check_playable(scene, [Applied(name, HIDDEN[name].typical[1])])
        except ValueError:
            continue  # changes whole traces: nothing a closed loop has
        places = ("", str(scene.object_joint)) if HIDDEN[name].on == "joint" else ("",)
        found += [Applied(name, HIDDEN[name].typical[1] * factor, p) for p in places for factor in FACTORS]
    return found[:2] if arguments.quick else found


def recordable(scene: Scene, setting: Setting, hidden: Sequence[Applied]) -> bool:
    """Whether demonstration A keeps its grasp on a robot with these effects."""
    once, shown = SyntheticRobotConfig(timestep=LONGEST_STEP, repeats=1), load_recording(demonstration_path("A"))
    try:
        record_hidden(scene, shown, truth_of(setting), hidden, seed=setting.robot, config=once)
    except ValueError:
        return False
    return True


def rows(policy: Policy, setting: Setting, task: Task, arguments: Arguments) -> Iterator[dict[str, Any]]:
    """Results of the policy without a hidden effect and with each effect."""
    scene, demonstrated = door_scene(limits=True), door_scene(timestep=TIMESTEP)
    start = DoorEnv(door_scene(timestep=TIMESTEP, limits=True), task).start
    config = TransferConfig(trials=arguments.trials, seed=setting.robot)
    effects: list[Applied | None] = [None, *applicable(scene, arguments)]
    for hidden in track(effects, "effects", console=Console(stderr=True)):
        applied = [hidden] if hidden else []
        robot = synthetic_robot(scene, start, truth_of(setting), applied, task, config)
        found = column(
            [{"synthetic_robot": transfer(policy, robot).to_json(), "seed": setting.robot}], "synthetic_robot"
        )
        yield {
            "hidden": hidden.name if hidden else "nothing",
            "joint": hidden.joint if hidden else "",
            "amplitude": hidden.amplitude if hidden else 0.0,
            "unit": HIDDEN[hidden.name].unit if hidden else "",
            "success_rate": found["success_rate"],
            "interval_95": found["success_interval_95"],
            "blown_up": found["blown_up"],
            "angle_deg": found["angle_deg"]["mean"],
            "grip": found["grip"]["mean"],
            "stopped": found["stopped"],
            "recordable": recordable(demonstrated, setting, applied),
        }


def trained(arguments: Arguments, setting: Setting, code: Mapping[str, Any]) -> Path:
    """File of a policy trained on the prior; trains one where there is none yet."""
    folder, budget, seed = arguments.cases("effects_on_policy"), arguments.budget, arguments.first
    task = asdict(budget.task(Task(**setting.task)))
    of = {"setting": asdict(setting), "task": task, "seed": seed, "budget": budget.to_json()}
    make = functools.partial(policy_case, "prior", seed, setting, arguments, code)
    path = folder / f"prior_{seed}.json"
    finish(run_all([Case(path, make, of, "prior")], 1, code))
    with claimed(path, wait=True):  # another process may be training it
        pass
    if not path.is_file():
        raise SystemExit(f"error: another process failed to make {path}; start again")
    return arguments.trained / json.loads(path.read_text())["trained"] / POLICY


def needs_out(arguments: Arguments) -> None:
    """Ends the program where the table of another policy or other effects would overwrite that of the pilot."""
    if (arguments.policy or arguments.hide) and not arguments.quick and arguments.out == RESULTS:
        raise SystemExit("error: --policy and --hide make another table than the one that is kept: give --out DIR")


def main() -> None:
    arguments, code = tyro.cli(Arguments, description=__doc__), origin(0)
    needs_out(arguments)
    setting = replace(setting_of("paper", arguments.robot), springs=arguments.springs)
    path = arguments.policy or trained(arguments, setting, code)
    policy = load_policy(path)
    of = {
        "springs": arguments.springs,
        "policy": arguments.policy.parent.name if arguments.policy else "prior",
        "policy_sha256": file_sha256(path),
    }
    table = list(rows(policy, setting, arguments.budget.task(Task()), arguments))
    write_json(arguments.summary("effects_on_policy"), {**of, "rows": table, **code})
    known, usual = [r for r in table if r["success_rate"] is not None], table[0]["success_rate"] or 0.0
    felt = [r for r in known if r["success_rate"] < usual - 0.2]
    names = [f"{r['hidden']}{'[' + r['joint'] + ']' if r['joint'] else ''}={r['amplitude']:g}" for r in felt]
    print(json.dumps({"effects": len(table) - 1, "felt": names}))


if __name__ == "__main__":
    main()
