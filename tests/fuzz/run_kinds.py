"""Folders of runs and the pages made from them, quick to draw; policies, and what a run keeps to go on from."""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import model_kinds
import numpy as np
import recording_kinds
from kinds import ROOT, Kind, use
from markupsafe import Markup
from recording_kinds import recording

from droid_jax.cost.replay_cache import cached
from droid_jax.files import POLICY
from droid_jax.identify.checkpoints import Checkpoints
from droid_jax.policy.control import ACTIONS, FORMAT, LAYOUT, OBSERVED, SHAPES, load_policy
from droid_jax.storage import write_npz

sys.path.append(str(ROOT / "tests" / "report"))

# isort: split

from made_up_gap import make_gap as made_up_gap
from made_up_run import make_policy as made_up_policy
from made_up_run import make_run as made_up_run

from droid_jax.commands import source
from droid_jax.commands.folder import OtherRun, finished
from droid_jax.commands.gap import values_of
from droid_jax.commands.synthetic import known_robot
from droid_jax.files import (
    CONFIG,
    CORRELATION,
    DISTRIBUTION,
    FIT,
    GAP,
    GAP_TRACES,
    HISTORY,
    HISTORY_TABLE,
    LAST_FILES,
    SAMPLES,
    SETUP,
    SYNTHETIC_ROBOT,
    TRACES,
    TRAINING,
    TRANSFER,
)
from droid_jax.model.parameters import Parameter, Space
from droid_jax.recordings.formats import save_recording
from droid_jax.report import page, stages, style
from droid_jax.report.tables import frames

CHOSEN = [0, 2, -1]  # of the made-up fit's parameters
FITTED = Space((Parameter("hinge_stiffness", "N m/rad", 0.8, 0.4, 0.0, 5.0),))  # one of them
TRIALS = 6  # of the made-up policy's


def make_run(folder: Path) -> None:
    """The made-up fit of the report's tests with three parameters, two joints and 40 instants."""
    made_up_run(folder)
    fit = json.loads((folder / FIT).read_text())
    fit["parameters"] = [fit["parameters"][i] for i in CHOSEN]
    for of in fit["heldout_distances"].values():
        of |= {key: of[key][:2] for key in ("per_joint_before", "per_joint_after")}
    (folder / FIT).write_text(json.dumps(fit))
    _cut(folder / TRACES, _short_traces)
    _cut(folder / HISTORY, lambda key, a: a[CHOSEN] if key == "names" else a[:9][:, CHOSEN] if a.ndim == 2 else a[:9])
    _cut(folder / CORRELATION, lambda key, a: a[CHOSEN] if a.ndim == 1 else a[np.ix_(CHOSEN, CHOSEN)])
    _cut(folder / DISTRIBUTION, lambda key, a: a[:50])
    shutil.rmtree(folder / "frames")
    setup = {"command": "identify", "preset": "quick", "recording": ["wave.npz"], "recordings_sha256": ["ab" * 32],
             "scene": None, "scene_sha256": "cd" * 32, "extended": None, "seed": 0, "versions": {"jax": "0.9.2"},
             "hide": [], "springs": 1, "synthetic_robot": {}, "fit": None, "fit_sha256": None}  # fmt: skip
    (folder / SETUP).write_text(json.dumps(setup))


def _short_traces(key: str, array: np.ndarray) -> np.ndarray:
    if key.endswith("joints"):
        return array[:2]
    return array[:400:10, :2] if array.ndim == 2 else array[:400:10] if array.ndim else array


def _cut(path: Path, how: Callable[[str, np.ndarray], np.ndarray]) -> None:
    with np.load(path) as file:
        arrays: dict[str, Any] = {key: how(key, file[key]) for key in file.files}
    np.savez_compressed(path, **arrays)


def make_gap(folder: Path) -> None:
    """The made-up search with one joint and few candidates."""
    made_up_gap(folder, "named", test=False)
    found = json.loads((folder / GAP).read_text())
    found["score_tests"] = [{**s, "ranking": s["ranking"][:3]} for s in found["score_tests"]]
    found["cells"] = {key: cells[::40] for key, cells in found["cells"].items()}
    (folder / GAP).write_text(json.dumps(found))
    _cut(folder / GAP_TRACES, lambda key, a: a[:1] if key == "joints" else a[::5, :1] if a.ndim == 2 else a[::5])


def make_policy_run(folder: Path) -> None:
    """The made-up policy with few trials and no films."""
    folder.mkdir(exist_ok=True)
    folder.rmdir()
    made_up_policy(folder)
    transfer = json.loads((folder / TRANSFER).read_text())
    for of in ("simulation", "synthetic_robot"):
        found = transfer[of]
        whole = found["trials"]
        found |= {key: v[:TRIALS] for key, v in found.items() if isinstance(v, list) and len(v) == whole}
        for key in ("angle_deg", "steps"):
            found[key]["all"] = found[key]["all"][:TRIALS]
        found["trials"] = TRIALS
    (folder / TRANSFER).write_text(json.dumps(transfer))
    shutil.rmtree(folder / "films")


def make_whole(folder: Path) -> None:
    """A folder of `all`."""
    for make, stage in zip((make_run, make_gap, make_policy_run), LAST_FILES, strict=True):
        make(folder / stage)


@contextlib.contextmanager
def undrawn() -> Iterator[None]:
    """No figure is drawn inside: only the text of the page is made."""

    def drawing(folder: Path, stem: str, title: str, make: Any, *args: Any) -> style.Drawing:
        return style.Drawing(folder / "figures", stem, title, Markup(""), Markup(""))

    with mock.patch.object(style, "drawing", drawing):
        yield


def use_whole(folder: Path) -> None:
    """What commands ask about the stages of a folder, and the page."""
    stages.left_over(folder)
    for stage, last in LAST_FILES.items():
        at = folder / stage
        use(stages.extended_of(at), stages.fingerprint(at), stages.unfinished(at))
        use(source.synthetic_robot_of(at), source.has_model(at))
        with contextlib.suppress(OtherRun):  # only damage is of interest here
            finished(at, {"seed": 0}, again=False, last=last)
    source.model_folder(folder)
    values_of(folder / "identify", FITTED)
    with undrawn():
        page.write_report(folder)


def make_tables(folder: Path) -> None:
    """A fit with its tables."""
    make_run(folder)
    costs = "generation,best_cost,median_cost,sigma,mean_a,std_a\r\n1,0.5,0.6,1.0,1.0,0.1\r\n2,0.4,0.5,0.9,1.1,0.1\r\n"
    (folder / SAMPLES).write_text("a\r\n1.0\r\n0.5\r\n")
    (folder / HISTORY_TABLE).write_text(costs)


def use_tables(folder: Path) -> None:
    """The tables, and a number of each."""
    found = frames(folder)
    use(found.samples.mean(), found.history["best_cost"].min())


def make_synthetic(folder: Path) -> None:
    """What is kept of the synthetic robot beside its recording."""
    (folder / SYNTHETIC_ROBOT).write_text(json.dumps({"springs": 1, "seed": 3, "hide": ["magnetic_catch=1.5"]}))
    save_recording(replace(recording(), meta={}), folder / "a.npz")


def use_synthetic(folder: Path) -> None:
    """The file, as commands that go on with its robot read it."""
    known = known_robot([folder / "a.npz"])
    use(known.get("springs"), known.get("seed"), list(known.get("hide", [])))


_whole = functools.partial(Kind, make=make_whole, read=use_whole)
_FILES = {
    **{f"identify/{FIT}": 4, f"identify/{CONFIG}": 2, f"identify/{TRACES}": 2, f"identify/{HISTORY}": 1},
    **{f"identify/{CORRELATION}": 1, f"identify/{DISTRIBUTION}": 1, f"*/{SETUP}": 4, f"gap/{GAP}": 5},
    **{f"gap/{GAP_TRACES}": 2, f"train/{TRAINING}": 2, f"train/{TRANSFER}": 2},
}


def make_policy(folder: Path) -> None:
    rng = np.random.default_rng(0)
    layers = {
        "weight_0": rng.normal(size=(OBSERVED, 4)), "weight_1": rng.normal(size=(4, 2 * ACTIONS)),
        "bias_0": np.zeros(4), "bias_1": np.zeros(2 * ACTIONS),
    }  # fmt: skip
    own = {"format": FORMAT, "layout": np.array(LAYOUT), "mean": np.zeros(OBSERVED), "std": np.ones(OBSERVED)}
    write_npz(folder / POLICY, {**own, **layers, **{name: np.ones(shape) for name, shape in SHAPES.items()}})


def use_policy(folder: Path) -> None:
    action = load_policy(folder / POLICY).act(np.zeros(OBSERVED))
    if np.shape(action) != (ACTIONS,):
        raise RuntimeError(f"an action has shape {np.shape(action)}")


_TREE = {"state": {"mean": np.arange(6.0).reshape(2, 3), "key": np.arange(4, dtype=np.uint32)}, "best": np.ones(3)}
_FINGERPRINT = {"config": "a text", "data": "another"}


def make_checkpoints(folder: Path) -> None:
    with Checkpoints(folder, fingerprint=_FINGERPRINT) as checkpoints:
        for step in (3, 6):
            checkpoints.save(step, {**_TREE, "best": np.full(3, float(step))})


def use_checkpoints(folder: Path) -> None:
    """What is restored is one of the states that were saved, with the step it was saved at."""
    with Checkpoints(folder, fingerprint=_FINGERPRINT) as checkpoints:
        found = checkpoints.restore()
    if found is None:
        return
    step, tree = found
    if step not in (3, 6) or not np.array_equal(tree["best"], np.full(3, float(step))):
        raise RuntimeError(f"step {step} holds another state")


def _replayed(values: Any) -> np.ndarray:
    """Replays that are known."""
    return np.arange(8.0).reshape(2, 4) * float(np.sum(values))


_ROWS = np.array([[1.0, 2.0], [3.0, 4.0]])


def make_replays(folder: Path) -> None:
    cached(_replayed, folder, "whitened")(_ROWS)


def use_replays(folder: Path) -> None:
    """A damaged file is computed again; what comes back is what was computed."""
    found = cached(_replayed, folder, "whitened")(_ROWS)
    if not np.array_equal(found, _replayed(_ROWS)) or found.dtype.kind != "f":
        raise RuntimeError(f"replays of shape {found.shape}, {found.dtype}")


KINDS = (
    *(_whole(Path(file).name, file, weight=weight) for file, weight in _FILES.items()),
    Kind("fit's files, page drawn", "*.*", make_run, page.write_report, 0.1, drawn=True),
    Kind("search's files, page drawn", "*.*", make_gap, page.write_report, 0.1, drawn=True),
    Kind("policy's files, page drawn", "*.json", make_policy_run, page.write_report, 0.1, drawn=True),
    Kind("fit's tables", "*.csv", make_tables, use_tables, 2),
    Kind("synthetic robot's file", SYNTHETIC_ROBOT, make_synthetic, use_synthetic, 1),
    Kind("policy.npz", POLICY, make_policy, use_policy, 4),
    Kind("checkpoints", "**/*", make_checkpoints, use_checkpoints, 1.5),
    Kind("kept replays", "*.npz", make_replays, use_replays, 2),
)

# Every kind of file that the program reads back, by name.  A user's file of effects is code, and is none of them.
EVERY: dict[str, Kind] = {kind.name: kind for kind in (*recording_kinds.KINDS, *model_kinds.KINDS, *KINDS)}
