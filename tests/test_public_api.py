"""The public names: loaded when asked for, and the code in the documents runs as it is printed."""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import droid_jax as dj
from droid_jax import runtime
from droid_jax.commands.identify import Identify, identify_config, identify_model
from droid_jax.door.scene import door_scene
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.pipeline import identify_parameters as identify_function
from droid_jax.identify.search import CmaConfig
from droid_jax.model.effect_interface import State
from droid_jax.model.effects import registry
from droid_jax.model.parameter_file import load_parameters
from droid_jax.run import main

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "docs" / "examples" / "two_link.py"
HEAVY = ("jax", "mujoco", "evosax", "brax", "flax", "matplotlib", "tyro")
SMALL = dj.IdentifyConfig(
    search=CmaConfig(population=10, parents=None, generations=3), refine=RefineConfig(iterations=8)
)


def loaded(*codes: str) -> list[set[str]]:
    """Which of HEAVY a new Python has loaded after each piece of code, one after the other."""
    tell = f"print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    probe = "\n".join(["import sys, json", *(f"{code}\n{tell}" for code in codes)])
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    run = subprocess.run([sys.executable, "-c", probe], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return [set(json.loads(line)) for line in run.stdout.splitlines()]


# ----- what is loaded when


LOADED = {  # from little to much: each piece of code runs behind those before it
    "import droid_jax; dir(droid_jax)": set(),
    "from droid_jax import Parameter, Space, Scaling, Recording, load_recording, save_recording": set(),
    "from droid_jax import identify, Gaussian": set(),
    "from droid_jax import load_scene, door_scene, Scene, door_space, door_nuisances": {"mujoco"},
    "from droid_jax import make_cost": {"jax", "mujoco"},
    # evosax needs flax
    "from droid_jax import find_missing_effects, DiscrepancyConfig": {"jax", "mujoco"},
}


def test_a_name_loads_no_more_than_it_needs():
    assert dict(zip(LOADED, loaded(*LOADED), strict=True)) == LOADED


def test_tune_can_follow_any_import_that_does_not_start_jax():
    """`import droid_jax`, scene and parameters first, then tune: what the documents do."""
    code = (
        "import droid_jax as dj\nfrom droid_jax.model.fields import joint_damping\n"
        "from droid_jax.recordings.recording import Channel\ndj.load_scene, dj.Space\n"
        "assert dj.tune(devices=2).devices == 2\nimport jax; assert jax.local_device_count() == 2"
    )
    (found,) = loaded(code)
    assert "jax" in found


def test_every_public_name_is_there_and_kept():
    assert len(set(dj.__all__)) == len(dj.__all__) == 25
    for name in dj.__all__:
        assert getattr(dj, name) is getattr(dj, name)
        assert name in dir(dj)
    assert dj.load_recording is importlib.import_module("droid_jax.recordings.formats").load_recording
    assert dj.tune is runtime.tune


def test_static_and_lazy_names_are_the_same():
    """What type checkers see in the TYPE_CHECKING block is what __getattr__ gives."""
    source = inspect.getsource(dj)
    seen = {
        new: (module, old) for module, old, new in re.findall(r"from droid_jax\.(\S+) import (\w+) as (\w+)", source)
    }
    assert seen == dj._HOMES
    assert set(seen) == set(dj.__all__)


def test_an_unknown_name_is_refused():
    with pytest.raises(AttributeError, match=r"no attribute 'make_coast'; public: .*make_cost"):
        dj.make_coast  # noqa: B018
    with pytest.raises(ImportError, match="make_coast"):
        exec("from droid_jax import make_coast")


def test_a_public_name_is_a_module_or_a_function():
    """Importing a module sets it as an attribute of the package, where it would replace a function of that name."""
    assert not {*dj.__all__} & {p.stem for p in (ROOT / "droid_jax").iterdir()}


def test_identify_passes_everything_on():
    with pytest.raises(ValueError, match="different names"):
        dj.identify_parameters(None, None, [TINY, TINY])
    with pytest.raises(ValueError, match="space must be a Space"):  # one alone is a list of one
        dj.identify_parameters(None, None, TINY)
    with pytest.raises(TypeError, match="colour"):
        dj.identify_parameters(None, None, [TINY], colour="red")


TINY = dj.Recording("twice", np.zeros(0), np.zeros((0, 0)), (), {}, None, {})  # type: ignore[arg-type]


# ----- the example


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("two_link", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def recording(example: ModuleType) -> dj.Recording:
    return example.record()


def test_the_example_is_short(example: ModuleType):
    lines = inspect.getsource(example.fit).splitlines()
    assert len(lines) < 20


@pytest.mark.slow
def test_the_example_recovers_the_arm(example: ModuleType, recording: dj.Recording):
    """A small budget, far from the truth: the guesses are off by 27, 35, 67 and 71 percent."""
    found = example.fit(recording, SMALL)
    truth = np.array([example.TRUTH[name] for name in found.space.names])
    assert np.abs(found.space.mean / truth - 1).min() > 0.2
    np.testing.assert_allclose(found.best, truth, rtol=0.01)
    assert [t.name for t in found.identifiability if not t.identifiable] == []
    (gap,) = found.heldout_distances.values()
    # two joints with 0.02 N m each: sqrt(pi / 2) times that is the mean norm
    assert gap.after == pytest.approx(0.0251, rel=0.05)
    assert gap.before > 0.5


@pytest.mark.slow
def test_the_example_runs_as_a_script(example: ModuleType, tmp_path: Path):
    """A separate process, with the default settings."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    run = subprocess.run(
        [sys.executable, str(EXAMPLE)], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "runs" / "two_link.npz").is_file()
    rows = re.findall(r"^(\w+) +(\S+) \[(\S+), (\S+)\].*truth (\S+)$", run.stdout, re.MULTILINE)
    assert [r[0] for r in rows] == list(example.TRUTH)
    for name, best, low, high, truth in rows:
        assert float(best) == pytest.approx(example.TRUTH[name], rel=0.01)
        assert float(low) < float(best) < float(high)
        assert float(truth) == pytest.approx(example.TRUTH[name], abs=1e-3)


# ----- the documents


def blocks(document: str, language: str) -> list[str]:
    """Fenced code blocks of one language, in order."""
    text = (ROOT / document).read_text()
    found = re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert found, f"{document} has no {language} block"
    return found


@pytest.fixture
def workplace(tmp_path: Path, recording: dj.Recording, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with my_robot.xml and my_log.npz of the documents; small budgets, jax already tuned."""
    shutil.copy(EXAMPLE.with_suffix(".xml"), tmp_path / "my_robot.xml")
    dj.save_recording(recording, tmp_path / "my_log.npz")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dj, "tune", lambda: None)
    monkeypatch.setattr(runtime, "tune", lambda: None)
    monkeypatch.setattr(dj, "identify_parameters", lambda *a, **options: identify_function(*a, config=SMALL, **options))
    return tmp_path


@pytest.mark.slow
def test_the_readme_identifies_a_robot_in_ten_lines(workplace: Path, capsys: pytest.CaptureFixture[str]):
    (code,) = blocks("README.md", "python")
    assert len(code.splitlines()) <= 11
    exec(compile(code, "README.md", "exec"), {})
    gap, *lines = capsys.readouterr().out.splitlines()
    # The shoulder's damping is wrong and not fitted.
    assert gap.startswith("share of the torque distance closed: {'two-link': 0.2")
    printed = dict(line.split(": ") for line in lines)
    assert list(printed) == ["elbow_damping", "forearm_mass"]
    content = json.loads((workplace / "gaussian.json").read_text())
    assert [p["name"] for p in content["space"]] == list(printed)


@pytest.mark.slow
def test_the_code_of_your_robot_runs(workplace: Path, capsys: pytest.CaptureFixture[str]):
    names: dict[str, object] = {}
    for code in blocks("docs/your-robot.md", "python"):
        exec(compile(code, "your-robot.md", "exec"), names)
    out = capsys.readouterr().out
    assert "{'two-link': 0.99" in out and "(64, 600, 2)" in out
    assert dj.load_recording("wave.npz").repeats == 10
    assert np.shape(names["samples"]) == (1000, 4)
    fitted = dj.load_scene("fitted.xml").model.body("forearm").mass[0]
    assert fitted == pytest.approx(names["found"].best[0], rel=1e-4) != 0.8  # type: ignore[attr-defined]
    assert names["space"].names[-1] == "elbow_rotor_scale"  # type: ignore[attr-defined]


def test_the_json_of_your_robot_is_a_space(workplace: Path):
    text, shared = blocks("docs/your-robot.md", "json")
    (workplace / "parameters.json").write_text(shared)
    assert load_parameters("parameters.json", dj.load_scene("my_robot.xml")).names == ("rotor", "gain")
    (workplace / "parameters.json").write_text(text)
    space = load_parameters("parameters.json", dj.load_scene("my_robot.xml"))
    assert space.names == ("forearm_mass", "shoulder_damping", "elbow_damping", "elbow_frictionloss")
    np.testing.assert_allclose(space.mean, [0.8, 2.0, 1.0, 0.1])


@pytest.mark.slow
def test_the_command_of_your_robot_runs(workplace: Path):
    text, _ = blocks("docs/your-robot.md", "json")
    (workplace / "parameters.json").write_text(text)
    command = next(c for c in blocks("docs/your-robot.md", "sh") if "run identify" in c)
    words = shlex.split(command)
    assert words[:3] == ["python", "-m", "droid_jax.run"]
    assert main([*words[3:], "--generations", "4", "--population", "10"]) == 0
    files = {p.name for p in (workplace / "runs" / "mine").iterdir()}
    assert {"report.html", "fit.json", "gaussian.json", "fitted.xml", "config.json", "checkpoints"} <= files
    found = {p["name"]: p["best"] for p in json.loads((workplace / "runs/mine/fit.json").read_text())["parameters"]}
    assert found["forearm_mass"] == pytest.approx(1.1, rel=0.01)
    fitted = dj.load_scene(workplace / "runs" / "mine" / "fitted.xml")
    assert fitted.model.body("forearm").mass[0] == pytest.approx(found["forearm_mass"], rel=1e-4)


def test_the_documented_effect_is_one(monkeypatch: pytest.MonkeyPatch):
    """The example is registered, is a candidate for the door, pushes it open, and is removed again."""
    registry.registered()  # modules register once: before the list is replaced
    monkeypatch.setattr(registry, "_MAKERS", dict(registry._MAKERS))
    (code,) = blocks("docs/your-effect.md", "python")
    exec(compile(code, "your-effect.md", "exec"), {})
    scene = door_scene()
    (effect,) = registry.library(scene, ["gasket"])
    assert effect.force is not None
    nothing = np.zeros(scene.model.nq)
    assert effect.locations == {scene.object_joint: ("gasket",)}
    assert registry.library(dj.load_scene(EXAMPLE.with_suffix(".xml")), ["gasket"]) == ()  # nothing that is shut
    push = effect.force({"gasket": 0.7}, State(0.0, nothing, nothing, nothing))  # type: ignore[arg-type]
    assert float(push[scene.dof("hinge")]) == pytest.approx(0.7) and np.count_nonzero(push) == 1


def test_the_presets_are_those_of_the_command_line():
    """The table in docs/method.md, row by row."""
    rows = re.findall(
        r"^\| (quick|standard|paper|gpu) \| (\d+) \| (\d+) \| (\d+)(?:, in plain C (\d+))? \| (\d+) \| (\d) ms "
        r"\| (yes|no) \|$",
        (ROOT / "docs" / "method.md").read_text(),
        re.MULTILINE,
    )
    assert [r[0] for r in rows] == ["quick", "standard", "paper", "gpu"]
    for preset, population, elite, generations, in_c, restarts, step, refined in rows:
        command = Identify(preset=preset)
        config, search = identify_config(command), identify_config(command).search
        numbers = [int(n) for n in (population, elite, generations, restarts)]
        assert [search.population, search.elite, search.generations, search.restarts] == numbers
        assert config.generations_in_c == (int(in_c) if in_c else None)
        assert identify_config(Identify(preset=preset, generations=7)).generations_in_c is None
        assert (config.refine is not None) == (refined == "yes")
        scene, _, nuisances = identify_model(command)
        assert scene.model.opt.timestep == pytest.approx(int(step) / 1000)
        assert (nuisances is not None) == (preset != "paper")
