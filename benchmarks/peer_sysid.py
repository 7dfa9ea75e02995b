"""Compares mujoco.sysid with this program: same recordings, parameters, start and machine.

    pip install -c constraints.txt -e ".[peers]"
    python benchmarks/peer_sysid.py [--quick] [--out DIR]

Its own test problems (recovery of known values), its spring and mass with dry friction hidden in the data, the
three doors of Table I, and a door with a magnetic catch hidden in it.  Every case is one JSON file under
DIR/peer_sysid_cases/ and is not run again.  docs/comparison.md has the results as tables.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments"), str(ROOT / "benchmarks")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import tyro  # noqa: E402

from benchmarks.common import commits, origin, publish, stem  # noqa: E402
from benchmarks.peer_problems import doors, springs, sysid, sysid_models  # noqa: E402
from benchmarks.sharing import kept  # noqa: E402

Case = Callable[[], dict[str, Any]]


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Few iterations and short logs: shows that it runs; its numbers mean nothing."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of peer_sysid.json and of the cases."""
    cases: tuple[str, ...] = ()
    """Only these cases; default: all."""


def cases(quick: bool) -> dict[str, Case]:
    """All cases by name."""
    out: dict[str, Case] = {}
    steps = {
        "own_data": (0.002, 0.002),
        "real_2ms": (sysid_models.FINE, 0.002),
        "real_half_ms": (sysid_models.FINE, 0.0005),
    }
    for problem in ("spring",) if quick else ("spring", "arm"):
        for name, (data, fit) in list(steps.items())[: 1 if quick else None]:
            out[f"{problem}_{name}"] = lambda p=problem, d=data, f=fit: springs.recover(p, d, f)
    out["spring_hidden_friction"] = lambda: springs.hidden_friction(25.0 if quick else 40.0, 1)
    for count in (1,) if quick else (0, 1, 2):
        out[f"door_{count}"] = lambda k=count: doors.door(k, quick)
    if not quick:
        out["door_hidden_catch"] = lambda: doors.hidden("magnetic_catch", 1.5, quick)
    return out


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    sysid.library()
    known = cases(arguments.quick)
    unknown = [c for c in arguments.cases if c not in known]
    if unknown:
        raise SystemExit(f"unknown cases {', '.join(unknown)}; there are: {', '.join(known)}")
    folder = arguments.out / stem("peer_sysid_cases", arguments.quick)
    for name in arguments.cases or known:
        print(f"{name} ...", flush=True)
        kept(folder / f"{name}.json", lambda name=name: {**known[name](), "origin": origin(0)})
    done = {n: json.loads((folder / f"{n}.json").read_text()) for n in known if (folder / f"{n}.json").is_file()}
    figures = {n: {k: v for k, v in case.items() if k != "origin"} for n, case in done.items()}
    whole = {"cases_from_commits": commits(done.values()), "cases": figures}
    publish(arguments.out, "peer_sysid", arguments.quick, 0, whole, {"cases": figures})


if __name__ == "__main__":
    main()
