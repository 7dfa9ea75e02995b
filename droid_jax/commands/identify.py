"""`identify`: fits a Gaussian over the parameters to recordings."""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from droid_jax.commands import report
from droid_jax.commands.folder import begin, fingerprints, finished, kept_recordings, setup_of
from droid_jax.commands.options import (
    TIMESTEP,
    Channel,
    JointFriction,
    Preset,
    TestRecordings,
    compared,
    load_effects,
    needs_log,
    needs_recording,
    needs_scene,
    own_scene,
    quick_settings,
    recording_at,
    refine_config,
    search_config,
    warn_of_cpu,
)
from droid_jax.commands.pictures import keep_replay
from droid_jax.commands.synthetic import known_robot, with_robot_options
from droid_jax.commands.writer import writes
from droid_jax.files import EXTENDED

if TYPE_CHECKING:
    from droid_jax.identify.pipeline import Identified, IdentifyConfig
    from droid_jax.model.effect_interface import Effect
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording
    from droid_jax.report.identify_folder import FitFile


@dataclass(frozen=True)
class Identify:
    """Fit physical parameters to recorded torques or positions; the result is a Gaussian over the parameters.

    Without --recording a synthetic robot (a simulation with hidden physics) is recorded first.
    """

    preset: Preset = "quick"
    """quick: minutes on a laptop.  standard: 100 generations, 2 ms steps.  paper: the paper's search (Table I's prior
    and joint damping, 30 samples, 5 parents, no refinement).  gpu: 1024 samples."""
    recording: tuple[Path, ...] = ()
    """Recordings to fit (npz or CSV folder; ROS bags through convert); several of the same robot and object are
    fitted together."""
    judge_on: TestRecordings = ()
    """Test data: whole recordings on which the fit is evaluated and to which it is not fitted. All repeats of
    --recording are then fitted. Default: the last repeats are held out, or the last part of a log without commands.
    (Earlier name: --judge-on.)"""
    compare: tuple[Channel, ...] = ()
    """Measured channels to fit; several are weighted by their noise. Default: torque; without measured torques position
    (or, without it, velocity) and the object's angle."""
    demonstrations: tuple[str, ...] | None = None
    """Demonstrations that the synthetic robot repeats if no recording is given (A, B or C). Default: A C; A with the
    preset paper."""
    springs: Literal[0, 1, 2] | None = None
    """Springs on the synthetic robot's door (its values are the fitted columns of Table I). Default: 1."""
    scene: Path | None = None
    """Your own MJCF instead of the built-in door."""
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
    extended: Path | None = None
    """extended.json of a gap search: its effects are added to the model, and fitted too."""
    effects: tuple[str, ...] = ()
    """Effects of the library (docs/discrepancy-search.md) that are added to the model and fitted too, for example
    load_friction."""
    user_effects: Path | None = None
    """Python file that registers your own effects (docs/your-effect.md); it is executed."""
    engine: Literal["auto", "mjx", "mujoco"] = "auto"
    """mjx: compiled, on all devices.  mujoco: plain C, on all cores; commanded logs need motor-side torques, without
    gravity if the scene compensates it.  auto: plain C for commanded recordings of one repeat that C can replay (with a
    GPU only for small batches), otherwise MJX."""
    population: int | None = None
    """Samples per generation; default: the preset's."""
    generations: int | None = None
    """Largest number of generations; default: the preset's (quick: 20, or 5 in plain C)."""
    restarts: int | None = None
    """Independent searches in one batch; default: the preset's."""
    nuisances: bool = True
    """Fit and marginalise nuisances: pose, link masses, servo gains, timing and offsets (never with the preset paper).
    In your own scene: your parameters with "nuisance": true."""
    whitened: bool = False
    """The search weights torques by their noise instead of comparing them in N m (the refinement always does)."""
    mj_step: bool = False
    """The recordings come from a MuJoCo program with this scene and time step: replay them with the first-order steps
    of mj_step, one per row."""
    motion_cutoff: float | None = None
    """Logs without commands: cutoff of the filter of the measured positions, Hz; default: 20."""
    seed: int = 0
    """Seed of the search, of the synthetic robot and of the samples."""
    force: bool = False
    """Also fit a recording with a certain finding of `check`, whose fit would be meaningless; the report says so."""
    tensorboard: bool = False
    """Write scalars for TensorBoard while it runs, to OUT/tensorboard."""
    out: Path = Path("runs/identify")
    """Results folder. An interrupted run continues."""
    again: bool = False
    """Start over, even if the folder holds a finished or interrupted run."""


@writes("identify")
def run(command: Identify) -> None:
    """Record or load, fit, and write the run's folder and its page."""
    from droid_jax import runtime
    from droid_jax.report.progress import needs_writer

    command = with_robot_options(command)
    needs_scene(command)
    needs_writer(command.tensorboard)
    runtime.start()
    warn_of_cpu(command.preset)
    from droid_jax.identify.pipeline import cost_samples, prepare, run_fit
    from droid_jax.identify.results import write_run
    from droid_jax.identify.solution_checks import creep_of_fit
    from droid_jax.preflight.check_log import check_log, refuse_certain
    from droid_jax.preflight.preflight import command_notes
    from droid_jax.report.identify_folder import read_fit
    from droid_jax.report.progress import FOLDER, scalars, stages
    from droid_jax.storage import write_bytes

    load_effects(command.user_effects, None if command.extended is None else command.extended.parent)
    out = command.out
    scene, space, nuisances = identify_model(command)
    scene, space, effects = with_effects(command, scene, space)
    given, judges = _given(command)
    needs_log(command.motion_cutoff, (*given, *judges))
    setup = {**setup_of(command), **fingerprints(scene, space if nuisances is None else space + nuisances, given)}
    setup |= {"judge_on_sha256": [recording.sha256 for recording in judges]} if judges else {}
    if finished(out, setup, command.again):
        report.run(report.Report(out))
        return
    config = identify_config(command)
    _needs_demonstrations(command, given)
    if not command.force:
        refuse_certain(scene, (*given, *judges))
    recordings, truth, known = _recordings(command, scene, out, given)
    print("compiling the replay ...", flush=True)
    problem = prepare(scene, space, recordings, nuisances=nuisances, config=config, effects=effects, judge_on=judges)
    engine = {"mjx": "MJX", "mujoco": "plain C MuJoCo"}[problem.engine.engine]
    print(f"engine: {engine} ({problem.engine.why})", flush=True)
    # Read before the folder is cleared: the file may lie in it.
    extended = None if command.extended is None else command.extended.read_bytes()
    begin(out, setup, command.again, "identify")  # only now that all inputs are valid
    if extended is not None:
        write_bytes(out / EXTENDED, extended)
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    board = out / FOLDER if command.tensorboard else None
    with stages(("search", "refine", "judge", "sample")) as show, scalars(board) as write:

        def progress(stage: str, value: Any) -> None:
            show(stage, value)
            write(stage, value)

        found = run_fit(problem, checkpoints=out / "checkpoints", progress=progress)
        description = {
            **_description(command, found, recordings, judges),
            "started": started,
            "robot": known,
            "setup": setup,
        }
        progress("sample", None)
        keep_replay(out, found, recordings[0])
        write_run(
            out, found, description, truth=truth, effects=effects,
            samples=lambda: cost_samples(found, config.samples, config.seed),
            notes=[
                *(text for recording in recordings for text in command_notes(scene, recording)),
                *creep_of_fit(scene, found.full, found.best, recordings),
            ],
            findings=[finding for recording in (*recordings, *judges) for finding in check_log(scene, recording)],
        )  # fmt: skip
    report.run(report.Report(out))
    _summary(found, read_fit(out), [r.repeats for r in recordings])


def _description(
    command: Identify, found: Identified, recordings: Sequence[Recording], judges: Sequence[Recording]
) -> dict[str, Any]:
    """Content of config.json about a fit, without its setup."""
    from droid_jax import runtime
    from droid_jax.synthetic.robot import is_synthetic

    return {
        "command": "identify",
        "preset": command.preset,
        "scene": found.scene.name,
        "engine": found.engine.engine,
        "recordings": [_entry(r, found.heldout_repeats[r.name]) for r in recordings],
        "judged_on": [_entry(r) for r in judges],
        "seed": command.seed,
        "versions": runtime.versions(),
        "device": runtime.device(),
        "synthetic_robot": all(is_synthetic(r) for r in recordings),
    }


def _entry(recording: Recording, heldout: Sequence[int] = ()) -> dict[str, Any]:
    """Entry of config.json for a recording."""
    named = {"name": recording.name, "sha256": recording.sha256, "repeats": recording.repeats}
    return {**named, "heldout": list(heldout), "duration": recording.duration}


def identify_model(command: Identify) -> tuple[Scene, Space, Space | None]:
    """The scene, the parameters of interest, and the nuisances (None for none)."""
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space

    if command.scene is not None:
        scene, listed = own_scene(
            command, engine="mujoco" if command.engine == "mujoco" else "mjx", mj_step=command.mj_step
        )
        if all(p.nuisance for p in listed.parameters):
            raise ValueError(f"{command.parameters}: every entry is a nuisance; identify fits at least one that is not")
        main = listed.select(p.name for p in listed.parameters if not p.nuisance)
        extra = [p.name for p in listed.parameters if p.nuisance]
        return scene, main, listed.select(extra) if command.nuisances and extra else None
    timestep = TIMESTEP[command.preset]
    if command.preset == "paper":
        scene = door_scene(gains="paper", timestep=timestep)
        return scene, door_space(scene, preset="paper"), None
    scene = door_scene(timestep=timestep)
    return scene, door_space(scene), door_nuisances(scene) if command.nuisances else None


def identify_config(command: Identify) -> IdentifyConfig:
    """The preset's configuration with the numbers given by options."""
    from droid_jax.identify.pipeline import IdentifyConfig

    changes = {k: getattr(command, k) for k in ("population", "generations", "restarts")}
    settings = {**quick_settings(command.preset), **({"generations_in_c": None} if command.generations else {})}
    return IdentifyConfig(
        **settings,
        engine=command.engine,
        search=search_config(command.preset, command.seed, **changes),
        refine=refine_config(command.preset),
        seed=command.seed,
        channels=command.compare or None,
        compare=compared(command.motion_cutoff, whitened=command.whitened, mj_step=command.mj_step),
    )


def with_effects(command: Identify, scene: Scene, space: Space) -> tuple[Scene, Space, tuple[Effect, ...]]:
    """Scene and space with the effects of --extended or --effects, and these effects."""
    if command.extended is not None:
        from droid_jax.identify.extended_model import load_extended

        needs_one(command)
        model = load_extended(command.extended, scene)
        return model.scene, space + model.effect_space, model.effects
    from droid_jax.model.effects.registry import joined

    scene, effects = effects_in(command, scene)
    return scene, joined(space, effects) if effects else space, effects


def effects_in(command: Identify, scene: Scene) -> tuple[Scene, tuple[Effect, ...]]:
    """The scene as the effects of --extended or --effects need it, and these effects."""
    needs_one(command)
    if command.extended is not None:
        from droid_jax.identify.extended_model import load_extended

        model = load_extended(command.extended, scene)
        return model.scene, model.effects
    if not command.effects:
        return scene, ()
    from droid_jax.model.effects.registry import library, ready

    effects = library(scene, command.effects)
    if absent := [name for name in command.effects if name not in {e.name for e in effects}]:
        raise ValueError(f"scene {scene.name!r} cannot have the effects {', '.join(absent)} (--effects)")
    return ready(scene), effects


def needs_one(command: Identify) -> None:
    """ValueError if both --extended and --effects are given."""
    if command.extended is not None and command.effects:
        raise ValueError("--extended and --effects both add effects: give one of them")


def _given(command: Identify) -> tuple[list[Recording], list[Recording]]:
    """The recordings to fit (none for the synthetic robot) and the test recordings; ValueError for equal names."""
    needs_recording(command)
    if command.judge_on and not command.recording:
        raise ValueError("--test-recording needs --recording: the synthetic robot is tested on its own repeats")
    files: dict[str, Path] = {}
    paths = (*command.recording, *command.judge_on)
    recordings = [recording_at(path) for path in paths]
    for path, recording in zip(paths, recordings, strict=True):
        if recording.name in files:
            raise ValueError(
                f"{files[recording.name]} and {path} are both named {recording.name!r}, but results refer to "
                f"recordings by name: `python -m droid_jax.run convert {path} --name OTHER --out other.npz` changes it"
            )
        files[recording.name] = path
    count = len(command.recording)
    return recordings[:count], recordings[count:]


def _needs_demonstrations(command: Identify, given: list[Recording]) -> None:
    """ValueError for an unknown demonstration."""
    from droid_jax.door.demonstration import demonstration_path

    for name in () if given else command.demonstrations or ():
        demonstration_path(name)


def _recordings(
    command: Identify, scene: Scene, out: Path, given: list[Recording]
) -> tuple[list[Recording], dict[str, float] | None, dict[str, Any]]:
    """The recordings to fit, the synthetic robot's true values, and the robot's springs, seed and hidden effects.

    Recordings of the synthetic robot are stored in the run's folder.  True values are None if they are unknown.
    """
    from droid_jax.recordings.formats import load_recording
    from droid_jax.synthetic.robot import is_synthetic, synthetic_truth

    if given:  # real recordings may lie in the same folder as a synthetic_robot.json
        synthetic_robot = command.scene is None and all(is_synthetic(r) for r in given)
        known = known_robot(command.recording) if synthetic_robot else {}
        return given, synthetic_truth(scene, known["springs"], known["seed"]) if known else None, known
    from droid_jax.door.demonstration import PLANS, demonstration_path
    from droid_jax.synthetic.robot import record

    assert command.springs is not None and command.demonstrations is not None  # settled
    gains = "paper" if command.preset == "paper" else "impedance"
    truth = synthetic_truth(scene, command.springs, command.seed, nuisances=command.preset != "paper")

    def recorded(name: str) -> Recording:  # the same seed as in `record`
        demonstration = load_recording(demonstration_path(name, gains=gains))
        return record(scene, demonstration, truth, seed=1000 * command.seed + sorted(PLANS).index(name))

    tag = f"springs{command.springs}_seed{command.seed}" + ("_paper" if gains == "paper" else "")
    paths = {name: out / "recordings" / f"{name}_{tag}.npz" for name in command.demonstrations}
    return list(kept_recordings(paths, command.again, recorded).values()), truth, {}


def _summary(found: Identified, fit: FitFile, repeats: Sequence[int]) -> None:
    """Print the summary of a fit; fit: content of fit.json; repeats: their number in each recording."""
    from droid_jax.identify.solution_checks import solution_notes
    from droid_jax.report.identify_page import asked_of, far_off, lacks_something, needed, noiseless
    from droid_jax.report.text import lines

    for text in solution_notes(found.checks, found.scene.name):
        warnings.warn(text, stacklevel=2)
    said = {"far_off": far_off(fit), "lacks_something": lacks_something(fit), "needs": needed(repeats)}
    asked, seconds = asked_of(fit) if noiseless(fit) else "", sum(found.seconds.values())
    for line in lines("identify.txt.jinja", fit=fit, seconds=seconds, asked=asked, **said):
        print(line)
