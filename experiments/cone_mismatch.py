"""Does the search raise false alarms if the robot's friction cone differs from the simulation's and nothing is hidden?

    python experiments/cone_mismatch.py [--quick] [--out DIR] [--cases 4] [--commit HASH]

The synthetic robot's contacts get MuJoCo's elliptic cone; the simulation keeps its pyramid.  First the torques of one
robot with either cone are compared.  Then the whole search is run on robots of the blind suite without hidden effects.
One JSON file per case is written under OUT/cone_cases, so that a stopped run can be continued.  --quick omits the
searches.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import publish  # noqa: E402
from droid_jax.model.scene import with_options  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402
from experiments.blind.cases import Plan  # noqa: E402
from experiments.blind.draws import commit_of, folder_of, seed_of  # noqa: E402
from experiments.blind.make import Drawn, record, recorded, write_case  # noqa: E402
from experiments.blind.scenes import Setting, setting  # noqa: E402
from experiments.blind.search import Bench, search_case  # noqa: E402

CONE = mujoco.mjtCone.mjCONE_ELLIPTIC


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Only compare torques."""
    cases: int = 4
    """Number of robots to search."""
    commit: str = "HEAD"
    """Commit that froze the method: seeds derive from it."""
    out: Path = ROOT / "runs" / "cone_mismatch"
    """Folder of the cases and of cone_mismatch.json."""


def elliptic(where: Setting) -> Setting:
    """The same setting with a robot whose contacts are elliptic."""
    return replace(where, scene=with_options(where.scene, cone=int(CONE)))


def plan_of(number: int) -> Plan:
    """A robot with nothing hidden."""
    return Plan(f"door/cone/{number}", "door", "none")


def robot(where: Setting, number: int, seed: int) -> tuple[int, Drawn, dict[str, Recording]]:
    """A robot with elliptic contacts, as the suite draws and records them (`recorded`)."""
    found = recorded(elliptic(where), plan_of(number), {}, seed)
    if isinstance(found, str):
        raise SystemExit(f"error: case {plan_of(number).name}: {found}")
    return found


def between_cones(where: Setting, seed: int) -> list[float]:
    """Root mean square [N m] of each joint's torque difference between the cones, for one robot with the same noise.

    The first robot that is searched, which keeps hold of its door with elliptic contacts.
    """
    _, drawn, recordings = robot(where, 0, seed)
    try:
        pyramidal = record(where, drawn, ("train",))
    except ValueError as error:
        raise SystemExit(f"error: {plan_of(0).name} with pyramidal contacts: {error}") from None
    torque = [_mean_torque(r["train"]) for r in (pyramidal, recordings)]
    return np.sqrt(np.mean((torque[1] - torque[0]) ** 2, axis=0)).tolist()


def _mean_torque(recording: Recording) -> np.ndarray:
    return np.nanmean(recording.channels["torque"].values, axis=0)


def case(where: Setting, number: int, commit: str, out: Path, bench: Bench) -> dict[str, Any]:
    """One robot: recorded once, searched once."""
    name = plan_of(number).name
    folder = out / "cone_cases" / folder_of(commit, name)
    if not (folder / "result.json").is_file():
        if not folder.is_dir():
            _, _, recordings = robot(where, number, seed_of(commit, name))
            write_case(folder, "door", (), recordings)
        write_json(folder / "result.json", search_case(folder, bench))
    return json.loads((folder / "result.json").read_text())


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    commit, where = commit_of(arguments.commit), setting("door", arguments.out / "door")
    difference = between_cones(where, seed_of(commit, plan_of(0).name))
    result: dict[str, Any] = {"seeds_from": commit, "torque_difference": difference}
    bench, found = Bench({"door": where}), list[dict[str, Any]]()
    for number in range(0 if arguments.quick else arguments.cases):
        found.append(case(where, number, commit, arguments.out, bench))
        print(f"door {number}: {found[-1].get('sentence', found[-1].get('error'))}", flush=True)
    keys = ("verdict", "sentence", "effects", "p", "discrepancies", "discretisation_error", "seconds", "code")
    result["cases"] = [{k: c.get(k) for k in keys} for c in found]
    line = {"torque_difference": [round(d, 3) for d in difference], "said": [c["verdict"] for c in found]}
    publish(arguments.out, "cone_mismatch", arguments.quick, 0, result, line)


if __name__ == "__main__":
    main()
