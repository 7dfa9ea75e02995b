"""Does the check of a log find errors that are put into it, and nothing in correct logs?

    python benchmarks/check.py [--quick] [--real DIR] [--out DIR]

Every error of check_cases.py is put into synthetic logs of a two-link arm and into one real log of each robot, and the
findings are counted: the one that names the error, others, none.  The same logs and 100 synthetic ones are also checked
without an error; then every finding is false.  For the logs with the most joints the whole command is timed in a
separate process, with the parameters of their pages: first with an empty cache of compiled programs, then again.  DIR
holds the public logs (so101, bam_xl330, go2_leg, franka_gaz2019, emps, door_pr2_ikea), which are not part of this
repository; without it only synthetic logs are checked.
"""

from __future__ import annotations

import collections
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

# ruff: noqa: E402  (what is imported lies in a folder that is no package)
# isort: split

import tyro

from benchmarks.check_cases import ERRORS, Case, Error, real, synthetic, two_link
from benchmarks.common import publish
from droid_jax.door.scene import ARM
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.inspect_log import inspect_log
from droid_jax.recordings.checks import validate
from droid_jax.recordings.formats import save_recording

RIGHT, QUICK = 100, 4  # synthetic logs without an error
WITH = 12  # synthetic logs that each error is put into
CHOSEN = (
    "so101/multisine",
    "xl330/sin_sin_kp400",
    "go2/leg",
    "panda/exciting",
    "emps/DATA_EMPS",
    "door/ikea_cabinet_2",
)  # likewise
PAGES: dict[str, tuple[tuple[str, ...], str | None]] = {  # joints and parameters, None: joint friction, of the pages
    "so101/multisine": (("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll"), "so101.json"),
    "go2/leg": (("hip", "thigh", "calf"), "go2.json"),
    "panda/exciting": (ARM, None),
}


@dataclass(frozen=True)
class Check:
    """Put errors into logs and count what the check of a log finds.

    real: folder of public logs.  quick: four synthetic logs.  out: folder for check.json.  seed: of the first log.
    """

    real: Path | None = None
    quick: bool = False
    out: Path = ROOT / "benchmarks" / "results"
    seed: int = 0


def findings(case: Case) -> tuple[list[Finding], float]:
    """Findings of `check`, and its CPU seconds."""
    begin = time.process_time()  # what other programs take of the machine does not count
    try:
        validate(case.recording, allow_jitter=True)
        found = list(inspect_log(case.recording, case.scene))
    except ValueError as error:  # refused when it is read
        kind = "clock" if "time must be in seconds" in str(error) else "scene"
        found = [Finding(kind, "", 0.0, 0.0, "certain", str(error))]
    return found, time.process_time() - begin


def timed(folder: Path) -> dict[str, dict[str, float]]:
    """Wall and CPU seconds of `check` with parameters in a separate process, for the logs with the most joints."""
    found = {}
    for case in real(folder):
        if case.name not in PAGES:
            continue
        with tempfile.TemporaryDirectory() as name:
            out = Path(name)
            scene = out / "scene.xml"
            scene.write_text(case.scene.spec.to_xml())
            joints, entries = PAGES[case.name]
            if entries is None:
                terms = ("viscous", "coulomb", "torque_offset")
                entries = [{"sensor": t, "element": j, "std": 0.3, "high": 3} for t in terms for j in joints]
            else:
                entries = json.loads((ROOT / "experiments" / entries).read_text())
            (out / "parameters.json").write_text(json.dumps(entries))
            command = [sys.executable, "-m", "droid_jax.run", "check", "--scene", str(scene), "--joints", *joints]
            command += ["--recording", str(save_recording(case.recording, out / "log.npz"))]
            command += ["--parameters", str(out / "parameters.json"), "--out", str(out / "check")]
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "DROID_JAX_CACHE": str(out / "cache")}
            row = found[case.name] = {}
            for run in ("first", "again"):
                before, begin = _children(), time.monotonic()
                subprocess.run(command, env=environment, check=True, capture_output=True)
                row |= {f"{run}_wall_s": time.monotonic() - begin, f"{run}_cpu_s": _children() - before}
        print(f"{case.name:28s} {row}", file=sys.stderr)
    return found


def _children() -> float:
    """CPU seconds of the processes that were started and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def names(found: list[Finding], error: Error) -> bool:
    """Whether a finding names an error."""
    return any(f.kind in error.kinds and any(word in f.sentence for word in error.words) for f in found)


def main(command: Check) -> dict[str, Any]:
    """Run all cases; returns what is published."""
    scene, count = two_link(), QUICK if command.quick else RIGHT
    right = [synthetic(command.seed + i, scene) for i in range(count)]
    measured = list(real(command.real)) if command.real is not None else []
    slowest, false = 0.0, []
    for case in [*right, *measured]:
        found, seconds = findings(case)
        slowest = max(slowest, seconds)
        doubts = [f for f in found if f.severity != "note" and f.kind not in case.known]
        false += [(case.name, f.severity, f.sentence) for f in doubts]
    table: dict[str, dict[str, int]] = {}
    missed = []
    hosts = [*right[: min(count, WITH)], *(case for case in measured if case.name in CHOSEN)]
    for error in ERRORS:
        row = collections.Counter[str]()
        for case in (c for c in hosts if error.applies(c)):
            wrong = replace(case, recording=error.put(case.recording), scene=error.scene(case))
            found, seconds = findings(wrong)
            slowest = max(slowest, seconds)
            if names(found, error):
                row["found"] += 1
                row["certain"] += any(f.severity == "certain" for f in found)
            else:
                others = sorted({f.kind for f in found if f.severity != "note"})
                row["other: " + ", ".join(others) if others else "nothing"] += 1
                missed.append(f"{error.name} in {case.name}: {', '.join(others) or 'nothing'}")
        table[error.name] = {key: count for key, count in row.items() if count}
        print(f"{error.name:28s} {dict(row)}", file=sys.stderr)
    total = sum(count for row in table.values() for key, count in row.items() if key != "certain")
    commands = timed(command.real) if command.real is not None and not command.quick else {}
    return {
        "cases": total,
        "logs_as_they_are": len(right) + len(measured),
        "found_rate": sum(row.get("found", 0) for row in table.values()) / max(total, 1),
        "false_grave": sum(severity == "certain" for _, severity, _ in false),
        "false_mild_rate": len({n for n, severity, _ in false if severity != "certain"}) / len([*right, *measured]),
        "slowest_s": slowest,  # CPU, of the findings alone
        "command": commands,
        "slowest_command_wall_s": max((t[k] for t in commands.values() for k in t if "wall" in k), default=None),
        "load_average": os.getloadavg()[0],
        "confusion": table,
        "missed": missed,
        "false": [f"{name}: {sentence}" for name, _, sentence in false],
    }


if __name__ == "__main__":
    given = tyro.cli(Check, description=__doc__)
    result = main(given)
    line = {key: result[key] for key in ("found_rate", "false_grave", "false_mild_rate", "slowest_s", "cases")}
    publish(given.out, "check", given.quick, given.seed, result, line)
