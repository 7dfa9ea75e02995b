"""`evaluate`: a trained policy in its simulation and on the stand-in robot."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from droid_jax.commands import report
from droid_jax.commands.folder import setup_of
from droid_jax.commands.hidden import hidden_effects
from droid_jax.commands.source import needs_brax, source
from droid_jax.commands.train import randomise
from droid_jax.report.files import FILMS, POLICY, TRANSFER

if TYPE_CHECKING:
    from droid_jax.policy.control import Policy
    from droid_jax.policy.door_env import DoorEnv
    from droid_jax.policy.transfer import StandIn
    from droid_jax.policy.trials import Trials


@dataclass(frozen=True)
class Evaluate:
    """Try a trained policy: in the simulation it was trained in, and on the stand-in robot (plain C MuJoCo with hidden
    physics, sensor noise and, where wanted, a hidden effect)."""

    run: Annotated[Path, tyro.conf.Positional] = Path("runs/train")
    """Folder of `train`."""
    trials: int = 100
    """Trials on the stand-in robot, and episodes in simulation."""
    springs: Literal[0, 1, 2] | None = None
    """Springs on the stand-in's door. Default: those of the stand-in that was fitted, else 1."""
    hide: tuple[str, ...] | None = None
    """What the stand-in hides, name=amplitude; none for nothing. Default: what the fitted one hid."""
    robot: int | None = None
    """Seed of the stand-in's hidden values. Default: that of the one that was fitted, else 0."""
    seed: int = 0
    """Seed of start poses and sensor noise."""
    film: bool = True
    """Film a good and a bad trial."""


def run(command: Evaluate) -> None:
    """Try the policy, write transfer.json and the films, and build the page."""
    needs_brax()
    if command.trials < 1:
        raise ValueError(f"--trials must be 1 or more, got {command.trials}")
    from droid_jax import runtime

    runtime.start()
    from droid_jax.policy.control import load
    from droid_jax.policy.door_env import DoorEnv
    from droid_jax.policy.simulated import simulated
    from droid_jax.policy.task import Task
    from droid_jax.policy.transfer import transfer
    from droid_jax.report.policy_folder import read_training
    from droid_jax.report.words import percent
    from droid_jax.storage import write_json

    trained = read_training(command.run)
    setup, policy = trained["setup"], load(command.run / POLICY)
    scene, gaussian, effects = source(command.run, setup["knob"])
    env = DoorEnv(scene, Task(**trained["task"]), effects)
    robot, truth = _robot(command, trained, env)
    shutil.rmtree(command.run / FILMS, ignore_errors=True)
    print(f"{command.trials} episodes in simulation ...", flush=True)
    inside = simulated(policy, env, randomise(setup["method"], scene, gaussian), command.trials, command.seed)
    print(f"{command.trials} trials on the stand-in robot ...", flush=True)
    outside = transfer(policy, robot)
    write_json(
        command.run / TRANSFER,
        {
            "simulation": inside.to_json(),
            "stand_in": outside.to_json(),
            "robot": {"truth": truth, "hidden": [dataclasses.asdict(a) for a in robot.hidden]},
            "setup": setup_of(command),
            "versions": runtime.versions(),
            "device": runtime.device(),
        },
    )
    if command.film:
        _film(command.run, policy, robot, outside)
    for where, found in (("simulation", inside), ("stand-in robot", outside)):
        low, high = found.interval()
        print(f"{where}: {percent(found.rate)} success ({percent(low)} to {percent(high)}), {_angle(found)}")
    report.run(report.Report(command.run))


def _robot(command: Evaluate, trained: Mapping[str, Any], env: DoorEnv) -> tuple[StandIn, dict[str, float]]:
    """The stand-in robot, the one that was fitted unless asked for another; and its hidden values."""
    from droid_jax.measure.hidden import listed
    from droid_jax.measure.surrogate import stand_in_truth
    from droid_jax.model.door_scene import door_scene
    from droid_jax.policy.transfer import TransferConfig, stand_in

    asked = {"springs": command.springs, "seed": command.robot, "hide": command.hide}
    usual = {"springs": 1, "seed": 0, "hide": ()}
    own = usual | trained["stand_in"] | {name: value for name, value in asked.items() if value is not None}
    scene = door_scene(limits=True, knob=trained["setup"]["knob"])
    truth = stand_in_truth(scene, own["springs"], own["seed"])
    config = TransferConfig(trials=command.trials, seed=command.seed)
    return stand_in(scene, env.start, truth, listed(hidden_effects(own["hide"], scene)), env.task, config), truth


def _angle(found: Trials) -> str:
    import numpy as np

    degrees = np.rad2deg(found.angle)
    return f"opened to {degrees.mean():.1f} ± {degrees.std():.1f} degrees"


def _film(folder: Path, policy: Policy, robot: StandIn, found: Trials) -> None:
    """good.webp and bad.webp: of the trials that succeeded and of those that failed, the one of median angle."""
    import numpy as np

    from droid_jax.policy.transfer import filmed
    from droid_jax.report.film import film
    from droid_jax.report.render import NoOpenGL

    chosen = {"good": np.flatnonzero(found.success), "bad": np.flatnonzero(~found.success)}
    for name, numbers in chosen.items():
        if not len(numbers):
            continue
        path = folder / FILMS / f"{name}.webp"
        number = int(numbers[np.argsort(found.angle[numbers])[len(numbers) // 2]])
        try:
            film(path, robot.scene.visual_model(), [filmed(policy, robot, number)], robot.task.control)
        except NoOpenGL as error:
            print(f"no films: {error}", file=sys.stderr)
            return
