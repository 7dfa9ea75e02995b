"""`report`: rebuilds a run's page, after the pictures of its replay where they are missing."""

from __future__ import annotations

import contextlib
import os
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
from droid_jax.console import at_the_end
from droid_jax.files import LAST_FILES

PageProcesses = dict[Path, "subprocess.Popen[str]"]  # folder -> the process that draws its page
_MEANWHILE: ContextVar[PageProcesses | None] = ContextVar("processes that draw", default=None)


@dataclass(frozen=True)
class Report:
    """Build the HTML page of a finished run again, and draw pictures of its replay that are missing."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """The run's folder. Default: the one of runs/identify, runs/gap, runs/train and runs/all that was finished last."""


def run(command: Report) -> None:
    """Write RUN/report.html; inside `drawn_meanwhile` a process of its own does."""
    folder = command.run or _latest()
    drawing = _MEANWHILE.get()
    if drawing is not None:
        if distributed.first():
            _finish(drawing, folder)  # its page of an earlier stage
            drawing[folder] = _report_process(folder)
        print(f"report: {folder / 'report.html'} (is being drawn)", flush=True)
        return
    from droid_jax.report.page import write_report

    for of_fit in (folder, folder / "identify"):
        draw_replay(of_fit)
    print(f"report: {write_report(folder)}")


@contextlib.contextmanager
def drawn_meanwhile() -> Iterator[None]:
    """Pages are drawn by processes of their own, for which this context waits; a signal ends them too."""
    drawing = PageProcesses()

    def end() -> None:
        for process in list(drawing.values()):
            process.terminate()

    token = _MEANWHILE.set(drawing)
    try:
        with at_the_end(end):
            yield
            wait_for_pages()
    finally:
        _MEANWHILE.reset(token)
        end()
        for process in drawing.values():
            process.wait()


def wait_for_pages() -> None:
    """Wait for the processes of `drawn_meanwhile`, and print what they had to say."""
    drawing = _MEANWHILE.get() or {}
    for folder in list(drawing):
        _finish(drawing, folder)


def _finish(drawing: PageProcesses, folder: Path) -> None:
    """Wait for the process that draws a folder's page, if there is one."""
    if (process := drawing.get(folder)) is None:
        return
    _, said = process.communicate()
    del drawing[folder]
    if said or process.returncode:
        print(f"{folder / 'report.html'}: {said.strip() or 'could not be drawn'}", file=sys.stderr)


def _report_process(folder: Path) -> subprocess.Popen[str]:
    """A process that runs `report`, which no Ctrl-C reaches."""
    # -P: without it the current folder comes first on the path, where its modules could hide others.
    package = os.pathsep.join(filter(None, (str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "droid_jax.run", "report", str(folder)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace",
        env={**os.environ, "PYTHONPATH": package}, start_new_session=True,
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
