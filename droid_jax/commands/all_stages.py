"""`all`: from a recording to a policy, stage by stage, with one page for everything."""

from __future__ import annotations

import contextlib
import time
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from droid_jax import distributed
from droid_jax.commands import evaluate, gap, identify, train
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
IN_A_SCENE: tuple[Stage, ...] = ("identify", "gap")  # of your own: policies are trained at the built-in door


class _Presets(NamedTuple):
    """What a preset means to the stages."""

    identify: Literal["quick", "standard", "gpu"]
    train: Literal["quick", "paper", "gpu"]


PRESETS = {
    "quick": _Presets("quick", "quick"),
    "paper": _Presets("standard", "paper"),
    "gpu": _Presets("gpu", "gpu"),
}

MINUTES = {"record": 0.3, "identify": 4.0, "gap": 7.5, "train": 6.0, "evaluate": 1.1}
"""Of each stage in the preset "quick", on two cores with nothing compiled before (benchmarks/default_run.py)."""


@dataclass(frozen=True)
class All:
    """Everything: record, identify, search for what the model lacks, train a policy, try it, and one page.

    Without --recording a synthetic robot is recorded that hides an effect.  A stage whose inputs are as they were is
    not run again.
    """

    preset: Literal["quick", "paper", "gpu"] = "quick"
    """quick: identify, gap and train with their own quick; a laptop, half an hour.  paper: identify and gap with
    standard (100 generations; not identify's paper, whose servo no policy can be trained on), train with paper; hours.
    gpu: all with gpu."""
    recording: tuple[Path, ...] = ()
    """TRAIN VALIDATION [TEST], ONE or LOG [TEST], as in gap; with fewer repeats: --stages identify."""
    scene: Path | None = None
    """Your own MJCF instead of the built-in door: identify and gap, policies are trained at the built-in one."""
    parameters: Path | None = None
    """JSON list of the parameters of your own scene (docs/your-robot.md)."""
    joints: tuple[str, ...] = ()
    """Measured joints of your own scene; default: all driven joints."""
    object_joint: str | None = None
    """Joint of the thing that is moved, in your own scene."""
    joint_friction: JointFriction = "held"
    """Dry friction of your own scene's joints. held: it holds a load still, unless the MJCF sets solimpfriction or
    solreffriction itself. scene: as the MJCF has it, whose default lets joints creep."""
    motion_cutoff: float | None = None
    """Logs without commands: cutoff of the filter of the measured positions, Hz; default: 20."""
    effect_scale: float = 1.0
    """Forces and torques of the library's effects, relative to an arm of a Panda's size, as in gap."""
    user_effects: Path | None = None
    """Python file that registers effects of your own (docs/your-effect.md); it is run."""
    hide: tuple[str, ...] | None = None
    """What the synthetic robot hides, name=amplitude; none for nothing. Default: magnetic_catch=1.5 (N m)."""
    springs: Literal[0, 1, 2] | None = None
    """Springs on the synthetic robot's door. Default: 1."""
    seed: int = 0
    """Seed of every stage and of the synthetic robot."""
    force: bool = False
    """Fit recordings too of which no fit can mean anything (`check`: certain); the report says so."""
    trials: int = 100
    """Trials of the policy on the synthetic robot, and episodes in simulation."""
    stages: tuple[Stage, ...] = STAGES
    """Which stages; those left out are read from the folder where they are in it."""
    tensorboard: bool = False
    """Write scalars for TensorBoard while it fits and trains, to OUT/identify/tensorboard and so on."""
    out: Path = Path("runs/all")
    """Results folder, with one folder for each stage. A run that was interrupted goes on from where it was."""
    again: bool = False
    """Start over, even if the folder holds a finished or interrupted run."""


@writes("all")
def run(command: All) -> None:
    """Every stage in a folder of its own below OUT, then the page of all of them; where one fails, of those before."""
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
        needs_brax()  # rather now than after the search
    if "evaluate" in command.stages:
        evaluate.needs_trials(command.trials)
    runtime.start()  # before the recording, which would start jax untuned
    from droid_jax.model.effects.registry import check_scale

    check_scale(command.effect_scale)
    load_effects(command.user_effects)
    roles = _roles(command)
    _needs_robot(command)
    out = command.out
    if {*IN_A_SCENE} & {*command.stages}:
        _remember(command, out)
    if command.again:  # now: one that a stop leaves unreached is not to pass for this run's; the first does so itself
        for stage in [stage for stage in command.stages if stage in LAST_FILES][1:]:
            forget(out / stage, stage)
    _run_stages(command, out, roles)
    from droid_jax.report.page import write_report  # matplotlib: not before the stages

    page = write_report(out)
    print(f"\n{command.out}: {(time.monotonic() - started) / 60:.0f} minutes")
    for line in told(out):
        print(line)
    print(f"report: {page}")


def _needs_stages(command: All) -> None:
    """ValueError for options of the synthetic robot where no stage records one: they would change nothing."""
    given = [name for name in ("hide", "springs") if getattr(command, name) is not None]
    if given and not {*IN_A_SCENE} & {*command.stages}:
        raise ValueError(
            f"--{given[0]} is for the stages identify and gap, and --stages leaves them out; "
            "`evaluate RUN --springs ... --hide ...` tries another robot"
        )


def _remember(command: All, out: Path) -> None:
    """Keep what was asked for; OtherRun where the folder holds what other options made, which may have taken hours.

    Stages that are left out or added make no other run, nor do more trials, nor does a policy of what lies there.
    """
    asked = {k: v for k, v in setup_of(command).items() if k not in ("stages", "trials")}
    files = [*command.recording, *filter(None, (command.scene, command.parameters))]
    asked["files"] = [str(path.resolve()) for path in files]
    if own := setup(out):
        raise ValueError(
            f"{out} holds a run of `{own.get('command', 'identify')}` itself, and the page would be of both: "
            "give another folder (--out)"
        )
    path = out / ASKED
    before = _json(path) if not command.again else None
    if before is not None and (other := changed(before, asked)):
        raise OtherRun(out, other)
    write_json(path, asked)


def _stages(command: All) -> tuple[Stage, ...]:
    """The stages that were asked for, as far as the scene has them; ValueError where none is left."""
    possible = STAGES if command.scene is None else IN_A_SCENE
    left: tuple[Stage, ...] = tuple(stage for stage in possible if stage in command.stages)
    if not left:
        why = "" if command.scene is None else " with --scene: policies are trained at the built-in door"
        raise ValueError(f"--stages must name one of {', '.join(possible)}{why}")
    return left


def needs_one_process(command: All) -> None:
    """ValueError where several processes would train: brax takes the devices of all of them."""
    if distributed.count() > 1 and "train" in _stages(command):
        raise ValueError(
            "a policy is trained by one process: give --stages identify gap, then train in one process "
            f"(without {distributed.VARIABLE})"
        )


def _run_stages(command: All, out: Path, roles: tuple[str, ...]) -> None:
    """Record where nothing was recorded, then the stages that were asked for; each says how long it took.

    Where one fails, the page of those before it is written.  Where the search found an effect that no policy can be
    trained with, they end with it.
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
            if number > 1:
                from droid_jax.report.page import write_report

                with contextlib.suppress(ValueError):  # the recording alone makes no page
                    print(f"report of what is done: {write_report(out)}")
            raise
        print(f"[{number}/{len(plan)}] {stage}: {(time.monotonic() - began) / 60:.1f} minutes", flush=True)


def _left(command: All, stages: Sequence[str]) -> str:
    """How long these stages take, in words, where that has been measured; each shows its own progress besides."""
    if command.preset != "quick" or command.scene is not None or command.recording:
        return ""
    return f" (about {max(1, round(sum(MINUTES[stage] for stage in stages)))} min left on two cores)"


def _records(command: All) -> bool:
    """Whether the synthetic robot records: the stages after the search need no recording."""
    return not command.recording and bool({*IN_A_SCENE} & {*command.stages})


def _needs_robot(command: All) -> None:
    """ValueError for a synthetic robot that there cannot be, rather now than when the folder says it was asked for."""
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
            raise ValueError(f"{error}; or leave the trials away: --stages {left}") from None


def _roles(command: All) -> tuple[str, ...]:
    """What each recording is for: "train", "validation" or "test".

    Raises ValueError, before anything long begins, where the search could not use them.  Without the search there is
    nothing to seal, unless a search could be made later.
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
        if "gap" in command.stages:  # names that are taken are told now, and not after the fit
            joined(base, gap.chosen_effects(own, scene, given))
    except ValueError:
        if "gap" in command.stages:
            raise
        return ("train",) * len(command.recording)
    return tuple(roles)


def _own(command: All) -> dict[str, Any]:
    """The options of recordings, a scene and effects of your own, which both stages with them take."""
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
    """The stages that were asked for."""
    presets = PRESETS[command.preset]
    common: dict[str, Any] = {"seed": command.seed, "again": command.again, "user_effects": command.user_effects}
    own, board = _own(command) | common, {"tensorboard": command.tensorboard}
    # Test data stay closed until the search opens them.
    seen = tuple(path for path, role in zip(recordings, roles, strict=False) if role != "test")

    def fit() -> None:
        _stage(identify.run, identify.Identify(presets.identify, seen, out=out / "identify", **board, **own))

    def search() -> None:
        # A log in blocks of time has no validation recording, and its base fit needs no start.
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
    """Whether a folder of `identify` holds the fit of these recordings: made just now, or earlier of the same."""
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


def told(out: Path) -> list[str]:
    """One line for each stage that has a result."""
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
    """Let the synthetic robot record its motions."""
    from droid_jax.door.scene import door_scene

    assert command.springs is not None  # settled
    scene = door_scene(timestep=TIMESTEP[PRESETS[command.preset].identify])
    record_synthetic(
        scene, hidden_effects(command.hide, scene), command.out, command.springs, command.seed, command.again
    )


def _stage(run_stage: Callable[[Any], None], command: Any) -> None:
    """Run a stage, anew where its folder holds a run with other inputs.

    Raises OtherRun where it was asked for something else: that may have taken hours.
    """
    try:
        run_stage(command)
    except OtherRun as other:
        if not other.inputs:
            raise
        print(f"{other.what}: it is run again")
        run_stage(replace(command, again=True))


def _json(path: Path) -> dict[str, Any] | None:
    """What a stage left, or the run itself; None where it did not.  ValueError where it cannot be read."""
    from droid_jax.report.reading import Reader

    return Reader("all", "--again").json(path) if path.is_file() else None
