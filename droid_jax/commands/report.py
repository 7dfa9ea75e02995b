"""`report`: a run's page once more."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Report:
    """Build the HTML page of a finished run again."""

    run: Annotated[Path, tyro.conf.Positional] = Path("runs/identify")
    """The run's folder."""


def run(command: Report) -> None:
    """Write RUN/report.html."""
    print(f"report: {write(command.run)}")


def write(folder: Path) -> Path:
    """Write the page of a run's folder; its path."""
    from droid_jax.report.page import write_report

    return write_report(folder)
