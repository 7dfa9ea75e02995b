"""The command line on bad input: one sentence, exit code 2, and existing files stay unchanged."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import tyro
from small_log import elbow_log, write_elbow

from droid_jax import run
from droid_jax.commands import convert, folder, options
from droid_jax.commands.all_stages import All
from droid_jax.commands.folder import OtherRun, begin, changed, finished, setup_of
from droid_jax.commands.gap import GapCommand
from droid_jax.commands.identify import Identify
from droid_jax.commands.options import load_effects
from droid_jax.commands.synthetic import known_robot, with_robot_options
from droid_jax.commands.train import Train
from droid_jax.door.demonstration import demonstration_path
from droid_jax.identify import pipeline
from droid_jax.model.effects import registry
from droid_jax.read_json import typed
from droid_jax.recordings.formats import load_recording, save_recording
from droid_jax.report.stages import Setup
from droid_jax.run import main
from droid_jax.simulate.engine import EngineChoice

ROOT = Path(__file__).resolve().parents[1]
XML = ROOT / "docs" / "examples" / "two_link.xml"
GOOD = {"field": "dof_damping", "element": "elbow", "std": 0.5, "high": 20.0}


def test_help_into_a_pipe_that_is_closed_early():
    script = f"{sys.executable} -m droid_jax.run identify --help | head -n 1"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith("usage:") and done.stderr == ""


def content(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A folder that looks like an earlier run that was interrupted before its last file."""
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "fit.json").write_text('{"parameters": []}')
    (folder / "report.html").write_text("<html></html>")
    (folder / "checkpoints" / "5").write_bytes(b"\x00\x01")
    return folder


def parameters(tmp_path: Path, *entries: object) -> Path:
    path = tmp_path / "parameters.json"
    path.write_text(json.dumps(list(entries)))
    return path


# ----- recordings


@pytest.mark.parametrize("arguments", [["--recording"], ["--recording", ""], ["--recording", "--preset", "quick"]])
@pytest.mark.parametrize("command", ["all", "identify", "gap"])
def test_recordings_that_an_empty_variable_named(refused, command: str, arguments: list[str]):
    """Without the option a synthetic robot would be recorded, and its results mistaken for those of the real one."""
    assert "--recording names no file" in refused(command, *arguments)


def test_a_missing_recording(refused, run_folder: Path, tmp_path: Path):
    before = content(run_folder)
    said = refused("identify", "--recording", tmp_path / "nothing.npz", "--out", run_folder)
    assert f"no recording at {tmp_path / 'nothing.npz'}" in said
    assert content(run_folder) == before


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("empty.npz", b"", "empty.npz"),
        ("noise.npz", b"PK\x03\x04 cut", "noise.npz"),
        ("log.mat", b"x", "suffix '.mat'"),
    ],
)
def test_a_file_that_is_no_recording(refused, run_folder: Path, tmp_path: Path, name: str, data: bytes, expected: str):
    (tmp_path / name).write_bytes(data)
    before = content(run_folder)
    assert expected in refused("--recording", tmp_path / name, "--out", run_folder)
    assert content(run_folder) == before


def test_a_recording_with_nan(refused, run_folder: Path, tmp_path: Path):
    time = np.arange(10) * 0.01
    torque = np.zeros((1, 10, 1))
    torque[0, 4] = np.nan
    head = {
        "torque": {"side": "motor", "gravity": False},
        "command_names": ["panda_joint1"],
        "channels": {"torque": {"unit": "N m", "columns": ["panda_joint1"]}},
    }
    arrays = {"format": np.array("droid_jax recording 1"), "metadata": np.array(json.dumps(head)), "time": time,
              "command": np.zeros((10, 1)), "torque.time": time, "torque.values": torque}  # fmt: skip
    np.savez(tmp_path / "nan.npz", **arrays)
    said = refused("--recording", tmp_path / "nan.npz", "--out", run_folder)
    assert "nan.npz" in said and "torque" in said and "4" in said


@pytest.mark.parametrize("name", ["fit.bag", "fit/repeat_00.mcap", "fit/metadata.yaml", "fit/repeat_00/metadata.yaml"])
@pytest.mark.parametrize("command", ["identify", "gap"])
def test_bags_are_sent_through_convert(refused, tmp_path: Path, name: str, command: str):
    """Bags do not state what their efforts are, and these commands have no option for it."""
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("")
    said = refused(command, "--recording", tmp_path / name.split("/")[0], "--out", tmp_path / "run")
    assert "`python -m droid_jax.run convert BAGS --joints ... --torque ...` makes a recording of it" in said


@pytest.mark.parametrize(("preset", "backend", "warned"), [("gpu", "cpu", 1), ("gpu", "gpu", 0), ("quick", "cpu", 0)])
def test_a_gpu_that_is_not_there_is_said_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], preset: str, backend: str, warned: int
):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    options.warn_of_cpu.cache_clear()
    for _ in range(2):
        options.warn_of_cpu(preset)
    assert capsys.readouterr().err.count("jax finds no GPU") == warned
    options.warn_of_cpu.cache_clear()


def test_two_recordings_of_one_name(refused, tmp_path: Path):
    """Refused before anything is written to the folder."""
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    for path in (first, second):
        save_recording(load_recording(small_recording(tmp_path), name="repeat_00"), path)
    said = refused("identify", "--recording", first, second, "--out", tmp_path / "run")
    assert f"{first} and {second} are both named 'repeat_00'" in said and f"convert {second} --name" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", ["identify", "gap"])
def test_a_cutoff_that_filters_nothing(refused, tmp_path: Path, command: str):
    said = refused(command, "--recording", demonstration_path("A"), "--motion-cutoff", "12", "--out", tmp_path / "run")
    assert "--motion-cutoff is for logs without commands, and no recording is one" in said


def stopped_in_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Input of `identify` is accepted, and the search ends at once with an error."""

    def stopped(*_, **__) -> None:
        raise ValueError("stopped")

    good = SimpleNamespace(engine=EngineChoice("mjx", "as asked for"))
    monkeypatch.setattr(pipeline, "prepare", lambda *_, **__: good)
    monkeypatch.setattr(pipeline, "run_fit", stopped)


def test_the_same_files_in_another_place_are_the_same_run(refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Only content counts: paths may be absolute or relative, and folders may have other names."""

    stopped_in_the_search(monkeypatch)
    monkeypatch.chdir(tmp_path)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        parameters(tmp_path / name, GOOD)
        small_recording(tmp_path / name)
        (tmp_path / name / "two_link.xml").write_bytes(XML.read_bytes())
        (tmp_path / name / "mine.py").write_text("")

    def run(folder: Path) -> str:
        files = {"scene": "two_link.xml", "parameters": "parameters.json", "recording": "small.npz"}
        files |= {"user-effects": "mine.py"}
        options = [text for option, name in files.items() for text in (f"--{option}", folder / name)]
        return refused("identify", *options, "--out", tmp_path / "run")

    assert "stopped" in run(Path("one")) and "stopped" in run(tmp_path / "one") and "stopped" in run(Path("two"))
    assert json.loads((tmp_path / "run" / "setup.json").read_text())["scene"] == "two/two_link.xml"
    (tmp_path / "two" / "mine.py").write_text("\n")
    assert "other settings (user_effects)" in run(Path("two"))


@pytest.mark.parametrize("command", ["identify", "gap", "all"])
def test_input_that_cannot_be_read_leaves_no_folder(refused, tmp_path: Path, command: str):
    refused(command, "--recording", tmp_path / "typo.npz", "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_edited_nuisance_makes_another_run(refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The setup holds the whole parameter file, not only the parameters of interest."""

    stopped_in_the_search(monkeypatch)

    def run(std: float) -> str:
        nuisance = {**GOOD, "element": "shoulder", "nuisance": True, "std": std}
        path = parameters(tmp_path, GOOD, nuisance)
        recording = small_recording(tmp_path)
        return refused(
            "identify", "--scene", XML, "--parameters", path, "--recording", recording, "--out", tmp_path / "run"
        )

    assert "stopped" in run(0.5) and "stopped" in run(0.5)
    assert "holds a run with other settings (parameters)" in run(0.6)


# ----- results folders


def test_a_file_where_the_results_folder_should_be(refused, tmp_path: Path):
    (tmp_path / "run").write_text("mine")
    said = refused("identify", "--out", tmp_path / "run")
    assert f"the results folder {tmp_path / 'run'} cannot be written" in said
    assert (tmp_path / "run").read_text() == "mine"


def test_a_file_above_the_results_folder(refused, tmp_path: Path):
    (tmp_path / "file").write_text("mine")
    assert "cannot be written" in refused("identify", "--out", tmp_path / "file" / "run")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    "command",
    [
        Identify(),
        GapCommand(),
        GapCommand((Path("log.npz"),)),
        Identify(scene=Path("own.xml")),
        Train(),
        Train(Path("fit")),
        All(),
    ],
    ids=lambda command: type(command).__name__,
)
def test_what_a_run_was_asked_for_can_be_read_back(command: object):
    """Options that were not given are null."""
    asked = json.loads(json.dumps(setup_of(command)))
    typed(asked, Setup, "setup.json")


@pytest.mark.parametrize("text", ["", "{", "[]", "\udcff"])
def test_a_damaged_setup(refused, run_folder: Path, text: str):
    (run_folder / "setup.json").write_bytes(text.encode(errors="surrogateescape"))
    before = content(run_folder)
    said = refused("identify", "--out", run_folder)
    assert f"{run_folder / 'setup.json'} is damaged" in said and "--again" in said
    assert content(run_folder) == before


def test_a_run_that_was_stopped_may_get_another_budget(tmp_path: Path):
    (tmp_path / "setup.json").write_text('{"budget": null, "seed": 1}')
    assert not finished(tmp_path, {"budget": 5.0, "seed": 1}, False, "gap.json")
    with pytest.raises(OtherRun, match=r"other settings \(seed\)"):
        finished(tmp_path, {"budget": 5.0, "seed": 2}, False, "gap.json")
    with pytest.raises(OtherRun, match=r"other settings \(test-recording\)"):
        finished(tmp_path, {"budget": 5.0, "seed": 1, "judge_on_sha256": ["a"]}, False, "gap.json")
    (tmp_path / "gap.json").write_text("{}")
    with pytest.raises(OtherRun, match=r"other settings \(budget\)"):
        finished(tmp_path, {"budget": 5.0, "seed": 1}, False, "gap.json")


def test_a_finished_run_with_other_settings(refused, run_folder: Path):
    (run_folder / "setup.json").write_text(json.dumps({"preset": "paper", "seed": 7}))
    before = content(run_folder)
    said = refused("identify", "--out", run_folder)
    assert "other settings" in said and "seed" in said and "preset" in said
    assert content(run_folder) == before


def test_starting_over_with_bad_input_keeps_the_old_run(refused, run_folder: Path, tmp_path: Path):
    (run_folder / "setup.json").write_text("{}")
    before = content(run_folder)
    refused("identify", "--again", "--recording", tmp_path / "nothing.npz", "--out", run_folder)
    assert content(run_folder) == before


@pytest.mark.parametrize("command", ["identify", "gap"])
def test_a_recording_that_the_scene_does_not_know_leaves_the_folder_as_it_was(refused, run_folder: Path, command: str):
    """With files of an earlier run (--again) or without: the same command with a better log can run."""
    recording = elbow_log(0.0, 36.0)
    channels = {name: replace(c, columns=("elbwo",)) for name, c in recording.channels.items()}
    save_recording(replace(recording, channels=channels), run_folder.parent / "log.npz")
    (run_folder / "config.json").write_text("{}")
    before = content(run_folder)
    given = (command, *write_elbow(run_folder.parent), "--recording", run_folder.parent / "log.npz")
    assert "positions lack elbow" in refused(*given, "--again", "--out", run_folder)
    assert content(run_folder) == before
    assert "positions lack elbow" in refused(*given, "--out", run_folder.parent / "new")
    assert content(run_folder.parent / "new") == {}


def test_a_report_of_nothing(refused, tmp_path: Path):
    assert str(tmp_path / "nothing") in refused("report", tmp_path / "nothing")


# ----- one's own scene


def test_a_scene_without_parameters(refused, run_folder: Path):
    before = content(run_folder)
    said = refused("identify", "--scene", XML, "--out", run_folder)
    assert "--scene needs --parameters" in said
    assert content(run_folder) == before


def test_a_scene_without_a_recording(refused, tmp_path: Path):
    said = refused("identify", "--scene", XML, "--parameters", parameters(tmp_path, GOOD), "--out", tmp_path / "run")
    assert "--scene needs --recording" in said


def test_a_missing_scene(refused, tmp_path: Path):
    said = refused(
        "identify",
        "--scene",
        tmp_path / "no.xml",
        "--parameters",
        parameters(tmp_path, GOOD),
        "--out",
        tmp_path / "run",
    )
    assert f"no MJCF file at {tmp_path / 'no.xml'}" in said


def test_a_scene_that_mjx_would_ignore_in_part(refused, tmp_path: Path):
    text = XML.read_text().replace('damping="2"', 'damping="2 1"')
    assert text != XML.read_text()
    (tmp_path / "odd.xml").write_text(text)
    said = refused(
        "identify", "--scene", tmp_path / "odd.xml", "--parameters", parameters(tmp_path, GOOD), "--out", tmp_path / "r"
    )
    assert "polynomial joint damping" in said


@pytest.mark.parametrize(
    ("options", "expected"),
    [(["--joints", "wrist"], "wrist"), (["--object-joint", "lid"], "lid")],
)
def test_an_unknown_joint(refused, tmp_path: Path, options: list[str], expected: str):
    said = refused(
        "identify", "--scene", XML, "--parameters", parameters(tmp_path, GOOD), "--out", tmp_path / "run", *options
    )  # fmt: skip
    assert f"unknown joint {expected!r}" in said and "shoulder, elbow" in said


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ({**GOOD, "field": "dof_colour"}, "'dof_colour' is not a model field that a parameter can write; fields start"),
        (
            {**GOOD, "field": "dof_dampng"},
            "is not a model field that a parameter can write, did you mean 'dof_damping'?",
        ),
        ({**GOOD, "field": "opt_timestep"}, "'opt_timestep' is not a model field"),
        ({**GOOD, "element": "wrist"}, "unknown joint 'wrist'"),
        ({"field": "body_mass", "element": "hand", "std": 0.1, "high": 2.0}, "unknown body 'hand'"),
        ({**GOOD, "colour": "red"}, "entry 2: unknown colour; known keys"),
        ({"field": "dof_damping", "element": "elbow"}, "missing std, high; known keys"),
        ({**GOOD, "mode": "sett"}, "'mode' must be one of set, negative, scale, divide, add, got 'sett'"),
        ({**GOOD, "scaling": "cubic"}, "'scaling' must be one of linear, log, got 'cubic'"),
        ({**GOOD, "mean": 30.0}, "outside its bounds"),
        ({**GOOD, "std": -1.0}, "std must be positive"),
        ("dof_damping", "expected an object"),
    ],
)
def test_a_bad_parameter(refused, run_folder: Path, tmp_path: Path, entry: object, expected: str):
    path = parameters(tmp_path, GOOD, entry)
    before = content(run_folder)
    said = refused(
        "identify", "--scene", XML, "--parameters", path, "--recording", tmp_path / "x.npz", "--out", run_folder
    )
    assert f"{path}, entry 2" in said and expected in said
    assert content(run_folder) == before


@pytest.mark.parametrize(
    ("text", "expected"),
    [("[", "not valid JSON"), ("{}", "expected a list"), ("[]", "expected a list"), (None, "no parameter")],
)
def test_a_bad_parameter_file(refused, tmp_path: Path, text: str | None, expected: str):
    path = tmp_path / "parameters.json"
    if text is not None:
        path.write_text(text)
    said = refused("identify", "--scene", XML, "--parameters", path, "--out", tmp_path / "run")
    assert str(path) in said and expected in said


def test_the_same_name_twice(refused, tmp_path: Path):
    said = refused(
        "identify", "--scene", XML, "--parameters", parameters(tmp_path, GOOD, GOOD), "--out", tmp_path / "run"
    )
    assert "elbow_damping" in said and "unique" in said


# ----- options


@pytest.mark.parametrize("command", ["all", "identify", "gap"])
@pytest.mark.parametrize(
    "option",
    [("--parameters", "p.json"), ("--joints", "elbow"), ("--object-joint", "lid"), ("--joint-friction", "scene")],
)
def test_an_option_of_a_scene_without_a_scene(refused, tmp_path: Path, command: str, option: tuple[str, str]):
    said = refused(command, *option, "--recording", "log.npz", "--out", tmp_path / "run")
    assert f"{option[0]} is for your own scene: give --scene too" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("all", ("--hide", "closer=1")),
        ("all", ("--springs", "1")),
        ("gap", ("--hide", "closer=1")),
        ("gap", ("--springs", "2")),
        ("identify", ("--springs", "0")),
        ("identify", ("--demonstrations", "A")),
    ],
)
def test_an_option_of_the_synthetic_robot_beside_recordings(
    refused, tmp_path: Path, command: str, option: tuple[str, str]
):
    said = refused(command, *option, "--recording", "log.npz", "--out", tmp_path / "run")
    assert f"{option[0]} is for the synthetic robot, which is not recorded with --recording" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", [Identify, GapCommand])
@pytest.mark.parametrize("option", ["--test-recording", "--judge-on"])
def test_test_recordings_keep_their_earlier_option(command: type, option: str):
    parsed = tyro.cli(command, args=["--recording", "a.npz", option, "b.npz", "c.npz"])
    assert parsed.judge_on == (Path("b.npz"), Path("c.npz"))


def test_options_of_the_synthetic_robot_are_filled_in_where_it_records():
    """The page lists options: with recordings of a real robot it must not state a number of springs."""
    assert with_robot_options(Identify()) == Identify(springs=1, demonstrations=("A", "C"))
    assert with_robot_options(Identify(springs=2)).springs == 2
    own = Identify(recording=(Path("log.npz"),))
    assert with_robot_options(own) == own


@pytest.mark.parametrize("command", ["all", "identify", "gap", "train"])
def test_scalars_that_nothing_can_write_are_said_at_once(refused, tmp_path: Path, monkeypatch, command: str):
    """Before anything is recorded."""
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "tensorboardX" else found(name))
    said = refused(command, "--tensorboard", "--out", tmp_path / "run")
    assert "--tensorboard needs tensorboardX: in the checkout, pip install" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [(["--population", "1"], "population"), (["--generations", "0"], "generations"), (["--restarts", "0"], "restarts")],
)
def test_a_search_that_cannot_be(refused, tmp_path: Path, options: list[str], expected: str):
    """Refused before anything long begins."""
    said = refused("identify", *options, "--recording", small_recording(tmp_path), "--out", tmp_path / "run")
    assert f"{expected} must be at least" in said


def small_recording(tmp_path: Path) -> Path:
    """A valid recording, too short to fit anything."""
    time = np.arange(10) * 0.01
    head = {
        "torque": {"side": "motor", "gravity": False},
        "command_names": ["panda_joint1"],
        "channels": {"torque": {"unit": "N m", "columns": ["panda_joint1"]}},
    }
    arrays = {"format": np.array("droid_jax recording 1"), "metadata": np.array(json.dumps(head)), "time": time,
              "command": np.zeros((10, 1)), "torque.time": time, "torque.values": np.ones((2, 10, 1))}  # fmt: skip
    np.savez(tmp_path / "small.npz", **arrays)
    return tmp_path / "small.npz"


def test_a_demonstration_that_does_not_exist(refused, tmp_path: Path):
    assert "'Z'" in refused("record", "--demonstration", "Z", "--out", tmp_path / "z.npz")
    assert not (tmp_path / "z.npz").exists()


def test_what_record_wrote_says_which_robot_it_was(tmp_path: Path):
    """A fit of it knows the true values, and a policy is tried on this robot only."""
    recording = replace(load_recording(demonstration_path("A")), meta={"springs": "2", "robot": "7"})
    save_recording(recording, tmp_path / "c.npz")
    assert known_robot([tmp_path / "c.npz"]) == {"springs": 2, "seed": 7, "hide": []}
    save_recording(replace(recording, meta={"springs": "1", "robot": "7"}), tmp_path / "d.npz")
    assert known_robot([tmp_path / "c.npz", tmp_path / "d.npz"]) == {}
    save_recording(replace(recording, meta={}), tmp_path / "d.npz")
    assert known_robot([tmp_path / "d.npz"]) == {}


@pytest.mark.parametrize(
    "arguments", [["--bogus"], ["identify", "--preset", "huge"], ["dance"], ["record", "--seed", "x"]]
)
def test_an_option_that_does_not_exist(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    said = capsys.readouterr()
    assert arguments[-1] in said.err + said.out and "Traceback" not in said.err


COMMANDS = (
    "all",
    "identify",
    "gap",
    "train",
    "evaluate",
    "evaluate-fit",
    "export",
    "record",
    "convert",
    "check",
    "rehearse",
    "report",
    "view",
)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_is_quick(command: str):
    """It imports nothing that takes time, and names its subject."""
    arguments = [*command.split(), "--help"]
    code = (
        "import sys\nfrom droid_jax.run import main\n"
        f"try:\n    main({arguments!r})\nexcept SystemExit as stop:\n    assert stop.code == 0\n"
        "heavy = [m for m in ('numpy', 'jax', 'mujoco', 'scipy', 'matplotlib', 'evosax') if m in sys.modules]\n"
        "assert not heavy, heavy"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    said = [f"{command} [-h]"] if command else [",".join(COMMANDS)]
    said += ["--out"] if command in ("identify", "record") else ["report"] if command in ("", "report") else []
    assert all(text in run.stdout for text in said), run.stdout


# ----- effects of your own

EFFECT = """
from droid_jax.model.effects.registry import register

@register
def gasket(scene):
    return None
"""


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Callable[[], tuple[str, ...]]:
    """Names in the library of effects, which is as it was after the test."""
    registry.registered()
    registry.registered()  # those of the library, which are registered once in a process
    monkeypatch.setattr(registry, "_MAKERS", dict(registry._MAKERS))
    return registry.registered


def test_a_file_of_effects_is_in_the_library_from_then_on(library, tmp_path: Path):
    (tmp_path / "mine.py").write_text(EFFECT)
    assert "gasket" not in library()
    load_effects(tmp_path / "mine.py")
    load_effects(tmp_path / "mine.py")  # the next stage of `all`
    assert "gasket" in library()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "there is no file"),
        ("def broken(", "SyntaxError"),
        ("import nothing_of_this_name", "ModuleNotFoundError: No module named 'nothing_of_this_name'"),
        (EFFECT.replace("gasket", "latch"), "an effect 'latch' is registered already"),
    ],
)
def test_a_file_of_effects_that_cannot_be(refused, library, tmp_path: Path, text: str | None, expected: str):
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    said = refused("identify", "--user-effects", tmp_path / "mine.py", "--out", tmp_path / "run")
    assert "--user-effects" in said and expected in said


def test_results_with_effects_of_ones_own_ask_for_them_and_run_nothing(refused, library, tmp_path: Path):
    (tmp_path / "mine.py").write_text(EFFECT)
    (tmp_path / "gap").mkdir()
    (tmp_path / "gap" / "setup.json").write_text(json.dumps({"user_effects": str(tmp_path / "mine.py")}))
    said = refused("identify", "--extended", tmp_path / "gap" / "extended.json", "--out", tmp_path / "run")
    assert f"give --user-effects {tmp_path / 'mine.py'}" in said and "gasket" not in library()


def test_a_changed_file_of_effects_makes_another_run(tmp_path: Path):
    for option in ("user_effects", "extended"):
        (tmp_path / "mine.py").write_text(EFFECT)
        first = setup_of(Identify(**{option: tmp_path / "mine.py"}))
        (tmp_path / "mine.py").write_text(EFFECT + "\n")
        assert changed(first, setup_of(Identify(**{option: tmp_path / "mine.py"}))) == [f"{option}_sha256"]
        assert f"{option}_sha256" not in setup_of(Identify())


# ----- the program itself


def test_the_page_of_the_command_line_is_current():
    """`python docs/command_line.py` writes it."""
    spec = importlib.util.spec_from_file_location("command_line", ROOT / "docs" / "command_line.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text(encoding="utf-8") == module.page()
    assert re.findall(r"^## ([\w-]+)$", module.page(), re.MULTILINE) == [module.name_of(c) for c in run._ACTIONS]
    assert "## gap\n" in module.page()


def test_a_warning_is_one_line_without_a_place_in_the_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def warn(command: object) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.showwarning = told  # what pytest puts in its place never asks for words
            warnings.warn("the log is old", stacklevel=1)
            warnings.warn("not for people", DeprecationWarning, stacklevel=1)

    def told(message, category, filename, lineno, file=None, line=None):
        said.append(warnings.formatwarning(message, category, filename, lineno, line))

    said: list[str] = []
    usual = warnings.formatwarning
    monkeypatch.setitem(run._ACTIONS, convert.Convert, warn)
    assert main(["convert", "x"]) == 0 and warnings.formatwarning is usual
    assert said[0] == "warning: the log is old\n" and "DeprecationWarning: not for people" in said[1]


def test_it_says_its_version(capsys: pytest.CaptureFixture[str]):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"droid_jax {importlib.metadata.version('droid_jax')}\n"


@pytest.mark.parametrize(
    ("arguments", "begun", "said"),
    [
        (["identify"], True, "interrupted; the same command goes on from here"),
        (["identify", "--again"], True, "interrupted; the same command without --again goes on from here"),
        (["identify", "--again"], False, "interrupted; the same command goes on from here"),
        (["record"], False, "interrupted"),
        (["evaluate", "--again"], False, "interrupted"),
    ],
)
def test_what_an_interrupted_command_promises(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], begun: bool, said: str
):
    """begun: whether the run has set its folder up, so that --again would start over once more."""

    def stopped(command: object) -> None:
        if begun:
            folder.BEGUN.add(Path("run"))
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "_ACTIONS", dict.fromkeys(run._ACTIONS, stopped))
    assert main(arguments) == 130
    assert capsys.readouterr().err == f"{said}\n"


def test_nothing_about_warp_is_printed(tmp_path: Path):
    """In a separate process, because mujoco.mjx prints it when it is first imported."""
    command = [
        sys.executable,
        "-m",
        "droid_jax.run",
        "record",
        "--demonstration",
        "Z",
        "--out",
        str(tmp_path / "z.npz"),
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and "'Z'" in done.stderr and done.stdout == ""


def test_it_completes_in_a_shell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/droid-jax", "--tyro-print-completion", "bash"])
    with pytest.raises(SystemExit) as ended:
        main()
    out = capsys.readouterr().out
    assert not ended.value.code and "droid-jax" in out and "identify" in out and "--recording" in out


@pytest.mark.parametrize("command", [["record", "--seed"], ["train", "--seed"], ["evaluate", "--robot"]])
def test_a_negative_seed_is_refused(refused, command: list[str]):
    assert f"{command[1]} must not be negative, got -1" in refused(*command, "-1")


@pytest.mark.parametrize(("before", "kept"), [("gap", ()), ("identify", ("gap.json", "gaussian.json"))])
def test_starting_over_forgets_another_commands_results(tmp_path: Path, before: str, kept: tuple[str, ...]):
    """Only results of the same command are removed from a shared folder, with the test results of the fit."""
    for name in ("gap.json", "gaussian.json", "gaussian_full.json", "config.json", "evaluation.json", "notes.txt"):
        (tmp_path / name).write_text("{}")
    # identify's own names no command
    (tmp_path / "setup.json").write_text(json.dumps({} if before == "identify" else {"command": before}))
    begin(tmp_path, {"command": "identify"}, again=True, stage="identify")
    left = {p.name for p in tmp_path.iterdir()} - {"setup.json", "notes.txt"}
    assert left == set(kept) - {"gaussian.json"} and (tmp_path / "notes.txt").exists()
