"""The wheel holds all that the package needs at run time, the MJCF files included."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.slow


def run(*command: str, cwd: Path = ROOT) -> str:
    """Output of a command of this Python; a failure shows its messages."""
    done = subprocess.run([sys.executable, *command], cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(wheel, sdist) of this checkout; the wheel is built from the sdist, as an index would."""
    pytest.importorskip("hatchling", reason="hatchling builds the wheel; it comes with the extra 'dev'")
    folder = tmp_path_factory.mktemp("dist")
    run("-m", "hatchling", "build", "-t", "sdist", "-d", str(folder))
    sdist = next(folder.glob("*.tar.gz"))
    command = ("-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", str(folder))
    run(*command, str(sdist))
    return next(folder.glob("*.whl")), sdist


def test_wheel_holds_every_module_and_mjcf_file(built):
    names = set(zipfile.ZipFile(built[0]).namelist())
    modules = {p.relative_to(ROOT).as_posix() for p in (ROOT / "droid_jax").rglob("*.py")}
    scenes = {f"droid_jax/{p.relative_to(ROOT).as_posix()}" for p in (ROOT / "mjcf").rglob("*") if p.is_file()}
    assert modules and "droid_jax/mjcf/panda.xml" in scenes
    templates = {p.relative_to(ROOT).as_posix() for p in (ROOT / "droid_jax/report/templates").iterdir()}
    layouts = {p.relative_to(ROOT).as_posix() for p in (ROOT / "droid_jax/recordings/layouts").iterdir()}
    assert len(templates) > 10 and layouts and modules | scenes | templates | layouts | {"droid_jax/py.typed"} <= names
    tops = {name.split("/")[0] for name in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"droid_jax"}


def test_wheel_says_what_it_is(built):
    wheel = zipfile.ZipFile(built[0])
    info = next(n for n in wheel.namelist() if n.endswith(".dist-info/METADATA")).removesuffix("METADATA")
    metadata = Parser().parsestr(wheel.read(f"{info}METADATA").decode())
    assert (metadata["Name"], metadata["License-Expression"]) == ("droid_jax", "Apache-2.0")
    assert "droid-jax = droid_jax.console:program" in wheel.read(f"{info}entry_points.txt").decode()
    assert any(n.startswith(info) and n.endswith("/LICENSE") for n in wheel.namelist())


def test_installed_package_finds_its_own_mjcf(built, tmp_path):
    target = tmp_path / "site"
    run("-m", "pip", "install", "--no-deps", "--no-index", "--target", str(target), str(built[0]))
    code = (
        f"import sys; sys.path.insert(0, {str(target)!r})\n"
        "import mujoco, droid_jax.door.scene as scene\n"
        "folder = scene.mjcf_dir()\n"
        "print(scene.__file__, folder, mujoco.MjModel.from_xml_path(str(folder / 'panda.xml')).nu, sep='\\n')"
    )
    # Away from the checkout, whose own package and MJCF files would be found first.
    module, folder, actuators = run("-c", code, cwd=tmp_path).splitlines()[-3:]
    assert Path(module).is_relative_to(target)
    assert Path(folder).resolve() == (target / "droid_jax" / "mjcf").resolve()
    assert int(actuators) > 0


def test_the_api_reference_is_built(tmp_path: Path):
    pytest.importorskip("pdoc")
    (modules,) = re.findall(r"^python -m pdoc (.*)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    run("-m", "pdoc", *modules.split(), "-o", str(tmp_path))
    assert "make_cost" in (tmp_path / "droid_jax.html").read_text()
    assert (tmp_path / "droid_jax" / "identify" / "pipeline.html").is_file()
