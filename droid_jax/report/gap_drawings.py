"""The figures of the search for a missing effect, with their captions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure

from droid_jax.report import gap_figures, gap_maps, gap_torques
from droid_jax.report.drawings import Drawing, drawing
from droid_jax.report.gap_folder import Gap
from droid_jax.report.gap_words import ROLES, role_words

CURVE = ("unexplained", "partly explained")  # verdicts that leave something to look at


def draw_gap(gap: Gap) -> dict[str, list[Drawing]]:
    """Figures by section of the page; PNG and PDF copies go to FOLDER/figures/."""
    found, extended = gap.found, gap.extended
    sections: dict[str, list[Drawing]] = {"size": [], "torque": [], "place": [], "shifts": [], "curve": []}
    cells = (found["cells"]["before"], found["cells"]["after"] if extended else None)

    def add(section: str, stem: str, title: str, caption: str, make: Callable[..., Figure], *args: Any) -> None:
        sections[section].append(drawing(gap.folder, f"missing_{stem}", title, caption, make, *args))

    if found["floor"] is None:
        floor = ""
    else:
        floor = " Dashed: what the simulation's own time step leaves; nothing below it has a meaning."
    names = [f"{gap.recording(role)}\n{ROLES[role]}" for role in gap.roles]
    add(
        "size", "gap", "U and torque distance",
        "Left: U, the mean square of what all repeats share of the residual, σ being one repeat's noise; noise itself "
        f"has no part in it.{floor} Right: the paper's distance between simulated and measured torques, with noise.",
        gap_figures.gap_bars, names, [found["gaps"][r] for r in gap.roles], found["floor"], gap.unit, extended,
    )  # fmt: skip
    for role in reversed(gap.roles):
        shaded = " Shaded: every other phase of the motion." if gap.traces[role]["phases"] else ""
        add(
            "torque", f"torque_{role}", f"Torque over time, {role_words(gap, role)}",
            "Upper: black line and band, the repeats' mean and two of their deviations; lines, the simulation. "
            f"Lower: measurement minus simulation.{shaded}",
            gap_torques.torque_overlays, gap.traces[role], gap.unit, extended,
        )  # fmt: skip
    fitted = f"On {role_words(gap, 'fit')}. Hatched: the sign-flip test (false discoveries 10 %) finds nothing there."
    if gap_maps.joints_and_phases(cells[0])[0]:
        add("place", "cells", "By joint and phase", fitted, gap_maps.cell_maps, *cells)
    if gap_maps.state_bins(cells[0]):
        add("place", "state", "Over the state of the motion", fitted, gap_maps.state_bars, *cells)
    if extended and gap_figures.largest_shifts(found["shifts"]):
        add(
            "shifts", "shifts", "What the missing effect had bent",
            "Base parameters, fitted again together with what was missing: how far they moved, in units of the "
            "deviation that the base fit had claimed. Far outside the band: the base fit was wrong and sure of it.",
            gap_figures.base_shifts, found["shifts"],
        )  # fmt: skip
    if found["verdict"] in CURVE:
        add(
            "curve", "remainder", "What is left, as a curve",
            f"Descriptive only, on {role_words(gap, 'fit')}: it shows where the remainder lives and is no name for it. "
            "σ: one repeat's noise.",
            gap_torques.remainder, gap.traces["fit"], found["cells"]["after"], gap.unit,
        )  # fmt: skip
    return sections
