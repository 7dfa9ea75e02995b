"""The report of an identification run: one HTML page, built from the files of the run's folder alone.

`write_report(run)` reads the folder, puts its numbers into words, tables and figures and
writes RUN/report.html (everything inside, nothing loaded from elsewhere) and the figures as
PNG and PDF under RUN/figures/.  Required: config.json, fit.json, history.npz, traces.npz and
correlation.npz.  distribution.npz and frames/*.png are optional; where one is missing the
page says so in its place.
"""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from droid_jax.report import figures

_RERUN = "run `python -m droid_jax.run identify` again, or pass the folder that it wrote"
_ARRAYS = {
    "history": ("names", "generation", "mean", "std", "best_cost", "median_cost"),
    "correlation": ("names", "correlation"),
    "distribution": ("initial_cost", "fitted_cost"),
}
_PARAMETER_KEYS = (
    *(
        "name",
        "unit",
        "group",
        "nuisance",
        "initial_mean",
        "initial_std",
        "low",
        "high",
        "best",
        "mean",
        "std",
    ),
    *("interval", "identifiable", "reason", "truth", "on_bound", "partners"),
)
_TRACE_KEYS = ("time", "measured_mean", "measured_low", "measured_high", "before", "after", "joints")
_DOWNLOADS = (
    ("gaussian.json", "the fitted Gaussian, for training"),
    ("fitted.xml", "the scene with the fitted values"),
    ("fit.json", "every number of this page"),
    ("samples.csv", "parameter sets drawn from the fitted Gaussian"),
    ("history.csv", "the search, generation by generation"),
    ("traces.npz", "torques over time"),
    ("config.json", "how the run was set up"),
)


@dataclass(frozen=True)
class Run:
    """What a run's folder holds.

    config, fit: config.json and fit.json.  traces: per recording the arrays of traces.npz plus
    "phases", a list.  history, correlation: arrays by name.  distribution: None when missing.
    frames: PNG files.  missing: one sentence per optional thing that the page leaves out.
    """

    folder: Path
    config: Mapping[str, Any]
    fit: Mapping[str, Any]
    traces: Mapping[str, Mapping[str, Any]]
    history: Mapping[str, np.ndarray]
    correlation: Mapping[str, np.ndarray]
    distribution: Mapping[str, np.ndarray] | None
    frames: tuple[Path, ...]
    missing: tuple[str, ...]

    @property
    def robot(self) -> str:
        """How the page calls what was measured: a stand-in simulation is never called a robot."""
        return "stand-in robot" if self.config["stand_in"] else "robot"

    @property
    def parameters(self) -> list[Mapping[str, Any]]:
        """The parameters of interest, nuisances left out."""
        return [p for p in self.fit["parameters"] if not p["nuisance"]]


@dataclass(frozen=True)
class Drawing:
    """One figure as the page shows it: HTML for a wide and for a narrow screen, and a caption."""

    stem: str
    title: str
    caption: str
    wide: Markup
    narrow: Markup


def write_report(run: Path) -> Path:
    """Write RUN/report.html and RUN/figures/ from the files in RUN; returns the page's path.

    Raises ValueError that names the file when a required one is missing or broken.
    """
    loaded = read_run(run)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": number,
        "like": like,
        "percent": percent,
        "label": figures.label,
        "speak": _speaker(loaded),
        "unbroken": lambda text: re.sub(r"(?<=\d) (?=N m|%)", "\u00a0", text).replace("N m", "N\u00a0m"),
    }
    nuisances = grouped(p for p in loaded.fit["parameters"] if p["nuisance"])
    html = environment.get_template("template.html.j2").render(
        run=loaded,
        summary=summary(loaded),
        groups=grouped(loaded.parameters),
        nuisances=nuisances,
        drawings=draw(loaded),
        frames=frame_rows(loaded.frames),
        downloads=[(f, text) for f, text in _DOWNLOADS if (loaded.folder / f).is_file()],
    )
    path = loaded.folder / "report.html"
    figures.write_atomically(path, html.encode("utf-8"))
    return path


# ---------------------------------------------------------------------------------------- reading


def read_run(run: Path) -> Run:
    """Load and check a run's folder; ValueError names the file that is missing or broken."""
    run = Path(run)
    if not run.is_dir():
        raise ValueError(f"report: there is no folder {run}; {_RERUN}")
    config, fit = _json(run / "config.json"), _json(run / "fit.json")
    _need(config, ("preset", "scene", "engine", "recordings", "seed", "stand_in"), "config.json")
    _need(fit, ("parameters", "cost", "gap", "stop", "rule"), "fit.json")
    for i, p in enumerate(fit["parameters"]):
        _need(p, _PARAMETER_KEYS, f"fit.json, parameter {p.get('name', i)!r}")
    for name, gap in fit["gap"].items():
        _need(gap, ("before", "after", "per_joint_before", "per_joint_after"), f"fit.json, gap {name!r}")
    missing = []
    distribution = None
    if not (run / "distribution.npz").is_file():
        missing.append(
            "distribution.npz is not there: the initial and the fitted Gaussian are not compared by samples."
        )
    else:
        distribution = _arrays(run / "distribution.npz", _ARRAYS["distribution"])
    frames = tuple(sorted((run / "frames").glob("*.png")))
    if not frames:
        missing.append("frames/ holds no pictures: drawing needs OpenGL, see the documentation.")
    return Run(
        folder=run,
        config=config,
        fit=fit,
        traces=_traces(run / "traces.npz", list(fit["gap"])),
        history=_arrays(run / "history.npz", _ARRAYS["history"]),
        correlation=_arrays(run / "correlation.npz", _ARRAYS["correlation"]),
        distribution=distribution,
        frames=frames,
        missing=tuple(missing),
    )


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"report: {path} is missing; {_RERUN}") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"report: {path} cannot be read ({error}); {_RERUN}") from None
    if not isinstance(value, dict):
        raise ValueError(f"report: {path} must hold a JSON object, got {type(value).__name__}; {_RERUN}")
    return value


def _need(table: Mapping[str, Any], keys: Iterable[str], where: str) -> None:
    absent = [k for k in keys if k not in table]
    if absent:
        raise ValueError(f"report: {where} lacks {', '.join(map(repr, absent))}; {_RERUN}")


def _arrays(path: Path, keys: Iterable[str] = ()) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {k: file[k] for k in file.files}
    except FileNotFoundError:
        raise ValueError(f"report: {path} is missing; {_RERUN}") from None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"report: {path} cannot be read ({error}); {_RERUN}") from None
    _need(arrays, keys, path.name)
    return arrays


def _traces(path: Path, recordings: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Arrays per recording, their shapes checked against time [T] and joints [J]."""
    arrays = _arrays(path, [f"{r}/{key}" for r in recordings for key in _TRACE_KEYS])
    traces: dict[str, dict[str, Any]] = {}
    for r in recordings:
        one: dict[str, Any] = {key: arrays[f"{r}/{key}"] for key in _TRACE_KEYS}
        shape = (len(one["time"]), len(one["joints"]))
        for key in _TRACE_KEYS[1:-1]:
            if one[key].shape != shape:
                raise ValueError(f"report: {path}, {r}/{key} must be [time, joints] = {shape}, got {one[key].shape}")
        one["phases"] = json.loads(str(arrays[f"{r}/phases"])) if f"{r}/phases" in arrays else []
        traces[r] = one
    return traces


# ---------------------------------------------------------------------------------------- words


def number(value: float | None, digits: int = 3) -> str:
    """A number with three significant digits, a real minus sign, and a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size and not 1e-4 <= size < 1e5:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10^{int(exponent)}".replace("-", "−")
    decimals = max(0, digits - 1 - math.floor(math.log10(size))) if size else 0
    return f"{value:.{decimals}f}".replace("-", "−")


def like(value: float | None, deviation: float) -> str:
    """A number with as many decimals as show two significant digits of its deviation."""
    if value is None or not math.isfinite(value) or not math.isfinite(deviation) or deviation <= 0:
        return number(value)
    decimals = max(0, 1 - math.floor(math.log10(deviation)))
    if decimals > 6 or abs(value) >= 1e6:
        return number(value)
    return f"{value:.{decimals}f}".replace("-", "−")


def listed(names: Sequence[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def summary(run: Run) -> list[str]:
    """The sentences at the top of the page, from the numbers alone."""
    sentences = [_what(run), *(_gap(run, name) for name in run.fit["gap"]), _told(run), *_truth(run)]
    bound = [_bound(p) for p in run.fit["parameters"] if p["on_bound"]]
    if bound:
        sentences.append(f"On a bound of its range: {listed(bound)}.")
    return [*sentences, _next(run)]


def _what(run: Run) -> str:
    groups = {g: len(ps) for g, ps in grouped(run.parameters).items()}
    robot = run.robot
    parts = listed([f"{n} of the {robot if g == 'Robot' else g.lower()}" for g, n in groups.items()])
    nuisances = len(run.fit["parameters"]) - len(run.parameters)
    beside = f", and {nuisances} nuisances beside them," if nuisances else ""
    recordings = [r["name"] for r in run.config["recordings"]]
    return (
        f"{len(run.parameters)} parameters ({parts}){beside} were fitted so that the simulation "
        f"reproduces the joint torques which the {robot} measured in "
        f"the demonstration{'s' if len(recordings) > 1 else ''} {listed([f'“{r}”' for r in recordings])}."
    )


def _gap(run: Run, name: str) -> str:
    gap = run.fit["gap"][name]
    where = f"In “{name}”, on" if len(run.fit["gap"]) > 1 else "On"
    text = (
        f"{where} repeats that the fit did not see, simulation and {run.robot} differed by "
        f"{number(gap['before'])} N m before the fit (RMS over all joints) and differ by "
        f"{number(gap['after'])} N m after it"
    )
    floor, closed = gap.get("floor"), gap.get("closed")
    if gap["after"] > gap["before"]:
        return text + ": the fit made it worse."
    if floor is None:
        return text + "; how much repeats differ among themselves is not known."
    share = f", so {percent(closed)} of what can be closed was closed" if closed is not None else ""
    return f"{text}; repeats differ among themselves by {number(floor)} N m{share}."


def _told(run: Run) -> str:
    untold = [figures.label(p["name"]).lower() for p in run.parameters if not p["identifiable"]]
    if not untold:
        return "Every parameter of interest can be told from this demonstration."
    rows = "its row" if len(untold) == 1 else "their rows"
    return f"This demonstration does not tell {listed(untold)}; take no number from {rows}."


def _truth(run: Run) -> list[str]:
    known = [p for p in run.parameters if p["truth"] is not None and p["identifiable"]]
    if not known:
        return []
    inside = sum(p["interval"][0] <= p["truth"] <= p["interval"][1] for p in known)
    return [
        f"The true value is known for {len(known)} of the parameters that it does tell, and lies inside "
        f"the 90 % interval for {inside} of them."
    ]


def _bound(p: Mapping[str, Any]) -> str:
    return f"{figures.label(p['name']).lower()} ({which_bound(p)})"


def which_bound(p: Mapping[str, Any]) -> str:
    """ "lower bound 0 N m", for a parameter that sits on one."""
    low = abs(p["best"] - p["low"]) <= abs(p["best"] - p["high"])
    value = number(p["low"] if low else p["high"])
    return f"{'lower' if low else 'upper'} bound {value} {p['unit']}".strip()


def _next(run: Run) -> str:
    steps = []
    gaps = list(run.fit["gap"].values())
    if any(g["after"] > g["before"] for g in gaps):
        steps.append("do not train on this fit; check the recording and the scene first")
    if any(p["on_bound"] for p in run.fit["parameters"]):
        steps.append("ask whether the bound is real; if not, widen it and fit again")
    if any(not p["identifiable"] for p in run.parameters):
        steps.append("record a motion that moves what is not told, or leave it at its initial spread")
    if any(g.get("floor") and g["after"] > 1.5 * g["floor"] for g in gaps):
        steps.append(
            "what is left is well above the floor, so the model lacks something: "
            "look for it with python -m droid_jax.run gap"
        )
    elif not steps:
        steps.append("train on the fitted Gaussian with python -m droid_jax.run train")
    return "Next: " + "; ".join(steps) + "."


def percent(share: float) -> str:
    """A share as a whole percentage, 100 % only when it is."""
    return f"{math.floor(100 * share + 1e-9)} %".replace("-", "−")


def _speaker(run: Run) -> Callable[[str], str]:
    """For texts of others: with a stand-in, "robot" becomes "stand-in robot"."""

    def speak(text: str) -> str:
        if not run.config["stand_in"]:
            return text
        text = re.sub(r"(?<!stand-in )(?<!Stand-in )\brobot", "stand-in robot", text)
        return re.sub(r"(?<!stand-in )(?<!Stand-in )\bRobot", "Stand-in robot", text)

    return speak


def grouped(parameters: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Parameters by group, in the order of the paper's Table I, other groups after it."""
    groups: dict[str, list[Mapping[str, Any]]] = {"Door": [], "Robot": [], "Gripper": []}
    for p in parameters:
        groups.setdefault(p["group"], []).append({**p, "bound": which_bound(p) if p["on_bound"] else ""})
    return {g: ps for g, ps in groups.items() if ps}


# ---------------------------------------------------------------------------------------- pictures


def draw(run: Run) -> dict[str, list[Drawing]]:
    """All figures by section of the page; PNG and PDF copies go to RUN/figures/."""
    fit, robot = run.fit, run.robot
    sections: dict[str, list[Drawing]] = {"gap": [], "torque": [], "parameters": [], "search": []}

    def add(section: str, stem: str, title: str, caption: str, make: Callable[..., Figure], *args: Any) -> None:
        sections[section].append(_drawing(run.folder, stem, title, caption, make, *args))

    for i, (name, gap) in enumerate(fit["gap"].items()):
        of = f" ({name})" if len(fit["gap"]) > 1 else ""
        traces = run.traces[name]
        bars = (traces["joints"], gap["per_joint_before"], gap["per_joint_after"], gap.get("floor"))
        add(
            "gap", f"gap_{i}", f"Torque difference of each joint{of}",
            f"RMS difference between simulation and {robot} on held-out repeats, joint by joint.",
            figures.gap_per_joint, *bars, gap.get("per_joint_floor"),
        )  # fmt: skip
        add(
            "torque", f"torque_{i}", f"Torque over time{of}",
            f"Thick line and band: the {robot}'s held-out repeats. Dashed: the simulation with the initial "
            "means. Thin blue line: with the fitted values. Shaded: every other phase of the motion.",
            figures.torque_traces, traces, traces["phases"],
        )  # fmt: skip
    add(
        "parameters", "intervals", "What is known about each parameter",
        "90 % intervals in units of the initial deviation: 0 is where the fit started, the shaded band is "
        "what was assumed before it. Narrow is well known; grey is not told by this demonstration.",
        figures.intervals, run.parameters,
    )  # fmt: skip
    add(
        "parameters", "correlation", "What cannot be told apart",
        "Correlation of the fitted parameters, nuisances included. Two parameters near ±1 act alike in "
        "this motion; only a combination of them is known.",
        figures.correlation_map, run.correlation["names"], run.correlation["correlation"],
    )  # fmt: skip
    add(
        "search", "parameter_history", "Parameters over generations",
        "Search mean and deviation of the best-told parameters; the point at the right is the final fit "
        "after refinement, with its deviation.",
        figures.parameter_history, run.history, fit["parameters"],
    )  # fmt: skip
    add(
        "search", "cost_history", "Cost over generations",
        "The best and the median sample of every generation.",
        figures.cost_history, run.history, fit["cost"],
    )  # fmt: skip
    if run.distribution is not None:
        samples = (run.distribution["initial_cost"], run.distribution["fitted_cost"])
        add(
            "search", "cost_distribution", "The two Gaussians, replayed",
            f"Parameter sets drawn from the initial and from the fitted Gaussian ({samples[0].size} and "
            f"{samples[1].size}), replayed against repeats that the fit did not see. Lines: medians. "
            "A failed replay counts with its penalty.",
            figures.cost_histograms, *samples,
        )  # fmt: skip
    return sections


def _drawing(folder: Path, stem: str, title: str, caption: str, make: Callable[..., Figure], *args: Any) -> Drawing:
    wide, narrow = make(*args, width=figures.WIDE), make(*args, width=figures.NARROW)
    figures.save(wide, folder / "figures", stem)
    html = [_inline(f, f"{stem}-{kind}", title) for kind, f in (("wide", wide), ("narrow", narrow))]
    return Drawing(stem, title, caption, *html)


def _inline(figure: Figure, prefix: str, title: str) -> Markup:
    """SVG, or PNG on a white card where the SVG would be too long."""
    svg = figures.inline_svg(figure, prefix)
    points = 72 * figure.get_figwidth()
    if len(svg) <= figures.SVG_LIMIT:
        # Fixed points would not shrink on a phone; the viewBox keeps the proportions.
        svg = re.sub(r'(<svg [^>]*?) ?\bheight="[^"]*"', r"\1", svg, count=1)
        svg = re.sub(r'(<svg [^>]*?)\bwidth="[^"]*"', rf'\1style="max-width:{1.45 * points:.0f}px"', svg, count=1)
        head = Markup('<svg role="img" aria-label="{}"').format(title)
        return Markup(head + Markup(svg.removeprefix("<svg")))
    return Markup('<img class="card" alt="{}" src="{}">').format(title, figures.data_uri(figures.png_bytes(figure)))


def frame_rows(paths: Sequence[Path]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Pictures by the first word of their names: (heading, [(caption, data URI)])."""
    rows: dict[str, list[tuple[str, str]]] = {}
    for path in paths:
        name = re.fullmatch(r"(.*?)_\d+_(-?[\d.]+)s", path.stem)
        heading, caption = (name[1], f"{name[2]} s") if name else ("", path.stem)
        rows.setdefault(heading, []).append((caption, figures.data_uri(path.read_bytes())))
    names = {"before": "Before the fit", "after": "After the fit", "": "The scene"}
    order = sorted(rows, key=lambda k: (["", "before", "after"].index(k) if k in names else 3, k))
    return [(names.get(k, figures.label(k)), rows[k]) for k in order]
