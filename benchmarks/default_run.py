"""The default command for a new user: time to the first line, time of each stage, and results.

    python benchmarks/default_run.py [--against CHECKOUT] [--quick] [--out DIR]

Runs `python -m droid_jax.run` with no option but its folder, in a separate process with an empty compilation cache, and
stores its output with the time of every line.  With --against, the same command of another commit runs afterwards, and
then this commit's once more with its compiled programs.  Writes DIR/default_run.json after each run.  The run's folder,
with the page, stays in DIR/default_run.
"""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tempfile  # noqa: E402

import tyro  # noqa: E402

from benchmarks.common import empty_cache, origin, stem  # noqa: E402
from droid_jax import runtime  # noqa: E402
from droid_jax.files import TRANSFER  # noqa: E402
from droid_jax.report.gap_folder import read_answer  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402

STAGE = re.compile(r"\[\d+/\d+\] (?P<stage>\w+): (?P<minutes>[\d.]+) minutes")  # as the command says that one ended
PROGRESS = re.compile(r"\[1/\d+\]")  # its first stage began
HELPS = 5


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Stop the command where its first stage begins: shows that it starts, and how fast."""
    against: Path | None = None
    """Checkout of another commit whose default command is timed too (git worktree add --detach CHECKOUT COMMIT)."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of default_run.json."""


class Line(NamedTuple):
    """A printed line, and its time after the start in seconds."""

    seconds: float
    text: str


def command_lines(out: Path, cache: str, program: Path | None = None) -> Iterator[Line]:
    """Lines of a checkout's command as they are printed; closing the generator stops the command.

    RuntimeError where the command fails.

    It starts over where the folder holds a run, and in the folder above, so that no line names this machine's folders.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    command = [sys.executable, "-u", "-m", "droid_jax.run", "all", "--out", out.name, "--again"]
    streams: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    environment = empty_cache(cache) | {"PYTHONPATH": str((program or ROOT).resolve())}
    with subprocess.Popen(command, cwd=out.parent, env=environment, **streams) as process:
        assert process.stdout is not None
        try:
            last = ""
            for text in process.stdout:
                last = text.rstrip()
                yield Line(time.perf_counter() - began, last)
            if process.wait():
                raise RuntimeError(f"the command ended with {process.returncode}: {last}")
        finally:
            process.terminate()


def shown(lines: Iterator[Line], quick: bool) -> list[Line]:
    """The lines, printed as they come; of a quick run those before its first stage."""
    kept = list[Line]()
    for line in lines:
        print(line.text, flush=True)
        kept.append(line)
        if quick and PROGRESS.match(line.text):
            break
    return kept


def of_another_commit(program: Path, out: Path, quick: bool) -> dict[str, Any]:
    """Times of another checkout's command with an empty cache, and what it named; its folder is not kept."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / out.name
        found: dict[str, Any] = figures(shown(command_lines(run, f"{folder}/cache", program), quick))
        if not quick:
            found |= {"effects": json.loads((run / "gap" / "gap.json").read_text())["effects"]}
    return {"commit": runtime.git_commit(program), **found}


def help_seconds() -> float:
    """s of `--help`, the least of several."""
    return min(_seconds([sys.executable, "-m", "droid_jax.run", "--help"]) for _ in range(HELPS))


def _seconds(command: Sequence[str]) -> float:
    began = time.perf_counter()
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def figures(lines: Sequence[Line]) -> dict[str, Any]:
    """What the lines tell of time: s until the first one and until the first stage begins, the longest silence, minutes
    of each stage and of the whole."""
    times = [0.0, *(line.seconds for line in lines)]
    ended = [found for line in lines if (found := STAGE.match(line.text))]
    return {
        "first_line_s": lines[0].seconds,
        "first_stage_s": next((line.seconds for line in lines if PROGRESS.match(line.text)), None),
        "longest_silence_s": max(after - before for before, after in itertools.pairwise(times)),
        "minutes": {found["stage"]: float(found["minutes"]) for found in ended},
        "whole_minutes": lines[-1].seconds / 60,
    }


def results(out: Path) -> dict[str, Any]:
    """Results of a run: gap before and after, verdict and hidden effect, success of the policy."""
    fit, gap, transfer = (
        json.loads((out / name).read_text()) for name in ("identify/fit.json", "gap/gap.json", f"train/{TRANSFER}")
    )
    return {
        "hidden": read_answer(out / "gap").hidden,
        "torque_distances": fit["heldout_distances"],
        "verdict": gap["verdict"],
        "effects": gap["effects"],
        "sentence": gap["sentence"],
        "success": {place: transfer[place]["success_rate"] for place in ("simulation", "synthetic_robot")},
    }


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    name, quick = stem("default_run", arguments.quick), arguments.quick
    out, other = arguments.out / name, arguments.against
    written = arguments.out / f"{name}.json"
    with tempfile.TemporaryDirectory() as cache:
        lines = shown(command_lines(out, cache), quick)
        found: dict[str, Any] = {"help_s": help_seconds(), **figures(lines), **({} if quick else results(out))}
        found["printed"] = [[round(line.seconds, 1), line.text] for line in lines]
        paired = dict[str, Any]()
        write_json(written, found)  # each run takes long: what is there stays
        if other is not None:
            paired["against"] = of_another_commit(other, out, quick)
            write_json(written, found | paired | ratios(found, paired))
            with tempfile.TemporaryDirectory() as folder:
                paired["warm"] = figures(shown(command_lines(Path(folder) / name, cache), quick))
    import tuned  # noqa: F401  (before jax starts: the run had all cores)

    result = found | paired | ratios(found, paired)
    write_json(written, result | origin(0))
    print(json.dumps({k: result[k] for k in result if k not in ("torque_distances", "sentence", "printed")}))


def ratios(found: dict[str, Any], paired: dict[str, Any]) -> dict[str, float]:
    """Ratios of the command's minutes to the other commit's, with an empty cache and with its own, where measured."""
    if "against" not in paired or "effects" not in paired["against"]:  # a quick one
        return {}
    before = paired["against"]["whole_minutes"]
    warm = {"ratio_warm": paired["warm"]["whole_minutes"] / before} if "warm" in paired else {}
    return {"ratio_cold": found["whole_minutes"] / before, **warm}


if __name__ == "__main__":
    main()
