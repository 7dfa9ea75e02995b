"""The folder list is the data flow: imports point only to layers further up."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from droid_jax.door.scene import door_scene
from droid_jax.door.space import door_nuisances, door_space
from droid_jax.model.effects.registry import library
from droid_jax.model.parameters import OF_A_JOINT

PACKAGE = Path(__file__).resolve().parents[1] / "droid_jax"
ORDER = (
    *("model", "recordings", "simulate", "preflight", "cost", "identify", "discrepancy", "policy", "report"),
    *("door", "synthetic"),  # the leaves: of the paper's door and of the synthetic robot no layer above knows anything
    "rehearsal",  # hides effects in the synthetic robot
    *("commands", "run"),
)
FOR_ALL = (
    "installation",
    "storage",
    "runtime",
    "distributed",
    "quiet",
    "console",
    "errors",
    "files",
    "arguments",
    "read_json",
    "read_npz",
)
# Third-party package -> the only files or folders of droid_jax that may import it.
ONLY_IN = {
    "evosax": ("identify/cma.py",),
    "brax": ("policy", "door/environment.py"),
    "matplotlib": ("report",),
    "jinja2": ("report",),
    "PIL": ("report",),
    "imageio": ("report",),
}


def imports(source: str, module: tuple[str, ...], is_package: bool) -> Iterator[str]:
    """Dotted names a module imports, at any depth of its code, relative ones made absolute.

    module: the dotted name as a tuple, e.g. ("droid_jax", "model", "scene"); `from a import b`
    yields "a.b", which may name a module or something inside one.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base: tuple[str, ...] = ()
            if node.level:
                base = module[: len(module) - node.level + is_package]
            start = [*base, *([node.module] if node.module else [])]
            yield from (".".join([*start, alias.name]) for alias in node.names)


def layer_fault(path: str, imported: str) -> str | None:
    """Fault of a file (relative to the package, "model/scene.py") that imports a name; None where it may."""
    parts = imported.split(".")
    if parts[0] != "droid_jax":
        homes = ONLY_IN.get(parts[0])
        allowed = homes is None or any(path == home or path.startswith(f"{home}/") for home in homes)
        return None if allowed else f"{path} imports {imported}, which belongs in {' or '.join(homes or ())}"
    here = path.removesuffix(".py").split("/")[0]
    there = parts[1] if len(parts) > 1 else ""
    if here == "__init__" or there in FOR_ALL:
        return None
    if here in FOR_ALL:
        return f"{path} imports {imported}, but every layer may import {path}"
    if there not in ORDER:
        return f"{path} imports {imported}, which is in no layer"
    if here == "__main__" or ORDER.index(there) <= ORDER.index(here):
        return None
    return f"{path} imports {imported}, but {there} comes after {here}"


def faults(folder: Path) -> list[str]:
    """All faults of a package folder."""
    found = []
    for file in sorted(folder.rglob("*.py")):
        relative = file.relative_to(folder)
        module = ("droid_jax", *relative.with_suffix("").parts)
        is_package = file.name == "__init__.py"
        names = imports(file.read_text(), module[:-1] if is_package else module, is_package)
        found += [fault for name in names if (fault := layer_fault(relative.as_posix(), name))]
    return found


def test_imports_point_only_to_layers_further_up():
    assert faults(PACKAGE) == []


def names_of_mjx_internals(source: str) -> set[str]:
    """What of mjx's private parts a module names: `mujoco.mjx._src` in an import, `_impl` as an attribute or a path."""
    found = {name for name in imports(source, ("droid_jax",), False) if name.startswith("mujoco.") and "._" in name}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and node.attr in ("_impl", "_src"):
            found.add(node.attr)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.split(".")[0] == "_impl":
            found.add(node.value)
    return found


def test_mjx_internals_are_named_in_one_module():
    """So that another version of MuJoCo needs changes in one file only."""
    found = {f.relative_to(PACKAGE).as_posix(): names_of_mjx_internals(f.read_text()) for f in PACKAGE.rglob("*.py")}
    assert [path for path, names in found.items() if names] == ["model/mjx_internals.py"]


@pytest.mark.parametrize(
    "source",
    [
        "rows = data._impl",
        "import mujoco.mjx._src.math as math",
        "from mujoco.mjx._src import constraint",
        'data = data.tree_replace({"_impl.efc_force": force})',
    ],
)
def test_a_name_of_mjx_internals_is_found(source):
    assert names_of_mjx_internals(source)


GENERIC = ("model", "recordings", "simulate", "preflight", "cost", "identify", "discrepancy", "policy", "report")
# Where parameters that a replay or an effect reads, or an encoder has, get their names.
NAMES_DEFINED = ("model/parameters.py", "model/fields.py", "model/effects/")


def parameter_names() -> set[str]:
    """Names of the parameters of the door, of all effects in its scene, and of what a replay reads; no joints.

    Those that are fields of MuJoCo's model too (sensor_delay) are left out.
    """
    scene = door_scene(springs=1)
    spaces = (*door_space(scene).parameters, *door_nuisances(scene).parameters)
    effects = (p for e in library(scene) for p in e.parameters)
    found = {p.name.partition("[")[0] for p in (*spaces, *effects)} | {role.value for role in OF_A_JOINT}
    return {name for name in found if not hasattr(scene.model, name)}


def looked_up(source: str, names: set[str]) -> set[str]:
    """Texts in a module, docstrings aside, that are a parameter's name, or begin as one of a joint does."""
    tree = ast.parse(source)
    nodes = [n for n in ast.walk(tree) if isinstance(n, (ast.Module, ast.ClassDef, ast.FunctionDef))]
    documented = {ast.get_docstring(n, clean=False) for n in nodes}
    texts = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)} - documented
    return {t for t in texts if t.partition("[")[0] in names}


def test_generic_layers_know_parameters_by_role():
    """`Parameter.role` states what a parameter is; its name is only for the user."""
    names = parameter_names()
    assert {"hinge_preload", "payload_mass", "sliding_friction_left", "time_offset", "torque_offset"} <= names
    found = {
        path: hits
        for file in PACKAGE.rglob("*.py")
        if (path := file.relative_to(PACKAGE).as_posix()).split("/")[0] in GENERIC
        and not path.startswith(NAMES_DEFINED)
        and (hits := looked_up(file.read_text(), names))
    }
    assert found == {}


@pytest.mark.parametrize("source", ['space["hinge_preload"]', 'n.startswith("torque_offset[")', 'f"viscous[{joint}]"'])
def test_a_looked_up_name_is_found(source):
    assert looked_up(source, {"hinge_preload", "torque_offset", "viscous"})


def test_every_folder_and_file_of_the_package_is_a_layer():
    names = {p.stem for p in PACKAGE.iterdir() if p.suffix == ".py" or (p.is_dir() and any(p.glob("*.py")))}
    assert names <= {*ORDER, *FOR_ALL, "__init__", "__main__"}


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("model/scene.py", "from droid_jax.cost import residuals"),
        ("model/scene.py", "from ..cost import residuals"),
        ("model/__init__.py", "from ..cost import residuals"),
        ("model/effects/delay.py", "from ...recordings.recording import Recording"),
        ("cost/cost.py", "def late():\n    import droid_jax.report.page"),
        ("cost/cost.py", "from droid_jax import run"),
        ("cost/cost.py", "from droid_jax import Parameter"),
        ("simulate/replay.py", "from droid_jax.door.scene import door_scene"),
        ("report/page.py", "from droid_jax.synthetic.hidden_effects import HIDDEN"),
        ("runtime.py", "from droid_jax.model import parameters"),
        ("storage.py", "from droid_jax.recordings import recording"),
        ("identify/gaussian.py", "import evosax"),
        ("identify/multistart.py", "from evosax.algorithms import CMA_ES"),
        ("discrepancy/screen.py", "import brax.envs"),
        ("discrepancy/screen.py", "import matplotlib.pyplot as plt"),
        ("report/page.py", "from droid_jax.commands import gap"),
        ("commands/gap.py", "from droid_jax.run import main"),
        ("run.py", "from PIL import Image"),
    ],
)
def test_a_wrong_import_is_found(tmp_path, path, source):
    file = tmp_path / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(source)
    assert len(faults(tmp_path)) == 1


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("cost/cost.py", "from droid_jax.model.parameters import Space"),
        ("cost/cost.py", "from .residuals import torque_distance\nfrom ..model import scene"),
        ("simulate/__init__.py", "from .replay import make_replay"),
        ("cost/cost.py", "from droid_jax.runtime import compiler_options\nfrom droid_jax import errors"),
        ("model/parameter_file.py", "from droid_jax.storage import write_json"),
        ("identify/cma.py", "from evosax.algorithms import CMA_ES"),
        ("policy/train.py", "from brax.training.agents.ppo import train"),
        ("commands/gap.py", "from droid_jax.discrepancy.case import make_case\nfrom droid_jax.report import page"),
        ("run.py", "from droid_jax.commands import gap\nimport numpy, pathlib"),
        ("__init__.py", "from droid_jax.report.page import write"),
    ],
)
def test_a_right_import_passes(tmp_path, path, source):
    file = tmp_path / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(source)
    assert faults(tmp_path) == []
