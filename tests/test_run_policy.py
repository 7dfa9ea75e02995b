"""The commands train, evaluate and export, one after the other in one folder."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from droid_jax.commands.evaluate import Evaluate, _film, _print_trials, _robot, _task
from droid_jax.commands.folder import begin, setup_of, stage_folder
from droid_jax.commands.source import source, synthetic_robot_of
from droid_jax.commands.train import Train, _fit_folder
from droid_jax.door.environment import DoorEnv
from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_nuisances, door_space
from droid_jax.door.task import Task
from droid_jax.identify.gaussian import prior
from droid_jax.policy.control import load_policy
from droid_jax.policy.evaluate import Played
from droid_jax.policy.trials import BLOWN_UP, Trials
from droid_jax.report import page
from droid_jax.report.policy_folder import Trained, Training, Transfer
from droid_jax.report.render import NoOpenGL
from droid_jax.report.stages import extended_of, fingerprint
from droid_jax.run import main
from droid_jax.storage import write_own

pytestmark = pytest.mark.usefixtures("tuned")


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def scene():
    return door_scene(timestep=0.004, limits=True)


def fit(folder: Path, door, **setup) -> Path:
    """A folder as `identify` leaves one."""
    prior(door_space(door).select(["hinge_stiffness", "hinge_damping"])).save(folder / "gaussian.json")
    (folder / "setup.json").write_text(json.dumps(setup))
    (folder / "config.json").write_text("{}")
    return folder


def test_a_fit_that_is_not_whole_is_refused(scene, tmp_path: Path):
    """After --again and a stop, the folder holds results of the earlier run."""
    folder = fit(tmp_path, scene, springs=2, seed=7, recording=[])
    (folder / "config.json").unlink()
    with pytest.raises(ValueError, match="holds a run that is not complete"):
        source(folder, knob=0)


def test_a_fit_brings_its_gaussian_and_its_synthetic_robot(scene, tmp_path: Path):
    folder = fit(tmp_path, scene, springs=2, seed=7, recording=[])
    found, gaussian, effects = source(folder, knob=1)
    assert gaussian.space.names == ("hinge_stiffness", "hinge_damping") and effects == () and "knob 1" in found.name
    assert synthetic_robot_of(folder) == {"springs": 2, "seed": 7} and extended_of(folder) is None
    assert synthetic_robot_of(fit(tmp_path, scene, springs=1, recording=["own.npz"])) == {}


def test_a_policy_meets_the_nuisances_of_its_fit(scene, tmp_path: Path):
    """Regression: the door's pose and the links' masses stayed nominal in training."""
    without = fingerprint(fit(tmp_path, scene))
    full = prior(door_space(scene) + door_nuisances(scene))
    full = replace(full, mean=np.full(len(full.space), 0.1))
    full.save(tmp_path / "gaussian_full.json")
    _, gaussian, _ = source(tmp_path, knob=1)
    assert gaussian.space.names == full.space.names and fingerprint(tmp_path) != without
    np.testing.assert_array_equal(gaussian.mean, full.mean)


def test_fits_for_another_servo_or_scene_are_refused(scene, tmp_path: Path):
    with pytest.raises(ValueError, match="fitted with the paper's stiff servo"):
        source(fit(tmp_path, scene, preset="paper", generations=None), knob=0)
    with pytest.raises(ValueError, match=r"was fitted in own.xml: policies are trained in the built-in scene"):
        source(fit(tmp_path, scene, preset="quick", scene="own.xml"), knob=0)


def test_a_fit_with_effects_of_the_library_is_refused(scene, tmp_path: Path):
    """Regression: the message was about another scene."""
    fit(tmp_path, scene, effects=["latch"])
    with pytest.raises(ValueError, match=r"with --effects latch, .*a folder of `gap`, or on a fit with --extended"):
        source(tmp_path, knob=0)


def test_a_gaussian_that_came_without_its_setup_is_known_by_its_parameters(scene, tmp_path: Path):
    """Its parameters exist in the door's model too, but for other joints."""
    fit(tmp_path, scene)
    whole = json.loads((tmp_path / "gaussian.json").read_text())
    for what, said in (
        ("name", "elbow_damping is no parameter of the built-in door"),
        ("index", "is not the built"),
    ):
        other = json.loads(json.dumps(whole))
        damping = other["space"][1]
        if what == "name":
            damping["name"] = "elbow_damping"
        else:
            damping["writes"][0]["index"] = [1]
        (tmp_path / "gaussian.json").write_text(json.dumps(other))
        with pytest.raises(ValueError, match=f"gaussian.json belongs to another scene: .*{said}"):
            source(tmp_path, knob=0)


def test_a_trained_folder_hands_on_its_synthetic_robot(scene, tmp_path: Path):
    fit(tmp_path, scene, command="train", seed=9, synthetic_robot={"springs": 2, "seed": 3})
    assert synthetic_robot_of(tmp_path) == {"springs": 2, "seed": 3}


def test_the_setup_of_every_command_can_be_written():
    assert setup_of(Evaluate())["trials"] == 100
    assert "again" not in setup_of(Train())


def test_a_new_training_forgets_the_old_policy(tmp_path: Path):
    old = ("policy.npz", "transfer.json", "extended.json", "films/good.webp", "export/policy.onnx", "training.json")
    for name in (*old, "checkpoints/0/x", "mine.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    begin(tmp_path, {"seed": 1}, again=False, stage="train")
    assert {p.name for p in tmp_path.iterdir()} == {"setup.json", "checkpoints", "mine.txt"}
    begin(tmp_path, {"seed": 1}, again=True, stage="train")
    assert {p.name for p in tmp_path.iterdir()} == {"setup.json", "mine.txt"}
    write_own(tmp_path / "export", {"control.py": b"old", "policy.onnx": b"old"})
    (tmp_path / "export" / "control.py").write_text("changed")
    begin(tmp_path, {"seed": 1}, again=True, stage="train")
    assert {p.name for p in (tmp_path / "export").iterdir()} == {
        "control.py",
        ".written.json",
    }  # which the user changed


def test_without_a_fit_there_is_the_prior(scene):
    _, gaussian, _ = source(None, knob=0)
    of_a_fit = door_space(scene) + door_nuisances(scene)  # Table II's three methods differ in nothing but the ranges
    assert gaussian.space.names == of_a_fit.names and synthetic_robot_of(None) == {}
    np.testing.assert_array_equal(gaussian.cov, prior(of_a_fit).cov)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "--fit", "nowhere"], "--fit nowhere is no folder"),
        (["train"], "there is no fit in runs/identify or runs/all: give --fit FOLDER, or --method prior"),
        (["train", "--method", "mean"], "there is no fit in runs/identify or runs/all"),
        (["evaluate", "--trials", "0"], "--trials must be 1 or more, got 0"),
        (["evaluate", "nowhere"], "nowhere/training.json is missing; run `python -m droid_jax.run train` again"),
        (["export", "nowhere"], "nowhere/policy.npz: there is no such file"),
        (["evaluate"], "runs/train/training.json is missing"),
        (["export"], "runs/train/policy.npz: there is no such file"),
        (["view"], "runs/identify holds no replay.npz"),
        (["report"], "there is no finished run in runs/identify, runs/gap, runs/train, runs/all"),
    ],
)
def test_what_is_missing_is_said(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    assert main(arguments) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fitted", "asked", "stiffness", "hidden"),
    [
        ({}, {}, 1.06, ()),
        ({"springs": 2, "seed": 3, "hide": ["closer=2"]}, {}, 1.24, ("closer",)),
        ({"springs": 2, "hide": None}, {}, 1.24, ("magnetic_catch",)),
        ({"springs": 2, "hide": ["closer=2"]}, {"springs": 0, "hide": ("none",)}, 0.002, ()),
    ],
)
def test_the_synthetic_robot_is_the_fitted_one_unless_asked(
    scene, fitted, asked, stiffness: float, hidden: tuple[str, ...]
):
    trained: Any = SimpleNamespace(synthetic_robot=fitted, setup=SimpleNamespace(knob=0))
    robot, truth = _robot(Evaluate(trials=3, **asked), trained, DoorEnv(scene))
    assert truth["hinge_stiffness"] == pytest.approx(stiffness, rel=0.3)
    assert tuple(a.name for a in robot.hidden) == hidden and robot.config.trials == 3
    assert robot.config.timestep <= (0.00025 if hidden else 0.0005)


@pytest.mark.parametrize(
    ("there", "given", "meant"),
    [
        ([], None, "runs/train"),
        (["runs/all/train"], None, "runs/all/train"),
        (["runs/all/train", "runs/train"], None, "runs/train"),
        (["runs/all/train"], "runs/all", "runs/all/train"),
        (["runs/all/train"], "runs/all/train", "runs/all/train"),
        (["runs/all/train"], "elsewhere", "elsewhere"),
    ],
)
def test_a_command_finds_what_the_default_command_left(tmp_path: Path, there: list[str], given: str | None, meant: str):
    for folder in there:
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "policy.npz").write_bytes(b"")
    assert stage_folder(None if given is None else Path(given), "train", "policy.npz") == Path(meant)


def test_a_page_without_a_path_is_that_of_the_run_that_was_finished_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """A folder without a finished run, as a refused command may leave one, does not count."""
    monkeypatch.setattr(page, "write_report", lambda folder: folder)
    (tmp_path / "runs" / "identify").mkdir(parents=True)
    for age, (file, found) in enumerate((
        ("all/gap/gap.json", "all"), ("gap/gap.json", "gap"), ("train/training.json", "train"),
        ("all/identify/config.json", "all"), ("identify/config.json", "identify"),
    )):  # fmt: skip
        path = tmp_path / "runs" / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
        os.utime(path, (age, age))
        assert main(["report"]) == 0
        assert capsys.readouterr().out == f"report: runs/{found}\n"


@pytest.mark.parametrize(
    ("there", "named", "options", "found"),
    [
        (["runs/identify", "runs/all/identify"], False, [], "runs/identify"),
        (["runs/all/identify"], False, [], "runs/all/identify"),
        (["runs/all/identify", "runs/all/gap"], True, [], "runs/all/gap"),
        (["runs/all/identify", "runs/all/gap"], True, ["--fit", "runs/all"], "runs/all/gap"),
        (["runs/all/identify", "runs/identify"], False, ["--fit", "runs/all"], "runs/all/identify"),
        (["mine"], False, ["--fit", "mine"], "mine"),
        ([], False, ["--method", "prior"], None),
    ],
)
def test_which_fit_is_trained_on(tmp_path: Path, there: list[str], named: bool, options: list[str], found: str | None):
    for folder in there:
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "gaussian.json").write_text("{}")
    if named:
        (tmp_path / "runs/all/gap/gaussian.json").rename(tmp_path / "runs/all/gap/extended.json")
        (tmp_path / "runs/all/gap/gap.json").write_text('{"effects": [{"effect": "latch", "location": "hinge"}]}')
    asked = dict(zip(options[::2], options[1::2], strict=True))
    fit = Path(asked["--fit"]) if "--fit" in asked else None
    method = "prior" if "--method" in asked else "fitted"
    assert _fit_folder(Train(fit=fit, method=method)) == (None if found is None else Path(found))


class Killed(RuntimeError):
    """Stands for a kill in a test."""


def test_a_killed_training_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """brax's PPO is played; checkpoints, resuming and final files are those of the command."""
    from droid_jax.policy import train as module

    asked = list[tuple[int, bool]]()

    def ppo(environment, num_timesteps, restore_params, policy_params_fn, **_):
        asked.append((num_timesteps, restore_params is not None))
        blank = module._blank(environment, module.PRESETS["quick"])
        for step in (0, 1_000_000, 2_000_000):
            policy_params_fn(step, None, restore_params or blank)
            if step and len(asked) == 1:
                raise Killed

    half = Trials(np.array([True, False]), *[np.zeros(2)] * 3, stopped=np.array(["", ""]))
    monkeypatch.setattr(module.ppo, "train", ppo)
    monkeypatch.setattr(module, "batch_of_episodes", lambda *_: lambda policy, start: Played(half, 0.0))
    command = ["train", "--method", "prior", "--out", "run"]
    with pytest.raises(Killed):
        main(command)
    assert not (tmp_path / "run" / "training.json").exists() and not (tmp_path / "run" / "policy.npz").exists()
    assert main(command) == 0
    assert asked == [(4_000_000, False), (3_000_000, True)]
    history = json.loads((tmp_path / "run" / "training.json").read_text())["history"]
    assert [now["step"] for now in history] == [0, 1_000_000, 2_000_000, 3_000_000]
    load_policy(tmp_path / "run" / "policy.npz")
    assert main(command) == 0 and len(asked) == 2  # it is done


@pytest.mark.parametrize("again", [(), ("--again",)])
def test_settings_that_cannot_be_trained_with_leave_the_folder_as_it_was(tmp_path: Path, again, capsys):
    run = tmp_path / "run"
    command = ["train", "--method", "prior", "--steps", "0", "--out", "run", *again]
    assert main(command) == 2 and not run.exists()
    assert "steps must be at least 1, got 0" in capsys.readouterr().err
    for name in ("training.json", "policy.npz", "checkpoints/1"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text("old")
    before = sorted(run.rglob("*"))
    assert main(command) == 2 and sorted(run.rglob("*")) == before


@pytest.mark.parametrize("opengl", [True, False])
def test_films_are_of_the_trials_of_median_angle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opengl: bool, capsys):
    success = np.array([True, True, True, False, False, False])
    why = np.array(["", "", "", "", "", BLOWN_UP])
    trials = Trials(success, np.array([0.9, 0.6, 0.7, 0.1, 0.2, 9.0]), np.ones(6, int), np.ones(6), why)
    made = dict[str, int]()

    def film(path: Path, model, states, period):
        if not opengl:
            raise NoOpenGL("no OpenGL here")
        made[path.name] = states[0]

    monkeypatch.setattr("droid_jax.report.render.film", film)
    monkeypatch.setattr("droid_jax.synthetic.policy_trials.filmed", lambda policy, robot, number: number)
    robot: Any = SimpleNamespace(scene=SimpleNamespace(visual_model=lambda: None), task=Task())
    why = _film(tmp_path, None, robot, trials)  # type: ignore[arg-type]
    assert why is None if opengl else str(why).startswith("no OpenGL here; ")
    assert made == ({"good.webp": 2, "bad.webp": 4} if opengl else {})
    assert ("no films: no OpenGL here" in capsys.readouterr().err) is not opengl


@pytest.mark.parametrize(
    ("fit", "robot", "another"), [("fit", {}, True), ("fit", {"springs": 1, "seed": 0}, False), (None, {}, False)]
)
def test_trials_on_another_robot_than_the_fitted_one_say_so(fit: str | None, robot: dict, another: bool, capsys):
    """With recordings of your own the synthetic robot is another robot; without a fit there is none that it
    could be.
    """
    trials = {"success_rate": 1.0, "interval_95": [0.9, 1.0], "angle_deg": {"mean": 40.0, "std": 1.0, "all": []}}
    trials |= {"trials": 0, "success": [], "stopped": {}, "grip": {"mean": 0.5}, "steps": trials["angle_deg"]}
    tried = {"simulation": trials, "synthetic_robot": trials, "robot": {"hidden": []}}
    task = {"opened": 0.7, "held": 1.0, "control": 0.02, "steps": 512}
    training = {"setup": {"method": "fitted", "preset": "quick", "knob": 0, "seed": 0, "fit": fit}, "task": task}
    training |= {"synthetic_robot": robot, "scene": "door", "effects": [], "versions": {}, "device": "", "history": []}
    _print_trials(Trained(Path(), msgspec.convert(training, Training), msgspec.convert(tried, Transfer), {}))
    said = capsys.readouterr().out
    assert "synthetic robot: 100 % success" in said
    assert ("The fit is of your own recordings: the synthetic robot is another one" in said) == another


@pytest.mark.slow
def test_train_evaluate_export(scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "fit"
    folder.mkdir()
    fit(folder, scene, springs=0, seed=1, recording=[])
    assert main(["train", "--fit", "fit", "--steps", "20000", "--out", "run"]) == 0
    assert main(["evaluate", "run", "--trials", "4", "--no-film"]) == 0
    transfer_json = tmp_path / "run" / "transfer.json"
    before = transfer_json.stat().st_mtime_ns
    assert main(["evaluate", "run", "--trials", "4", "--no-film"]) == 0
    said = capsys.readouterr().out
    assert "holds these trials already" in said and said.count("synthetic robot: 0 % success") == 2
    assert transfer_json.stat().st_mtime_ns == before
    assert main(["evaluate", str(tmp_path / "run"), "--trials", "4", "--no-film"]) == 0  # by another path
    assert transfer_json.stat().st_mtime_ns == before
    assert main(["evaluate", "run", "--trials", "3", "--no-film"]) == 0  # others are
    assert json.loads(transfer_json.read_text())["synthetic_robot"]["trials"] == 3
    assert main(["evaluate", "run", "--trials", "4", "--no-film"]) == 0
    pytest.importorskip("onnxruntime")
    assert main(["export", "run"]) == 0
    said = capsys.readouterr().out
    assert "synthetic robot: 0 % success" in said and "ONNX and JAX differ by at most" in said
    transfer = json.loads((tmp_path / "run" / "transfer.json").read_text())
    assert transfer["simulation"]["trials"] == transfer["synthetic_robot"]["trials"] == 4
    assert np.isfinite(load_policy(tmp_path / "run" / "export" / "policy.npz").act(np.zeros(23))).all()
    assert "Learning" in (tmp_path / "run" / "report.html").read_text()
    assert main(["train", "--fit", "fit", "--steps", "20000", "--out", "run"]) == 0
    assert "holds this run already" in capsys.readouterr().out


def test_a_policy_of_another_task_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="was trained for a task with patience; train it again"):
        _task(tmp_path, {"steps": 10, "patience": 3})
