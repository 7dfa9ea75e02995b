"""Do the predictions of a quick rehearsal agree with complete rehearsals?

    python benchmarks/rehearse.py [--quick] [--scenes hinge ...] [--minutes 60] [--out DIR] [--runs DIR]

The lone hinge, an arm of two links beside a driven door, and the built-in door.  Each effect that has a place in the
scene, and for which the synthetic robot has a separate law, is hidden at the size that the quick form predicts.  While
it is found, smaller sizes follow, otherwise larger ones, in steps from 0.5 to 2 times that size.  Results of earlier
runs at other sizes are used too.  Every log is fitted and searched (`droid_jax.rehearsal.full`).  Each case has a
folder under RUNS, so that a stopped run can be continued.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments")]

import tuned  # noqa: E402, F401  (before jax starts)

# isort: split
import json  # noqa: E402
import subprocess  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Mapping, Sequence  # noqa: E402
from dataclasses import dataclass, replace  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import tyro  # noqa: E402

from benchmarks.common import CODE, publish  # noqa: E402
from benchmarks.sharing import claimed, kept  # noqa: E402
from droid_jax.commands.options import quick_settings, refine_config, search_config  # noqa: E402
from droid_jax.commands.rehearse import plain  # noqa: E402
from droid_jax.discrepancy.candidates import observable_effects  # noqa: E402
from droid_jax.discrepancy.config import CONVERGE_ITERATIONS, DiscrepancyConfig  # noqa: E402
from droid_jax.identify.multistart import RefineConfig  # noqa: E402
from droid_jax.identify.pipeline import IdentifyConfig  # noqa: E402
from droid_jax.model.scene import Scene  # noqa: E402
from droid_jax.recordings.recording import Recording  # noqa: E402
from droid_jax.rehearsal.config import DEFAULT_REHEARSAL, RehearsalConfig  # noqa: E402
from droid_jax.rehearsal.full import FullRehearsal, HiddenCase, hidden_case, run_case  # noqa: E402
from droid_jax.rehearsal.linearised import rehearsed  # noqa: E402
from droid_jax.rehearsal.plan import RehearsalPlan  # noqa: E402
from droid_jax.rehearsal.quick import quick_rehearsal  # noqa: E402
from droid_jax.synthetic.robot import SyntheticRobotConfig, record  # noqa: E402
from experiments.blind.scenes import ROLES as ROLES_THERE  # noqa: E402
from experiments.blind.scenes import Setting, setting  # noqa: E402

SCENES = ("hinge", "bench", "door")
LADDER = (0.5, 0.7, 1.0, 1.4, 2.0)  # times the predicted size
SEEDS = 1
REPEATS = 10
CLOSE = 0.99  # times the predicted size, from which a case counts as one at it
FACTOR = 1.5  # a prediction that is off by less counts as right
CHANNELS = ("torque",)


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """One effect of the hinge at one size; its numbers are not to be reported."""
    scenes: tuple[str, ...] = SCENES
    """Scenes in which cases are run; existing cases of the others are summarised."""
    seeds: int = SEEDS
    """Cases of each effect at each tried size; the effect counts as found if it is found in all of them."""
    minutes: float = 0.0
    """No case is begun after this time; 0: all are run."""
    sum_only: bool = False
    """Run no case; summarise the existing ones."""
    seed: int = 0
    """Seed of all draws."""
    earlier: tuple[Path, ...] = ()
    """Folders of cases of earlier runs of the same search, which are used too."""
    runs: Path | None = None
    """Folder of the cases; default: runs/rehearse, of --quick below OUT."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of rehearse.json."""


def measured(where: Setting, seed: int) -> list[Recording]:
    """Two motions of a robot without hidden effects: their commands and the scatter of their repeats."""
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


def door_by_command(runs: Path) -> dict[str, Any]:
    """Wall and CPU seconds of the quick form on the built-in door, as a command; kept."""

    def made() -> dict[str, Any]:
        out = runs / "door_command"
        subprocess.run([sys.executable, "-m", "droid_jax.run", "rehearse", "--out", str(out)], check=True, cwd=ROOT)
        seconds = json.loads((out / "rehearsal.json").read_text())["seconds"]
        return {"seconds": seconds["whole"], "cpu_seconds": seconds["cpu"], "code": CODE.get("git")}

    return kept(runs / "door_command.json", made)


def rehearsal_of(name: str, runs: Path, seed: int, full: bool) -> tuple[dict[str, Any], Scene, FullRehearsal | None]:
    """The quick rehearsal of a scene, kept; the scene; and the shared data of its complete rehearsals."""
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
        _, found = quick_rehearsal(where.scene, where.base, effects, recordings, plan, config, rehearsal)
        return plain({**found, "code": CODE.get("git"), "whole_seconds": time.monotonic() - began})

    quick = kept(runs / f"quick_{name}_seed{seed}.json", made)
    if not full:
        return quick, where.scene, None
    settings = {**quick_settings("quick"), "samples": 0}
    identify = IdentifyConfig(search=search_config("quick", seed), refine=refine_config("quick"), **settings)
    found = rehearsed(where.scene, where.base, effects, recordings, plan, config, rehearsal, step_error=False)
    return (
        quick,
        where.scene,
        FullRehearsal(
            where.scene, where.base, effects, tuple(recordings), plan, config, identify, rehearsal, found, seed
        ),
    )


def asked(quick: Mapping[str, Any], scene: Scene) -> list[dict[str, Any]]:
    """One place and coefficient of each effect that the synthetic robot has a law of its own for."""
    best: dict[str, dict[str, Any]] = {}
    for entry in quick["effects"]:
        if entry["smallest"] is None or not hidden_case(scene, 0, entry, 1.0).hidden:
            continue
        known = best.get(entry["effect"])
        if known is None or entry["smallest"] < known["smallest"]:
            best[entry["effect"]] = entry
    return list(best.values())


def next_step(steps: Mapping[float, bool]) -> float | None:
    """The size to try next, given the results at `steps`; None where the smallest found size is known."""
    rungs = list(LADDER)
    if not steps:
        return 1.0
    found = [t for t, f in steps.items() if f]
    if found:
        below = rungs.index(min(found)) - 1
        return rungs[below] if below >= 0 and rungs[below] not in steps else None
    above = rungs.index(max(steps)) + 1
    return rungs[above] if above < len(rungs) else None


def cases_at(scene: Scene, entry: Mapping[str, Any], index: int, times: float, seeds: int) -> list[HiddenCase]:
    """The cases of one effect at one size."""
    rung = LADDER.index(times)
    return [hidden_case(scene, 1000 * seed + 100 * rung + index, entry, times) for seed in range(seeds)]


def kept_case(folder: Path, case: HiddenCase) -> dict[str, Any] | None:
    """The result of a case, if it exists."""
    path = folder / case.name / "result.json"
    return json.loads(path.read_text()) if path.is_file() else None


def staircase(
    of: FullRehearsal | None,
    scene: Scene,
    entry: Mapping[str, Any],
    index: int,
    arguments: Arguments,
    folder: Path,
    late: Callable[[], bool],
) -> list[dict[str, Any]]:
    """The cases of one effect, made as far as time allows."""
    steps, made, seeds = dict[float, bool](), list[dict[str, Any]](), 1 if arguments.quick else arguments.seeds
    while (times := next_step(steps)) is not None:
        found = list[bool]()
        for case in cases_at(scene, entry, index, times, seeds):
            result = kept_case(folder, case)
            if result is None and of is not None and not late():
                with claimed(folder / case.name / "result.json", wait=True):
                    result = run_case(of, case, folder)
                named = " + ".join(result["effects"]) or result["verdict"]
                print(f"{case.name}: {named}, {result['seconds']:.0f} s {result.get('error', '')}", flush=True)
            if result is None:
                return made
            made.append(result)
            found.append(bool(result["found"]))
        steps[times] = all(found)
        if arguments.quick:
            break
    return made


def earlier_cases(folders: Sequence[Path], scene: str, entry: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Cases of earlier runs with the same coefficient hidden at the same place."""
    found = [json.loads(p.read_text()) for f in folders for p in sorted((f / scene).glob("*/result.json"))]
    wanted = ("effect", "location", "coefficient", "shape")
    return [c for c in found if c["verdict"] != "error" and all(c[n] == entry[n] for n in wanted)]


def measured_size(entry: Mapping[str, Any], cases: Sequence[Mapping[str, Any]]) -> float | None:
    """Ratio of the smallest size found to the predicted one; inf where none is found; None where not known yet.

    It is known if a smaller size was not found, or if none was found up to twice the predicted size.
    """
    times = {round(c["size"] / entry["smallest"], 3) for c in cases}
    known = {t: all(c["found"] for c in cases if round(c["size"] / entry["smallest"], 3) == t) for t in times}
    missed = max((t for t, f in known.items() if not f), default=0.0)
    found = min((t for t, f in known.items() if f and t > missed), default=np.inf)
    if np.isinf(found):
        return np.inf if missed >= LADDER[-1] else None
    return found if missed or found <= LADDER[0] else None


def judged(entry: Mapping[str, Any], cases: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One effect: at which multiples of the predicted size it was found, and which of them is the smallest."""
    steps = sorted({round(c["size"] / entry["smallest"], 3) for c in cases})
    rates = {t: [bool(c["found"]) for c in cases if round(c["size"] / entry["smallest"], 3) == t] for t in steps}
    ratio = measured_size(entry, cases)
    promise = DEFAULT_REHEARSAL.promise
    return {
        "effect": entry["effect"],
        "location": entry["location"],
        "predicted": entry["smallest"],
        "sure": entry["law"] is None or entry["law"]["sure"],
        "unit": entry["unit"],
        "limit": entry["limit"],
        "form": cases[0]["form"] if cases else None,
        "amplitude_over_size": cases[0]["amplitude"] / cases[0]["size"] if cases else None,
        "found": {f"{t:g}": [int(sum(f)), len(f)] for t, f in rates.items()},
        "measured_over_predicted": None if ratio is None or not np.isfinite(ratio) else ratio,
        "not_found_at_twice": bool(ratio == np.inf),
        "missed": any(t > CLOSE and not all(f) for t, f in rates.items()),
        "promised": promise * entry["smallest"] <= entry["bound"],
        "missed_at_promised": any(t > CLOSE * promise and not all(f) for t, f in rates.items()),
        "within": None if ratio is None else bool(1 / FACTOR <= ratio <= FACTOR),
        "answers": [c["sentence"] if "sentence" in c else c["error"] for c in cases],
    }


def summary(by_scene: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Shares over the effects whose smallest size is known.

    Wrong advice: an effect that would surely be found was not found at the promised size (`RehearsalConfig.promise`) or
    above.  Nothing is promised beyond the bounds of the search.
    """
    done = [e for effects in by_scene.values() for e in effects if e["within"] is not None]
    every = [e for effects in by_scene.values() for e in effects if e["sure"] and e["promised"]]
    advised = [e for e in every if e["within"] is not None or any(float(t) > CLOSE for t in e["found"])]
    sure = [e for e in done if e["sure"]]
    return {
        "effects": len(done),
        "within_factor": float(np.mean([e["within"] for e in done])) if done else None,
        "advised": len(advised),
        "wrong_advice_rate": float(np.mean([e["missed_at_promised"] for e in advised])) if advised else None,
        "missed_at_predicted_rate": float(np.mean([e["missed"] for e in advised])) if advised else None,
        "sure": len(sure),
        "within_factor_of_sure": float(np.mean([e["within"] for e in sure])) if sure else None,
        "unsure_not_found": sum(e["not_found_at_twice"] for e in done if not e["sure"]),
    }


def main(arguments: Arguments) -> None:
    """Run the missing cases, and summarise all."""
    began = time.monotonic()
    runs = arguments.runs or (arguments.out if arguments.quick else ROOT / "runs") / "rehearse"
    runs = runs / ("quick" if arguments.quick else f"seed{arguments.seed}")
    scenes = ("hinge",) if arguments.quick else arguments.scenes
    effects, seconds, case_seconds = dict[str, list[dict[str, Any]]](), dict[str, float](), list[float]()
    cpu = dict[str, float]()
    for scene in SCENES:
        if scene not in scenes and not (runs / f"quick_{scene}_seed{arguments.seed}.json").is_file():
            continue
        quick, model, of = rehearsal_of(scene, runs, arguments.seed, not arguments.sum_only)
        seconds[scene], cpu[scene] = quick["whole_seconds"], quick["seconds"]["cpu"]

        def late(scene: str = scene) -> bool:
            over = bool(arguments.minutes) and time.monotonic() - began > 60 * arguments.minutes
            return over or arguments.sum_only or scene not in scenes

        entries = asked(quick, model)[: 1 if arguments.quick else None]
        effects[scene] = []
        for index, entry in enumerate(entries):
            made = earlier_cases(arguments.earlier, scene, entry)
            if measured_size(entry, made) is None:
                made += staircase(of, model, entry, index, arguments, runs / scene, late)
            case_seconds += [c["seconds"] for c in made]
            effects[scene].append(judged(entry, made))
    whole, door = summary(effects), {}
    if not arguments.quick and ("door" in scenes or (runs / "door_command.json").is_file()):
        door = door_by_command(runs)
    result = {
        **whole,
        "seconds_door": door.get("seconds"),
        "cpu_seconds_door": door.get("cpu_seconds"),
        "code_door": door.get("code"),
        "seconds_quick": seconds,
        "cpu_seconds_quick": cpu,
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
