"""The report of a run's folder: one HTML page, built from the files in it alone.

`write_report(run)` reads the folder, puts its numbers into words, tables and figures and
writes RUN/report.html (everything inside, nothing loaded from elsewhere) and the figures as
PNG and PDF under figures/ of the folder that they belong to.  RUN holds an identification, a
search for a missing effect, a trained policy, or several of these, in it or in the folders of
their stages.  Of an identification, config.json, fit.json, history.npz, traces.npz and
correlation.npz are required; distribution.npz and frames/*.png are optional; where one is missing
the page says so in its place.  Of a search, gap.json and gap.npz are required; of a policy,
training.json.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from droid_jax.files import (
    CONFIG,
    EXTENDED,
    EXTENDED_MJCF,
    FIT,
    FITTED,
    GAP,
    GAP_TRACES,
    GAUSSIAN,
    HISTORY_TABLE,
    LAST_FILES,
    POLICY,
    SAMPLES,
    TRACES,
    TRAINING,
    TRANSFER,
)
from droid_jax.report.drawings import draw, frame_rows
from droid_jax.report.export import data_uri
from droid_jax.report.gap_drawings import draw_gap
from droid_jax.report.gap_folder import Gap, has_gap, read_gap
from droid_jax.report.gap_marks import marks
from droid_jax.report.gap_tables import groups
from droid_jax.report.gap_words import (
    DECISIVE,
    ROLES,
    at_bound,
    effect_words,
    gap_summary,
    readable,
    role_words,
    settings,
    span_of,
    unit_words,
)
from droid_jax.report.lead import doubt, lead
from droid_jax.report.policy_drawings import draw_policy, film_row
from droid_jax.report.policy_folder import Trained, has_policy, read_policy
from droid_jax.report.policy_words import policy_summary
from droid_jax.report.run_folder import Run, has_run, read_run
from droid_jax.report.stages import left_over, needs_whole
from droid_jax.report.told import moved_words, went_far
from droid_jax.report.words import (
    counted,
    grouped,
    judged,
    label,
    like,
    number,
    percent,
    speaker,
    summary,
)
from droid_jax.storage import refuse_foreign, write_text

_DOWNLOADS = (
    (GAUSSIAN, "the Gaussian of the model's parameters, for training"),
    (EXTENDED, "the extended model: effects, values and Gaussian, for fits and training"),
    (EXTENDED_MJCF, "the extended model as MJCF, as far as MJCF has words for it"),
    (FITTED, "the scene with the fitted values"),
    (FIT, "every number of this page"),
    (SAMPLES, "parameter sets drawn from the fitted Gaussian"),
    (HISTORY_TABLE, "the search, generation by generation"),
    (TRACES, "torques over time"),
    (CONFIG, "how the run was set up"),
    (POLICY, "the policy: python -m droid_jax.run export makes it ready for a robot"),
    (TRAINING, "how the policy was trained"),
    (TRANSFER, "every trial of the policy"),
    (GAP, "the search for a missing effect: every number"),
    (GAP_TRACES, "the search for a missing effect: torques over time"),
)


def write_report(run: Path) -> Path:
    """Write RUN/report.html, and figures/ of the folder of each part, from the files in RUN; returns the page's path.

    Raises ValueError that names the file when a required one is missing or broken.
    """
    folder = Path(run)
    path = folder / "report.html"
    old = left_over(folder)
    places = [folder, *(folder / stage for stage in LAST_FILES if stage not in old)]
    gap = read_gap(at) if (at := _part(places, has_gap)) else None
    policy = read_policy(at) if (at := _part(places, has_policy)) else None
    at = _part(places, has_run)
    if not (at or gap or policy):
        needs_whole(folder)
    loaded = read_run(at or folder) if at or not (gap or policy) else None
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
        "counted": counted,
        "quote": lambda path: shlex.quote(str(path)),
        "judged": judged,
        "effect": effect_words,
        "unit": unit_words,
        "moved": moved_words,
        "at_bound": at_bound,
        "span": span_of,
        "speak": speaker(loaded) if loaded else str,
        "from_page": lambda path: path.relative_to(folder).as_posix(),
        "nested": _nested,
        "unbroken": lambda text: re.sub(r"(?<=\d) (?=N m|%)", "\u00a0", text).replace("N m", "N\u00a0m"),
    }
    environment.tests["went_far"] = went_far
    parts = (_policy(policy, gap, doubt(loaded, gap, policy)) if policy else {}) | (_search(gap) if gap else {})
    parts |= _identification(loaded, gap is not None) if loaded else {}
    if len([part for part in (loaded, gap, policy) if part]) > 1:
        parts |= _together(folder, loaded, gap, policy)
    parts_at = [part.folder for part in (loaded, gap, policy) if part]
    html = environment.get_template("template.html.j2").render(
        folder=folder, run=loaded, gap=gap, policy=policy, downloads=list(_downloads(parts_at)),
        **{"lead": [], **parts},
    )  # fmt: skip
    refuse_foreign(path, "a file", _is_page, "a page of this program")
    write_text(path, html)
    return path


def _is_page(path: Path) -> bool:
    """Whether a file is a page that `write_report` wrote, now or before pages named their generator."""
    with path.open("rb") as file:
        head = file.read(2000)
    return b'name="generator" content="droid_jax"' in head or b"default-src 'none'; img-src data:" in head


def _part(places: Sequence[Path], has: Callable[[Path], bool]) -> Path | None:
    """Where a part of the page is: in the run's folder, or in that of one of its stages."""
    return next((at for at in places if has(at)), None)


def _nested(html: str) -> Markup:
    """A part of a page with several: its headings one level deeper."""
    return Markup(re.sub(r"(</?h)([2-5])\b", lambda found: f"{found[1]}{int(found[2]) + 1}", html))


def _downloads(folders: Sequence[Path]) -> Iterator[tuple[Path, str]]:
    """The files to offer, of several with one name the first."""
    for name, text in _DOWNLOADS:
        at = next((folder / name for folder in folders if (folder / name).is_file()), None)
        if at is not None:
            yield at, text


def _together(folder: Path, run: Run | None, gap: Gap | None, policy: Trained | None) -> dict[str, Any]:
    """The head of a page with several parts."""
    name = folder.resolve().name
    scene = run.config["scene"] if run else policy.training["scene"] if policy else ""
    return {
        "title": f"Report: {name}",
        "heading": f"Report: {scene or name}",
        "lead": lead(run, gap, policy, gap.hidden if gap else ""),
    }


def _identification(run: Run, searched: bool) -> dict[str, Any]:
    """What the page says of an identification; the head of the page is its, also where both are there."""
    config = run.config
    count = len(config["recordings"])
    meta = [f"Preset {config['preset']}", f"{count} recording{'s' if count != 1 else ''}"]
    if "started" in config:
        meta.append(f"{str(config['started'])[:16].replace('T', ' ')} UTC")
    return {
        "title": f"Identification of {config['scene']}",
        "heading": f"Identification report: {config['scene']}",
        "meta": [*meta, run.folder.resolve().name],
        "synthetic_robot": config["synthetic_robot"],
        "summary": summary(run, searched),
        "groups": grouped(run.parameters),
        "nuisances": grouped(p for p in run.fit["parameters"] if p["nuisance"]),
        "drawings": draw(run),
        "frames": frame_rows(run.frames),
        "replay": data_uri(run.film.read_bytes(), "webp") if run.film else None,
    }


def _search(gap: Gap) -> dict[str, Any]:
    """What the page says of a search for a missing effect."""
    name = gap.folder.resolve().name
    return {
        "title": f"Search for a missing effect: {name}",
        "heading": "Search for a missing effect",
        "meta": [*(role_words(gap, role) for role in gap.roles), name],
        "synthetic_robot": gap.synthetic_robot,
        "answer": readable(gap.found["sentence"], gap.found),
        "gap_summary": gap_summary(gap),
        "gap_drawings": draw_gap(gap),
        "marks": marks(gap),
        "settings": settings(gap),
        "candidates": groups(gap.found),
        "roles": ROLES,
        "decisive": DECISIVE,
    }


def _policy(trained: Trained, gap: Gap | None, doubt: str) -> dict[str, Any]:
    """What the page says of a trained policy; gap and doubt as in `policy_summary`."""
    setup, name = trained.training["setup"], trained.folder.resolve().name
    return {
        "title": f"Policy: {name}",
        "heading": f"Policy for {trained.training['scene']}",
        "meta": [f"Method {setup['method']}", f"preset {setup['preset']}", f"seed {setup['seed']}", name],
        "synthetic_robot": bool(trained.trials),
        "policy_summary": policy_summary(trained, gap, doubt),
        "policy_drawings": draw_policy(trained),
        "films": film_row(trained),
        "no_films": trained.no_films,
    }
