"""Figures of the code base: number of files, length of sentences, time of tests.

python benchmarks/house.py [--gap]

Runs only `git ls-files` and `docs/sentences.py`, and with --gap a small search whose modules are counted.  The time of
the tests is given or read from durations.json; a newcomer's tasks are read from newcomer.json.
"""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from benchmarks.common import publish  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results"
PACKAGE = ROOT / "droid_jax"


@dataclass(frozen=True)
class Arguments:
    """Count files, names and sentences.

    out: folder for house.json.
    quick: writes house_quick.json instead; the figures are the same.
    ci_minutes: what `.ci/run` took, by the clock; default: what house.json has.
    suite_minutes: what the quick suite took; default: what durations.json has.
    minutes_of: at which commits these minutes were measured; default: what house.json has.
    gap: count the modules that a search enters, a minute or two; default: what house.json has.
    """

    out: Path = RESULTS
    quick: bool = False
    ci_minutes: float | None = None
    suite_minutes: float | None = None
    minutes_of: str | None = None
    gap: bool = False


def tracked_files() -> int:
    """How many files git tracks."""
    return len(subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split())


def modules(folder: Path) -> dict[str, int]:
    """Module -> lines, without `__init__.py`."""
    return {p.stem: len(p.read_text().splitlines()) for p in sorted(folder.glob("*.py")) if p.name != "__init__.py"}


def shared_names() -> dict[str, list[str]]:
    """Public functions and classes that several modules define."""
    homes = defaultdict[str, list[str]](list)
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith(
                "_"
            ):
                homes[node.name].append(file.relative_to(PACKAGE).as_posix())
    return {name: files for name, files in homes.items() if len(files) > 1}


def sentence_words() -> float:
    """Mean words per sentence of README and documents."""
    command = [sys.executable, str(ROOT / "docs" / "sentences.py")]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return float(json.loads(said.strip().splitlines()[-1])["mean"])


def gap_modules() -> dict[str, list[str]]:
    """Layer -> modules that a search for a missing effect enters, from its start to its verdict.

    The small search of tests/small_gap.py, by the command `gap`, on two recordings.  A module is entered if one of its
    functions is called while `discrepancy.missing.search` runs, not by importing it.  The modules beside the layers and
    report/, which only shows progress, are not counted.
    """
    import droid_jax
    from droid_jax import runtime

    runtime.tune()
    for module in pkgutil.walk_packages(droid_jax.__path__, "droid_jax."):
        # Not what needs brax, or mjlab beside a run's files; neither is part of it.
        if not module.name.startswith(("droid_jax.policy", "droid_jax.identify.mjlab_terms")):
            importlib.import_module(module.name)
    import small_gap

    from droid_jax.commands import gap
    from droid_jax.discrepancy import missing
    from droid_jax.recordings.formats import save_recording
    from droid_jax.run import main as command

    entered, depth, start = set[Path](), 0, missing.search.__code__

    def called(frame: Any, event: str, argument: Any) -> None:
        nonlocal depth
        if frame.f_code is start:
            depth += {"call": 1, "return": -1}.get(event, 0)
        if depth and event == "call":
            entered.add(Path(frame.f_code.co_filename))

    gap.gap_config = lambda options: small_gap.QUICK
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        small_gap.write_parameters(folder)
        recordings = [
            save_recording(small_gap.record(role), folder / f"{role}.npz") for role in ("train", "validation")
        ]
        options = ["--scene", small_gap.SCENE, "--parameters", folder / "parameters.json", "--object-joint", "door"]
        options += ["--effects", *small_gap.EFFECTS, "--out", folder / "run"]
        sys.setprofile(called)
        try:
            code = command([str(part) for part in ("gap", "--recording", *recordings, *options)])
        finally:
            sys.setprofile(None)
    if code:
        raise SystemExit(f"error: the small search ended with exit code {code}")
    layers = defaultdict[str, list[str]](list)
    for path in sorted(path for path in entered if path.is_relative_to(PACKAGE) and path.suffix == ".py"):
        layer, *rest = path.relative_to(PACKAGE).with_suffix("").parts
        if rest and layer != "report":
            layers[layer].append("/".join(rest))
    return dict(layers)


def kept(name: str) -> dict[str, Any]:
    """A committed result; empty where there is none yet."""
    path = RESULTS / name
    return json.loads(path.read_text()) if path.is_file() else {}


def main(arguments: Arguments) -> None:
    """Count, and write house.json."""
    discrepancy, newcomer, before = modules(PACKAGE / "discrepancy"), kept("newcomer.json"), kept("house.json")
    entered = gap_modules() if arguments.gap else before.get("gap_modules_entered", {})
    found = {
        "tracked_files": tracked_files(),
        "discrepancy_files": len(discrepancy),
        "discrepancy_lines": discrepancy,
        "report_files": len(modules(PACKAGE / "report")),
        "shared_public_names": list(shared_names()),
        "mean_sentence_words": sentence_words(),
        "quick_suite_minutes": arguments.suite_minutes or kept("durations.json").get("minutes"),
        "ci_minutes": arguments.ci_minutes or before.get("ci_minutes"),
        "minutes_of": arguments.minutes_of or before.get("minutes_of"),
        "gap_modules": sum(map(len, entered.values())),
        "gap_modules_entered": entered,
        "newcomer": {task["task"]: task["files"] for task in newcomer.get("tasks", [])},
    }
    publish(
        arguments.out,
        "house",
        arguments.quick,
        0,
        found,
        {k: found[k] for k in found if k not in ("discrepancy_lines", "gap_modules_entered")},
    )


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
