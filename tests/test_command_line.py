"""The command line on bad input: one sentence, exit code 2, and what was there before is there after."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from droid_jax import runtime
from droid_jax.run import main

ROOT = Path(__file__).resolve().parents[1]
XML = ROOT / "docs" / "examples" / "two_link.xml"
GOOD = {"field": "dof_damping", "element": "elbow", "std": 0.5, "high": 20.0}


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must fail with exit code 2; returns its one line on stderr."""
    monkeypatch.setattr(runtime, "tune", lambda *a, **k: None)  # jax runs already in this process

    def run(*arguments: str | Path) -> str:
        assert main([str(a) for a in arguments]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("error: "), lines
        return lines[0]

    return run


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


@pytest.mark.parametrize("text", ["", "{", "[]", "\udcff"])
def test_a_damaged_setup(refused, run_folder: Path, text: str):
    (run_folder / "setup.json").write_bytes(text.encode(errors="surrogateescape"))
    before = content(run_folder)
    said = refused("identify", "--out", run_folder)
    assert f"{run_folder / 'setup.json'} is damaged" in said and "--again" in said
    assert content(run_folder) == before


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
        ({**GOOD, "field": "dof_colour"}, "'dof_colour' is not a model field"),
        ({**GOOD, "field": "opt_timestep"}, "'opt_timestep' is not a model field"),
        ({**GOOD, "element": "wrist"}, "unknown joint 'wrist'"),
        ({"field": "body_mass", "element": "hand", "std": 0.1, "high": 2.0}, "unknown body 'hand'"),
        ({**GOOD, "colour": "red"}, "unknown colour"),
        ({"field": "dof_damping", "element": "elbow"}, "missing std, high"),
        ({**GOOD, "mode": "wobble"}, "wobble"),
        ({**GOOD, "scaling": "cubic"}, "cubic"),
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
    [("[", "not JSON"), ("{}", "expected a list"), ("[]", "expected a list"), (None, "no parameter")],
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


@pytest.mark.parametrize(
    ("options", "expected"),
    [(["--population", "1"], "population"), (["--generations", "0"], "generations"), (["--restarts", "0"], "restarts")],
)
def test_a_search_that_cannot_be(refused, tmp_path: Path, options: list[str], expected: str):
    """Said before anything long begins."""
    said = refused("identify", *options, "--recording", small_recording(tmp_path), "--out", tmp_path / "run")
    assert f"{expected} must be at least" in said


def small_recording(tmp_path: Path) -> Path:
    """A valid recording, of too little to fit anything."""
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


@pytest.mark.parametrize(
    "arguments", [["--bogus"], ["identify", "--preset", "huge"], ["dance"], ["record", "--seed", "x"]]
)
def test_an_option_that_does_not_exist(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    said = capsys.readouterr()
    assert arguments[-1] in said.err + said.out and "Traceback" not in said.err


@pytest.mark.parametrize("arguments", [["--help"], ["identify", "--help"], ["record", "--help"], ["report", "--help"]])
def test_help_is_quick(arguments: list[str]):
    """It loads nothing that takes time, and names what it is about."""
    code = (
        "import sys\nfrom droid_jax.run import main\n"
        f"try:\n    main({arguments!r})\nexcept SystemExit as stop:\n    assert stop.code == 0\n"
        "heavy = [m for m in ('jax', 'mujoco', 'scipy', 'matplotlib', 'evosax') if m in sys.modules]\n"
        "assert not heavy, heavy"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    assert ("--out" if arguments[0] in ("identify", "record") else "report") in run.stdout


# ----- the program itself


def test_it_completes_in_a_shell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["/usr/bin/droid-jax", "--tyro-print-completion", "bash"])
    with pytest.raises(SystemExit) as ended:
        main()
    out = capsys.readouterr().out
    assert not ended.value.code and "droid-jax" in out and "identify" in out and "--recording" in out
