"""`train`: a policy that opens the door, on environments drawn from a distribution."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from droid_jax.commands import report
from droid_jax.commands.folder import RUNS, begin, finished, refuse_own_source, setup_of
from droid_jax.commands.options import load_effects, warn_of_cpu
from droid_jax.commands.source import has_model, model_folder, needs_brax, source, synthetic_robot_of
from droid_jax.commands.writer import writes
from droid_jax.files import EXTENDED, GAUSSIAN, POLICY, TRAINING
from droid_jax.report.stages import extended_of, fingerprint

if TYPE_CHECKING:
    from droid_jax.door.environment import DoorEnv
    from droid_jax.identify.gaussian import Gaussian
    from droid_jax.policy.train import TrainConfig, TrainedPolicy, TrainProgress

Method = Literal["fitted", "mean", "prior"]


@dataclass(frozen=True)
class Train:
    """Train a policy with PPO on doors drawn from a Gaussian: the fitted one, or the prior.

    --fit names the Gaussian of `identify`, nuisances included, or the extended model of `gap`.
    """

    fit: Path | None = None
    """Folder of `identify`, `gap` or `all`. Default: runs/identify if it has a fit, otherwise runs/all."""
    method: Method = "fitted"
    """fitted: each environment has a draw from the fitted Gaussian.  mean: all have its mean.  prior: draws from the
    prior (the three methods of the paper's Table II)."""
    preset: Literal["quick", "paper", "gpu"] = "quick"
    """quick: minutes on a laptop.  paper: longer.  gpu: 4096 environments."""
    knob: Literal[0, 1, 2, 3] = 0
    """Location of the knob along the door, each 5 cm nearer to the hinge than the one before."""
    steps: int | None = None
    """Total number of actions, rounded up to whole rounds; default: the preset's."""
    seed: int = 0
    """Seed of the networks and of the environments."""
    user_effects: Path | None = None
    """Python file that registers your own effects (docs/your-effect.md); it is executed."""
    tensorboard: bool = False
    """Write scalars for TensorBoard while it runs, to OUT/tensorboard."""
    out: Path = Path("runs/train")
    """Results folder. An interrupted run continues from its last checkpoint."""
    again: bool = False
    """Start over, even if the folder holds a finished or interrupted run."""


@writes("train")
def run(command: Train) -> None:
    """Train, and write the run's folder and its page."""
    needs_brax()
    from droid_jax import runtime
    from droid_jax.report.progress import FOLDER, needs_writer, scalars, training

    needs_writer(command.tensorboard)
    runtime.start()
    warn_of_cpu(command.preset)
    from droid_jax.door.environment import DoorEnv
    from droid_jax.policy.network import save_policy
    from droid_jax.policy.randomise import of_method
    from droid_jax.policy.train import train
    from droid_jax.storage import write_bytes, write_json

    out, fit = command.out, _fit_folder(command)
    refuse_own_source(out, fit)
    load_effects(command.user_effects, fit)
    scene, gaussian, effects = source(fit, command.knob)
    gaussian = _chosen(command, gaussian)
    origin = {
        "fit": None if fit is None else str(fit),
        "fit_sha256": fingerprint(fit),
        "synthetic_robot": synthetic_robot_of(fit),
    }
    setup = {**setup_of(command), "command": "train", **origin}
    if finished(out, setup, command.again, TRAINING):
        report.run(report.Report(out))
        return
    config = train_config(command)
    env, randomise = DoorEnv(scene, effects=effects), of_method(command.method, scene, gaussian)
    begin(out, setup, command.again, "train")
    gaussian.save(out / GAUSSIAN)
    model = None if fit is None else extended_of(fit)
    if model is not None:
        write_bytes(out / EXTENDED, model.read_bytes())
    board = out / FOLDER if command.tensorboard else None
    with training(config.steps) as show, scalars(board) as write:

        def progress(now: TrainProgress) -> None:
            show(now)
            write("train", now)

        found = train(
            env, randomise, config, checkpoints=out / "checkpoints",
            fingerprint={"method": command.method, "gaussian": (out / GAUSSIAN).read_text()},
            progress=progress,
        )  # fmt: skip
    save_policy(out / POLICY, found.policy)
    if (done := found.history[-1].step) < config.steps:
        held = f"the last {config.held} evaluations together had {config.enough:.0%} success or more"
        why = held if found.held else "its weights became NaN or infinite"
        print(f"training ended after {done} of {config.steps} actions: {why}")
    write_json(
        out / TRAINING, _description(setup, config, env, found)
    )  # last: its presence means that the run is complete
    report.run(report.Report(out))


def _description(setup: dict[str, Any], config: TrainConfig, env: DoorEnv, found: TrainedPolicy) -> dict[str, Any]:
    """Content of training.json."""
    from droid_jax import runtime

    return {
        "setup": setup,
        "synthetic_robot": setup["synthetic_robot"],
        "config": dataclasses.asdict(config),
        "task": dataclasses.asdict(env.task),
        "scene": env.scene.name,
        "effects": [e.name for e in env.effects],
        "held": found.held,
        "history": [dataclasses.asdict(now) for now in found.history],
        "versions": runtime.versions(),
        "device": runtime.device(),
    }


def train_config(command: Train) -> TrainConfig:
    """The preset's configuration with the numbers given by options."""
    from droid_jax.policy.train import PRESETS

    asked = {} if command.steps is None else {"steps": command.steps}
    return dataclasses.replace(PRESETS[command.preset], seed=command.seed, **asked)


def _chosen(command: Train, gaussian: Gaussian) -> Gaussian:
    from droid_jax.identify.gaussian import prior

    return prior(gaussian.space) if command.method == "prior" else gaussian


def _fit_folder(command: Train) -> Path | None:
    """Folder of the Gaussian; None for the prior of the built-in door.

    Raises ValueError if a fit is needed and there is none.
    """
    if command.fit is not None:
        if not command.fit.is_dir():
            raise ValueError(f"--fit {command.fit} is no folder")
        whole = model_folder(command.fit)
        return whole if has_model(whole) else command.fit
    for folder in (RUNS / "identify", model_folder(RUNS / "all")):
        if has_model(folder):
            what = "the prior of the fit" if command.method == "prior" else "the fit"
            print(f"training on {what} in {folder} (another: --fit)")
            return folder
    if command.method != "prior":
        raise ValueError(
            f"there is no fit in {RUNS / 'identify'} or {RUNS / 'all'}: give --fit FOLDER, or --method prior"
        )
    return None
