"""`all`: from a recording to a policy, stage by stage, with one page for everything."""

from __future__ import annotations

import json
import time
import typing
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from droid_jax.commands import evaluate, gap, identify, report, train
from droid_jax.commands.folder import OtherRun
from droid_jax.commands.hidden import DEMONSTRATIONS, hidden_effects, record_stand_in
from droid_jax.commands.scenes import needs_recording
from droid_jax.commands.source import needs_brax, setup
from droid_jax.report.files import TRANSFER

Stage = Literal["identify", "gap", "train", "evaluate"]
STAGES: tuple[Stage, ...] = typing.get_args(Stage)


class _Presets(NamedTuple):
    """What a preset means to the stages."""

    identify: Literal["quick", "standard", "gpu"]
    train: Literal["quick", "paper", "gpu"]


PRESETS = {
    "quick": _Presets("quick", "quick"),
    "paper": _Presets("standard", "paper"),
    "gpu": _Presets("gpu", "gpu"),
}


@dataclass(frozen=True)
class All:
    """Everything: record, identify, search for what the model lacks, train a policy, try it, and one page.

    Without --recording a stand-in robot is recorded that hides an effect.  A stage whose inputs are as they were is
    not run again.
    """

    preset: Literal["quick", "paper", "gpu"] = "quick"
    """quick: a laptop, half an hour.  paper: the paper's budgets (hours).  gpu: large batches."""
    recording: tuple[Path, ...] = ()
    """FIT CONFIRM [SEALED]: motions of your own robot, as in `gap`."""
    scene: Path | None = None
    """Your own MJCF instead of the built-in door: identify and gap, policies are trained at the built-in one."""
    parameters: Path | None = None
    """JSON list of the parameters of your own scene (docs/own-robot.md)."""
    joints: tuple[str, ...] = ()
    """Measured joints of your own scene; default: all driven joints."""
    object_joint: str | None = None
    """Joint of the thing that is moved, in your own scene."""
    hide: tuple[str, ...] | None = None
    """What the stand-in robot hides, name=amplitude; none for nothing. Default: magnetic_catch=1.5 (N m)."""
    springs: Literal[0, 1, 2] = 1
    """Springs on the stand-in's door."""
    seed: int = 0
    """Seed of every stage and of the stand-in robot."""
    trials: int = 100
    """Trials of the policy on the stand-in robot, and episodes in simulation."""
    stages: tuple[Stage, ...] = STAGES
    """Which stages; those left out are read from the folder where they are in it."""
    out: Path = Path("runs/all")
    """Results folder, with one folder for each stage. A run that was interrupted goes on from where it was."""
    again: bool = False
    """Start over, even if the folder holds a finished or interrupted run."""


def run(command: All) -> None:
    """Every stage in a folder of its own below OUT, then the page of all of them."""
    started = time.monotonic()
    from droid_jax import runtime

    runtime.start()  # before the recording, which would start jax untuned
    from droid_jax.identify.results import prepare_folder

    out = prepare_folder(command.out)
    if command.scene is None and "train" in command.stages:
        needs_brax()  # rather now than after the search
    needs_recording(command)
    plan = _plan(command, out, command.recording or _recorded(command))
    for number, (stage, run_stage) in enumerate(plan.items(), 1):
        print(f"\n[{number}/{len(plan)}] {stage}", flush=True)
        run_stage()
    page = report.write(out)
    print(f"\n{command.out}: {(time.monotonic() - started) / 60:.0f} minutes")
    for line in told(out):
        print(line)
    print(f"report: {page}")


def _plan(command: All, out: Path, recordings: tuple[Path, ...]) -> dict[str, Callable[[], None]]:
    """The stages that were asked for, as far as the scene has them."""
    presets = PRESETS[command.preset]
    common: dict[str, Any] = {"seed": command.seed, "again": command.again}
    own = {name: getattr(command, name) for name in ("scene", "parameters", "joints", "object_joint")}
    seen = recordings[:2]  # a sealed one stays sealed until the search opens it

    def fit() -> None:
        _stage(identify.run, identify.Identify(presets.identify, recording=seen, out=out / "identify", **own, **common))

    def search() -> None:
        fit = out / "identify" if (out / "identify" / "fit.json").is_file() else None
        _stage(gap.run, gap.Gap(recordings, fit=fit, preset=presets.identify, out=out / "gap", **own, **common))

    def learn() -> None:
        _stage(train.run, train.Train(model_folder(out), preset=presets.train, out=out / "train", **common))

    def judge() -> None:
        evaluate.run(evaluate.Evaluate(out / "train", trials=command.trials, **common))

    plan = {"identify": fit, "gap": search}
    if command.scene is None:
        plan |= {"train": learn, "evaluate": judge}
    return {stage: run_stage for stage, run_stage in plan.items() if stage in command.stages}


def model_folder(out: Path) -> Path:
    """Where the model is that a policy shall be trained on: the extended one where the search named an effect.

    A search in other recordings than the fit's, left over from an earlier run, does not count.
    """
    found = _json(out / "gap" / "gap.json")
    fit, gap_ = (setup(out / stage).get("recordings_sha256") for stage in ("identify", "gap"))
    stale = fit is not None and gap_ is not None and gap_[: len(fit)] != fit
    return out / ("gap" if found and found["effects"] and not stale else "identify")


def told(out: Path) -> list[str]:
    """One line for each stage that has a result."""
    from droid_jax.report.words import percent

    lines = []
    if fit := _json(out / "identify" / "fit.json"):
        unit = fit.get("torque_unit", "N m")
        gaps = [f"{name} {g['before']:.3f} -> {g['after']:.3f} {unit}" for name, g in fit["gap"].items()]
        lines.append(f"identify: torque distance on repeats that were not fitted: {', '.join(gaps)}")
    if found := _json(out / "gap" / "gap.json"):
        role, size = list(found["gaps"].items())[-1]
        closed = "" if size["closed"] is None else f"; {percent(size['closed'])} of the gap closed on the {role} motion"
        lines.append(f"gap: {found['sentence']}{closed}")
    for name, of in (_json(out / "train" / TRANSFER) or {}).items():
        if name in ("simulation", "stand_in"):
            low, high = of["interval_95"]
            where = {"simulation": "in simulation", "stand_in": "on the stand-in robot"}[name]
            lines.append(f"policy: {percent(of['success_rate'])} success {where} ({percent(low)} to {percent(high)})")
    return lines


def _recorded(command: All) -> tuple[Path, ...]:
    """Files of the stand-in robot's motions: fit, confirm, sealed."""
    from droid_jax.commands.presets import TIMESTEP
    from droid_jax.model.door_scene import door_scene

    scene = door_scene(timestep=TIMESTEP[PRESETS[command.preset].identify])
    hidden = hidden_effects(command.hide, scene)
    if "evaluate" in command.stages:  # rather now than when the policy is there
        from droid_jax.measure.hidden import listed
        from droid_jax.policy.transfer import check_playable

        try:
            check_playable(scene, listed(hidden))
        except ValueError as error:
            raise ValueError(f"{error}; or leave the trials away: --stages identify gap train") from None
    record_stand_in(scene, hidden, command.out, command.springs, command.seed, command.again)
    return tuple(command.out / "recordings" / f"{name}.npz" for name in DEMONSTRATIONS.values())


def _stage(run_stage: Callable[[Any], None], command: Any) -> None:
    """Run a stage, anew where its folder holds a run with other inputs."""
    try:
        run_stage(command)
    except OtherRun as other:
        print(f"{other.what}: it is run again")
        run_stage(replace(command, again=True))


def _json(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.is_file() else None
