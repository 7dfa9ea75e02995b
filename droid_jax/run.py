"""The command line: parses, calls, writes.  `python -m droid_jax.run --help`

Heavy modules are imported inside the commands, after `runtime.tune()` and so that --help is quick.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from droid_jax.identify.pipeline import IdentifyConfig
    from droid_jax.measure.recording import Recording
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene

Preset = Literal["quick", "standard", "paper", "gpu"]


@dataclass(frozen=True)
class Identify:
    """Fit the physics to recorded torques: recordings in, a Gaussian over the parameters out.

    Without --recording a stand-in robot (a simulation with hidden physics) is recorded first.
    """

    preset: Preset = "quick"
    """quick: a laptop, minutes.  standard: 100 generations, 2 ms steps.  paper: the paper's own
    setting (Table I's servo, 30 samples, 5 parents, no refinement).  gpu: 1024 samples."""
    recording: tuple[Path, ...] = ()
    """Recordings to fit (npz, CSV folder, ROS bag); several of the same robot and object are fitted together."""
    demonstrations: tuple[str, ...] = ("A", "C")
    """What the stand-in robot repeats when no recording is given (A, B or C; the paper preset uses A)."""
    springs: Literal[0, 1, 2] = 1
    """Springs on the stand-in's door (its values are the fitted columns of Table I)."""
    scene: Path | None = None
    """Your own MJCF instead of the built-in door."""
    parameters: Path | None = None
    """JSON list of the parameters of your own scene (docs/own-robot.md)."""
    joints: tuple[str, ...] = ()
    """Measured joints of your own scene; default: all driven joints."""
    object_joint: str | None = None
    """Joint of the thing that is moved, in your own scene."""
    engine: Literal["mjx", "mujoco"] = "mjx"
    """mjx: compiled, all devices.  mujoco: plain C, all cores."""
    population: int | None = None
    """Samples per generation; default: the preset's."""
    generations: int | None = None
    """Generations at most; default: the preset's."""
    restarts: int | None = None
    """Independent searches in one batch; default: the preset's."""
    nuisances: bool = True
    """Fit and marginalise pose, link masses, servo gains, timing and offsets too (never in the paper preset).
    In your own scene: those of your parameters that say "nuisance": true."""
    whitened: bool = False
    """The search counts torques in units of their noise instead of N m (the refinement always does)."""
    seed: int = 0
    """Seed of the search, of the stand-in robot and of the samples."""
    out: Path = Path("runs/identify")
    """Results folder. A run that was interrupted goes on from where it was."""
    again: bool = False
    """Start over, even if the folder holds a finished or interrupted run."""


@dataclass(frozen=True)
class Record:
    """Record the stand-in robot (plain C MuJoCo with hidden physics): repeats of a demonstration, as an npz file."""

    demonstration: str = "A"
    """A, B or C."""
    springs: Literal[0, 1, 2] = 1
    """Springs on the door."""
    repeats: int = 10
    """How often the motion is repeated."""
    seed: int = 0
    """Seed of the robot's hidden errors and of its noise."""
    gains: Literal["impedance", "paper"] = "impedance"
    """Servo gains."""
    out: Path = Path("runs/recording.npz")
    """File (npz) or folder (CSV) to write."""


@dataclass(frozen=True)
class Report:
    """Build the HTML page of a finished run again."""

    run: Annotated[Path, tyro.conf.Positional] = Path("runs/identify")
    """The run's folder."""


@dataclass(frozen=True)
class Convert:
    """Read ROS bags or a CSV folder, check them, and write a recording that identify takes.

    Bags do not say what their efforts are, nor the servo's gains: say it here.
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """ROS 1 .bag or ROS 2 bags, one per repeat (or a folder of them), a CSV folder, or an npz file."""
    out: Path = Path("runs/recording.npz")
    """File (npz) or folder (CSV) to write."""
    joints: tuple[str, ...] = ()
    """Bags: measured joints, in the order wanted."""
    torque: Literal["motor", "link"] | None = None
    """Bags: motor (current, actuator force) or link (a sensor behind the gear, a Panda's tau_J)."""
    gravity: bool = False
    """Bags: the torque contains what carries the arm's weight."""
    state_topic: str = "/joint_states"
    """Bags: topic of sensor_msgs/JointState."""
    command_topic: str | None = None
    """Bags: topic of the position commands; without one the log is replayed by inverse dynamics."""
    stiffness: tuple[float, ...] = ()
    """Bags: servo gains of the commanded joints, N m/rad."""
    damping: tuple[float, ...] = ()
    """Bags: servo damping of the commanded joints, N m s/rad."""
    start: float | None = None
    """Keep the part from here, s."""
    end: float | None = None
    """Keep the part up to here, s."""


Command = Identify | Record | Convert | Report


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; bad input ends with one line on stderr and exit code 2."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help")):
        arguments = ["identify", *arguments]
    command = tyro.cli(Command, args=arguments, prog="python -m droid_jax.run", description=__doc__)
    actions: dict[type, Callable[[Any], None]] = {
        Identify: run_identify, Record: run_record, Convert: run_convert, Report: run_report,
    }  # fmt: skip
    try:
        actions[type(command)](command)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    return 0


def run_identify(command: Identify) -> None:
    """Record or load, fit, write the run's folder and its page."""
    print("starting jax ...", flush=True)
    from droid_jax import runtime

    runtime.tune()
    runtime.import_mjx()
    from droid_jax.identify.pipeline import cost_samples, identify
    from droid_jax.identify.results import prepare_folder, write_run
    from droid_jax.report.progress import stages

    out = prepare_folder(command.out)
    setup = _setup(command)
    if _finished(out, setup, command.again):
        run_report(Report(out))
        return
    scene, space, nuisances = _model(command)
    recordings, truth = _recordings(command, scene, out)
    config = _config(command)
    _begin(out, setup, command.again)
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    with stages(("search", "refine", "judge", "sample")) as progress:
        found = identify(
            scene, space, recordings, nuisances=nuisances, config=config, checkpoints=out / "checkpoints",
            progress=progress,
        )  # fmt: skip
        progress("sample", None)
        samples = cost_samples(found, config.samples, config.seed)
    description = {
        "command": "identify",
        "preset": command.preset,
        "scene": scene.name,
        "engine": config.engine,
        "recordings": [
            {
                "name": r.name,
                "sha256": r.sha256,
                "repeats": r.repeats,
                "heldout": list(found.heldout_repeats[r.name]),
                "duration": r.duration,
            }
            for r in recordings
        ],
        "seed": command.seed,
        "versions": runtime.versions(),
        "device": runtime.device(),
        "started": started,
        "stand_in": truth is not None,
        "setup": setup,
    }
    write_run(out, found, description, truth=truth, samples=samples)
    _draw(out, found, recordings[0])
    run_report(Report(out))
    _summary(found)


def run_record(command: Record) -> None:
    """Record the stand-in robot and save what it measured."""
    from droid_jax.measure.demonstration import demonstration_path
    from droid_jax.measure.formats import load, save
    from droid_jax.measure.surrogate import SurrogateConfig, record, stand_in_truth
    from droid_jax.model.door_scene import door_scene

    scene = door_scene(springs=command.springs, gains=command.gains)
    demonstration = load(demonstration_path(command.demonstration, gains=command.gains))
    truth = stand_in_truth(scene, command.springs, command.seed)
    recording = record(scene, demonstration, truth, seed=command.seed, config=SurrogateConfig(repeats=command.repeats))
    command.out.parent.mkdir(parents=True, exist_ok=True)
    path = save(recording, command.out)
    print(f"stand-in robot recorded {recording.repeats} repeats of {recording.duration:.1f} s: {path}")


def run_convert(command: Convert) -> None:
    """Load whatever it is, validate, cut, and save."""
    from droid_jax.measure.formats import load, save

    if not command.source:
        raise ValueError("convert needs the files or folders to read")
    path, *others = command.source
    if others:
        from droid_jax.measure.rosbag import read_bags

        recording = read_bags(command.source, **_bag_options(command))
    else:
        recording = load(path, **(_bag_options(command) if command.joints else {}))
    if command.start is not None or command.end is not None:
        first, last = recording.span
        start, end = command.start, command.end
        recording = recording.window(first if start is None else start, last if end is None else end)
    path = save(recording, command.out)
    channels = ", ".join(f"{n} ({len(c.columns)} x {len(c.time)})" for n, c in recording.channels.items())
    print(f"{recording.repeats} repeats of {recording.duration:.1f} s, channels {channels}: {path}")


def _bag_options(command: Convert) -> dict[str, Any]:
    """What bags do not say; ValueError names what is missing."""
    import numpy as np

    from droid_jax.measure.recording import ServoGains, TorqueConvention, TorqueSide

    if not command.joints or command.torque is None:
        raise ValueError("a ROS bag does not say which joints to read or what its efforts are: give --joints, --torque")
    if len(command.stiffness) != len(command.damping):
        raise ValueError(f"got {len(command.stiffness)} --stiffness and {len(command.damping)} --damping")
    gains = ServoGains(np.array(command.stiffness), np.array(command.damping)) if command.stiffness else None
    return {
        "joints": command.joints,
        "torque": TorqueConvention(TorqueSide(command.torque), command.gravity),
        "state_topic": command.state_topic,
        "command_topic": command.command_topic,
        "gains": gains,
    }


def run_report(command: Report) -> None:
    """Write RUN/report.html."""
    from droid_jax.report.page import write_report

    print(f"report: {write_report(command.run)}")


def _model(command: Identify) -> tuple[Scene, Space, Space | None]:
    """The scene, what is fitted, and the nuisances beside it."""
    from droid_jax.model.door import door_nuisances, door_space
    from droid_jax.model.door_scene import door_scene
    from droid_jax.model.own import friction_joints, load_parameters
    from droid_jax.model.scene import load_scene

    if command.scene is not None:
        if command.parameters is None:
            raise ValueError("--scene needs --parameters FILE.json, the list of what to fit (docs/own-robot.md)")
        scene = load_scene(
            command.scene,
            joints=command.joints or None,
            object_joint=command.object_joint,
            friction_joints=friction_joints(command.parameters),
        )
        listed = load_parameters(command.parameters, scene)
        main = listed.select(p.name for p in listed.parameters if not p.nuisance)
        extra = [p.name for p in listed.parameters if p.nuisance]
        return scene, main, listed.select(extra) if command.nuisances and extra else None
    timestep = {"quick": 0.004, "standard": 0.002, "paper": 0.002, "gpu": 0.002}[command.preset]
    if command.preset == "paper":
        scene = door_scene(gains="paper", timestep=timestep)
        return scene, door_space(scene, preset="paper"), None
    scene = door_scene(timestep=timestep)
    return scene, door_space(scene), door_nuisances(scene) if command.nuisances else None


def _recordings(command: Identify, scene: Scene, out: Path) -> tuple[list[Recording], dict[str, float] | None]:
    """The given recordings, or the stand-in's (kept in the run's folder) with their hidden truth."""
    from droid_jax.measure.formats import load

    if command.recording:
        return [load(path) for path in command.recording], None
    if command.scene is not None:
        raise ValueError("--scene needs --recording: the stand-in robot only knows the built-in door")
    from droid_jax.measure.demonstration import demonstration_path
    from droid_jax.measure.formats import save
    from droid_jax.measure.surrogate import record, stand_in_truth

    gains = "paper" if command.preset == "paper" else "impedance"
    names = command.demonstrations[:1] if command.preset == "paper" else command.demonstrations
    truth = stand_in_truth(scene, command.springs, command.seed, nuisances=command.preset != "paper")
    recordings = []
    for index, name in enumerate(names):
        path = out / "recordings" / f"{name}_springs{command.springs}_seed{command.seed}.npz"
        if command.again or not path.is_file():
            print(f"recording the stand-in robot: demonstration {name}, 10 repeats ...", flush=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            demonstration = load(demonstration_path(name, gains=gains))
            save(record(scene, demonstration, truth, seed=1000 * command.seed + index), path)
        recordings.append(load(path, name=name))
    return recordings, truth


def _config(command: Identify) -> IdentifyConfig:
    """The preset with the command's own numbers."""
    from droid_jax.compare.residuals import CompareConfig
    from droid_jax.identify.pipeline import IdentifyConfig
    from droid_jax.identify.refine import RefineConfig
    from droid_jax.identify.search import SearchConfig

    search = {
        "quick": SearchConfig(population=30, parents=None, generations=20),
        "standard": SearchConfig(population=30, parents=None, generations=100),
        "paper": SearchConfig(population=30, parents=5, generations=100),
        "gpu": SearchConfig(population=1024, parents=None, generations=60, restarts=2),
    }[command.preset]
    changes = {k: getattr(command, k) for k in ("population", "generations", "restarts")}
    search = dataclasses.replace(search, seed=command.seed, **{k: v for k, v in changes.items() if v is not None})
    hop = 12 if command.preset == "quick" else RefineConfig.hop_generations
    refine = None if command.preset == "paper" else RefineConfig(hop_generations=hop)
    compare = CompareConfig(whitened=command.whitened)
    return IdentifyConfig(engine=command.engine, search=search, refine=refine, seed=command.seed, compare=compare)


def _setup(command: Identify) -> dict[str, Any]:
    """What decides a run's results, as plain data: a finished run with the same is not run again."""
    fields = dataclasses.asdict(command)
    for name in ("out", "again"):
        fields.pop(name)
    return {k: [str(v) for v in value] if isinstance(value, tuple) else _plain(value) for k, value in fields.items()}


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def _finished(out: Path, setup: dict[str, Any], again: bool) -> bool:
    """True where the folder holds this very run, whole. A folder with another run in it is refused."""
    path = out / "setup.json"
    if again or not path.is_file():
        return False
    try:
        before = json.loads(path.read_text())
        changed = sorted(k for k in {*before, *setup} if before.get(k) != setup.get(k))
    except (json.JSONDecodeError, UnicodeDecodeError, AttributeError, TypeError):
        raise ValueError(f"{path} is damaged; choose another --out, or start over with --again") from None
    if changed:
        raise ValueError(
            f"{out} holds a run with other settings ({', '.join(changed)}); choose another --out, or --again"
        )
    if not (out / "config.json").is_file():
        print(f"{out} holds this run unfinished; going on")
        return False
    print(f"{out} holds this run already; its report is built again (start over with --again)")
    return True


def _begin(out: Path, setup: dict[str, Any], again: bool) -> None:
    """Only now, with all input read, forget an earlier run where that was asked for, and say what runs here."""
    import shutil

    from droid_jax.storage import write_json

    if again:
        shutil.rmtree(out / "checkpoints", ignore_errors=True)
        (out / "config.json").unlink(missing_ok=True)
    write_json(out / "setup.json", setup)


def _draw(out: Path, found: Any, recording: Recording) -> None:
    """Frames of the fitted replay; without OpenGL the report says that there are none."""
    from droid_jax.compare.replay import make_drive
    from droid_jax.measure.engine import poses
    from droid_jax.model.physics import make_c_model
    from droid_jax.report.render import NoOpenGL, frames, save_frames

    if found.scene.grip is None:
        return
    drive = make_drive(found.scene, recording)
    qpos = poses(make_c_model(found.scene, found.full, found.best), drive.qpos0, drive.command)
    rows = [int(f * (len(qpos) - 1)) for f in (0.0, 0.33, 0.6, 1.0)]
    try:
        images = frames(found.scene.visual_model(), qpos, rows)
    except NoOpenGL as error:
        print(f"no pictures: {error}", file=sys.stderr)
        return
    save_frames(out / "frames", images, [float(drive.time[r]) for r in rows], "after")


def _summary(found: Any) -> None:
    """Five lines that say how it went."""
    for name, gap in found.gaps.items():
        way = "one repeat: what noise alone would leave is not known"
        if gap.floor is not None:
            way = f"a perfect model: {gap.floor:.3f}; {gap.closed:.0%} of the gap closed"
        unit = found.fit.comparisons[0].channel("torque").unit
        print(f"{name}: held-out torque distance {gap.before:.3f} -> {gap.after:.3f} {unit} ({way})")
    silent = [t.name for t in found.tells if not t.identifiable and not found.full[t.name].nuisance]
    if silent and found.refined is not None:
        print(f"this demonstration tells little about: {', '.join(silent)}")
    print(f"search stopped: {found.search.stop}; {sum(found.seconds.values()):.0f} s")


if __name__ == "__main__":
    sys.exit(main())
