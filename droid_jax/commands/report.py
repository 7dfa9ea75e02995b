"""`report`: a run's page once more."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from droid_jax.commands.folder import RUNS


@dataclass(frozen=True)
class Report:
    """Build the HTML page of a finished run again."""

    run: Annotated[Path | None, tyro.conf.Positional] = None
    """The run's folder. Default: runs/identify where there is one, else runs/all."""


def run(command: Report) -> None:
    """Write RUN/report.html."""
    usual = next((f for f in (RUNS / "identify", RUNS / "all") if f.is_dir()), RUNS / "identify")
    print(f"report: {write(command.run or usual)}")


def write(folder: Path) -> Path:
    """Write the page of a run's folder; its path."""
    from droid_jax.report.page import write_report

    return write_report(folder)
