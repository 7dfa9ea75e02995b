"""Is what a quick rehearsal predicts what complete ones find?

    python benchmarks/rehearse.py [--quick] [--scenes hinge ...] [--minutes 60] [--out DIR] [--runs DIR]

The lone hinge, an arm of two links beside a driven door, and the built-in door.  Each effect that has a place in the
scene, and of which the synthetic robot has a law of its own, is hidden at 0.5 to 2 times the size that the quick form
predicts, several times each; every log is fitted and searched (`droid_jax.rehearsal.full`).  One folder a case under
RUNS: the run can be stopped and goes on where it was, and the same command started twice shares the cases.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402
import time  # noqa: E402
from collections.abc import Iterator, Mapping, Sequence  # noqa: E402
from dataclasses import dataclass, replace  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import CODE, publish  # noqa: E402
from benchmarks.sharing import claimed, kept  # noqa: E402
from droid_jax.commands.options import refine_config, search_config  # noqa: E402
from droid_jax.commands.rehearse import plain  # noqa: E402
from droid_jax.discrepancy.candidates import observable_effects  # noqa: E402
from droid_jax.discrepancy.config import CONVERGE_ITERATIONS, DiscrepancyConfig  # noqa: E402
from droid_jax.identify.multistart import RefineConfig  # noqa: E402
from droid_jax.identify.pipeline import IdentifyConfig  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402
from droid_jax.rehearsal.full import FullRehearsal, HiddenCase, hidden_case, run_case  # noqa: E402
from droid_jax.rehearsal.linear import RehearsalConfig  # noqa: E402
from droid_jax.rehearsal.quick import RehearsalPlan, quick_rehearsal, rehearsed  # noqa: E402
from droid_jax.synthetic.robot import SyntheticRobotConfig, record  # noqa: E402
from experiments.blind.scenes import ROLES as ROLES_THERE  # noqa: E402
from experiments.blind.scenes import Setting, setting  # noqa: E402

SCENES = ("hinge", "bench", "door")
LADDER = (1.0, 1.4, 0.7, 2.0, 0.5)  # times the predicted size, in the order in which they are made
SEEDS = 3
REPEATS = 10
FACTOR = 1.5  # a prediction that is off by less counts as right
CHANNELS = ("torque",)


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """One effect of the hinge at one size; its numbers are not for keeping."""
    scenes: tuple[str, ...] = SCENES
    """To make cases in; the others are summed up, if any are there."""
    seeds: int = SEEDS
    """Cases of each effect at each size."""
    minutes: float = 0.0
    """No case is begun after so many; 0: all are made."""
    sum_only: bool = False
    """Make no case: sum up those that are there."""
    seed: int = 0
    """Of all draws."""
    runs: Path | None = None
    """Folder of the cases; default: runs/rehearse, of --quick below OUT."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of rehearse.json."""


def measured(where: Setting, seed: int) -> list[Recording]:
    """Two motions of a robot of which nothing is hidden: their commands, and how their repeats scatter."""
    truth = dict(zip(where.base.names, where.base.mean.tolist(), strict=True))
    config = SyntheticRobotConfig(repeats=REPEATS)
    out = []
    for number, role in enumerate(ROLES_THERE[:2]):
        demonstration = where.demonstrations[role]
        log = _recorded(where, demonstration, truth, 10 * seed + number, config)
        out.append(replace(log, name=role, channels={n: log.channels[n] for n in ("position", *CHANNELS)}))
    return out


def _recorded(
    where: Setting, demonstration: Recording, truth: Mapping[str, float], seed: int, config: SyntheticRobotConfig
) -> Recording:
    if where.name == "door":
        return record(where.scene, demonstration, truth, seed=seed, config=config)
    from droid_jax.simulate.c_engine import simulate
    from droid_jax.synthetic.robot import as_recording, sensor_torque, set_up

    robot = set_up(where.scene, demonstration, truth, seed=seed, config=config, space=where.base)
    trace = simulate(robot.scene, robot.models, robot.qpos0, robot.control[None])
    return as_recording(robot, trace, sensor_torque(robot, trace), trace.position)


def rehearsal_of(name: str, runs: Path, seed: int) -> tuple[dict[str, Any], FullRehearsal]:
    """The quick rehearsal of a scene, kept, and what its complete ones share."""
    where = setting(name, runs / "door")
    recordings = measured(where, seed)
    effects = observable_effects(where.scene, recordings, channels=CHANNELS)
    config = DiscrepancyConfig(
        search=search_config("quick", seed),
        refine=replace(refine_config("quick") or RefineConfig(), iterations=CONVERGE_ITERATIONS),
        channels=CHANNELS,
        seed=seed,
    )
    rehearsal, plan = RehearsalConfig(seed=seed), RehearsalPlan(channels=CHANNELS)

    def made() -> dict[str, Any]:
        began = time.monotonic()
        found = quick_rehearsal(where.scene, where.base, effects, recordings, plan, config, rehearsal)
        return plain({**found, "code": CODE.get("git"), "whole_seconds": time.monotonic() - began})

    quick = kept(runs / f"quick_{name}_seed{seed}.json", made)
    identify = IdentifyConfig(search=search_config("quick", seed), refine=refine_config("quick"), samples=0)
    found = rehearsed(where.scene, where.base, effects, recordings, plan, config, rehearsal, step_error=False)
    return quick, FullRehearsal(
        where.scene, where.base, effects, tuple(recordings), plan, config, identify, rehearsal, found, seed
    )


def asked(quick: Mapping[str, Any], of: FullRehearsal) -> list[dict[str, Any]]:
    """One place and coefficient of each effect that the synthetic robot has a law of its own for."""
    best: dict[str, dict[str, Any]] = {}
    for entry in quick["effects"]:
        if entry["smallest"] is None or not hidden_case(of.scene, 0, entry, 1.0).hidden:
            continue
        known = best.get(entry["effect"])
        if known is None or entry["smallest"] < known["smallest"]:
            best[entry["effect"]] = entry
    return list(best.values())


def plans(quick: Mapping[str, Any], of: FullRehearsal, arguments: Arguments) -> Iterator[HiddenCase]:
    """All cases of a scene: of every effect one seed at one size first."""
    effects = asked(quick, of)[: 1 if arguments.quick else None]
    for seed in range(1 if arguments.quick else arguments.seeds):
        for times in LADDER[: 1 if arguments.quick else None]:
            for i, entry in enumerate(effects):
                number = 1000 * seed + 100 * LADDER.index(times) + i
                yield hidden_case(of.scene, number, entry, times)


def judged(entry: Mapping[str, Any], cases: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One effect: at which multiples of the predicted size it was found, and from which on it always was."""
    mine = [c for c in cases if c["effect"] == entry["effect"] and c["verdict"] != "error"]
    steps = sorted({c["times"] for c in mine})
    rates = {t: [bool(c["found"]) for c in mine if c["times"] == t] for t in steps}
    above = [t for i, t in enumerate(steps) if all(np.mean(rates[s]) >= 0.9 for s in steps[i:])]
    whole = len(steps) == len(LADDER)
    ratio = (above[0] if above else np.inf) if whole else None
    return {
        "effect": entry["effect"],
        "location": entry["location"],
        "predicted": entry["smallest"],
        "unit": entry["unit"],
        "limit": entry["limit"],
        "found": {f"{t:g}": [int(sum(f)), len(f)] for t, f in rates.items()},
        "measured_over_predicted": None if ratio is None or not np.isfinite(ratio) else ratio,
        "not_found_at_twice": bool(whole and not above),
        "within": None if ratio is None else bool(1 / FACTOR <= ratio <= FACTOR),
        "taken_for": sorted({n for c in mine if not c["found"] for n in c["taken_for"]}),
    }


def summary(by_scene: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Shares over the effects whose ladder was made.

    Wrong advice: said to be found and found in less than half of the cases at that size or above, or said to be below
    what is found and always found at half of it.
    """
    done = [e for effects in by_scene.values() for e in effects if e["within"] is not None]

    def wrong(e: Mapping[str, Any]) -> bool:
        at = [n for t, (n, _) in e["found"].items() if float(t) >= 1.0]
        of = [m for t, (_, m) in e["found"].items() if float(t) >= 1.0]
        low = e["found"].get("0.5", [0, 1])
        return sum(at) < 0.5 * sum(of) or low[0] == low[1]

    return {
        "effects": len(done),
        "within_factor": float(np.mean([e["within"] for e in done])) if done else None,
        "wrong_advice_rate": float(np.mean([wrong(e) for e in done])) if done else None,
    }


def main(arguments: Arguments) -> None:
    """Make the cases that are not there, and sum up those that are."""
    began = time.monotonic()
    runs = arguments.runs or (arguments.out if arguments.quick else ROOT / "runs") / "rehearse"
    runs = runs / ("quick" if arguments.quick else f"seed{arguments.seed}")
    scenes = ("hinge",) if arguments.quick else arguments.scenes
    effects, seconds, case_seconds = dict[str, list[dict[str, Any]]](), dict[str, float](), list[float]()
    for scene in SCENES:
        if scene not in scenes and not (runs / f"quick_{scene}_seed{arguments.seed}.json").is_file():
            continue
        quick, of = rehearsal_of(scene, runs, arguments.seed)
        seconds[scene] = quick["whole_seconds"]
        cases = list(plans(quick, of, arguments))
        for case in cases if scene in scenes and not arguments.sum_only else ():
            if arguments.minutes and time.monotonic() - began > 60 * arguments.minutes:
                break
            path = runs / scene / case.name / "result.json"
            if path.is_file():
                continue
            with claimed(path, wait=False) as mine:
                if not mine or path.is_file():
                    continue
                found = run_case(of, case, runs / scene)
                named = " + ".join(found["effects"]) or found["verdict"]
                print(f"{scene} {case.name}: {named}, {found['seconds']:.0f} s {found.get('error', '')}", flush=True)
        made = [json.loads(p.read_text()) for c in cases if (p := runs / scene / c.name / "result.json").is_file()]
        case_seconds += [c["seconds"] for c in made]
        effects[scene] = [judged(entry, made) for entry in asked(quick, of)]
    whole = summary(effects)
    result = {
        **whole,
        "seconds_door": seconds.get("door"),
        "seconds_quick": seconds,
        "seconds_case_median": float(np.median(case_seconds)) if case_seconds else None,
        "cases": len(case_seconds),
        "plan": {"scenes": list(SCENES), "ladder": sorted(LADDER), "seeds": arguments.seeds, "repeats": REPEATS},
        "not_measured": [s for s in SCENES if s not in effects],
        "by_scene": {scene: {**summary({scene: some}), "effects": some} for scene, some in effects.items()},
    }
    publish(
        arguments.out, "rehearse", arguments.quick, arguments.seed, result, line={**whole, "cases": len(case_seconds)}
    )


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
