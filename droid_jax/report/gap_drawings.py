"""The figures of the search for a missing effect, with their captions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from matplotlib.figure import Figure

from droid_jax.report import gap_figures, gap_maps, gap_torques
from droid_jax.report.drawings import Drawing, drawing
from droid_jax.report.gap_folder import Gap
from droid_jax.report.gap_maps import Cell
from droid_jax.report.gap_words import ROLES, largest_shifts, role_words

CURVE = ("unexplained", "partly explained")  # verdicts that leave something to look at


def draw_gap(gap: Gap) -> dict[str, list[Drawing]]:
    """Figures by section of the page; PNG and PDF copies go to FOLDER/figures/."""
    found, extended = gap.found, gap.extended
    sections: dict[str, list[Drawing]] = {"size": [], "torque": [], "place": [], "shifts": [], "curve": []}
    before, after = (_shown(gap, found["cells"][when]) for when in ("before", "after"))
    cells = (before, after if extended else None)

    def add(section: str, stem: str, title: str, caption: str, make: Callable[..., Figure], *args: Any) -> None:
        sections[section].append(drawing(gap.folder, f"missing_{stem}", title, caption, make, *args))

    floor = " Dashed: what the simulation's own time step leaves; nothing below it has a meaning." if gap.floor else ""
    names = [f"{gap.recording(role)}\n{ROLES[role]}".replace(", ", ",\n") for role in gap.roles]
    add(
        "size", "gap", "U and torque distance",
        f"First: {gap.parts.bars}{floor} "
        "Second: the paper's distance between simulated and measured torques, with noise.",
        gap_figures.gap_bars, names, [found["gaps"][r] for r in gap.roles], gap.floor, gap.unit, extended,
    )  # fmt: skip
    for roles, traces in gap.sheets:
        shaded = " Shaded: every other phase of the motion." if traces["phases"] else ""
        where = " and ".join(role_words(gap, role) for role in roles)
        add(
            "torque", f"torque_{roles[0]}", f"Torque over time, {where}",
            f"Upper: {gap.parts.lines} Lower: measurement minus simulation.{shaded}",
            gap_torques.torque_overlays, traces, gap.unit, extended,
        )  # fmt: skip
    fitted = f"On {role_words(gap, 'train')}. {gap.parts.places}"
    if gap_maps.joints_and_phases(cells[0])[0]:
        add("place", "cells", "By joint and phase", fitted, gap_maps.cell_maps, *cells)
    if gap_maps.state_bins(cells[0]):
        add("place", "state", "Over the state of the motion", fitted, gap_maps.state_bars, *cells)
    if extended and largest_shifts(found["shifts"]):
        add(
            "shifts", "shifts", "What the missing effect had bent",
            "Base parameters, fitted again together with what was missing: how far they moved, in units of the "
            "deviation that the base fit had claimed. Far outside the band: the base fit was wrong and sure of it.",
            gap_figures.base_shifts, found["shifts"],
        )  # fmt: skip
    if found["verdict"] in CURVE:
        add(
            "curve", "remainder", "What is left, as a curve",
            f"Descriptive only, on {role_words(gap, 'train')}: it shows where the remainder lives and is no name "
            "for it. "
            f"σ: {gap.parts.sigma}.",
            gap_torques.remainder, gap.sheets[-1][1], found["cells"]["after"], gap.unit,
        )  # fmt: skip
    return sections


def _shown(gap: Gap, cells: Sequence[Cell]) -> Sequence[Cell]:
    """Cells to draw; without repeats no test judges them, and all that hold an instant are shown as they are."""
    if gap.parts.repeated:
        return cells
    return [{**c, "found": True} for c in cells if c["discrepancy"]]
