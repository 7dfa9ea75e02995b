"""`evaluate`: a trained policy in its simulation and on the synthetic robot."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from droid_jax.commands import report
from droid_jax.commands.folder import changed, setup_of, stage_folder
from droid_jax.commands.options import load_effects
from droid_jax.commands.source import needs_brax, source
from droid_jax.commands.synthetic import hidden_effects
from droid_jax.commands.writer import writes
from droid_jax.files import FILMS, POLICY, TRAINING, TRANSFER
from droid_jax.read_json import read_json

if TYPE_CHECKING:
    from droid_jax.door.environment import DoorEnv
    from droid_jax.door.task import Task
    from droid_jax.policy.control import Policy
    from droid_jax.policy.trials import Trials
    from droid_jax.report.policy_folder import Trained, Training
    from droid_jax.synthetic.policy_trials import PolicyRobot


@dataclass(frozen=True)
class Evaluate:
    """Test a trained policy: in the simulation in which it was trained, and on the synthetic robot (plain C MuJoCo with
    hidden physics, sensor noise and, optionally, a hidden effect)."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of `train` or of `all`. Default: runs/train where it holds a policy, else runs/all."""
    trials: int = 100
    """Trials on the synthetic robot, and episodes in simulation."""
    springs: Literal[0, 1, 2] | None = None
    """Springs on the synthetic robot's door. Default: as on the fitted synthetic robot, otherwise 1."""
    hide: tuple[str, ...] | None = None
    """Hidden effect, name=coefficient; none for no effect. Default: that of the fitted synthetic robot."""
    robot: int | None = None
    """Seed of the synthetic robot's hidden values. Default: that of the fitted synthetic robot, otherwise 0."""
    seed: int = 0
    """Seed of start poses and sensor noise."""
    film: bool = True
    """Film a good and a bad trial."""
    user_effects: Path | None = None
    """Python file that registers your own effects (docs/your-effect.md); it is executed."""
    again: bool = False
    """Repeat trials that the folder already has."""


@writes("train", lambda command: stage_folder(command.run, "train", TRAINING), make=False)
def run(command: Evaluate) -> None:
    """Test the policy, write transfer.json and the films, and build the page; trials that exist are not repeated."""
    needs_brax()
    needs_trials(command.trials)
    from droid_jax import runtime

    runtime.start()
    from droid_jax.door.environment import DoorEnv
    from droid_jax.policy.control import load_policy
    from droid_jax.policy.evaluate import simulated
    from droid_jax.policy.randomise import of_method
    from droid_jax.report.policy_folder import read_policy, read_training
    from droid_jax.report.progress import counting
    from droid_jax.storage import file_sha256, new_folder, write_json
    from droid_jax.synthetic.hidden_effects import HIDDEN
    from droid_jax.synthetic.policy_trials import transfer

    folder = stage_folder(command.run, "train", TRAINING)
    load_effects(command.user_effects, folder)
    trained, policy = read_training(folder), load_policy(folder / POLICY)
    setup_now = {**setup_of(command), "run": str(folder), "policy_sha256": file_sha256(folder / POLICY)}
    if not command.again and _done(folder, setup_now):
        print(f"{folder} holds these trials already (start over with --again)")
        _print_trials(read_policy(folder))
        report.run(report.Report(folder))
        return
    scene, gaussian, effects = source(folder, trained.setup.knob)
    env = DoorEnv(scene, _task(folder, read_json(folder / TRAINING)["task"]), effects)
    robot, truth = _robot(command, trained, env)
    # One compiled program runs all of them and reports no progress.
    with counting("episodes in simulation, a minute of compiling first", command.trials) as count:
        inside = simulated(policy, env, of_method(trained.setup.method, scene, gaussian), command.trials, command.seed)
        count(command.trials)
    with counting("trials on the synthetic robot", command.trials) as count:
        outside = transfer(policy, robot, count)
    inside.check()
    outside.check()
    with new_folder(folder / FILMS) as films:  # replaces those of an earlier policy at the end
        no_films = _film(films, policy, robot, outside) if command.film else "they were not asked for (--no-film)"
    content = {
        "simulation": inside.to_json(),
        "synthetic_robot": outside.to_json(),
        "robot": {
            "truth": truth,
            "hidden": [{**dataclasses.asdict(a), "unit": HIDDEN[a.name].unit} for a in robot.hidden],
        },
        "no_films": no_films,
        "setup": setup_now,
        "versions": runtime.versions(),
        "device": runtime.device(),
    }
    write_json(folder / TRANSFER, content)  # last: its presence means that the trials are complete
    _print_trials(read_policy(folder))
    report.run(report.Report(folder))


def needs_trials(trials: int) -> None:
    """ValueError unless there is at least one trial."""
    if trials < 1:
        raise ValueError(f"--trials must be 1 or more, got {trials}")


def _done(folder: Path, setup: dict[str, Any]) -> bool:
    """Whether the folder has a complete transfer.json of these trials."""
    from droid_jax.report.policy_folder import read_policy

    try:
        found = read_policy(folder).transfer
    except ValueError:  # damaged: the trials are repeated
        return False
    return found is not None and not changed(found.setup, setup)


def _task(folder: Path, known: Mapping[str, Any]) -> Task:
    """The task of a folder's policy; ValueError if this version's task lacks some of its fields."""
    from droid_jax.door.task import Task

    strange = sorted(set(known) - {f.name for f in dataclasses.fields(Task)})
    if strange:
        raise ValueError(f"{folder}: the policy was trained for a task with {', '.join(strange)}; train it again")
    return Task(**known)


def _print_trials(trained: Trained) -> None:
    """Print the success rates of the trials, and a caveat if another robot was fitted."""
    from droid_jax.report.text import lines

    for line in lines("evaluate.txt.jinja", trials=trained.trials, another_robot=trained.training.another_robot):
        print(line)


def _robot(command: Evaluate, trained: Training, env: DoorEnv) -> tuple[PolicyRobot, dict[str, float]]:
    """The synthetic robot of the trials and its hidden values; by default the fitted one."""
    from droid_jax.door.scene import door_scene
    from droid_jax.synthetic.hidden_effects import as_applied
    from droid_jax.synthetic.policy_trials import TransferConfig, synthetic_robot
    from droid_jax.synthetic.robot import synthetic_truth

    asked = {"springs": command.springs, "seed": command.robot, "hide": command.hide}
    usual = {"springs": 1, "seed": 0, "hide": ()}
    given = {name: value for name, value in asked.items() if value is not None}
    own: dict[str, Any] = {**usual, **trained.synthetic_robot, **given}
    scene = door_scene(limits=True, knob=trained.setup.knob)
    truth = synthetic_truth(scene, own["springs"], own["seed"])
    config = TransferConfig(trials=command.trials, seed=command.seed)
    return synthetic_robot(
        scene, env.start, truth, as_applied(hidden_effects(own["hide"], scene)), env.task, config
    ), truth


def _film(folder: Path, policy: Policy, robot: PolicyRobot, found: Trials) -> str | None:
    """Write good.webp and bad.webp: the successful and the failed trial of median angle.

    Diverged trials do not count as failures.  Returns the reason if no film could be made.
    """
    import numpy as np

    from droid_jax.report.render import NoOpenGL, film
    from droid_jax.synthetic.policy_trials import filmed

    chosen = {"good": np.flatnonzero(found.success), "bad": np.flatnonzero(~found.success & found.counted)}
    for name, numbers in chosen.items():
        if not len(numbers):
            continue
        path = folder / f"{name}.webp"
        number = int(numbers[np.argsort(found.angle[numbers])[len(numbers) // 2]])
        try:
            film(path, robot.scene.visual_model(), [filmed(policy, robot, number)], robot.task.control)
        except NoOpenGL as error:
            print(f"no films: {error}", file=sys.stderr)
            return f"{error}; `evaluate --again` tries once more"
    return None if any(map(len, chosen.values())) else "every trial blew up"
