"""The report of a run's folder: one HTML page, built from the files in it alone.

`write_report(run)` reads the folder, fills templates/page.html.jinja and writes RUN/report.html (everything inside,
nothing loaded from elsewhere) and the figures as PNG and PDF under figures/ of the folder that they belong to.  RUN
holds an identification, a search for a missing effect, a trained policy, or several of these, in it or in the folders
of their stages.  Of an identification, config.json, fit.json, history.npz, traces.npz and correlation.npz are
required; distribution.npz and frames/*.png are optional; where one is missing the page says so in its place.  Of a
search, gap.json and gap.npz are required; of a policy, training.json; of an evaluation, evaluation.json and
evaluation.npz.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from droid_jax import distributed, files
from droid_jax.report.evaluation_folder import Evaluation, has_evaluation, read_evaluation
from droid_jax.report.evaluation_page import evaluation_view
from droid_jax.report.gap_folder import Gap, has_gap, read_gap
from droid_jax.report.gap_page import gap_view
from droid_jax.report.identify_folder import Run, has_run, read_run
from droid_jax.report.identify_page import far_off, identify_view
from droid_jax.report.policy_folder import Trained, has_policy, read_policy
from droid_jax.report.policy_page import policy_view
from droid_jax.report.stages import left_over, needs_whole
from droid_jax.report.text import html
from droid_jax.storage import refuse_foreign, write_text

_DOWNLOADS = (
    (files.GAUSSIAN, "the Gaussian of the model's parameters, for training"),
    (files.FULL_GAUSSIAN, "the same with the nuisances, as train takes it"),
    (files.EXTENDED, "the extended model: effects, values and Gaussian, for fits and training"),
    (files.EXTENDED_MJCF, "the extended model as MJCF, as far as MJCF can express it"),
    (files.FITTED, "the scene with the fitted values"),
    (files.FIT, "every number of this page"),
    (files.SAMPLES, "parameter sets drawn from the fitted Gaussian"),
    (files.HISTORY_TABLE, "the search, generation by generation"),
    (files.TRACES, "the compared channels over time"),
    (files.CONFIG, "how the run was set up"),
    (files.POLICY, "the policy: python -m droid_jax.run export makes it ready for a robot"),
    (files.TRAINING, "how the policy was trained"),
    (files.TRANSFER, "every trial of the policy"),
    (files.GAP, "the search for a missing effect: every number"),
    (files.GAP_TRACES, "the search for a missing effect: the compared channels over time"),
    (files.EVALUATION, "the evaluation: every number"),
    (files.EVALUATION_TRACES, "the evaluation: channels over time"),
)


def write_report(run: Path) -> Path:
    """Write RUN/report.html, and figures/ of the folder of each part, from the files in RUN.

    Args:
        run: the folder of a run.

    Returns:
        Path of the page.  In a run of several processes only the first writes it.

    Raises:
        ValueError: a required file is missing or broken; the message names it.
    """
    folder = Path(run)
    path = folder / "report.html"
    if not distributed.first():
        return path
    old = left_over(folder)
    places = [folder, *(folder / stage for stage in files.LAST_FILES if stage not in old)]
    gap = read_gap(at) if (at := _part(places, has_gap)) else None
    policy = read_policy(at) if (at := _part(places, has_policy)) else None
    evaluation = read_evaluation(folder) if has_evaluation(folder) else None
    at = _part(places, has_run)
    if not (at or gap or policy or evaluation):
        needs_whole(folder)
    loaded = read_run(at or folder) if at or not (gap or policy or evaluation) else None
    text = html("page.html.jinja", **_context(folder, loaded, gap, policy, evaluation))
    refuse_foreign(path, "a file", _is_page, "a page of this program")
    write_text(path, text)
    return path


def _context(
    folder: Path, run: Run | None, gap: Gap | None, policy: Trained | None, evaluation: Evaluation | None
) -> dict[str, Any]:
    """The values of page.html.jinja: the parts of the page and the lines above them."""
    views = {
        "identify": identify_view(run, gap is not None) if run else None,
        "gap": gap_view(gap) if gap else None,
        "policy": policy_view(policy, run, gap) if policy else None,
        "evaluation": evaluation_view(evaluation) if evaluation else None,
    }
    parts = {  # each escaped by its template
        name: Markup(html(f"{name}.html.jinja", folder=folder, **view)) for name, view in views.items() if view
    }
    downloads = list(_downloads([part.folder for part in (run, gap, policy, evaluation) if part]))
    setup_first = run is not None and gap is not None and far_off(run.fit)
    return {"folder": folder, "parts": parts, "downloads": downloads, "setup_first": setup_first, **views}


def _is_page(path: Path) -> bool:
    """Whether a file is a page that `write_report` wrote, now or before pages named their generator."""
    with path.open("rb") as file:
        head = file.read(2000)
    return b'name="generator" content="droid_jax"' in head or b"default-src 'none'; img-src data:" in head


def _part(places: Sequence[Path], has: Callable[[Path], bool]) -> Path | None:
    """Folder of a part of the page: the run's, or that of one of its stages."""
    return next((at for at in places if has(at)), None)


def _downloads(folders: Sequence[Path]) -> Iterator[tuple[Path, str]]:
    """The files that the page links; of several with the same name, the first."""
    for name, text in _DOWNLOADS:
        at = next((folder / name for folder in folders if (folder / name).is_file()), None)
        if at is not None:
            yield at, text
