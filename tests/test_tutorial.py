"""The tutorial runs from start to end on its data, and finds the effects in them."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import pytest

from droid_jax.identify.extended_model import Extended
from droid_jax.identify.gaussian import prior
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.model.parameter_file import load_parameters
from droid_jax.recordings.formats import load_recording
from droid_jax.run import main

HERE = Path(__file__).resolve().parents[1] / "docs" / "tutorial"


@pytest.fixture
def copy(tuned: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The tutorial's folder, elsewhere."""
    pytest.importorskip("rosbags")
    shutil.copytree(HERE, tmp_path / "tutorial", ignore=shutil.ignore_patterns("runs"))
    monkeypatch.chdir(tmp_path / "tutorial")
    return tmp_path / "tutorial"


def converted() -> list[str]:
    """The arguments of the page's first command."""
    text = (HERE / "README.md").read_text().replace("\\\n", " ")
    command = re.findall(r"^python -m droid_jax\.run (convert .*)$", text, re.MULTILINE)[0]
    bags = sorted(str(path) for path in Path("data/train").iterdir())
    return [part for word in command.split() for part in (bags if word == "data/train/*" else [word])]


def test_its_bags_become_a_recording(copy: Path, capsys: pytest.CaptureFixture[str]):
    assert main(converted()) == 0
    assert "10 repeats of 4.0 s, channels torque (2 x 400), position (2 x 400)" in capsys.readouterr().out
    assert load_recording("runs/train.npz").name == "train"  # as the page of the search calls the motion


def test_the_notebook_is_stored_without_outputs():
    cells = json.loads((HERE / "your_robot.ipynb").read_text())["cells"]
    assert [c for c in cells if c["cell_type"] == "code" and (c["outputs"] or c["execution_count"])] == []


@pytest.mark.slow
def test_the_arms_that_it_draws_rub_as_was_found(copy: Path):
    """Its last cell, on a Gaussian that needs no search: with theta at zero the same arms fall otherwise."""
    matplotlib.use("agg")
    import jax
    import matplotlib.pyplot as plt

    import droid_jax as dj

    scene = ready(dj.load_scene("arm.xml"))
    effects = library(scene, ["joint_coulomb"])
    space = load_parameters("parameters.json", scene) + effect_space(effects)
    extended = Extended(scene, (), effects, space.mean, prior(space))
    names: dict[str, Any] = {"dj": dj, "plt": plt, "extended": extended}
    cell = [c for c in json.loads((copy / "your_robot.ipynb").read_text())["cells"] if c["cell_type"] == "code"][-1]
    exec(compile("".join(cell["source"]), "your_robot.ipynb", "exec"), names)
    physics, batched = names["physics"], names["batched"]
    smooth = replace(physics, theta=jax.tree.map(jax.numpy.zeros_like, physics.theta))
    apart = names["angles"] - jax.jit(jax.vmap(names["fall"], in_axes=(batched,)))(smooth)
    assert names["angles"].shape == (16, 200, 2) and float(abs(apart).max()) > 0.05


@pytest.mark.slow
def test_the_notebook_runs_and_finds_the_friction(copy: Path, monkeypatch: pytest.MonkeyPatch):
    matplotlib.use("agg")
    import droid_jax

    monkeypatch.setattr(droid_jax, "tune", lambda *a, **k: None)
    names: dict[str, Any] = {}
    for cell in json.loads((copy / "your_robot.ipynb").read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "your_robot.ipynb", "exec"), names)
    found = json.loads((copy / "runs" / "gap" / "gap.json").read_text())
    assert found["verdict"] == "named" and found["effects"] == ["joint_coulomb at shoulder"]
    assert found["discrepancies"]["test"]["closed"] > 0.95
    at = dict(zip(names["extended"].space.names, names["extended"].values, strict=True))
    assert all(at[name] == pytest.approx(value, rel=0.1) for name, value in names["truth"].items())
    assert names["angles"].shape == (16, 200, 2)


@pytest.mark.slow
def test_the_commands_of_the_page_run(copy: Path, capsys: pytest.CaptureFixture[str]):
    assert main(converted()) == 0
    text = (HERE / "README.md").read_text().replace("\\\n", " ")
    (command,) = re.findall(r"^python -m droid_jax\.run (--scene .*)$", text, re.MULTILINE)
    assert main(command.split()) == 0
    out = capsys.readouterr().out
    assert "The model lacks: joint_coulomb at shoulder." in out and "[2/2] gap" in out
    assert "gap: The model lacks: joint coulomb at shoulder; " in out
    assert (copy / "runs" / "arm" / "report.html").is_file()
