"""Identification on the synthetic robot: doors of Table I, calibration of intervals, second arm pose, C parity.

    python experiments/identify_suite.py [--quick] [--out DIR] [--parts doors calibration pose parity]

Every case is one JSON file under DIR/identify_cases/ and is not run again, so that a stopped suite can be continued.
DIR/identify.json summarises them.  Truth and seeds of a case derive from its number alone.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402

import numpy as np  # noqa: E402
import scipy.stats  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import commits, origin, publish, stem  # noqa: E402
from benchmarks.sharing import kept  # noqa: E402
from droid_jax.cost.cost import make_cost  # noqa: E402
from droid_jax.door.demonstration import demonstration_path  # noqa: E402
from droid_jax.door.scene import door_scene  # noqa: E402
from droid_jax.door.space import JOINT_DAMPING, door_nuisances, door_space  # noqa: E402
from droid_jax.door.space import truth as table_i  # noqa: E402
from droid_jax.identify.gaussian import prior  # noqa: E402
from droid_jax.identify.multistart import RefineConfig  # noqa: E402
from droid_jax.identify.pipeline import Identified, IdentifyConfig, cost_samples, identify_parameters  # noqa: E402
from droid_jax.identify.search import CmaConfig  # noqa: E402
from droid_jax.model.scene import Scene  # noqa: E402
from droid_jax.recordings.formats import load_recording  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402
from droid_jax.synthetic.robot import draw_nuisances, record, synthetic_truth  # noqa: E402

Part = Literal["doors", "calibration", "pose", "parity"]
MUST_BE_KNOWN = ("hinge_stiffness", "hinge_frictionloss", "hinge_damping", *JOINT_DAMPING)
LEVEL = 0.9  # of the intervals in the cases
TIMESTEP = 0.004  # s: the replay's second-order step is as good here as at 2 ms (docs/simulation-step.md)


@dataclass(frozen=True)
class Arguments:
    """Options of the suite."""

    quick: bool = False
    """One case of each part (both poses) with a small budget: shows that it runs; its numbers mean nothing."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of identify.json and of the cases."""
    parts: tuple[Part, ...] = ("doors", "calibration", "pose", "parity")
    """Which parts to run."""
    calibration: int = 20
    """Doors of the calibration part."""


def settings(quick: bool, seed: int) -> IdentifyConfig:
    """The budget of a case."""
    search = CmaConfig(population=30, parents=None, generations=3 if quick else 20, seed=seed)
    return IdentifyConfig(search=search, refine=RefineConfig(iterations=2 if quick else 30), seed=seed)


def recordings(scene: Scene, truth: dict[str, float], names: str, seed: int) -> list[Recording]:
    """Ten repeats of each demonstration on the synthetic robot."""
    return [
        record(scene, load_recording(demonstration_path(n)), truth, seed=100 * seed + i, name=n)
        for i, n in enumerate(names)
    ]


def describe(found: Identified, truth: dict[str, float]) -> dict[str, Any]:
    """Figures of a case: share of the gap closed, and truth, interval and verdict of every parameter.

    search: mean and deviation in the coordinate in which the parameter was fitted, where it is normal.
    """
    gaussian = found.full_gaussian
    low, high = gaussian.interval(LEVEL)
    assert gaussian.coordinates == "search"
    deviation = np.sqrt(np.diag(gaussian.cov))
    parameters = {
        p.name: {
            "truth": truth[p.name],
            "best": float(found.best[i]),
            "interval": [float(low[i]), float(high[i])],
            "search": [float(gaussian.mean[i]), float(deviation[i])],
            "inside": bool(low[i] <= truth[p.name] <= high[i]),
            "identifiable": found.identifiability[i].identifiable,
            "shrinkage": found.identifiability[i].shrinkage,
            "nuisance": p.nuisance,
        }
        for i, p in enumerate(found.full.parameters)
    }
    refined = found.refined
    return {
        "gap": {
            n: {"before": g.before, "after": g.after, "floor": g.noise_floor, "closed": g.closed}
            for n, g in found.heldout_distances.items()
        },
        "parameters": parameters,
        "mean_square": None if refined is None else float(np.mean(refined.residual**2)),
        "converged": None if refined is None else refined.converged,
        "evaluations": found.search.evaluations + (refined.evaluations if refined else 0),
        "seconds": found.seconds,
        "rule": found.gaussian.rule,
    }  # fmt: skip


def fit(truth: dict[str, float], names: str, seed: int, quick: bool) -> tuple[Identified, dict[str, Any]]:
    """Record, identify, describe."""
    scene = door_scene(timestep=TIMESTEP)
    found = identify_parameters(
        scene,
        door_space(scene),
        recordings(scene, truth, names, seed),
        nuisances=door_nuisances(scene),
        config=settings(quick, seed),
    )
    return found, describe(found, truth)


def door_case(springs: int, quick: bool) -> dict[str, Any]:
    """A door of Table I from demonstrations A and C, with 200 samples of the initial and fitted Gaussian."""
    truth = synthetic_truth(door_scene(), springs, springs)
    found, result = fit(truth, "A" if quick else "AC", springs, quick)
    samples = cost_samples(found, 20 if quick else 200, springs)
    for key in ("initial_cost", "fitted_cost"):
        result[key] = {
            "median": float(np.median(samples[key])),
            "quantiles_5_95": np.quantile(samples[key], [0.05, 0.95]).tolist(),
        }
    return result


def calibration_case(number: int, quick: bool) -> dict[str, Any]:
    """A random door: hinge log-uniform, the rest around Table I, nuisances on.

    Doors whose grip fails on the synthetic robot are drawn again, since a demonstration must open the door.
    """
    scene = door_scene()
    space = door_space(scene)
    rng = np.random.default_rng([number, 77])
    while True:
        truth = dict(zip(space.names, prior(space.linear()).sample(rng, 1)[0].tolist(), strict=True))
        hinge = {"hinge_stiffness": (0.01, 3), "hinge_frictionloss": (0.01, 1.5), "hinge_damping": (0.1, 6)}
        for name, (low, high) in hinge.items():
            truth[name] = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        truth |= draw_nuisances(scene, 1000 + number)
        try:
            _, result = fit(truth, "A" if quick else "AC", 500 + number, quick)
            return result
        except ValueError as error:
            if "grasp" not in str(error):
                raise


def pose_case(demonstration: str, quick: bool) -> dict[str, Any]:
    """The one-spring door from one opening alone, with the arm pose of A or of B (paper, section IV-C)."""
    truth = synthetic_truth(door_scene(), 1, 1)
    _, result = fit(truth, demonstration, 900 + ord(demonstration), quick)
    return result


def parity_case(seed: int, quick: bool) -> dict[str, Any]:
    """MJX against the C engine over the whole opening: traces, and the rank correlation of the cost."""
    scene = door_scene(timestep=0.002)
    space = door_space(scene)
    truth = synthetic_truth(scene, 1, 1)
    data = recordings(scene, truth, "A", seed)
    values = prior(space).sample(0, 8 if quick else 200)
    tables = np.stack([space.values(table_i(k)) for k in (0, 1, 2)])
    costs, torques, of_tables = {}, {}, {}
    for engine in ("mjx", "mujoco"):
        cost = make_cost(scene, space, data, engine=engine)
        costs[engine] = cost(values)
        torques[engine] = cost.rollouts(values[:8])[0].torque
        of_tables[engine] = cost(tables).tolist()
    error = torques["mjx"] - torques["mujoco"]
    grasp = next(p for p in data[0].phases if p.name == "grasp")
    contact = int(grasp.start / 0.002)
    return {
        "rank_correlation": float(scipy.stats.spearmanr(costs["mjx"], costs["mujoco"]).statistic),
        "samples": len(values),
        "rms_before_contact": np.sqrt(np.mean(error[:, :contact] ** 2, axis=(0, 1))).tolist(),
        "rms_whole": np.sqrt(np.mean(error**2, axis=(0, 1))).tolist(),
        "table_i_costs": of_tables,
    }


def run_cases(arguments: Arguments) -> dict[str, dict[str, Any]]:
    """Run the missing cases of the chosen parts; returns all existing cases by name."""
    quick = arguments.quick
    cases: dict[str, tuple[int, Callable[[], dict[str, Any]]]] = {}  # name -> seed, and what makes it
    if "doors" in arguments.parts:
        for k in (1,) if quick else (0, 1, 2):
            cases[f"door_{k}"] = k, lambda k=k: door_case(k, quick)
    if "parity" in arguments.parts:
        cases["parity"] = 1, lambda: parity_case(1, quick)
    if "pose" in arguments.parts:
        for name in "AB":
            cases[f"pose_{name}"] = 900 + ord(name), lambda name=name: pose_case(name, quick)
    if "calibration" in arguments.parts:
        for k in range(1 if quick else arguments.calibration):
            cases[f"calibration_{k:02d}"] = 500 + k, lambda k=k: calibration_case(k, quick)
    folder = arguments.out / stem("identify_cases", quick)
    for number, (name, (seed, run)) in enumerate(cases.items(), 1):
        print(f"[{number}/{len(cases)}] {name} ...", flush=True)
        kept(folder / f"{name}.json", lambda run=run, seed=seed: {**run(), "origin": origin(seed)})
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def kept_cases(out: Path, quick: bool, part: Part, names: Sequence[str]) -> list[dict[str, Any]]:
    """Cases that the suite left in `out`; SystemExit where one is missing says how to make it."""
    paths = [out / stem("identify_cases", quick) / f"{name}.json" for name in names]
    if missing := [path for path in paths if not path.is_file()]:
        options = f"--parts {part}{' --quick' if quick else ''} --out {out}"
        raise SystemExit(
            f"error: there is no {missing[0]}: run experiments/identify_suite.py {options} "
            f"(the reported cases: benchmarks/archive.py unpack identify --out {out})"
        )
    return [json.loads(path.read_text()) for path in paths]


def summarise(cases: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The figures of issue and paper: gap closed, errors, coverage, agreement of the poses."""
    out: dict[str, Any] = {"cases_from_commits": commits(cases.values())}
    doors = {n: c for n, c in cases.items() if n.startswith("door_")}
    if doors:
        out["doors"] = {n: _door_summary(c) for n, c in doors.items()}
    calibration = [c for n, c in cases.items() if n.startswith("calibration_")]
    if calibration:
        out["calibration"] = _coverage(calibration)
    if {"pose_A", "pose_B"} <= set(cases):
        out["pose_agreement"] = agreement(cases["pose_A"], cases["pose_B"])
    if "parity" in cases:
        out["parity"] = {k: v for k, v in cases["parity"].items() if k != "origin"}
    return out


def _door_summary(case: dict[str, Any]) -> dict[str, Any]:
    main = {n: p for n, p in case["parameters"].items() if not p["nuisance"]}
    known = [p for p in main.values() if p["identifiable"]]
    damping = [abs(main[n]["best"] / main[n]["truth"] - 1) for n in JOINT_DAMPING]
    return {
        "gap_closed": {n: g["closed"] for n, g in case["gap"].items()},
        "stiffness_error": main["hinge_stiffness"]["best"] - main["hinge_stiffness"]["truth"],
        "frictionloss_error": main["hinge_frictionloss"]["best"] - main["hinge_frictionloss"]["truth"],
        "largest_joint_damping_error": max(damping),
        "identifiable": sum(p["identifiable"] for p in main.values()),
        "identifiable_inside_90": sum(p["inside"] for p in known) / max(len(known), 1),
        "not_called_identifiable": [n for n in MUST_BE_KNOWN if not main[n]["identifiable"]],
        "converged": case["converged"],
        "mean_square": case["mean_square"],
        "seconds": sum(case["seconds"].values()),
    }


def _coverage(cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Share of identifiable parameters whose 90 % interval holds the truth, with a bootstrap over doors."""
    counts = {"doors": len(cases), "converged": sum(bool(c["converged"]) for c in cases)}
    known = [[p["inside"] for p in c["parameters"].values() if p["identifiable"] and not p["nuisance"]] for c in cases]
    counts["parameters"] = sum(map(len, known))
    if not counts["parameters"]:
        return {**counts, "coverage": None, "coverage_interval_95": None}
    rng = np.random.default_rng(0)
    drawn = ([known[i] for i in rng.integers(len(known), size=len(known))] for _ in range(2000))
    draws = [
        np.mean(np.concatenate(doors)) for doors in drawn if any(doors)
    ]  # doors without identifiable parameters have no share
    return {
        **counts,
        "coverage": float(np.mean(np.concatenate(known))),
        "coverage_interval_95": np.quantile(draws, [0.025, 0.975]).tolist(),
    }


def identifiable_in_both(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """Names of the parameters that are identifiable in both poses."""
    return [n for n, p in a.items() if not p["nuisance"] and p["identifiable"] and b[n]["identifiable"]]


def agreement(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Agreement of the two poses on the parameters that are identifiable in both.

    If they agree, their difference in the coordinate of the search, in units of its deviation, is normal.
    """
    names = identifiable_in_both(a["parameters"], b["parameters"])
    apart = {}
    for name in names:
        (mean_a, std_a), (mean_b, std_b) = (case["parameters"][name]["search"] for case in (a, b))
        apart[name] = (mean_a - mean_b) / np.hypot(std_a, std_b)
    within = np.abs(list(apart.values())) <= scipy.stats.norm.ppf(0.95)
    return {"difference_in_deviations": apart, "within_90": float(np.mean(within)) if names else None}


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    summary = summarise(run_cases(arguments))
    publish(arguments.out, "identify", arguments.quick, 0, summary, summary)


if __name__ == "__main__":
    main()
