"""The report of an identification run: one HTML page, built from the files of the run's folder alone.

`write_report(run)` reads the folder, puts its numbers into words, tables and figures and
writes RUN/report.html (everything inside, nothing loaded from elsewhere) and the figures as
PNG and PDF under RUN/figures/.  Required: config.json, fit.json, history.npz, traces.npz and
correlation.npz.  distribution.npz and frames/*.png are optional; where one is missing the
page says so in its place.
"""

from __future__ import annotations

import re
from pathlib import Path

import jinja2

from droid_jax.report.drawings import draw, frame_rows
from droid_jax.report.run_folder import read_run
from droid_jax.report.words import grouped, label, like, number, percent, speaker, summary
from droid_jax.storage import write_text

_DOWNLOADS = (
    ("gaussian.json", "the fitted Gaussian, for training"),
    ("fitted.xml", "the scene with the fitted values"),
    ("fit.json", "every number of this page"),
    ("samples.csv", "parameter sets drawn from the fitted Gaussian"),
    ("history.csv", "the search, generation by generation"),
    ("traces.npz", "torques over time"),
    ("config.json", "how the run was set up"),
)


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
        "label": label,
        "speak": speaker(loaded),
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
    write_text(path, html)
    return path
