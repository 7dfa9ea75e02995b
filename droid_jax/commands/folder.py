"""A run's folder before and after the run: its options, whether the run is complete, and what a new run removes."""

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
from droid_jax.storage import file_sha256, remove_own

if TYPE_CHECKING:
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording

RUNS = Path("runs")  # default place of results
BEGUN = set[Path]()  # folders of the runs that this process began
HASHED = ("user_effects", "extended")  # options whose file has its own hash in a setup
LATER = ("budget",)  # options that may change when an unfinished run continues
CODE = "versions"  # in setup.json: versions of the code that began the run; other versions may continue it
PATHS = (
    "recording",
    "judge_on",
    "scene",
    "parameters",
    "fit",
    "run",
    *HASHED,
)  # options with paths; a setup also has the content's hash
SHOWN = {"judge_on": "test-recording"}  # options whose name on the command line is another
INPUTS = ("start", "synthetic_robot")  # entries of a setup from other runs, like all that end in _sha256


def setup_of(command: Any) -> dict[str, Any]:
    """The options that determine a run's results, as plain data; a finished run with equal ones is not repeated."""
    fields = dataclasses.asdict(command)
    for name in ("out", "again", "force", "tensorboard"):
        fields.pop(name, None)
    for name in HASHED:  # a changed file means another run
        if path := fields.get(name):
            fields[f"{name}_sha256"] = file_sha256(path)
    return {k: [str(v) for v in value] if isinstance(value, tuple) else _plain(value) for k, value in fields.items()}


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def stage_folder(given: Path | None, stage: str, file: str) -> Path:
    """The folder of a stage that a command reads.

    given: that folder, or one of `all` that has it; None: RUNS/STAGE, or below RUNS/all if the former lacks `file`.
    """
    tried = (RUNS / stage, RUNS / "all" / stage) if given is None else (given, given / stage)
    return next((folder for folder in tried if (folder / file).is_file()), tried[0])


def fingerprints(scene: Scene, space: Space, recordings: Iterable[Recording]) -> dict[str, Any]:
    """Hashes of scene, parameters and recordings for a run's setup; a run does not continue with changed ones."""
    from droid_jax.identify.gaussian import space_to_json

    return {
        "scene_sha256": scene.sha256,
        "parameters_sha256": hashlib.sha256(json.dumps(space_to_json(space)).encode()).hexdigest(),
        "recordings_sha256": [recording.sha256 for recording in recordings],
    }


def changed(before: Mapping[str, Any], setup: Mapping[str, Any]) -> list[str]:
    """Names of the entries that differ between two setups; paths of files and versions of the code are ignored."""
    return sorted(k for k in {*before, *setup} - {CODE, *PATHS} if before.get(k) != setup.get(k))


class OtherRun(ValueError):
    """The folder has a run with other settings or inputs; `what` is a sentence with their names.

    inputs: whether only inputs differ, and no option.
    """

    def __init__(self, out: Path, changed: Iterable[str]) -> None:
        changed = tuple(changed)
        self.inputs = all(name in INPUTS or name.endswith("_sha256") for name in changed)
        names = (name.removesuffix("_sha256") for name in changed)
        self.what = f"{out} holds a run with other settings ({', '.join(SHOWN.get(name, name) for name in names)})"
        super().__init__(f"{self.what}; choose another --out, or --again")


def finished(out: Path, setup: dict[str, Any], again: bool, last: str = CONFIG) -> bool:
    """Whether the folder has this run, complete: with `last`, the file that is written last.

    Prints a message, also if a run continues with other code than it was begun with.

    Raises OtherRun for a folder with another run, ValueError if its setup.json is damaged.
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
    """Text with the versions that changed since a run was begun; empty if none did, or if they are unknown."""
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
    """ValueError if a run would overwrite the folder of the fit from which it starts."""
    if fit is not None and out.resolve() == fit.resolve():
        raise ValueError(f"--out {out} holds the fit that this run starts from: choose another --out")


def begin(out: Path, setup: dict[str, Any], again: bool, stage: str, keep: bool = False) -> None:
    """Remove an earlier run's results and write setup.json; call it when all inputs are valid.

    again: remove checkpoints too.  keep: remove nothing, since the results are of this run and it adds to them.
    """
    from droid_jax import runtime
    from droid_jax.storage import write_json

    if not keep:
        for each in LAST_FILES if again and _of_another_stage(out, stage) else (stage,):
            forget(out, each, results_alone=not again)
        for name in (EVALUATION, EVALUATION_TRACES):  # of the removed fit
            (out / name).unlink(missing_ok=True)
    write_json(out / SETUP, {**setup, CODE: runtime.versions()})
    BEGUN.add(out)


def _of_another_stage(out: Path, stage: str) -> bool:
    """Whether a folder has a run of another command, or one without a readable setup.json."""
    with contextlib.suppress(OSError, ValueError):
        return typed(read_json(out / SETUP), Setup, SETUP).get("command", "identify") != stage  # which names none
    return any((out / LAST_FILES[other]).exists() for other in LAST_FILES if other != stage)


def forget(out: Path, stage: str, results_alone: bool = False) -> None:
    """Remove the results of a stage's run, and its checkpoints unless `results_alone`."""
    begun = () if results_alone else ("checkpoints", "tensorboard", SETUP)
    for name in (LAST_FILES[stage], *RESULTS[stage], *begun):
        if (path := out / name).is_dir():
            if not remove_own(path):
                shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def kept_recordings(paths: Mapping[str, Path], again: bool, record: Callable[[str], Recording]) -> dict[str, Recording]:
    """Recordings of the synthetic robot in this run's folder, by name; missing ones are recorded now.

    paths: name -> file.  record: name -> recording.
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
