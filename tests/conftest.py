"""Fixtures of all tests: two virtual CPU devices, a cache of compiled programs, OpenGL, real data."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

from benchmarks import archive
from droid_jax import runtime
from droid_jax.report import style

ROOT = Path(__file__).resolve().parents[1]
# Kept between sessions: a second run finds its programs compiled.
CACHE = ROOT / ".cache" / "tests"
DATA_VARIABLE = "DROID_JAX_DATA"
_DRAW = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    assert renderer.render().std() > 0
"""


def _draws(backend: str) -> bool:
    """Whether MuJoCo can draw with this OpenGL backend, tried in a separate process."""
    environment = {**os.environ, "MUJOCO_GL": backend}
    try:
        run = subprocess.run([sys.executable, "-c", _DRAW], env=environment, capture_output=True, timeout=60)
    except subprocess.TimeoutExpired:
        return False
    return run.returncode == 0


def _choose_gl() -> bool:
    """Set MUJOCO_GL to a backend that draws, as it must be before mujoco is first imported."""
    chosen = os.environ.get("MUJOCO_GL")
    for backend in [chosen] if chosen else ["egl", "osmesa", "glfw"]:
        if _draws(backend):
            os.environ["MUJOCO_GL"] = backend
            return True
    return False


HAS_GL = _choose_gl()
runtime.tune(devices=2, cache_dir=os.environ.get(runtime.CACHE_VARIABLE) or CACHE)
import jax  # noqa: E402  (tuned first)

# s: the processes of pytest-xdist share the cache; many of the tests' programs are small.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@pytest.fixture(scope="session")
def archived(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a scored run in benchmarks/results/archive, by name."""

    @functools.cache
    def of(name: str) -> Path:
        folder = tmp_path_factory.mktemp("archived") / name
        archive.unpack(name, folder)
        return folder

    return of


@pytest.fixture
def tuned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces `tune` for commands called in this process, where jax runs already and cannot be tuned."""
    monkeypatch.setattr(runtime, "tune", lambda *a, **k: None)


@pytest.fixture
def refused(tuned: None, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must fail with exit code 2; returns its one line on stderr."""
    from droid_jax.run import main

    def run(*arguments: str | Path) -> str:
        assert main([str(a) for a in arguments]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("error: "), lines
        return lines[0]

    return run


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page without its figures, which take seconds: `one_line` makes them all, once for each kind of page."""

    def left_out(folder: Path, stem: str, title: str, make: Callable[..., Figure], *args: Any) -> style.Drawing:
        return style.Drawing(folder / "figures", stem, title, Markup(""), Markup(""))

    monkeypatch.setattr(style, "drawing", left_out)


def _line(width: float) -> Figure:
    figure = Figure(figsize=(1, 1))
    figure.subplots().plot([0, 1])
    return figure


@pytest.fixture(scope="module")
def one_line() -> Iterator[None]:
    """Figures are made, but one line in their place is saved and put into the page."""
    drawing = style.drawing

    def line_drawing(folder: Path, stem: str, title: str, make: Callable[..., Figure], *args: Any) -> style.Drawing:
        assert all(isinstance(make(*args, width=width), Figure) for width in (style.WIDE, style.NARROW))
        return drawing(folder, stem, title, _line)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "drawing", line_drawing)
        yield


@pytest.fixture
def gl() -> str:
    """The OpenGL backend; skips the test where nothing can draw."""
    if not HAS_GL:
        pytest.skip("no OpenGL: MuJoCo draws with none of egl, osmesa and glfw here")
    return os.environ["MUJOCO_GL"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A test marked `gl` is skipped like one that asks for the fixture."""
    if HAS_GL:
        return
    for item in items:
        if item.get_closest_marker("gl"):
            item.add_marker(pytest.mark.skip(reason="no OpenGL: MuJoCo draws with none of egl, osmesa, glfw"))


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """Finder of a real-data folder: DROID_JAX_DATA/<name>, else real/<name> in a folder beside the checkout."""

    def find(name: str) -> Path:
        chosen = os.environ.get(DATA_VARIABLE)
        folders = [Path(chosen) / name] if chosen else sorted(ROOT.parent.glob(f"*/real/{name}"))
        for folder in folders:
            if folder.is_dir():
                return folder
        pytest.skip(f"real data {name!r} not found (set {DATA_VARIABLE} to the folder that holds {name})")

    return find
