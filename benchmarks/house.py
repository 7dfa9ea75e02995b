"""Figures of the code base itself: how many files, how long the sentences, how long the tests.

python benchmarks/house.py

Nothing is run but `git ls-files` and `docs/sentences.py`: the time of the tests is read from durations.json,
a newcomer's tasks from newcomer.json.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.common import publish  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results"
PACKAGE = ROOT / "droid_jax"


@dataclass(frozen=True)
class Arguments:
    """Count files, names and sentences.

    out: folder for house.json.
    quick: writes house_quick.json instead; the figures are the same.
    ci_minutes: what `.ci/run` took, by the clock; default: what house.json has.
    """

    out: Path = RESULTS
    quick: bool = False
    ci_minutes: float | None = None


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


def kept(name: str) -> dict[str, Any]:
    """A committed result; empty where there is none yet."""
    path = RESULTS / name
    return json.loads(path.read_text()) if path.is_file() else {}


def main(arguments: Arguments) -> None:
    """Count, and write house.json."""
    discrepancy, newcomer = modules(PACKAGE / "discrepancy"), kept("newcomer.json")
    found = {
        "tracked_files": tracked_files(),
        "discrepancy_files": len(discrepancy),
        "discrepancy_lines": discrepancy,
        "report_files": len(modules(PACKAGE / "report")),
        "shared_public_names": list(shared_names()),
        "mean_sentence_words": sentence_words(),
        "quick_suite_minutes": kept("durations.json").get("minutes"),
        "ci_minutes": arguments.ci_minutes or kept("house.json").get("ci_minutes"),
        "newcomer": {task["task"]: task["files"] for task in newcomer.get("tasks", [])},
    }
    publish(arguments.out, "house", arguments.quick, 0, found, {k: found[k] for k in found if k != "discrepancy_lines"})


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
