"""Tables of policies and their histograms: Table II, this program's beside the paper's, and the knob places."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from droid_jax.report.style import AFTER, BEFORE, INK, MUTED, legend, styled
from experiments.policies.table import METHODS, OPENED, PAPER, SLIPPERY, trials

WORDS = {"prior": "prior, randomised", "mean": "fitted mean alone", "fitted": "fitted, randomised"}
WHERE = {
    "simulation": "simulation",
    "synthetic_robot": "synthetic robot",
    SLIPPERY: "synthetic robot, pads with a friction of 0.05",
}
TARGETS: dict[str, tuple[str, Callable[[float], bool]]] = {  # of every policy, by place
    "simulation": ("policies at 95 % or more", lambda rate: rate >= 0.95),
    SLIPPERY: ("policies below 20 %, as it should be", lambda rate: rate < 0.2),
}
OPENED_WORDS = "30°, where the paper counts a success"
PAPER_WORDS = "the paper's real robot, mean and deviation"
BINS = np.arange(0.0, 111.0, 5.0)  # degrees; the door opens to 100.3, and its end stop gives a little


def as_text(summary: Mapping[str, Any]) -> str:
    """Markdown: for each setting a column for each method, simulation above robot, the paper's numbers last."""
    lines = ["# Table II", ""]
    for setting, found in summary["table"].items():
        if not found["methods"]:  # still to be run
            continue
        lines += [f"## Setting `{setting}`", "", *_rows(found["methods"], found["fitted_better_than"]), ""]
    if "hidden_effect" in summary:
        lines += _hidden(summary["hidden_effect"])
    lines += ["## The paper (three policies of each method, ten trials each)", ""]
    lines += ["| | prior | mean | fitted |", "|---|---|---|---|"]
    for place, words in (("simulation", "simulation"), ("robot", "real robot")):
        cells = [summary["paper"][m][place] for m in METHODS]
        lines.append(f"| {words}: success, % | " + " | ".join(f"{c[0]:.1f}" for c in cells) + " |")
        lines.append("| largest angle, degrees | " + " | ".join(f"{c[1][0]:.1f} ± {c[1][1]:.1f}" for c in cells) + " |")
        lines.append("| steps | " + " | ".join(f"{c[2][0]:.1f} ± {c[2][1]:.1f}" for c in cells) + " |")
    return "\n".join(lines) + "\n"


def knobs_as_text(levers: Mapping[str, Any]) -> str:
    """Markdown of the knob places: a column for each, simulation above robot.  levers: columns by place."""
    lines = ["# Four knob places, one fit (section IV-E)", ""]
    lines += ["Policies for the knob at each distance from the hinge, all on the fit of the first place.", ""]
    lines += [*_columns(levers), ""]
    lines += ["The paper gives no numbers: its policies opened the door at all of its places."]
    return "\n".join(lines) + "\n"


def _hidden(found: Mapping[str, Any]) -> list[str]:
    """The fourth comparison: policies of prior, base fit and extended model on a robot that hides an effect."""
    title = f"## A robot that hides {', '.join(found['hidden'])}: prior, base fit and extended model"
    sentence = f"What the search said: {found['sentence']}"
    if not found["models"]:
        return [title, "", sentence, "", "No policy was trained.", ""]
    rows = _columns(found["models"])
    for other, better in found["extended_better_than"].items():
        rows += ["", _apart(f"Extended against {other}", better)]
    return [title, "", sentence, "", *rows, ""]


def _rows(methods: Mapping[str, Any], better: Mapping[str, Any]) -> list[str]:
    rows = _columns({m: methods[m] for m in METHODS if m in methods})
    for other, found in better.items():
        rows += ["", _apart(f"Fitted against {other}", found)]
    return rows


def _columns(of: Mapping[str, Any]) -> list[str]:
    """A column for each method or model, its places one below the other."""
    rows = ["| | " + " | ".join(of) + " |", "|---|" + "---|" * len(of)]

    def row(words: str, cells: Sequence[str]) -> None:
        rows.append(f"| {words} | " + " | ".join(cells) + " |")

    for place, words in WHERE.items():
        cells = [columns[place] for columns in of.values() if place in columns]
        if not cells:
            continue
        row(f"{words}: success, % (95 %)", [_success(c) for c in cells])
        row("of each policy", [_each(c) for c in cells])
        if place in TARGETS:
            words, reached = TARGETS[place]
            row(words, [_count(c, reached) for c in cells])
        if place == SLIPPERY:
            continue
        if all("beyond_30_deg" in c for c in cells):  # older summaries do not say
            row(f"beyond {OPENED:g} degrees, % (the paper's success)", [_percent(c["beyond_30_deg"], 1) for c in cells])
        row("largest angle, degrees (mean's 95 %)", [_spread(c["angle_deg"]) for c in cells])
        row("steps of successes (mean's 95 %)", [_spread(c["steps"]) for c in cells])
        row("actions with the grip on, %", [_percent(c["grip"]["mean"], 0) for c in cells])
        if place == "synthetic_robot":
            row("stopped by the control loop, %", [_percent(c["stopped"], 1) for c in cells])
        if any(c["blown_up"] for c in cells):
            row("blew up, not counted above", [str(c["blown_up"]) for c in cells])
    return rows


def _apart(what: str, found: Mapping[str, Any]) -> str:
    success, angle = found["success"], found["angle"]
    if success["difference"] is None:
        return f"{what}, synthetic robot: nothing to compare, all trials of one of them blew up."
    welch = f"; Welch's {_between(success['welch_95'], _points)}" if success["welch_95"] else ""
    points = f"{_points(success['difference'])} points of success ({_between(success['interval_95'], _points)}{welch})"
    degrees = f"{angle['difference']:+.1f} degrees ({_between(angle['interval_95'], '{:+.1f}'.format)})"
    return f"{what}, synthetic robot: {points}, {degrees}."


def _between(interval: Sequence[float], words: Callable[[float], str]) -> str:
    low, high = interval
    return f"{words(low)} to {words(high)}"


def _success(column: Mapping[str, Any]) -> str:
    if column["success_rate"] is None:
        return "none"
    low, high = column["success_interval_95"]
    return f"{100 * column['success_rate']:.1f} ({100 * low:.0f} to {100 * high:.0f})"


def _each(column: Mapping[str, Any]) -> str:
    return ", ".join(_percent(rate, 0) for rate in column["success_of_each"])


def _count(column: Mapping[str, Any], reached: Callable[[float], bool]) -> str:
    return f"{sum(rate is not None and reached(rate) for rate in column['success_of_each'])} of {column['policies']}"


def _percent(share: float | None, decimals: int) -> str:
    return "none" if share is None else f"{100 * share:.{decimals}f}"


def _spread(found: Mapping[str, Any]) -> str:
    if found["mean"] is None:
        return "none"
    of_mean = f" ({_between(found['interval_95'], '{:.1f}'.format)})" if found["interval_95"] else ""
    return f"{found['mean']:.1f} ± {found['std']:.1f}{of_mean}"


def _points(share: float) -> str:
    return f"{100 * share:+.0f}"


@styled
def histograms(cases: Sequence[Mapping[str, Any]], settings: Sequence[str]) -> Figure:
    """Largest angles on the synthetic robot: a row for each setting that was run, a column for each method.

    A bar above each panel is the paper's mean and deviation on its real robot, whose doors are none of these.
    """
    settings = [s for s in settings if any(c["setting"]["name"] == s for c in cases)] or list(settings[:1])

    def panel(setting: str, method: str) -> Panel:
        own = [c for c in cases if c["setting"]["name"] == setting and c["method"] == method]
        colour = BEFORE if method == "prior" else AFTER
        return Panel(f"{setting}: {WORDS[method]}", own, colour, PAPER[method]["robot"][1])

    return _panels([[panel(setting, method) for method in METHODS] for setting in settings])


@styled
def knob_histograms(places: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Largest angles on the synthetic robot, a panel for each place of the knob (its name: its policies)."""
    panels = [Panel(f"{lever} from the hinge", own, AFTER) for lever, own in places.items()]
    return _panels([panels])


class Panel(NamedTuple):
    """A histogram: its title, the policies whose trials it counts, its colour, and the paper's mean and deviation."""

    title: str
    cases: Sequence[Mapping[str, Any]]
    colour: str
    paper: tuple[float, float] | None = None


def _panels(rows: Sequence[Sequence[Panel]]) -> Figure:
    """Histograms of the largest angle on the synthetic robot, in per cent of each panel's trials, on common axes."""
    figure = Figure(figsize=(7.0, 1.9 * len(rows) + 0.7), layout="constrained")
    grid = figure.subplots(len(rows), len(rows[0]), sharex=True, sharey=True, squeeze=False)
    for row, panels in zip(grid, rows, strict=True):
        for axes, panel in zip(row, panels, strict=True):
            each = [trials(case, "synthetic_robot")["angle"] for case in panel.cases]
            angles = np.concatenate(each) if each else np.zeros(0)
            axes.hist(angles, BINS, weights=np.full(len(angles), 100.0 / max(len(angles), 1)), color=panel.colour)
            axes.axvline(OPENED, color=INK, lw=0.8, ls=":", label=OPENED_WORDS)
            high = axes.get_xaxis_transform()  # degrees, and a share of the panel's height
            axes.annotate(
                f"{OPENED:g}°", (OPENED - 1.5, 0.78), xycoords=high, ha="right", va="center", fontsize=7, color=INK
            )
            if panel.paper:
                mean, std = panel.paper
                axes.errorbar(
                    mean, 0.93, xerr=std, fmt="o", ms=3, lw=1, capsize=2, color=MUTED, transform=high, label=PAPER_WORDS
                )
            axes.set_title(panel.title, fontsize=8)
        row[0].set_ylabel("trials [%]")
    grid[0, 0].set_ylim(top=1.15 * grid[0, 0].get_ylim()[1])  # of all: room for the paper's above the bars
    figure.supxlabel("largest opening [degrees]", fontsize="medium")
    legend(figure, list(grid.ravel()), figure.get_figwidth(), columns=2)
    return figure
