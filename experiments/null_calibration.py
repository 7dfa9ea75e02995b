"""How often does the search raise an alarm where nothing is hidden?

    python experiments/null_calibration.py [--quick] [--counts.hinge 150 ...] [--commit HASH] [--out DIR]

Every case draws a robot with all its nuisances and records it; base fit and screening follow.  Only where the
screening rejects are the other demonstrations recorded and the search completed.  One JSON file per case is written
under OUT/null_cases.  A stopped run can be continued, and several processes, or runs for single scenes, can share the
cases.  Every summary is of all existing cases of the commit.  Truths and seeds are drawn as in the blind suite.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import numpy as np  # noqa: E402
import scipy.stats  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import CODE, origin, stem  # noqa: E402
from benchmarks.sharing import claimed  # noqa: E402
from droid_jax.discrepancy.candidates import directions_of, score_test  # noqa: E402
from droid_jax.discrepancy.config import SelectionConfig  # noqa: E402
from droid_jax.discrepancy.fitting import base_fit  # noqa: E402
from droid_jax.discrepancy.search import search_effects  # noqa: E402
from droid_jax.discrepancy.step_error import discretisation_error  # noqa: E402
from droid_jax.model.effects.candidate import candidates  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.blind.cases import Plan  # noqa: E402
from experiments.blind.draws import commit_of, seed_of  # noqa: E402
from experiments.blind.make import recorded  # noqa: E402
from experiments.blind.rates import rate  # noqa: E402
from experiments.blind.scenes import setting  # noqa: E402
from experiments.blind.search import FAILED, Bench, Stopwatch, silent  # noqa: E402

LEVELS = (0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9)


@dataclass(frozen=True)
class Counts:
    """Cases of each scene."""

    hinge: int = 160
    bench: int = 140
    arm: int = 60
    door: int = 60


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Two cases of the lone hinge."""
    counts: Counts = field(default_factory=Counts)
    """Cases of each scene."""
    sum_only: bool = False
    """Run no case; summarise the existing ones."""
    commit: str = "HEAD"
    """Commit that froze the method: seeds derive from it.  "development" draws cases to tune with."""
    out: Path = ROOT / "runs" / "null_calibration"
    """Folder of the cases and of null_calibration.json."""


def case_of(plan: Plan, commit: str, bench: Bench) -> dict[str, Any]:
    """One case; a failure is a result too, with the p-value of the screening where that was done."""
    watch = Stopwatch()
    result = {
        "scene": plan.scene,
        "seed": seed_of(commit, plan.name),
        "code": CODE.get("git"),
        "seconds": watch.seconds,
    }
    try:
        for known in run_case(plan, commit, bench, watch):
            result |= known
    except FAILED as error:
        result |= {"verdict": "error", "error": str(error)}
    return result


def run_case(plan: Plan, commit: str, bench: Bench, watch: Stopwatch) -> Iterator[dict[str, Any]]:
    """Screen one case, and complete its search where the screening rejects; yields each part of the result."""
    scene, where = plan.scene, bench.setting(plan.scene)
    found = watch("record", lambda: recorded(where, plan, {}, seed_of(commit, plan.name)))
    if isinstance(found, str):
        raise ValueError(f"case {plan.name}: {found}")
    recordings = found[2]
    case = watch("prepare", lambda: bench.case(scene, {"train": recordings["train"]}))
    model = watch("base", lambda: base_fit(case.train, case.base, case.config, silent))
    case = watch("discretisation_error", lambda: bench.with_step(scene, case, model, recordings["train"]))
    screen = watch("screen", lambda: score_test(case.train, model, directions_of(candidates(case.effects))))
    best = screen.directions[int(np.argmax(np.abs(screen.t)))].candidate.key
    yield {
        "p": screen.p,
        "discrepancy": model.discrepancy,
        "converged": bool(model.refined.converged),
        "best": str(best),
    }
    if screen.p < case.config.selection.significance:
        step_error = discretisation_error(case.train, model)
        whole = replace(watch("prepare", lambda: bench.case(scene, recordings)), train=case.train)
        verdict = watch("find", lambda: search_effects(whole, model, step_error))
        yield {
            "discretisation_error": step_error,
            "verdict": verdict.conclusion.value,
            "effects": list(map(str, verdict.effects)),
        }


def summarise(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """False alarms with Wilson's intervals, and the p-values' distribution.

    Shares are of the cases that were screened; failed cases are counted separately.  For cases that failed after a
    rejection (`rejected_then_failed`) it is not known whether they would have ended in an alarm.
    """
    failed, cases = sum("error" in c for c in cases), [c for c in cases if "p" in c]
    if not cases:
        return {"cases": 0, "errors": failed}
    p = np.array([c["p"] for c in cases])
    return {
        "cases": len(cases),
        "errors": failed,
        "codes": sorted({str(c.get("code")) for c in cases}),
        "screening_rejects": rate(cases, lambda c: c["p"] < SelectionConfig().significance),
        "alarms": rate(cases, lambda c: c.get("verdict", "none") not in ("none", "fit not converged", "error")),
        "rejected_then_failed": sum("error" in c for c in cases),
        "names": rate(cases, lambda c: bool(c.get("effects"))),
        "unconverged": rate(cases, lambda c: not c["converged"]),
        "p_below": {f"{level:g}": float(np.mean(p < level)) for level in LEVELS},
        "uniform_p": float(scipy.stats.kstest(p, "uniform").pvalue),
        "p_histogram": np.histogram(p, np.linspace(0, 1, 11))[0].tolist(),
        "discrepancy_median": float(np.median([c["discrepancy"] for c in cases])),
        "seconds_median": float(np.median([sum(c["seconds"].values()) for c in cases])),
    }


def name_of(scene: str, number: int) -> str:
    """Name of a case, from which its seed derives."""
    return f"{scene}/null/{number}"


def file_of(scene: str, number: int, commit: str) -> str:
    """Name of a case's file."""
    return f"{scene}_{number:03d}_{seed_of(commit, name_of(scene, number)):08x}.json"


def cases_of(folder: Path, commit: str) -> dict[str, list[dict[str, Any]]]:
    """Scene -> its existing cases of this commit; cases of other commits have other seeds."""
    found = dict[str, list[dict[str, Any]]]()
    for path in sorted(folder.glob("*.json")):
        scene, number, _ = path.stem.split("_")
        if path.name == file_of(scene, int(number), commit):
            found.setdefault(scene, []).append(json.loads(path.read_text()))
    return found


def line_of(case: dict[str, Any]) -> str:
    """A line about a case."""
    p, error = (f"p = {case['p']:.3f}" if "p" in case else ""), (f"error: {case['error']}" if "error" in case else "")
    return ", ".join(filter(None, (p, error)))


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    commit = commit_of(arguments.commit)
    wanted = {"hinge": 2} if arguments.quick else asdict(arguments.counts)
    folder, summary = arguments.out / "null_cases", arguments.out / f"{stem('null_calibration', arguments.quick)}.json"
    if summary.is_file() and (other := json.loads(summary.read_text())["seeds_from"]) != commit:
        raise SystemExit(f"error: {summary} sums up cases of {other}, not of {commit}: choose another --out")
    for scene, count in wanted.items() if not arguments.sum_only else ():
        bench = Bench({scene: setting(scene, arguments.out / "door")})
        for number in range(count):
            path = folder / file_of(scene, number, commit)
            with claimed(path, wait=False) as mine:
                if not mine or path.is_file():
                    continue
                case = case_of(Plan(name_of(scene, number), scene, "none"), commit, bench)
                write_json(path, case)
                print(f"{scene} {number}: {line_of(case)}", flush=True)
    found = cases_of(folder, commit)
    if not found:
        raise SystemExit(f"error: {folder} holds no case of commit {commit}")
    scenes = {scene: summarise(cases) for scene, cases in found.items()}
    whole = summarise([c for cases in found.values() for c in cases])
    other = sum(c.get("code") != commit for cases in found.values() for c in cases)
    result = {**origin(0), "seeds_from": commit, "by_other_code": other, "all": whole, "scenes": scenes}
    write_json(summary, result)
    print(json.dumps(whole))


if __name__ == "__main__":
    main()
