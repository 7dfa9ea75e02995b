"""`gap`: searches for the physical effect that the model lacks."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from droid_jax.commands import report
from droid_jax.commands.folder import begin, fingerprints, finished, refuse_own_source, setup_of, stage_folder
from droid_jax.commands.gap_search import searched
from droid_jax.commands.options import (
    TIMESTEP,
    Channel,
    JointFriction,
    TestRecordings,
    compared,
    load_effects,
    needs_log,
    needs_recording,
    needs_scene,
    own_scene,
    recording_at,
    refine_config,
    search_config,
    warn_of_cpu,
)
from droid_jax.commands.synthetic import hidden_effects, kept_at, known_robot, record_synthetic, with_robot_options
from droid_jax.commands.writer import writes
from droid_jax.files import FIT, GAP
from droid_jax.read_json import read_json, typed
from droid_jax.report.stages import needs_whole, to_be_amended

if TYPE_CHECKING:
    import numpy as np

    from droid_jax.discrepancy.case import Case
    from droid_jax.discrepancy.config import DiscrepancyConfig
    from droid_jax.discrepancy.missing import Amended
    from droid_jax.model.effect_interface import Effect
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording


@dataclass(frozen=True)
class GapCommand:
    """Find the physical effect that the model lacks: fit, test a library of effects, validate on other recordings.

    Without --recording a synthetic robot with a hidden effect is recorded first.
    """

    recording: tuple[Path, ...] = ()
    """TRAIN VALIDATION [TEST]: two or three motions of the same robot and object, eight repeats or more of each.
    Parameters are fitted to the first, effects are selected on the second, and the third is evaluated at the end.

    ONE: one motion, sixteen repeats or more; the second half of them is validation data.

    LOG [TEST]: without repeats and commands; blocks of time are training and validation data in turns, the last third
    or the second log is test data. One motion supports weaker conclusions; the report states them.

    LOG [LOG ...]: commanded, positions measured, with fewer repeats than above; blocks of time of all logs are training
    and validation data in turns; test data are the last third of each, or --test-recording."""
    judge_on: TestRecordings = ()
    """Test data: commanded logs to which no model is fitted, beside others with few repeats. (Earlier name:
    --judge-on.)"""
    replay: Literal["auto", "whole", "windows"] = "auto"
    """How commanded logs with few repeats are replayed. whole: from their beginnings. windows: in windows of half a
    second, each from its measured state. auto: whole if a servo holds every joint (more than two minutes in windows of
    3 s), otherwise windows."""
    fit: Path | None = None
    """Folder of a finished `identify` (or `all`) of this robot and object: the base fit begins at its result, without a
    search."""
    compare: tuple[Channel, ...] = ()
    """Measured channels to compare; several are weighted by their noise. Default: as in identify."""
    preset: Literal["quick", "standard", "gpu"] = "quick"
    """Preset of the base fit, as in identify."""
    scene: Path | None = None
    """Your own MJCF instead of the built-in door."""
    parameters: Path | None = None
    """JSON list of the parameters of your own scene (docs/your-robot.md)."""
    joints: tuple[str, ...] = ()
    """Measured joints of your own scene; default: all driven joints."""
    object_joint: str | None = None
    """Joint of the object that is moved, in your own scene; without it no effect of a door is tested."""
    joint_friction: JointFriction = "held"
    """Dry friction of your own scene's joints. held: a stiffer constraint, with which friction holds a load still,
    unless the MJCF sets solimpfriction or solreffriction itself. scene: the MJCF's constraint, whose default lets
    joints creep."""
    motion_cutoff: float | None = None
    """Logs without commands: cutoff of the filter of the measured positions, Hz; default: 20."""
    effects: tuple[str, ...] = ()
    """Effects of the library to test; default: all that the scene can have."""
    without: tuple[str, ...] = ()
    """Effects of the library to leave out."""
    effect_scale: float | None = None
    """Factor on forces and torques of the library's effects (priors, bounds, minimum effect sizes), which are those of
    an arm of a Panda's size; default: by the robot's weight and inertia and the measured torques. For an axis with
    forces of a kilonewton: 30."""
    user_effects: Path | None = None
    """Python file that registers your own effects (docs/your-effect.md); it is executed."""
    budget: float | None = None
    """Minutes after which no further candidate is tried; the report says what was left out."""
    hide: tuple[str, ...] | None = None
    """Hidden effect of the synthetic robot, name=coefficient or name[joint]=coefficient; none for no effect. Default:
    magnetic_catch=1.5 (N m)."""
    springs: Literal[0, 1, 2] | None = None
    """Springs on the synthetic robot's door. Default: 1."""
    seed: int = 0
    """Seed of the search, of the synthetic robot and of the resamples."""
    force: bool = False
    """Also search a recording with a certain finding of `check`, whose fit would be meaningless; the report says so."""
    tensorboard: bool = False
    """Write scalars of the base fit for TensorBoard while it runs, to OUT/tensorboard."""
    out: Path = Path("runs/gap")
    """Results folder. An interrupted run continues."""
    again: bool = False
    """Start over, even if the folder holds a finished or interrupted run."""


@writes("gap")
def run(command: GapCommand) -> None:
    """Record or load, fit, search, and write the run's folder and its page."""
    from droid_jax import runtime
    from droid_jax.report.progress import FOLDER, needs_writer, stages

    command = with_robot_options(command)
    needs_scene(command)
    needs_writer(command.tensorboard)
    runtime.start()
    warn_of_cpu(command.preset)
    from droid_jax.discrepancy.log_case import case_of, open_loop_errors
    from droid_jax.discrepancy.results import write_amended, write_gap
    from droid_jax.preflight.check_log import check_log, refuse_certain
    from droid_jax.preflight.search_inputs import assigned_roles
    from droid_jax.recordings.split import Split
    from droid_jax.synthetic.hidden_effects import in_words
    from droid_jax.synthetic.robot import is_synthetic

    out = command.out
    fit = None if command.fit is None else stage_folder(command.fit, "identify", FIT)
    refuse_own_source(out, fit)
    load_effects(command.user_effects, fit)
    scene, base = gap_model(command)
    given = given_to(command)
    needs_log(command.motion_cutoff, given)
    hidden = {} if given else hidden_effects(command.hide, scene)
    effects = chosen_effects(command, scene, given)
    start = None if fit is None else values_of(fit, base)
    fitted, judges = given[: len(command.recording)], given[len(command.recording) :]
    scale = effect_scale(command, scene, given)
    setup = {**setup_of(command), "command": "gap", **fingerprints(scene, base, fitted), "effect_scale": scale}
    setup |= {"judge_on_sha256": [recording.sha256 for recording in judges]} if judges else {}
    if start is not None:
        setup["start"] = start.tolist()
    if finished(out, setup, command.again, GAP):
        _done(out)
        return
    known = not command.again and to_be_amended(out)  # the verdict exists and stays
    if not command.force:
        refuse_certain(scene, given)
    split, roles = assigned_roles(scene, fitted, judges) if given else (Split.RECORDINGS, {})
    if split is Split.BLOCKS and start is not None:
        print("a log without repeats is fitted without a search: --fit is not needed")
    config = gap_config(command)
    if not given:
        assert command.springs is not None  # settled
        roles = record_synthetic(scene, hidden, out, command.springs, command.seed, command.again)
    then = "; then first fits, which estimate the noise" if split is Split.WINDOWS else ""
    print(f"compiling the replay{then} ...", flush=True)
    began = time.monotonic()
    with stages(("first_fits",) if then else ()) as show:
        case = case_of(split, scene, base, effects, roles, config, start, lambda now: show("first_fits", now))
    preparation = time.monotonic() - began
    begin(out, setup, command.again, "gap", keep=known)  # only now that all inputs are valid
    board = out / FOLDER if command.tensorboard else None
    synthetic_robot = all(is_synthetic(r) for r in roles.values())
    robot = known_robot(command.recording or kept_at(out)) if synthetic_robot else {}
    description = {
        "findings": [asdict(f) for recording in given or roles.values() for f in check_log(scene, recording)],
        "split": {"by": split.value, "limits": " ".join(filter(None, (split.limits, *case.limits)))},
        "versions": runtime.versions(),
        "device": runtime.device(),
        "setup": {
            **setup,
            "synthetic_robot": synthetic_robot,
            "robot": robot,
            "hidden": in_words(robot.get("hide", ())),
        },
    }
    written = list[str]()

    def keep(case: Case, now: Amended, seconds: Mapping[str, float]) -> None:
        """Write the verdict, and again after each amendment, so that a stop between them loses nothing."""

        def write() -> None:
            described = {**description, "seconds": {"preparation": preparation, **seconds}}
            (write_amended if written else write_gap)(out, case, now.verdict, now.final, described, now.states)
            written.append(now.verdict.sentence)

        description.pop("open_loop", None)  # of the model before
        if split is not Split.WINDOWS or not written:
            write()
        if split is Split.WINDOWS:
            values = now.verdict.base.values, now.final.model.values
            try:
                description["open_loop"] = open_loop_errors(case, roles, *values)
            except ValueError as error:  # the verdict does not depend on it
                warnings.warn(f"whole motions are not replayed open loop: {error}", stacklevel=2)
            write()

    try:
        searched(split, case, roles, out / "checkpoints", start, board, keep)
    except KeyboardInterrupt:
        if written:
            print(f"the verdict is in {out / GAP}: {written[0]} The same command makes the amendments that are missing")
        raise
    shutil.rmtree(out / "checkpoints" / "replays", ignore_errors=True)
    _done(out)


def gap_model(command: GapCommand) -> tuple[Scene, Space]:
    """The scene and the base parameters, including nuisances."""
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space

    if command.scene is not None:
        return own_scene(command)
    scene = door_scene(timestep=TIMESTEP[command.preset])
    return scene, door_space(scene) + door_nuisances(scene)


class _Value(TypedDict):
    name: str
    best: float


class _Fit(TypedDict):
    """The entries of fit.json that a search reads."""

    parameters: list[_Value]


def values_of(folder: Path, base: Space) -> np.ndarray:
    """Values [F] of the base parameters in a folder of `identify`; nuisances that were not fitted keep their means.

    Raises ValueError if the folder has no complete fit, or the fit lacks a parameter of this model.
    """
    needs_whole(folder)
    try:
        parameters = typed(read_json(folder / FIT), _Fit, FIT)["parameters"]
        known = {p["name"]: p["best"] for p in parameters}
    except (OSError, ValueError) as error:
        raise ValueError(f"--fit {folder} is no folder of a finished `identify`: {error}") from None
    lacking = [p.name for p in base.parameters if not p.nuisance and p.name not in known]
    if lacking:
        raise ValueError(f"--fit {folder} is of another model: it lacks {', '.join(lacking)}")
    return base.values({n: v for n, v in known.items() if n in base.names})


def effect_scale(command: GapCommand, scene: Scene, recordings: Sequence[Recording]) -> float:
    """Scale of the library's forces and torques: the given one, or that of the machine."""
    from droid_jax.discrepancy.candidates import machine_scale

    fitted = recordings[: len(command.recording)]  # test recordings come after them
    return machine_scale(scene, fitted) if command.effect_scale is None else command.effect_scale


def chosen_effects(
    command: GapCommand, scene: Scene, recordings: list[Recording], channels: Sequence[str] = ()
) -> tuple[Effect, ...]:
    """The library's effects for this scene, filtered by --effects and --without.

    channels: compared channels; empty: those of the recordings or of --compare.
    Raises ValueError for unknown names, for effects that this scene cannot have, and if no effect remains.
    """
    from droid_jax.discrepancy.candidates import observable_effects
    from droid_jax.discrepancy.case import comparing
    from droid_jax.model.effects.registry import library

    library(scene, command.without)  # names are checked there
    config = gap_config(command)
    if not channels:
        compared = comparing(scene, recordings, config).compare.channels if recordings else command.compare
        channels = tuple(compared) or ("torque",)
    here = observable_effects(scene, recordings, effect_scale(command, scene, recordings), channels)
    asked = {e.name for e in library(scene, command.effects or None)}
    names = {e.name for e in here}
    impossible = [name for name in command.effects if name not in names]
    chosen = tuple(e for e in here if e.name in asked and e.name not in command.without)
    nowhere = [e.name for e in chosen if not e.locations]
    if nowhere:
        what = f"effects {', '.join(nowhere)} state no locations (Effect.locations), so they cannot be tested"
        if {*nowhere} & {*command.effects}:
            raise ValueError(what)
        warnings.warn(f"{what}: they are left out", stacklevel=2)
    if impossible or not any(e.locations for e in chosen):
        what = f"cannot have {', '.join(impossible)}" if impossible else "is left without any effect"
        raise ValueError(f"scene {scene.name!r} {what} here; it can have: {', '.join(sorted(names))}")
    return chosen


def gap_config(command: GapCommand) -> DiscrepancyConfig:
    """The preset's configuration with the numbers given by options."""
    from droid_jax.discrepancy.config import CONVERGE_ITERATIONS, DiscrepancyConfig
    from droid_jax.identify.multistart import RefineConfig

    if command.budget is not None and not command.budget > 0:
        raise ValueError(f"--budget must be above 0 minutes, got {command.budget:g}")
    asked: dict[str, Any] = {} if command.budget is None else {"budget_minutes": command.budget}
    return DiscrepancyConfig(
        search=search_config(command.preset, command.seed),
        refine=replace(refine_config(command.preset) or RefineConfig(), iterations=CONVERGE_ITERATIONS),
        compare=compared(command.motion_cutoff),
        channels=command.compare or None,
        replay=command.replay,
        seed=command.seed,
        **asked,
    )


def given_to(command: GapCommand) -> list[Recording]:
    """The given recordings, those of --test-recording last; empty if the synthetic robot is to be recorded."""
    needs_recording(command)
    if command.judge_on and not command.recording:
        raise ValueError("--test-recording needs --recording: the synthetic robot records its own test data")
    return [recording_at(path) for path in (*command.recording, *command.judge_on)]


def _done(out: Path) -> None:
    """Build the page and print a summary."""
    from droid_jax.report.gap_folder import largest_shifts, read_gap
    from droid_jax.report.text import lines

    gap = read_gap(out)
    shifted = next(iter(largest_shifts(gap.found.shifts)), None)
    for line in lines("gap.txt.jinja", gap=gap, found=gap.found, shifted=shifted):
        print(line)
    report.run(report.Report(out))
