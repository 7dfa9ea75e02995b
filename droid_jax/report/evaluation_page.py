"""The page of an evaluation of a fit: errors in physical units and the channels over time."""

from __future__ import annotations

from functools import partial
from typing import Any

from droid_jax.report import style, torque_figures
from droid_jax.report.evaluation_folder import Evaluation
from droid_jax.report.identify_page import spoken
from droid_jax.report.style import Drawing


def evaluation_view(found: Evaluation) -> dict[str, Any]:
    """The values that evaluation.html.jinja shows of an evaluation."""
    return {"found": found, "file": found.file, "drawings": _draw(found)}


def _draw(found: Evaluation) -> list[Drawing]:
    """A figure of every recording and channel; PNG and PDF copies go to FOLDER/figures/."""
    drawings = list[Drawing]()
    for name, errors in found.file.errors.items():
        for channel, of in errors.items():
            make = partial(torque_figures.torque_traces, repeats="all repeats", quantity=spoken(channel))
            title = f"{spoken(channel)} over time ({name})"
            stem = f"evaluation_{len(drawings)}"
            drawings.append(
                style.drawing(found.folder, stem, title, make, found.traces[f"{name}/{channel}"], (), of.unit)
            )
    return drawings
