"""`report`: rebuilds a run's page, after the pictures of its replay where they are missing."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from droid_jax import distributed
from droid_jax.commands.folder import RUNS
from droid_jax.commands.pictures import draw_replay
from droid_jax.files import LAST_FILES

_MEANWHILE: ContextVar[list[subprocess.Popen[bytes]] | None] = ContextVar("processes that draw", default=None)


@dataclass(frozen=True)
class Report:
    """Build the HTML page of a finished run again."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """The run's folder. Default: the one of runs/identify, runs/gap, runs/train and runs/all that was finished last."""


def run(command: Report) -> None:
    """Write RUN/report.html; inside `drawn_meanwhile` a process of its own does."""
    folder = command.run or _latest()
    drawing = _MEANWHILE.get()
    if drawing is not None:
        if distributed.first():
            drawing.append(_report_process(folder))
        print(f"report: {folder / 'report.html'} (is being drawn)", flush=True)
        return
    from droid_jax.report.page import write_report

    for of_fit in (folder, folder / "identify"):
        draw_replay(of_fit)
    print(f"report: {write_report(folder)}")


@contextlib.contextmanager
def drawn_meanwhile() -> Iterator[None]:
    """Pages are drawn by processes of their own, for which this context waits; an error ends them at once."""
    drawing = list[subprocess.Popen[bytes]]()
    token = _MEANWHILE.set(drawing)
    try:
        yield
        for process in drawing:
            process.wait()
    finally:
        _MEANWHILE.reset(token)
        for process in drawing:
            process.terminate()
            process.wait()


def _report_process(folder: Path) -> subprocess.Popen[bytes]:
    """A process that runs `report` and prints nothing but errors."""
    return subprocess.Popen(
        [sys.executable, "-m", "droid_jax.run", "report", str(folder)], stdout=subprocess.DEVNULL
    )  # fmt: skip


def _latest() -> Path:
    """The folder below RUNS whose run was finished last; ValueError if there is none."""
    files = {RUNS / stage / last: RUNS / stage for stage, last in LAST_FILES.items()}
    files |= {RUNS / "all" / stage / last: RUNS / "all" for stage, last in LAST_FILES.items()}
    whole = [file for file in files if file.is_file()]
    if not whole:
        folders = ", ".join(map(str, dict.fromkeys(files.values())))
        raise ValueError(f"there is no finished run in {folders}: give its folder")
    return files[max(whole, key=lambda file: file.stat().st_mtime)]
