"""Suppresses three messages of other programs that the user can do nothing about; prints everything else.

- mujoco.mjx prints two lines where warp is not installed, which it only needs on some GPUs.
- matplotlib prints two lines about the folder of its font list if there is no home folder.
- XLA prints errors of 2 kB when it loads a compiled CPU program from the cache.  They are about two tuning preferences
  that it sets itself and that no host can report (openxla/xla#44565), and about versions, which jax's cache key
  contains.  The cache has a folder for each kind of processor, see `runtime.tune`.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import logging
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any

from droid_jax.installation import check_mujoco

LOG_LEVEL = "TF_CPP_MIN_LOG_LEVEL"  # jaxlib reads it once, when it is loaded
_NO_WARP = (
    "Failed to import warp: No module named 'warp'",
    "Failed to import mujoco_warp: No module named 'warp'",
)
_OF_THE_CACHE = re.compile(
    rb"cpu_aot_loader\.cc.* Target machine feature \+prefer-no-(gather|scatter) is not +supported"
    rb"|pjrt_executable\.cc.* Assume version compatibility\. PjRt-IFRT does not track XLA executable versions"
)
_lock = threading.Lock()
_first = threading.RLock()
_settled: list[str] = []  # the log level that jaxlib was loaded with, where this package set it


_NO_HOME = re.compile(r"mkdir -p failed for path|Matplotlib created a temporary cache directory")


def quiet_matplotlib() -> None:
    """Leave out what matplotlib logs when it is imported and there is no folder for its cache."""
    logging.getLogger("matplotlib").addFilter(_of_use)


def _of_use(record: logging.LogRecord) -> bool:
    return not _NO_HOME.match(str(record.msg))


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Leave out the two lines that the first import of mujoco.mjx prints where warp is not installed.

    Everything else printed inside the block appears when the block ends.
    """
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            yield
    finally:
        lines = printed.getvalue().splitlines(keepends=True)
        if kept := "".join(line for line in lines if line.rstrip() not in _NO_WARP):
            print(kept, end="")


def import_mjx() -> ModuleType:
    """mujoco.mjx, imported without its two lines about warp, and jax's cache without XLA's errors about it."""
    before_jax()
    check_mujoco()
    with quiet():
        mjx = importlib.import_module("mujoco.mjx")
    quiet_cache()
    return mjx


class _WhenUsed:
    """mujoco.mjx, imported (`import_mjx`) when something of it is first used; plain C needs nothing of it."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_mjx(), name)


def _mjx() -> ModuleType:
    """mujoco.mjx, imported by one thread: `quiet` replaces the standard output of all meanwhile."""
    with _first:
        return sys.modules.get("mujoco.mjx") or import_mjx()


if TYPE_CHECKING:
    import mujoco.mjx as mjx
else:
    mjx = _WhenUsed()


def before_jax() -> None:
    """Switch XLA's log off, where jax is not imported yet and the user has not set the level."""
    if "jaxlib" not in sys.modules:
        os.environ.setdefault(LOG_LEVEL, "3")
        _settled.append(os.environ[LOG_LEVEL])


def quiet_cache() -> None:
    """Leave out what XLA writes about each program that jax loads from its cache, where its log is on."""
    if _settled == ["3"]:  # it is off
        return
    try:
        cache: Any = importlib.import_module("jax._src.compilation_cache")
        load = cache.get_executable_and_time
    except (ImportError, AttributeError):  # another version of jax, whose messages are printed
        return
    if hasattr(load, "quiet"):
        return

    @functools.wraps(load)
    def loaded(*args: Any, **kwargs: Any) -> Any:
        with _without(_OF_THE_CACHE):
            return load(*args, **kwargs)

    loaded.quiet = True  # type: ignore[attr-defined]
    cache.get_executable_and_time = loaded


@contextlib.contextmanager
def _without(pattern: re.Pattern[bytes]) -> Iterator[None]:
    """Suppress matching lines on the process's standard error inside the block.

    Everything else, of other threads too, appears when the block ends.
    """
    with _lock, tempfile.TemporaryFile() as kept:
        try:
            stderr = os.dup(2)
        except OSError:  # closed: nothing is written
            yield
            return
        try:
            os.dup2(kept.fileno(), 2)
            yield
        finally:
            os.dup2(stderr, 2)
            kept.seek(0)
            for line in kept:
                if not pattern.search(line):
                    os.write(stderr, line)
            os.close(stderr)
