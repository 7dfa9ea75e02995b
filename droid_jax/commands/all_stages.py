"""`all`: every stage from a recording to a policy, with one page."""

from __future__ import annotations

import contextlib
import time
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from droid_jax import distributed
from droid_jax.commands import evaluate, gap, identify, report, train
from droid_jax.commands.folder import OtherRun, changed, forget, setup_of
from droid_jax.commands.options import (
    TIMESTEP,
    JointFriction,
    load_effects,
    needs_log,
    needs_recording,
    needs_scene,
    recording_at,
)
from droid_jax.commands.source import model_folder, needs_brax, untrainable
from droid_jax.commands.synthetic import DEMONSTRATIONS, hidden_effects, kept_at, record_synthetic, with_robot_options
from droid_jax.commands.writer import writes
from droid_jax.files import ASKED, FIT, GAP, LAST_FILES, TRANSFER
from droid_jax.report.stages import left_over, setup, unfinished
from droid_jax.storage import write_json

Stage = Literal["identify", "gap", "train", "evaluate"]
STAGES: tuple[Stage, ...] = typing.get_args(Stage)
IN_A_SCENE: tuple[Stage, ...] = ("identify", "gap")  # stages for your own scene; policies need the built-in door


class _Presets(NamedTuple):
    """The presets of the stages that a preset of `all` selects."""

    identify: Literal["quick", "standard", "gpu"]
    train: Literal["quick", "paper", "gpu"]


PRESETS = {
    "quick": _Presets("quick", "quick"),
    "paper": _Presets("standard", "paper"),
    "gpu": _Presets("gpu", "gpu"),
}

MINUTES = {"record": 0.4, "identify": 2.6, "gap": 2.7, "train": 2.3, "evaluate": 1.1}
"""Duration of each stage with the preset "quick", on two cores with an empty cache (benchmarks/default_run.py)."""


@dataclass(frozen=True)
class All:
    """Run all stages: record, identify, search for missing effects, train a policy, test it; with one page.

    Without --recording a synthetic robot with a hidden effect is recorded.  A stage with unchanged inputs is not run
    again.
    """

    preset: Literal["quick", "paper", "gpu"] = "quick"
    """quick: preset quick in identify, gap and train; ten minutes on two cores.  paper: standard in identify and gap
    (100 generations; no policy can be trained with the servo of identify's preset paper), paper in train; hours.  gpu:
    gpu in all stages."""
    recording: tuple[Path, ...] = ()
    """TRAIN VALIDATION [TEST], ONE or LOG [TEST], as in gap. With fewer repeats use --stages identify."""
    scene: Path | None = None
    """Your own MJCF instead of the built-in door, for identify and gap; policies are trained at the built-in door."""
    parameters: Path | None = None
    """JSON list of the parameters of your own scene (docs/your-robot.md)."""
    joints: tuple[str, ...] = ()
    """Measured joints of your own scene; default: all driven joints."""
    object_joint: str | None = None
    """Joint of the object that is moved, in your own scene."""
    joint_friction: JointFriction = "held"
    """Dry friction of your own scene's joints. held: a stiffer constraint, with which friction holds a load still,
    unless the MJCF sets solimpfriction or solreffriction itself. scene: the MJCF's constraint, whose default lets
    joints creep."""
    motion_cutoff: float | None = None
    """Logs without commands: cutoff of the filter of the measured positions, Hz; default: 20."""
    effect_scale: float | None = None
    """Forces and torques of the library's effects, relative to an arm of a Panda's size, as in gap."""
    user_effects: Path | None = None
    """Python file that registers your own effects (docs/your-effect.md); it is executed."""
    hide: tuple[str, ...] | None = None
    """Hidden effect of the synthetic robot, name=coefficient; none for no effect. Default: magnetic_catch=1.5 (N m)."""
    springs: Literal[0, 1, 2] | None = None
    """Springs on the synthetic robot's door. Default: 1."""
    seed: int = 0
    """Seed of every stage and of the synthetic robot."""
    force: bool = False
    """Also fit recordings with a certain finding of `check`, whose fit would be meaningless; the report says so."""
    trials: int = 100
    """Number of trials of the policy on the synthetic robot, and of episodes in simulation."""
    stages: tuple[Stage, ...] = STAGES
    """Stages to run; results of the others are read from the folder, if it has them."""
    tensorboard: bool = False
    """Write scalars for TensorBoard while it fits and trains, to OUT/identify/tensorboard and so on."""
    out: Path = Path("runs/all")
    """Results folder, with one folder for each stage. An interrupted run continues."""
    again: bool = False
    """Start over, even if the folder holds a finished or interrupted run."""


@writes("all")
def run(command: All) -> None:
    """Run every stage in its own folder below OUT, then write one page; if a stage fails, a page of those before."""
    started = time.monotonic()
    from droid_jax import runtime
    from droid_jax.report.progress import needs_writer

    _needs_stages(command)
    command = with_robot_options(command)
    needs_scene(command)
    needs_recording(command)
    needs_writer(command.tensorboard)
    command = replace(command, stages=_stages(command))
    if "train" in command.stages:
        needs_brax()  # before the search, which takes long
    if "evaluate" in command.stages:
        evaluate.needs_trials(command.trials)
    runtime.start()  # before the recording, which would start jax without tune()
    from droid_jax.model.effects.registry import check_scale

    if command.effect_scale is not None:
        check_scale(command.effect_scale)
    load_effects(command.user_effects)
    roles = _roles(command)
    _needs_robot(command)
    out = command.out
    if {*IN_A_SCENE} & {*command.stages}:
        _remember(command, out)
    # Earlier results of later stages must not pass for results of this run if it is stopped before them.
    if command.again:
        for stage in [stage for stage in command.stages if stage in LAST_FILES][1:]:
            forget(out / stage, stage)
    with report.drawn_meanwhile():
        _run_stages(command, out, roles)
    from droid_jax.report.page import write_report  # matplotlib: not before the stages

    page = write_report(out)
    print(f"\n{command.out}: {(time.monotonic() - started) / 60:.0f} minutes")
    for line in summary_lines(out):
        print(line)
    print(f"report: {page}")


def _needs_stages(command: All) -> None:
    """ValueError for options of the synthetic robot if no stage records one."""
    given = [name for name in ("hide", "springs") if getattr(command, name) is not None]
    if given and not {*IN_A_SCENE} & {*command.stages}:
        raise ValueError(
            f"--{given[0]} is for the stages identify and gap, and --stages leaves them out; "
            "`evaluate RUN --springs ... --hide ...` tries another robot"
        )


def _remember(command: All, out: Path) -> None:
    """Write the options to all.json; OtherRun if the folder holds a run with other options, which may have taken hours.

    Other stages and another number of trials do not count as other options.
    """
    asked = {k: v for k, v in setup_of(command).items() if k not in ("stages", "trials")}
    files = [*command.recording, *filter(None, (command.scene, command.parameters))]
    asked["files"] = [str(path.resolve()) for path in files]
    if own := setup(out):
        raise ValueError(
            f"{out} holds a run of `{own.get('command', 'identify')}`, and the page would show both: "
            "give another folder (--out)"
        )
    path = out / ASKED
    before = _json(path) if not command.again else None
    if before is not None and (other := changed(before, asked)):
        raise OtherRun(out, other)
    write_json(path, asked)


def _stages(command: All) -> tuple[Stage, ...]:
    """The requested stages that the scene allows; ValueError if there are none."""
    possible = STAGES if command.scene is None else IN_A_SCENE
    chosen: tuple[Stage, ...] = tuple(stage for stage in possible if stage in command.stages)
    if not chosen:
        why = "" if command.scene is None else " with --scene: policies are trained at the built-in door"
        raise ValueError(f"--stages must name one of {', '.join(possible)}{why}")
    return chosen


def needs_one_process(command: All) -> None:
    """ValueError if several processes would train: brax uses the devices of all of them."""
    if distributed.count() > 1 and "train" in _stages(command):
        raise ValueError(
            "a policy is trained by one process: give --stages identify gap, then train in one process "
            f"(without {distributed.VARIABLE})"
        )


def _run_stages(command: All, out: Path, roles: tuple[str, ...]) -> None:
    """Record the synthetic robot if no recording is given, then run the stages and print how long each took.

    If a stage fails, the page of those before it is written.  If the search named an effect with which no policy can be
    trained, the run ends after it.
    """
    plan = _plan(command, out, command.recording or kept_at(out), roles)
    if _records(command):
        plan = {"record": lambda: _record(command), **plan}
    for number, (stage, run_stage) in enumerate(plan.items(), 1):
        if stage == "train" and "gap" in plan and (unfit := untrainable(model_folder(out))):
            print(f"\nno policy can be trained with {', '.join(unfit)}, which needs a whole command: the run ends here")
            return
        began = time.monotonic()
        print(f"\n[{number}/{len(plan)}] {stage}{_left(command, list(plan)[number - 1 :])}", flush=True)
        try:
            run_stage()
        except Exception:
            report.wait_for_pages()
            if number > 1:
                from droid_jax.report.page import write_report

                with contextlib.suppress(ValueError):  # the recording alone makes no page
                    print(f"report of what is done: {write_report(out)}")
            raise
        print(f"[{number}/{len(plan)}] {stage}: {(time.monotonic() - began) / 60:.1f} minutes", flush=True)


def _left(command: All, stages: Sequence[str]) -> str:
    """Text with the expected duration of these stages; empty for settings that were not measured."""
    if command.preset != "quick" or command.scene is not None or command.recording:
        return ""
    return f" (about {max(1, round(sum(MINUTES[stage] for stage in stages)))} min left on two cores)"


def _records(command: All) -> bool:
    """Whether the synthetic robot is recorded; the stages after the search need no recording."""
    return not command.recording and bool({*IN_A_SCENE} & {*command.stages})


def _needs_robot(command: All) -> None:
    """ValueError for an impossible synthetic robot, before the folder is written."""
    from droid_jax.door.scene import door_scene

    if not _records(command):
        return
    scene = door_scene()
    hidden = hidden_effects(command.hide, scene)
    if "evaluate" in command.stages:
        from droid_jax.synthetic.hidden_effects import as_applied
        from droid_jax.synthetic.policy_trials import check_playable

        applied = as_applied(hidden)
        try:
            check_playable(scene, applied)
        except ValueError as error:
            left = "identify gap" if "inner_profile" in {one.name for one in applied} else "identify gap train"
            raise ValueError(f"{error}; or run without trials: --stages {left}") from None


def _roles(command: All) -> tuple[str, ...]:
    """Role of each recording: "train", "validation" or "test".

    Without the stage gap, roles are assigned if a later search could use the recordings; otherwise all are "train".

    Raises:
        ValueError: the stage gap cannot use the recordings.
    """
    if not command.recording:
        needs_log(command.motion_cutoff, ())
        return tuple(DEMONSTRATIONS)
    from droid_jax.model.effects.registry import joined
    from droid_jax.preflight.check_log import refuse_certain
    from droid_jax.preflight.search_inputs import assigned_roles

    own = gap.GapCommand(command.recording, preset=PRESETS[command.preset].identify, **_own(command))
    scene, base = gap.gap_model(own)
    given = gap.given_to(own)
    if not command.force:
        refuse_certain(scene, given)
    try:
        _, roles = assigned_roles(scene, given)
        if "gap" in command.stages:  # refuses clashing names before the fit
            joined(base, gap.chosen_effects(own, scene, given))
    except ValueError:
        if "gap" in command.stages:
            raise
        return ("train",) * len(command.recording)
    return tuple(roles)


def _own(command: All) -> dict[str, Any]:
    """Options that the stages identify and gap share: your own scene, effects and recordings."""
    names = (
        "scene",
        "parameters",
        "joints",
        "object_joint",
        "joint_friction",
        "motion_cutoff",
        "user_effects",
        "force",
    )
    return {name: getattr(command, name) for name in names}


def _plan(
    command: All, out: Path, recordings: tuple[Path, ...], roles: tuple[str, ...]
) -> dict[str, Callable[[], None]]:
    """Stage -> function that runs it, for the requested stages."""
    presets = PRESETS[command.preset]
    common: dict[str, Any] = {"seed": command.seed, "again": command.again, "user_effects": command.user_effects}
    own, board = _own(command) | common, {"tensorboard": command.tensorboard}
    # Test data are not fitted.
    seen = tuple(path for path, role in zip(recordings, roles, strict=False) if role != "test")

    def fit() -> None:
        _stage(identify.run, identify.Identify(presets.identify, seen, out=out / "identify", **board, **own))

    def search() -> None:
        # A log that is split into blocks has no validation recording, and its base fit needs no start.
        fit = out / "identify" if "validation" in roles and _fitted(out / "identify", command, recordings) else None
        scale = command.effect_scale
        _stage(
            gap.run,
            gap.GapCommand(
                recordings, fit=fit, preset=presets.identify, effect_scale=scale, out=out / "gap", **board, **own
            ),
        )

    def learn() -> None:
        _stage(train.run, train.Train(model_folder(out), preset=presets.train, out=out / "train", **board, **common))

    def judge() -> None:
        evaluate.run(evaluate.Evaluate(out / "train", trials=command.trials, **common))

    plan = {"identify": fit, "gap": search, "train": learn, "evaluate": judge}
    return {stage: plan[stage] for stage in command.stages}


def _fitted(folder: Path, command: All, recordings: Sequence[Path]) -> bool:
    """Whether a folder of `identify` holds a fit of these recordings, from this run or an earlier one."""
    if not (folder / FIT).is_file() or unfinished(folder):
        return False
    if "identify" in command.stages:
        return True
    made = setup(folder)
    hashes = made.get("recordings_sha256", [])
    scene, _ = gap.gap_model(
        gap.GapCommand(command.recording, preset=PRESETS[command.preset].identify, **_own(command))
    )
    same_scene = made.get("scene_sha256") == scene.sha256
    return bool(hashes) and same_scene and [recording_at(p).sha256 for p in recordings[: len(hashes)]] == hashes


def summary_lines(out: Path) -> list[str]:
    """One line for each stage with a result."""
    from droid_jax.report.gap_folder import read_answer
    from droid_jax.report.identify_folder import Distances, read_fit
    from droid_jax.report.policy_folder import read_rates, read_training
    from droid_jax.report.text import lines

    old, at = left_over(out), {stage: out / stage for stage in LAST_FILES}
    tried = "train" not in old and (at["train"] / TRANSFER).is_file()
    return lines(
        "all.txt.jinja",
        old=sorted(old),
        fit=read_fit(at["identify"], Distances) if (at["identify"] / FIT).is_file() else None,
        answer=read_answer(at["gap"]) if "gap" not in old and (at["gap"] / GAP).is_file() else None,
        trials=read_rates(at["train"]) if tried else None,
        another_robot=tried and read_training(at["train"]).another_robot,
    )


def _record(command: All) -> None:
    """Record the motions of the synthetic robot."""
    from droid_jax.door.scene import door_scene

    assert command.springs is not None  # settled
    scene = door_scene(timestep=TIMESTEP[PRESETS[command.preset].identify])
    record_synthetic(
        scene, hidden_effects(command.hide, scene), command.out, command.springs, command.seed, command.again
    )


def _stage(run_stage: Callable[[Any], None], command: Any) -> None:
    """Run a stage; start it over if its folder holds a run with other inputs.

    Raises OtherRun if that run had other options, since it may have taken hours.
    """
    try:
        run_stage(command)
    except OtherRun as other:
        if not other.inputs:
            raise
        print(f"{other.what}: it is run again")
        run_stage(replace(command, again=True))


def _json(path: Path) -> dict[str, Any] | None:
    """Content of a JSON file of a run; None if there is none, ValueError if it cannot be read."""
    from droid_jax.report.reading import Reader

    return Reader("all", "--again").json(path) if path.is_file() else None
