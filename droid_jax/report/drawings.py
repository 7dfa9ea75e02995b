"""The pictures of the page: which figures it shows, with their captions, and the frames of the scene."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from droid_jax.report import export, parameter_figures, search_figures, torque_figures
from droid_jax.report.run_folder import Run
from droid_jax.report.style import NARROW, WIDE
from droid_jax.report.words import judged, label


@dataclass(frozen=True)
class Drawing:
    """One figure as the page shows it: HTML for a wide and for a narrow screen, and a caption.

    folder: where its PNG and PDF copies lie, as STEM.png and STEM.pdf.
    """

    folder: Path
    stem: str
    title: str
    caption: str
    wide: Markup
    narrow: Markup


def draw(run: Run) -> dict[str, list[Drawing]]:
    """All figures by section of the page; PNG and PDF copies go to RUN/figures/."""
    fit, robot = run.fit, run.robot
    sections: dict[str, list[Drawing]] = {"gap": [], "torque": [], "parameters": [], "search": []}

    def add(section: str, stem: str, title: str, caption: str, make: Callable[..., Figure], *args: Any) -> None:
        sections[section].append(drawing(run.folder, stem, title, caption, make, *args))

    for i, (name, gap) in enumerate(fit["gap"].items()):
        of = f" ({name})" if len(fit["gap"]) > 1 else ""
        traces = run.traces[name]
        bars = (traces["joints"], gap["per_joint_before"], gap["per_joint_after"], gap.get("noise_floor"))
        add(
            "gap", f"gap_{i}", f"Torque difference of each joint{of}",
            f"RMS difference between the smoothed torques of simulation and {robot}, {judged(gap)}, joint by "
            "joint. The torque distance above is taken of torques as they were measured.",
            torque_figures.gap_per_joint, *bars, gap.get("per_joint_noise_floor"), run.torque_unit,
        )  # fmt: skip
        add(
            "torque", f"torque_{i}", f"Torque over time{of}",
            f"Thick line and band: what the {robot} measured ({judged(gap)}). Dashed: the simulation with the initial "
            "means. Thin blue line: with the fitted values. Below each joint, on a scale of its own: measurement minus "
            "simulation. Shaded: every other phase of the motion.",
            torque_figures.torque_traces, traces, traces["phases"], run.torque_unit,
        )  # fmt: skip
    add(
        "parameters", "intervals", "What is known about each parameter",
        "90 % intervals in units of the initial deviation: 0 is where the fit started, the light bar is "
        "what was assumed before it. Narrow is well known; grey is not told by this demonstration.",
        parameter_figures.intervals, run.parameters,
    )  # fmt: skip
    add(
        "parameters", "correlation", "What cannot be told apart",
        "Correlation of the fitted parameters, nuisances included. Two parameters near ±1 act alike in "
        "this motion; only a combination of them is known.",
        parameter_figures.correlation_map, run.correlation["names"], run.correlation["correlation"],
    )  # fmt: skip
    add(
        "search", "parameter_history", "Parameters over generations",
        "Search mean and deviation of the best-told parameters; the point at the right is the final fit "
        "after refinement, with its deviation.",
        search_figures.parameter_history, run.history, fit["parameters"],
    )  # fmt: skip
    add(
        "search", "cost_history", "Cost over generations",
        "The best and the median sample of every generation.",
        search_figures.cost_history, run.history, fit["cost"],
    )  # fmt: skip
    if run.distribution is not None:
        first = next(iter(fit["gap"].values()))
        samples = (run.distribution["initial_cost"], run.distribution["fitted_cost"])
        add(
            "search", "cost_distribution", "The two Gaussians, replayed",
            f"Parameter sets drawn from the initial and from the fitted Gaussian ({samples[0].size} and "
            f"{samples[1].size}), replayed and judged {judged(first)}. Lines: medians. "
            "A failed replay counts with its penalty.",
            search_figures.cost_histograms, *samples, run.torque_unit,
        )  # fmt: skip
    return sections


def drawing(folder: Path, stem: str, title: str, caption: str, make: Callable[..., Figure], *args: Any) -> Drawing:
    """The figure `make(*args, width=...)` draws, for the page; PNG and PDF copies go to FOLDER/figures/STEM.*."""
    wide, narrow = (export.settled(make(*args, width=width)) for width in (WIDE, NARROW))
    export.save(wide, folder / "figures", stem)
    html = [_inline(f, stem, kind, title) for kind, f in (("wide", wide), ("narrow", narrow))]
    return Drawing(folder / "figures", stem, title, caption, *html)


def _inline(figure: Figure, stem: str, kind: str, title: str) -> Markup:
    """SVG, or PNG on a white card where the SVG would be too long; the caption describes it to those who cannot see."""
    svg = export.inline_svg(figure, f"{stem}-{kind}")
    points = 72 * figure.get_figwidth()
    if len(svg) <= export.SVG_LIMIT:
        # Fixed points would not shrink on a phone; the viewBox keeps the proportions.
        svg = re.sub(r'(<svg [^>]*?) ?\bheight="[^"]*"', r"\1", svg, count=1)
        svg = re.sub(r'(<svg [^>]*?)\bwidth="[^"]*"', rf'\1style="max-width:{1.45 * points:.0f}px"', svg, count=1)
        head = Markup('<svg role="img" aria-label="{}" aria-describedby="{}-caption"').format(title, stem)
        return Markup(head + Markup(svg.removeprefix("<svg")))
    card = Markup('<img class="card" alt="{}" aria-describedby="{}-caption" src="{}">')
    return card.format(title, stem, export.data_uri(export.png_bytes(figure)))


def frame_rows(paths: Sequence[Path]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Pictures by the first word of their names: (heading, [(caption, data URI)])."""
    rows: dict[str, list[tuple[str, str]]] = {}
    for path in paths:
        name = re.fullmatch(r"(.*?)_\d+_(-?[\d.]+)s", path.stem)
        heading, caption = (name[1], f"{name[2]} s") if name else ("", path.stem)
        rows.setdefault(heading, []).append((caption, export.data_uri(path.read_bytes())))
    names = {"before": "Before the fit", "after": "After the fit", "": "The scene"}
    order = sorted(rows, key=lambda k: (["", "before", "after"].index(k) if k in names else 3, k))
    return [(names.get(k, label(k)), rows[k]) for k in order]
