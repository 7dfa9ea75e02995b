"""Posteriors of one door from two arm poses: the paper's distribution figure (section IV-C), from the suite's cases.

    python experiments/pose_figure.py [--quick] [--out DIR]

Reads pose_A and pose_B of `identify_suite.py` from DIR/identify_cases; writes DIR/pose_agreement.png, .pdf and .json.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import numpy as np  # noqa: E402
import tyro  # noqa: E402
from identify_suite import agreement, identifiable_in_both, kept_cases  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from scipy import stats  # noqa: E402

from benchmarks.common import stem  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import door_space  # noqa: E402
from droid_jax.report.style import (  # noqa: E402
    AFTER,
    BEFORE,
    TRUTH,
    WIDE,
    save,
    styled,
)
from droid_jax.report.text import label  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402


@dataclass(frozen=True)
class Arguments:
    """Where the cases are and the figure goes."""

    out: Path = ROOT / "benchmarks" / "results"
    """Folder with identify_cases."""
    quick: bool = False
    """Read the cases of a quick suite."""


@styled
def densities(a: dict[str, Any], b: dict[str, Any]) -> Figure:
    """One panel for each parameter that is identifiable in both poses: the two densities and the truth."""
    names = identifiable_in_both(a, b)
    known = {p.name: p for p in door_space(door_scene()).parameters}
    columns = 4
    rows = max(1, -(-len(names) // columns))
    figure = Figure(figsize=(WIDE, 0.6 + 1.5 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in panels[len(names) :]:
        unused.set_visible(False)
    for axes, name in zip(panels, names, strict=False):
        low = min(a[name]["interval"][0], b[name]["interval"][0])
        high = max(a[name]["interval"][1], b[name]["interval"][1])
        p = known[name]
        x = np.linspace(max(low - 0.4 * (high - low), p.low), min(high + 0.4 * (high - low), p.high), 300)
        stretch = np.gradient(p.to_search(x), x)  # of the coordinate in which the density is normal
        for pose, colour, case in (("A", AFTER, a), ("B", BEFORE, b)):
            density = stats.norm(*case[name]["search"]).pdf(p.to_search(x)) * stretch
            axes.fill_between(x, density, color=colour, alpha=0.35, linewidth=0, label=f"pose {pose}")
            axes.plot(x, density, color=colour, linewidth=1.2)
        axes.axvline(a[name]["truth"], color=TRUTH, linewidth=1.4, linestyle=(0, (4, 1.5)), label="truth")
        axes.set(title=label(name), xlabel=f"[{p.unit}]", yticks=[], xlim=(x[0], x[-1]))
        axes.locator_params(axis="x", nbins=3)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False)
    return figure


def _drawn(parameter: dict[str, Any]) -> dict[str, Any]:
    return {key: parameter[key] for key in ("best", "interval", "search")}


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    cases = kept_cases(arguments.out, arguments.quick, "pose", ["pose_A", "pose_B"])
    a, b = (case["parameters"] for case in cases)
    name = stem("pose_agreement", arguments.quick)
    save(densities(a, b), arguments.out, name)
    drawn = {n: {"truth": a[n]["truth"], "A": _drawn(a[n]), "B": _drawn(b[n])} for n in identifiable_in_both(a, b)}
    origins = {pose: case["origin"] for pose, case in zip("AB", cases, strict=True)}
    result = {"parameters": drawn, **agreement(*cases), "origin": origins}
    write_json(arguments.out / f"{name}.json", result, indent=2)
    print(json.dumps({"figure": str(arguments.out / f"{name}.png"), "within_90": result["within_90"]}))


if __name__ == "__main__":
    main()
