"""A run's folder before and after the run: whose it is, whether the run is whole, what it can go on from."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droid_jax.files import CONFIG, EVALUATION, EVALUATION_TRACES, LAST_FILES, RESULTS, SETUP
from droid_jax.read_json import read_json, typed
from droid_jax.report.stages import Setup, to_be_amended
from droid_jax.storage import file_sha256

if TYPE_CHECKING:
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording

RUNS = Path("runs")  # where results go unless --out says otherwise
BEGUN = set[Path]()  # folders of the runs that this process began
HASHED = ("user_effects", "extended")  # options whose file is in no other hash of a setup
LATER = ("budget",)  # options of which nothing that an unfinished run has kept depends
CODE = "versions"  # in setup.json: of the code that began the run, which others may go on with
PATHS = (
    "recording",
    "judge_on",
    "scene",
    "parameters",
    "fit",
    "run",
    *HASHED,
)  # beside each a setup holds what the file says
INPUTS = ("start", "synthetic_robot")  # in a setup: of what a run was given by another, as are all that end in _sha256


def setup_of(command: Any) -> dict[str, Any]:
    """What decides a run's results, as plain data: a finished run with the same is not run again."""
    fields = dataclasses.asdict(command)
    for name in ("out", "again", "force", "tensorboard"):
        fields.pop(name, None)
    for name in HASHED:  # a changed file makes another run
        if path := fields.get(name):
            fields[f"{name}_sha256"] = file_sha256(path)
    return {k: [str(v) for v in value] if isinstance(value, tuple) else _plain(value) for k, value in fields.items()}


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def stage_folder(given: Path | None, stage: str, file: str) -> Path:
    """The folder of a stage that a command is to read.

    given: it, or one of `all` that holds it; None: RUNS/STAGE, or where that lacks `file`, the one below RUNS/all.
    """
    tried = (RUNS / stage, RUNS / "all" / stage) if given is None else (given, given / stage)
    return next((folder for folder in tried if (folder / file).is_file()), tried[0])


def fingerprints(scene: Scene, space: Space, recordings: Iterable[Recording]) -> dict[str, Any]:
    """Hashes of what a run's files say, for its setup: it does not go on with changed ones."""
    from droid_jax.identify.gaussian import space_to_json

    return {
        "scene_sha256": scene.sha256,
        "parameters_sha256": hashlib.sha256(json.dumps(space_to_json(space)).encode()).hexdigest(),
        "recordings_sha256": [recording.sha256 for recording in recordings],
    }


def changed(before: Mapping[str, Any], setup: Mapping[str, Any]) -> list[str]:
    """What differs between two setups; where a file lies does not count, what it says does; nor does the code."""
    return sorted(k for k in {*before, *setup} - {CODE, *PATHS} if before.get(k) != setup.get(k))


class OtherRun(ValueError):
    """The folder holds a run with other settings or inputs; `what` says which.

    inputs: whether only what it was given differs, and nothing that was asked for.
    """

    def __init__(self, out: Path, changed: Iterable[str]) -> None:
        changed = tuple(changed)
        self.inputs = all(name in INPUTS or name.endswith("_sha256") for name in changed)
        self.what = f"{out} holds a run with other settings ({', '.join(c.removesuffix('_sha256') for c in changed)})"
        super().__init__(f"{self.what}; choose another --out, or --again")


def finished(out: Path, setup: dict[str, Any], again: bool, last: str = CONFIG) -> bool:
    """True where the folder holds this very run, whole: with `last`, the file that is written last.

    Says so where a run goes on with other code than it was begun with.

    Raises OtherRun for a folder with another run in it, ValueError where its setup.json is damaged.
    """
    path = out / SETUP
    if again or not path.is_file():
        return False
    try:
        before = typed(read_json(path), dict[str, Any], str(path))
        typed(before, Setup, str(path))
    except ValueError as error:
        said = str(error).removeprefix(f"{path}: ")
        raise ValueError(f"{path} is damaged ({said}); choose another --out, or start over with --again") from None
    other = changed(before, setup)
    whole = (out / last).is_file() and not to_be_amended(out)
    if not whole:
        other = [name for name in other if name not in LATER]
    if other:
        raise OtherRun(out, other)
    if not whole:
        print(f"{out} holds this run unfinished; going on{_with_other_code(before)}")
        return False
    print(f"{out} holds this run already; its report is built again (start over with --again)")
    return True


def _with_other_code(before: Mapping[str, Any]) -> str:
    """What of the code that began a run has changed since, in words; empty where nothing has, or nobody knows."""
    from droid_jax import runtime

    if not (old := before.get(CODE)):
        return ""
    new = runtime.versions()
    other = [
        f"{name} {old.get(name, 'none')} -> {new.get(name, 'none')}"
        for name in {**old, **new}
        if old.get(name) != new.get(name)
    ]
    return f" with other code than it was begun with ({', '.join(other)}; --again starts over)" if other else ""


def refuse_own_source(out: Path, fit: Path | None) -> None:
    """ValueError where a run would start over in the folder that it starts from."""
    if fit is not None and out.resolve() == fit.resolve():
        raise ValueError(f"--out {out} holds the fit that this run starts from: choose another --out")


def begin(out: Path, setup: dict[str, Any], again: bool, stage: str, keep: bool = False) -> None:
    """Only now, with all input read, forget an earlier run's results, and say what runs here.

    again: its checkpoints too.  keep: nothing; the results are this run's own, and it adds to them.
    """
    from droid_jax import runtime
    from droid_jax.storage import write_json

    if not keep:
        for each in LAST_FILES if again and _of_another_stage(out, stage) else (stage,):
            forget(out, each, results_alone=not again)
        for name in (EVALUATION, EVALUATION_TRACES):  # of the fit that goes
            (out / name).unlink(missing_ok=True)
    write_json(out / SETUP, {**setup, CODE: runtime.versions()})
    BEGUN.add(out)


def _of_another_stage(out: Path, stage: str) -> bool:
    """Whether another command's run is in a folder, or one of which nobody knows."""
    with contextlib.suppress(OSError, ValueError):
        return typed(read_json(out / SETUP), Setup, SETUP).get("command", "identify") != stage  # which names none
    return any((out / LAST_FILES[other]).exists() for other in LAST_FILES if other != stage)


def forget(out: Path, stage: str, results_alone: bool = False) -> None:
    """Remove what a run of this stage left; its checkpoints too, from which it would go on, unless told otherwise."""
    begun = () if results_alone else ("checkpoints", "tensorboard", SETUP)
    for name in (LAST_FILES[stage], *RESULTS[stage], *begun):
        if (path := out / name).is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def kept_recordings(paths: Mapping[str, Path], again: bool, record: Callable[[str], Recording]) -> dict[str, Recording]:
    """What the synthetic robot recorded earlier into this run's folder, by name; recorded now where it did not.

    paths: by name.  record: of a recording's name.
    """
    from droid_jax.recordings.formats import load_recording, save_recording
    from droid_jax.report.progress import counting

    absent = [name for name, path in paths.items() if again or not path.is_file()]
    if absent:
        with counting("recording the synthetic robot", len(absent)) as count:
            for done, name in enumerate(absent, 1):
                paths[name].parent.mkdir(parents=True, exist_ok=True)
                save_recording(record(name), paths[name])
                count(done)
    return {name: load_recording(path, name=name) for name, path in paths.items()}
