"""The page of an identification: doubts and next steps by fit.json, and its figures.

templates/identify.html.jinja lays it out, templates/identify_sentences.jinja has the sentences.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from droid_jax.recordings.split import FEWEST_IN_TWO_HALVES, FEWEST_REPEATS
from droid_jax.report import identify_figures, style, torque_figures
from droid_jax.report.identify_folder import DistanceEntry, FitFile, FittedParameter, Run
from droid_jax.report.style import Drawing, data_uri
from droid_jax.report.text import label

FAR_OFF = 3.0  # noise floors: above this distance, and above half the distance before, the set-up is in doubt
ABOVE_NOISE = 1.5  # noise floors: above this distance the model lacks something
LARGE_MEAN_SQUARE = 2.0  # of whitened residuals: above it the model lacks something (0.6 to 1.4 if nothing is missing)
GROUPS = ("Door", "Robot", "Gripper")  # the order of the paper's Table I


def identify_view(run: Run, searched: bool) -> dict[str, Any]:
    """The values that the templates show of an identification.

    Args:
        run: folder of the identification.
        searched: whether the page holds a search for a missing effect too.

    Returns:
        The context of identify.html.jinja.
    """
    return {
        "run": run,
        "neutral": run.neutral,
        "doubts": fit_doubts(run.fit),
        "next": next_steps(run, searched),
        "needed": needed([r.repeats for r in run.config.recordings]),
        "unidentifiable": [p for p in run.fit.of_interest if not p.identifiable and not p.moved_far],
        "moved": [p for p in run.fit.of_interest if p.moved_far],
        "known": [p for p in run.fit.of_interest if p.truth is not None and p.identifiable],
        "groups": grouped(run.fit.of_interest),
        "nuisances": grouped(run.fit.nuisances),
        "drawings": _draw(run),
        "titles": [f"{spoken(channel)}s" for channel in run.fit.channels],
        "judges": [gap.judged for gap in run.fit.heldout_distances.values() for _ in gap.channels],
        "frames": frame_rows(run.frames),
        "replay": data_uri(run.film.read_bytes(), "webp") if run.film else None,
        "viewer": run.viewer,
    }


def fit_doubts(fit: FitFile) -> list[str]:
    """The doubts about a fit, by their names in identify_sentences.jinja."""
    uncertain = [p for p in fit.of_interest if not p.identifiable]
    asked = {
        "worse": any(d.after > d.before for d in fit.heldout_distances.values()),
        "far_off": far_off(fit),
        "not_converged": fit.converged is False,
        "not_judged": fit.converged is None,
        "time_step": any(check.too_coarse for check in fit.checks.values()),
        "engine": any(check.engines_differ and not check.too_coarse for check in fit.checks.values()),
        "unidentifiable": fit.converged is not None and any(not p.moved_far for p in uncertain),
        "moved": fit.converged is not None and any(p.moved_far for p in uncertain),
        "on_bound": any(p.on_bound for p in fit.parameters),
        "noisy": lacks_something(fit),
        "one_repeat": noiseless(fit),
    }
    return [name for name, holds in asked.items() if holds]


def next_steps(run: Run, searched: bool) -> list[str]:
    """The next steps, by their names in identify_sentences.jinja, the most urgent first."""
    fit = run.fit
    steps = ["time_step"] if any(check.too_coarse for check in fit.checks.values()) else []
    if any(f.severity == "certain" for f in fit.findings):
        steps.append("mend")
    elif far_off(fit):
        steps.append("set_up")
    if any(p.on_bound for p in fit.parameters):
        steps.append("bound")
    if fit.converged is None:
        steps.append("preset")
    elif any(not p.identifiable for p in fit.of_interest):
        steps.append("motion")
    if lacks_something(fit):
        steps.append("search_below" if searched else "search")
    elif noiseless(fit):
        steps.append("asked_below" if searched else asked_of(fit))
    return steps or ["train"]


def far_off(fit: FitFile) -> bool:
    """Whether the fit increased the distance, or stays so far from the data that the set-up is in doubt.

    Where no noise floor is known, two parameters at a bound are required in place of `FAR_OFF`.
    """
    bounds = sum(p.on_bound for p in fit.of_interest)

    def far(gap: DistanceEntry) -> bool:
        floor = gap.noise_floor
        most = bounds >= 2 if floor is None else gap.after > FAR_OFF * floor
        return gap.after > gap.before or (most and gap.after > 0.5 * (gap.before + (floor or 0.0)))

    return any(far(gap) for gap in fit.heldout_distances.values())


def lacks_something(fit: FitFile) -> bool:
    """Whether the residuals after the fit exceed the noise, by equation 1 or by the whitened residuals."""
    far = any(g.noise_floor and g.after > ABOVE_NOISE * g.noise_floor for g in fit.heldout_distances.values())
    return far or (fit.mean_square or 0.0) > LARGE_MEAN_SQUARE


def noiseless(fit: FitFile) -> bool:
    """Whether a fit is of single repeats, from which the noise is not known."""
    return any(gap.noise_floor is None for gap in fit.heldout_distances.values())


def asked_of(fit: FitFile) -> str:
    """The next step that tests whether the model of a `noiseless` fit lacks something: "search_log" or "repeats"."""
    log = len(fit.heldout_distances) <= 2 and all(gap.judged == "time" for gap in fit.heldout_distances.values())
    return "search_log" if log else "repeats"


def needed(repeats: Sequence[int]) -> tuple[int, int, bool] | None:
    """What `gap` needs where the given repeats of the recordings are too few; None where they are enough.

    Returns:
        Repeats of each of two motions, repeats of a single motion, and whether a second motion alone would be enough.
    """
    alone = len(repeats) == 1
    if (alone and (repeats[0] == 1 or repeats[0] >= FEWEST_IN_TWO_HALVES)) or (
        not alone and min(repeats) >= FEWEST_REPEATS
    ):
        return None
    return FEWEST_REPEATS, FEWEST_IN_TWO_HALVES, alone and repeats[0] >= FEWEST_REPEATS


def grouped(parameters: Iterable[FittedParameter]) -> dict[str, list[FittedParameter]]:
    """Parameters by group, in the order of the paper's Table I, other groups after it."""
    groups: dict[str, list[FittedParameter]] = {name: [] for name in GROUPS}
    for p in parameters:
        groups.setdefault(p.group, []).append(p)
    return {g: ps for g, ps in groups.items() if ps}


def _draw(run: Run) -> dict[str, list[Drawing]]:
    """All figures by section of the page; PNG and PDF copies go to RUN/figures/."""
    fit = run.fit
    sections: dict[str, list[Drawing]] = {"distance": [], "torque": [], "parameters": [], "search": []}

    def add(section: str, stem: str, title: str, make: Callable[..., Figure], *args: Any) -> None:
        sections[section].append(style.drawing(run.folder, stem, title, make, *args))

    several, drawn = len(fit.heldout_distances) > 1, 0
    for i, (name, gap) in enumerate(fit.heldout_distances.items()):
        of = f" ({name})" if several else ""
        traces, what = run.traces[name], spoken(gap.leading)
        floor = gap.noise_floor if len(gap.channels) == 1 else None  # of several it has another unit
        bars = (traces["joints"], gap.per_joint_before, gap.per_joint_after, floor, gap.per_joint_noise_floor)
        title = f"{what} difference of each joint{of}"
        make = torque_figures.distance_per_joint
        add("distance", f"gap_{i}", title, make, *bars, gap.per_joint_unit, what.lower())
        for channel in gap.channels:
            unit = gap.per_joint_unit if channel == gap.leading else gap.errors[channel].unit
            lines = traces if channel == gap.leading else run.traces[f"{name}/{channel}"]
            overlay = (lines, traces["phases"], unit)
            title = f"{spoken(channel)} over time{of}"
            add(
                "torque",
                f"torque_{drawn}",
                title,
                partial(torque_figures.torque_traces, quantity=spoken(channel)),
                *overlay,
            )
            drawn += 1
    add("parameters", "intervals", "90 % intervals", identify_figures.interval_figure, fit.of_interest)
    correlation = (run.correlation["names"], run.correlation["correlation"])
    add("parameters", "correlation", "Correlation", identify_figures.correlation_map, *correlation)
    title = "Parameters over generations"
    add("search", "parameter_history", title, identify_figures.parameter_history, run.history, fit.parameters)
    add("search", "cost_history", "Cost over generations", identify_figures.cost_history, run.history, fit.cost)
    if run.distribution is not None:
        samples = (run.distribution["initial_cost"], run.distribution["fitted_cost"])
        title = "Cost of samples of both Gaussians"
        add("search", "cost_distribution", title, identify_figures.cost_histograms, *samples, fit.distance_unit)
    return sections


def spoken(channel: str) -> str:
    """A channel's name as in a heading."""
    return channel.replace("_", " ").capitalize()


def frame_rows(paths: Sequence[Path]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Pictures by the first word of their names: (heading, [(caption, data URI)])."""
    rows: dict[str, list[tuple[str, str]]] = {}
    for path in paths:
        name = re.fullmatch(r"(.*?)_\d+_(-?[\d.]+)s", path.stem)
        heading, caption = (name[1], f"{name[2]} s") if name else ("", path.stem)
        rows.setdefault(heading, []).append((caption, data_uri(path.read_bytes())))
    names = {"before": "Before the fit", "after": "After the fit", "": "The scene"}
    order = sorted(rows, key=lambda k: (["", "before", "after"].index(k) if k in names else 3, k))
    return [(names.get(k, label(k)), rows[k]) for k in order]
