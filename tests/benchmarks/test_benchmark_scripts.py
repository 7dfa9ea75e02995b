"""How benchmark scripts summarise their numbers; nothing is timed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import default_run, gpu, scaling
from benchmarks.default_run import Line, command_lines, figures
from benchmarks.durations import OPTION, summary
from benchmarks.peer_problems import springs, sysid
from droid_jax.commands import all_stages as whole
from droid_jax.model.parameters import Parameter, Space
from droid_jax.recordings.recording import Channel, Recording, TorqueConvention, TorqueSide


def test_a_part_keeps_what_it_has_and_leaves_out_what_there_is_no_time_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(gpu.time, "time", lambda: clock[0])
    monkeypatch.setattr(gpu.time, "monotonic", lambda: clock[0])
    now = gpu.Measuring(gpu.Arguments(part="jax", kept=tmp_path / "kept.json", until=100.0 + gpu.LEAVING + 50.0))
    done = []
    for item in now.while_there_is_time([1, 2, 3, 4]):
        done.append(item)
        clock[0] += 20.0
        now.keep(done=list(done))
    assert done == [1, 2]  # 10 s are left, and one takes 20
    assert json.loads((tmp_path / "kept.json").read_text()) == {"done": [1, 2], "no_time_for": [3, 4]}


def test_what_was_not_measured_is_none_and_errors_are_named() -> None:
    parts = {"c": {"steps_per_s": 2e6, "cores": 16}, "jax": {"steps_per_s": 5e7}, "gap": {"error": "stopped after 9 s"}}
    line = gpu.headline(parts)
    assert line["ratio_to_c"] == 25.0 and line["c_cores"] == 16
    assert line["warp_ratio_to_c"] is None and line["fit_after_compilation_s"] is None
    assert line["errors"] == {"gap": "stopped after 9 s"}


def test_a_search_that_was_cut_short_gives_no_time_of_a_whole_one() -> None:
    fit = {"after_compilation_s": 3.0, "generation_s": 0.1, "whole": False}
    line = gpu.headline({"fit": fit})
    assert line["fit_after_compilation_s"] is None and line["fit_generation_s"] == 0.1


def test_other_parts_and_axes_are_refused() -> None:
    with pytest.raises(SystemExit, match="there is no part tpu; there are c, jax"):
        gpu.Arguments(only=("c", "tpu"))
    with pytest.raises(SystemExit, match="there is no axis speed"):
        scaling.Arguments(only=("speed",))


@pytest.mark.parametrize("joints", [1, 3])
def test_the_chain_has_so_many_joints_and_begins_at_rest(joints: int) -> None:
    scene, space, (recording,), effects = scaling._chain({**scaling.BASE, "joints": joints, "duration": 0.3})
    assert len(scene.joints) == joints and len(space) == joints + 1 and effects == ()
    assert recording.channel("torque").values.shape[2] == joints
    assert abs(recording.command[:2]).max() < 1e-5


def test_the_figure_has_a_column_for_each_axis_that_was_measured() -> None:
    points = [
        {"axis": axis, axis: value, "seconds": 1.0 + value, "gib": 0.5}
        for axis in ("population", "joints") for value in (1, 2)
    ]  # fmt: skip
    drawn = scaling.figure([*points, {"axis": "effects", "effects": 1, "error": "not done"}])
    assert [plot.get_xlabel() for plot in drawn.axes[2:]] == ["samples", "joints of a chain"]
    assert drawn.axes[0].lines[0].get_ydata().tolist() == [2.0, 3.0]


def test_times_are_those_of_the_lines():
    said = ["starting jax ...", "", "[1/2] record", "[1/2] record: 0.5 minutes", "[2/2] gap", "[2/2] gap: 6.0 minutes"]
    found = figures([Line(s, text) for s, text in zip((2.0, 2.5, 9.0, 39.0, 39.0, 400.0), said, strict=True)])
    assert (found["first_line_s"], found["first_stage_s"], found["longest_silence_s"]) == (2.0, 9.0, 361.0)
    assert found["minutes"] == {"record": 0.5, "gap": 6.0} and found["whole_minutes"] == pytest.approx(400 / 60)
    assert figures([Line(3.0, "starting jax ...")])["longest_silence_s"] == 3.0  # the one before the first counts


def test_the_time_that_is_said_to_be_left_is_the_measured_one():
    measured = json.loads((default_run.ROOT / "benchmarks" / "results" / "default_run.json").read_text())
    assert measured["minutes"] == whole.MINUTES


def test_a_command_that_fails_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "droid_jax").mkdir()
    (tmp_path / "droid_jax" / "__init__.py").touch()
    (tmp_path / "droid_jax" / "run.py").write_text("print('begun'); raise SystemExit('error: no room')")
    monkeypatch.setattr(default_run, "ROOT", tmp_path)
    monkeypatch.setattr(default_run, "empty_cache", lambda folder: {"PYTHONPATH": str(tmp_path)})
    with pytest.raises(RuntimeError, match=r"ended with 1: error: no room"):
        list(command_lines(tmp_path / "out", str(tmp_path)))


ROOT = Path(__file__).resolve().parents[2]
TESTS = """
import subprocess, sys, time
BURN = "import time\\nwhile time.process_time() < 0.3: pass"
def test_idle(): time.sleep(0.1)
def test_busy(): subprocess.run([sys.executable, "-c", BURN], check=True)
def test_wrong(): assert False
"""


@pytest.mark.slow
def test_the_plugin_counts_cpu_and_not_wall_time_in_all_processes(tmp_path: Path):
    (tmp_path / "test_made_up.py").write_text(TESTS)
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "benchmarks.durations", f"{OPTION}=found.json"]
    done = subprocess.run(
        [*command, "test_made_up.py"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True
    )
    found = json.loads((tmp_path / "found.json").read_text())
    tests = {name.split("::")[1]: seconds for name, seconds in found["longest"].items()}
    assert done.returncode == 1 and set(tests) == {"test_idle", "test_busy", "test_wrong"}
    assert tests["test_busy"] >= 0.3 > 0.09 >= tests["test_idle"]
    assert found["tests"] == 3 and found["cpu_seconds"]["all"] > found["cpu_seconds"]["in_tests"] >= 0.3


def test_files_are_summed_the_longest_first():
    found = summary({"a.py::one": 1.0, "b.py::two": 2.5, "a.py::three": 2.0}, 6.0)
    assert list(found["files"].items()) == [("a.py", 3.0), ("b.py", 2.5)]
    assert list(found["longest"]) == ["b.py::two", "a.py::three", "a.py::one"]
    assert found["cpu_seconds"] == {"all": 6.0, "in_tests": 5.5}


def space() -> Space:
    return Space(
        (
            Parameter("mass", "kg", 1.0, 0.5, 0.1, 5.0),
            Parameter("offset", "N m", 0.2, 0.1, -1.0, 1.0, nuisance=True),
        )
    )


def line(x: np.ndarray, parameters: None) -> tuple[list[np.ndarray], list, list]:
    """A residual as the library hands it on: rows by columns of finite differences, which sees the mass alone."""
    return [np.outer(np.arange(3.0), np.atleast_2d(x.T)[:, 0]).reshape(3, *x.shape[1:])], [], []


def test_a_prior_is_a_row_for_each_nuisance_and_weighs_like_the_noise():
    whole = sysid.with_priors(line, space(), noise=0.01)
    (data, prior), *_ = whole(np.array([2.0, 0.5]), None)
    assert data.shape == (3,)
    assert prior == pytest.approx([0.03])  # three deviations off
    (data, prior), *_ = whole(np.array([[2.0, 2.1], [0.5, 0.2]]), None)
    assert data.shape == (3, 2) and prior == pytest.approx(np.array([[0.03, 0.0]]))


def test_the_noise_is_of_the_repeats_mean_in_rows_of_the_residual():
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 1.0, 501)
    clean = np.stack([np.sin(6 * time), 5 * np.cos(6 * time)], axis=1)
    values = clean + 0.1 * rng.normal(size=(10, *clean.shape))
    torque = Channel("torque", "N m", ("a", "b"), time, values, np.ones(values.shape, bool))
    recording = Recording(
        name="wave", time=time, command=clean, command_names=("a", "b"), channels={"torque": torque},
        torque=TorqueConvention(TorqueSide.MOTOR, gravity=True), qpos0={},
    )  # fmt: skip
    size = np.linalg.norm(clean, axis=0) / np.sqrt(2)  # as the library normalises
    expected = np.sqrt(np.mean((0.1 / np.sqrt(10) / size) ** 2))
    assert sysid._noise(recording) == pytest.approx(expected, rel=0.05)


def test_an_interval_without_end_is_written_as_none():
    found = springs.half_widths({"mass": 0.1, "stiffness": 2.0, "damping": 1.0}, np.array([0.2, np.inf, 0.0]))
    assert found["half_width_95"] == {"mass": 0.2, "stiffness": None, "damping": 0.0}
    assert found["error_in_half_widths"] == {"mass": 0.5, "stiffness": None, "damping": None}
    json.dumps(found, allow_nan=False)
