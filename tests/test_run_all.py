"""`all`: its stages, their input, and stages that are not run again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_log import elbow_log, write_elbow

from droid_jax.commands import all_stages, evaluate, gap, identify, synthetic, train
from droid_jax.commands.folder import OtherRun
from droid_jax.commands.options import TIMESTEP
from droid_jax.commands.source import synthetic_robot_of
from droid_jax.commands.synthetic import known_robot
from droid_jax.door.scene import door_scene
from droid_jax.identify.extended_model import Extended, save_extended
from droid_jax.identify.gaussian import prior
from droid_jax.model.effects.candidate import Candidate
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.recordings.formats import load_recording, save_recording
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide
from droid_jax.report import page
from droid_jax.run import main
from droid_jax.synthetic.robot import SOURCE

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def called(tuned: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """The stages' commands, in the order in which they were run; nothing is recorded or fitted."""
    commands: list[Any] = []
    monkeypatch.chdir(tmp_path)
    for module in (identify, gap, train, evaluate):
        monkeypatch.setattr(module, "run", commands.append)
    monkeypatch.setattr(synthetic, "kept_recordings", lambda paths, again, record: dict.fromkeys(paths))
    monkeypatch.setattr(page, "write_report", lambda folder: folder / "report.html")
    return commands


def motions(*files: str, repeats: int = 8, commands: bool = True, **meta: str) -> tuple[str, ...]:
    """Recordings of the built-in arm's first joint, each of another motion; the files' names."""
    time = np.arange(400) * 0.01
    rng = np.random.default_rng(0)
    for k, file in enumerate(files):
        motion = 0.3 * np.sin((1 + k) * time)[:, None]
        torque = rng.normal(size=(repeats, 400, 1)) + motion
        recording = Recording(
            name=Path(file).stem,
            time=time if commands else np.zeros(0),
            command=motion if commands else np.zeros((0, 0)),
            command_names=("panda_joint1",) if commands else (),
            channels={
                name: Channel(name, unit, ("panda_joint1",), time, values, np.isfinite(values))
                for name, unit, values in (
                    ("torque", "N m", torque),
                    ("position", "rad", np.repeat(motion[None], repeats, axis=0)),
                )
            },
            torque=TorqueConvention(TorqueSide.MOTOR, False),
            qpos0={},
            meta=meta,
        )
        save_recording(recording, file)
    return files


def found(folder: Path, effects: list[str], synthetic_robot: bool = True) -> None:
    """A folder with the results of a search."""
    folder.mkdir(parents=True)
    size = {"recording": "a", **dict.fromkeys(("before", "after", "torque_before", "torque_after"), 1.0)}
    sizes = {role: {**size, "closed": 0.5 + 0.1 * k} for k, role in enumerate(("train", "validation", "test"))}
    (folder / "gap.json").write_text(
        json.dumps(
            {
                "version": 2,
                "effects": [{"effect": effect, "location": "door_hinge"} for effect in effects],
                "amendments": {},
                "sentence": "The model lacks: latch.",
                "discrepancies": sizes,
                "setup": {
                    "synthetic_robot": synthetic_robot,
                    "hidden": "magnetic catch (1.5 N m; in the library: latch)",
                },
            }
        )
    )


def test_without_arguments_every_stage_runs_on_one_recording(called, tmp_path: Path, capsys):
    assert main([]) == 0
    fit, search, policy, trials = called
    files = tuple(Path("runs/all/recordings") / f"{name}.npz" for name in "CBA")
    assert fit.recording == files[:2] and search.recording == files
    assert policy.fit == fit.out and policy.out == trials.run == Path("runs/all/train")
    assert known_robot(files) == {"springs": 1, "seed": 0, "hide": ["magnetic_catch=1.5"]}
    lines = capsys.readouterr().out.splitlines()
    stages = {"record": 9, "identify": 9, "gap": 6, "train": 3, "evaluate": 1}
    assert [line for line in lines if line.startswith("[")] == [
        f"[{k}/5] {stage}{said}"
        for k, (stage, left) in enumerate(stages.items(), 1)
        for said in (f" (about {left} min left on two cores)", ": 0.0 minutes")
    ]
    assert lines[-1] == "report: runs/all/report.html"


def test_the_search_for_what_is_missing_begins_at_the_fit(called, tmp_path: Path):
    assert main(["all", "--stages", "gap"]) == 0
    (tmp_path / "runs" / "all" / "identify").mkdir(parents=True)
    (tmp_path / "runs" / "all" / "identify" / "fit.json").write_text('{"version": 3, "heldout_distances": {}}')
    assert main(["all", "--stages", "identify", "gap"]) == 0
    assert [c.fit for c in (called[0], called[-1])] == [None, Path("runs/all/identify")]


def test_the_scale_of_effects_reaches_the_search(called):
    assert main(["all", "--stages", "gap", "--effect-scale", "30"]) == 0
    assert [c.effect_scale for c in called] == [30.0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--trials", "0"], "--trials must be 1 or more, got 0"),
        (["--motion-cutoff", "12"], "--motion-cutoff is for logs without commands, and no recording is one"),
        (["--motion-cutoff", "0"], "--motion-cutoff must be above 0 Hz, got 0"),
        (["--effect-scale", "0"], "the scale of the effects must be above 0, got 0"),
        (
            ["--scene", "my.xml", "--recording", "a.npz", "--stages", "train", "evaluate"],
            "--stages must name one of identify, gap with --scene: policies are trained at the built-in door",
        ),
    ],
)
def test_what_a_later_stage_would_refuse_is_refused_at_once(called, capsys, options: list[str], said: str):
    assert main(["all", *options]) == 2
    assert said in capsys.readouterr().err
    assert called == [] and not Path("runs").exists()


def test_the_cutoff_of_a_log_reaches_fit_and_search(called, tmp_path: Path):
    save_recording(elbow_log(0.0), tmp_path / "log.npz")
    options = ["--recording", str(tmp_path / "log.npz"), *write_elbow(tmp_path), "--motion-cutoff", "12"]
    assert main(["all", *options]) == 0
    assert [c.motion_cutoff for c in called] == [12.0, 12.0]
    fit, search = called
    assert identify.identify_config(fit).compare.motion_cutoff == gap.gap_config(search).compare.motion_cutoff == 12.0


def test_trials_count_where_they_are_made(called):
    assert main(["all", "--trials", "0", "--stages", "identify"]) == 0


def test_a_policy_is_trained_on_the_extended_model_where_there_is_one(called, tmp_path: Path, capsys):
    found(tmp_path / "runs" / "all" / "gap", ["latch"])
    assert main(["all", "--stages", "train"]) == 0
    assert called[0].fit == Path("runs/all/gap")
    assert (
        "gap: The model lacks: latch; 70 % of the discrepancy U closed on the test recording" in capsys.readouterr().out
    )


def test_where_no_policy_can_be_trained_the_run_ends_with_the_search(called, tmp_path: Path, capsys):
    """Regression: it ended with an error of the environment after the search."""
    scene, folder = door_scene(), tmp_path / "runs" / "all" / "gap"
    effects = library(scene, ("profile_acceleration",))
    location, names = next(iter(effects[0].locations.items()))
    space = effect_space(effects).select(names)
    found(folder, [effects[0].name])
    part = Candidate(effects[0].name, location, names, {})
    save_extended(folder, Extended(ready(scene), (part,), effects, space.mean, prior(space)))
    assert main([]) == 0
    assert [type(command) for command in called] == [identify.Identify, gap.GapCommand]
    said = capsys.readouterr().out
    assert "no policy can be trained with profile_acceleration" in said and "report: runs/all/report.html" in said


@pytest.mark.parametrize("synthetic_robot", [True, False])
def test_the_last_lines_say_what_was_hidden_in_what_was_searched(called, tmp_path: Path, capsys, synthetic_robot: bool):
    """The folder may hold recordings of a synthetic robot although real recordings were searched."""
    found(tmp_path / "runs" / "all" / "gap", ["latch"], synthetic_robot)
    assert main([]) == 0
    said = capsys.readouterr().out
    assert ("hidden in the synthetic robot: magnetic catch (1.5 N m; in the library: latch)" in said) == synthetic_robot


@pytest.mark.parametrize("robot", [{}, {"springs": 1, "seed": 0}])
def test_a_success_on_another_robot_than_the_fitted_one_is_no_promise(called, tmp_path: Path, capsys, robot: dict):
    """The policy of a fit of real recordings is also tried on the synthetic robot."""
    folder = tmp_path / "runs" / "all" / "train"
    folder.mkdir(parents=True)
    trials = {"success_rate": 1.0, "interval_95": [0.9, 1.0]}
    (folder / "transfer.json").write_text(json.dumps({"simulation": trials, "synthetic_robot": trials}))
    setup = {"method": "fitted", "preset": "quick", "knob": 0, "seed": 0, "fit": "runs/all/identify"}
    task = {"opened": 0.7, "held": 1.0, "control": 0.02, "steps": 512}
    training = {"setup": setup, "synthetic_robot": robot, "task": task, "scene": "door", "effects": [], "versions": {},
                "device": "cpu", "history": []}  # fmt: skip
    (folder / "training.json").write_text(json.dumps(training))
    assert main(["all", "--stages", "identify"]) == 0
    said = capsys.readouterr().out
    assert "policy: 100 % success on the synthetic robot" in said
    assert ("The fit is of your own recordings: the synthetic robot is another one" in said) == (not robot)


def test_without_a_named_effect_it_is_trained_on_the_fit(called, tmp_path: Path):
    found(tmp_path / "run" / "gap", [])
    assert main(["all", "--stages", "train", "--out", "run"]) == 0
    assert called[0].fit == Path("run/identify")


def test_a_stage_with_other_inputs_is_run_again(called, monkeypatch: pytest.MonkeyPatch, capsys):
    def changed(command: identify.Identify) -> None:
        called.append(command)
        if not command.again:
            raise OtherRun(command.out, ["recordings_sha256"])

    monkeypatch.setattr(identify, "run", changed)
    assert main(["all", "--stages", "identify"]) == 0
    assert [command.again for command in called] == [False, True]
    assert "other settings (recordings): it is run again" in capsys.readouterr().out


def test_a_policy_that_was_made_with_other_options_is_kept(called, monkeypatch: pytest.MonkeyPatch, capsys):
    """It may have taken hours, and is not among the stages that are checked beforehand."""

    def other(command: train.Train) -> None:
        called.append(command)
        raise OtherRun(command.out, ["fit_sha256", "preset"])

    monkeypatch.setattr(train, "run", other)
    assert main(["all", "--stages", "train", "evaluate"]) == 2
    assert [command.again for command in called] == [False]
    assert "runs/all/train holds a run with other settings (fit, preset)" in capsys.readouterr().err


def test_what_a_stop_leaves_unreached_is_not_taken_for_this_runs_later(called, monkeypatch, tmp_path: Path):
    """`all --again`, stopped in its first stage, is continued without --again."""
    stages = {"identify": "config.json", "gap": "gap.json", "train": "training.json"}
    for stage, last in stages.items():
        for name in (last, "setup.json", "checkpoints/0"):
            (tmp_path / "runs" / "all" / stage / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "runs" / "all" / stage / name).write_text("{}")

    def stopped(command: identify.Identify) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(identify, "run", stopped)
    assert main(["all", "--again", "--stages", "identify", "gap"]) == 130
    left = {stage: {p.name for p in (tmp_path / "runs" / "all" / stage).iterdir()} for stage in stages}
    assert left["gap"] == set()  # and what was not asked for, or has its own input to read first, is whole
    assert left["identify"] >= {"config.json", "setup.json"} and left["train"] >= {"training.json", "setup.json"}


def test_a_search_begins_at_a_fit_of_its_own_recordings_alone(called, tmp_path: Path):
    motions("a.npz", "b.npz", "c.npz")
    fit = tmp_path / "run" / "identify"
    fit.mkdir(parents=True)
    for name in ("fit.json", "config.json"):
        (fit / name).write_text('{"version": 3}')
    hashes = [load_recording(Path(f"{name}.npz")).sha256 for name in "abc"]
    scene = door_scene(timestep=TIMESTEP["quick"]).sha256
    for made, of in ((hashes[:2], scene), (hashes[1:], scene), ([], scene), (hashes[:2], "another")):
        (fit / "setup.json").write_text(json.dumps({"recordings_sha256": made, "scene_sha256": of}))
        given = ("--recording", "a.npz", "b.npz", "c.npz", "--stages", "gap", "--out", "run")
        assert main(["all", *given]) == 0
    assert [command.fit for command in called] == [Path("run/identify"), None, None, None]


def test_a_parameter_with_an_effects_name_is_told_before_the_fit(called, tmp_path: Path, capsys):
    """Of this scene the library has joint_coulomb[elbow]."""
    own = write_elbow(tmp_path)
    file = tmp_path / "parameters.json"
    entries = json.loads(file.read_text())
    file.write_text(json.dumps([{**entries[0], "name": "joint_coulomb[elbow]"}, *entries[1:]]))
    save_recording(elbow_log(0.0, 2.0, 16), "log.npz")
    assert main(["all", "--stages", "identify", "gap", "--recording", "log.npz", *own]) == 2
    assert "'joint_coulomb[elbow]' (of the effect joint_coulomb); rename them" in capsys.readouterr().err
    assert called == []
    assert main(["all", "--stages", "identify", "--recording", "log.npz", *own]) == 0


def test_nothing_is_said_to_be_closed_where_nothing_is_named(called, tmp_path: Path, capsys):
    found(tmp_path / "runs" / "all" / "gap", [])
    assert main(["all", "--stages", "train"]) == 0
    said = capsys.readouterr().out
    assert "gap: The model lacks" in said and "closed" not in said


def test_another_synthetic_robot_is_recorded_anew(called, tmp_path: Path):
    """Also where a stop left some recordings of the one before."""
    files = [tmp_path / "runs" / "all" / "recordings" / f"{name}.npz" for name in "CB"]
    for springs, kept in (("1", True), ("2", False), ("2", True)):
        if not kept or springs == "1":
            assert main(["all", "--stages", "gap", "--springs", "1"]) == 0
            for file in files:
                file.write_text("of this robot")
        else:
            for file in files:
                file.write_text("of this robot")
        anew = () if kept else ("--again",)
        assert main(["all", "--stages", "gap", "--springs", springs, *anew]) == 0
        assert [file.is_file() for file in files] == [kept] * 2


@pytest.mark.parametrize("name", ["all.json", "gap/gap.json"])
@pytest.mark.parametrize("text", ["{", "[]"])
def test_a_damaged_file_is_named(called, tmp_path: Path, name: str, text: str):
    run = tmp_path / "run"
    found(run / "gap", ["latch"])
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).write_text(text)
    with pytest.raises(ValueError, match=f"{name}[ :]"):
        if name == "all.json":
            all_stages._remember(all_stages.All(), run)
        else:
            all_stages.summary_lines(run)


def test_another_runs_results_are_not_written_over(called, capsys):
    """They may have taken hours; omitted stages and more trials do not make it another run."""
    assert main(["all", "--preset", "paper"]) == 0
    assert main(["all", "--preset", "paper", "--stages", "identify", "gap"]) == 0
    assert main(["all", "--preset", "paper", "--trials", "7"]) == 0
    before = len(called)
    motions("a.npz", "b.npz", "c.npz")
    for other in ((), ("--preset", "paper", "--seed", "1"), ("--preset", "paper", "--recording", "a.npz", "b.npz")):
        assert main(["all", *other]) == 2
        assert "runs/all holds a run with other settings" in capsys.readouterr().err
    assert len(called) == before
    assert main(["all", "--stages", "train"]) == 0  # of what lies there
    assert main(["all", "--again"]) == 0
    assert main(["all"]) == 0


def test_what_no_policy_can_be_tried_with_is_said_at_once(called, capsys):
    assert main(["all", "--hide", "sensor_delay=0.01"]) == 2
    said = capsys.readouterr().err
    assert "hidden effects sensor_delay change whole traces" in said and "--stages identify gap train" in said
    assert main(["all", "--seed", "-1"]) == 2
    assert "--seed must not be negative" in capsys.readouterr().err
    assert main(["all", "--hide", "inner_profile=0.1"]) == 2  # nor be trained
    assert capsys.readouterr().err.strip().endswith("--stages identify gap")
    assert called == [] and not Path("runs/all/all.json").exists()  # the corrected command is no other run
    assert main(["all", "--hide", "sensor_delay=0.01", "--stages", "identify", "gap"]) == 0


def test_a_search_in_other_recordings_is_not_trained_on(called, tmp_path: Path):
    """The fit is of another robot by now, the search was not run again."""
    for stage, recordings in (("identify", ["new C", "new B"]), ("gap", ["old C", "old B", "old A"])):
        found(tmp_path / "run" / stage, ["latch at hinge"])
        (tmp_path / "run" / stage / "setup.json").write_text(json.dumps({"recordings_sha256": recordings}))
    assert main(["all", "--stages", "train", "--out", "run"]) == 0
    (tmp_path / "run" / "gap" / "setup.json").write_text('{"recordings_sha256": ["new C", "new B", "new A"]}')
    assert main(["all", "--stages", "train", "--out", "run"]) == 0
    assert [c.fit for c in called] == [Path("run/identify"), Path("run/gap")]


def test_your_own_recordings_know_no_synthetic_robot(called, tmp_path: Path):
    motions("a.npz", "b.npz")
    assert main(["all", "--recording", "a.npz", "b.npz", "--stages", "identify", "gap"]) == 0
    assert called[0].recording == called[1].recording == (Path("a.npz"), Path("b.npz"))
    (tmp_path / "setup.json").write_text(json.dumps({"command": "identify", "recording": ["a.npz", "b.npz"]}))
    assert synthetic_robot_of(tmp_path) == {}


def test_a_synthetic_robot_left_over_in_the_folder_is_not_the_robot_of_your_recordings(tmp_path: Path, monkeypatch):
    """`all` made other recordings before; the same names do not make them those of the fit."""
    monkeypatch.chdir(tmp_path)
    made, stage = tmp_path / "recordings", tmp_path / "identify"
    made.mkdir()
    stage.mkdir()
    (made / "synthetic_robot.json").write_text(json.dumps({"springs": 1, "seed": 0, "hide": []}))

    def told(recordings: list[str]) -> None:
        own = {"command": "identify", "recording": ["a.npz", "b.npz"], "recordings_sha256": recordings}
        (stage / "setup.json").write_text(json.dumps(own))

    for meta, known in (({}, {}), ({"source": SOURCE}, {"springs": 1, "seed": 0, "hide": []})):
        motions("a.npz", "b.npz", **meta)
        told([load_recording(Path(name)).sha256 for name in ("a.npz", "b.npz")])
        assert synthetic_robot_of(stage) == {}
        for name in ("a.npz", "b.npz"):
            (tmp_path / name).rename(made / name)
        assert synthetic_robot_of(stage) == known  # moved with the folder; a robot's own may be copied there
    told(["another", "two"])
    assert synthetic_robot_of(stage) == {}


def test_a_fit_keeps_which_synthetic_robot_it_is_of(tmp_path: Path, monkeypatch):
    """Wherever the recordings are by now, and wherever the next command runs."""
    robot = {"springs": 2, "seed": 5, "hide": []}
    (tmp_path / "setup.json").write_text(json.dumps({"recording": ["recs/A.npz"], "recordings_sha256": ["a"]}))
    assert synthetic_robot_of(tmp_path) == {}
    (tmp_path / "config.json").write_text(json.dumps({"synthetic_robot": True, "robot": robot}))
    assert synthetic_robot_of(tmp_path) == robot
    (tmp_path / "config.json").unlink()
    (tmp_path / "gap.json").write_text(json.dumps({"setup": {"synthetic_robot": True, "robot": robot}}))
    assert synthetic_robot_of(tmp_path) == robot


def test_options_of_stages_that_are_left_out_are_refused(called, refused):
    for option in (("--hide", "not_an_effect=9"), ("--springs", "2")):
        said = refused("all", "--stages", "train", "evaluate", *option)
        assert f"{option[0]} is for the stages identify and gap" in said and "evaluate RUN" in said
    assert called == []


def test_a_folder_of_identify_is_no_folder_of_all(called, refused, tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "setup.json").write_text('{"preset": "quick"}')
    assert "holds a run of `identify`, and the page would show both" in refused("all", "--out", "mine")
    assert called == []


@pytest.mark.parametrize(("meta", "known"), [({"source": SOURCE}, True), ({}, False)])
def test_a_robots_own_recording_beside_a_synthetic_robots_has_no_known_truth(
    tmp_path: Path, meta: dict[str, str], known: bool
):
    own = tmp_path / "mine.npz"
    motions(str(own), **meta)
    (tmp_path / "synthetic_robot.json").write_text(json.dumps({"springs": 1, "seed": 0, "hide": []}))
    command = identify.Identify(recording=(own,))
    _, truth, _ = identify._recordings(command, door_scene(), tmp_path, [load_recording(own)])
    assert (truth is not None) == known


def test_nothing_is_recorded_for_stages_that_need_no_recording(called, tmp_path: Path):
    found(tmp_path / "run" / "identify", [])
    assert main(["all", "--stages", "train", "evaluate", "--out", "run"]) == 0
    assert not (tmp_path / "run" / "recordings").exists()
    assert main(["all", "--hide", "magnetic_catch", "--out", "new"]) == 2
    assert main(["all", "--hide", "closer[elbow]=1", "--out", "new"]) == 2
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("repeats", "count", "commands", "fitted", "begins_at_fit"),
    [
        (8, 3, True, 2, True),
        (16, 1, True, 1, True),
        (1, 2, False, 1, False),  # the second log is sealed; one in blocks is fitted without a start
        (1, 1, False, 1, False),
    ],
)
def test_a_sealed_recording_is_not_fitted(
    called, tmp_path: Path, repeats: int, count: int, commands: bool, fitted: int, begins_at_fit: bool
):
    names = [f"{name}.npz" for name in "abc"[:count]]
    motions(*names, repeats=repeats, commands=commands)
    (tmp_path / "run" / "identify").mkdir(parents=True)
    (tmp_path / "run" / "identify" / "fit.json").write_text('{"version": 3, "heldout_distances": {}}')
    assert main(["all", "--recording", *names, "--stages", "identify", "gap", "--out", "run"]) == 0
    fit, search = called
    assert [str(path) for path in fit.recording] == names[:fitted]
    assert len(search.recording) == count and search.fit == (Path("run/identify") if begins_at_fit else None)


def test_recordings_are_checked_before_any_stage(called, capsys):
    for name in motions("a.npz", "b.npz", repeats=5):  # with positions they are searched by windows
        given = load_recording(name)
        torques = {key: channel for key, channel in given.channels.items() if key != "position"}
        save_recording(replace(given, channels=torques), name)
    assert main(["all", "--recording", "a.npz", "b.npz"]) == 2
    assert "the train recording 'a' has 5 repeats" in capsys.readouterr().err and called == []
    assert main(["all", "--recording", "a.npz", "b.npz", "--stages", "identify"]) == 0
    assert len(called[0].recording) == 2


def test_where_a_stage_fails_the_page_shows_those_before(called, monkeypatch: pytest.MonkeyPatch, capsys):
    def failing(command: gap.GapCommand) -> None:
        raise ValueError("nothing can be searched here")

    monkeypatch.setattr(gap, "run", failing)
    assert main(["all", "--stages", "identify", "gap"]) == 2
    said = capsys.readouterr()
    assert "nothing can be searched here" in said.err
    assert "report of what is done: runs/all/report.html" in said.out
    assert main(["all", "--stages", "gap", "--recording", *motions("a.npz", "b.npz")]) == 2
    assert "report of what is done" not in capsys.readouterr().out


def test_options_reach_the_stages(called, tmp_path: Path):
    (tmp_path / "mine.py").write_text("")
    pytest.importorskip("tensorboardX")
    assert main(["all", "--tensorboard", "--user-effects", "mine.py"]) == 0
    assert [c.user_effects for c in called] == 4 * [Path("mine.py")]
    assert all(c.tensorboard for c in called[:3])


def test_presets_reach_the_stages(called, capsys):
    assert main(["all", "--preset", "paper", "--seed", "3"]) == 0
    fit, search, policy, _ = called
    assert (fit.preset, search.preset, policy.preset) == ("standard", "standard", "paper")
    assert {c.seed for c in called} == {3}
    assert all_stages.PRESETS["gpu"] == ("gpu", "gpu")
    assert "left on two cores" not in capsys.readouterr().out  # which was measured for quick alone


def test_jax_is_tuned_before_the_synthetic_robot_is_recorded(tmp_path: Path):
    """In a separate process, where nothing has started jax, which could not be tuned afterwards."""
    code = (
        "from droid_jax.commands import all_stages, identify, synthetic\n"
        "from droid_jax.report import page\n"
        "synthetic.kept_recordings = lambda paths, again, record: dict.fromkeys(paths)\n"
        "def fit(command):\n"
        "    from droid_jax import runtime\n"
        "    runtime.tune()\n"
        "    print('tuned twice')\n"
        "identify.run = fit\n"
        "page.write_report = lambda folder: folder\n"
        "all_stages.run(all_stages.All(stages=('identify',)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
                          capture_output=True, text=True, timeout=120)  # fmt: skip
    assert "tuned twice" in done.stdout, done.stderr
