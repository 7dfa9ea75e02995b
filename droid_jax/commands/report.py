"""`report`: rebuilds a run's page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from droid_jax.commands.folder import RUNS
from droid_jax.files import LAST_FILES


@dataclass(frozen=True)
class Report:
    """Build the HTML page of a finished run again."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """The run's folder. Default: the one of runs/identify, runs/gap, runs/train and runs/all that was finished last."""


def run(command: Report) -> None:
    """Write RUN/report.html."""
    from droid_jax.report.page import write_report

    print(f"report: {write_report(command.run or _latest())}")


def _latest() -> Path:
    """The folder below RUNS whose run was finished last; ValueError if there is none."""
    files = {RUNS / stage / last: RUNS / stage for stage, last in LAST_FILES.items()}
    files |= {RUNS / "all" / stage / last: RUNS / "all" for stage, last in LAST_FILES.items()}
    whole = [file for file in files if file.is_file()]
    if not whole:
        folders = ", ".join(map(str, dict.fromkeys(files.values())))
        raise ValueError(f"there is no finished run in {folders}: give its folder")
    return files[max(whole, key=lambda file: file.stat().st_mtime)]
