"""All benchmarks on a GPU, in one run of at most eight minutes.

    python benchmarks/gpu.py [--quick] [--out DIR] [--only PART ...] [--seconds 480]

Packages, beside this one's own (`pip install -e ".[train]"`): jax[cuda13] (or jax[cuda12], as the driver has it), with
the version of jaxlib; for the part "warp" also warp-lang.  On a machine without network, bring as wheels: jax, jaxlib,
jax-cuda13-plugin, jax-cuda13-pjrt and the nvidia-* packages that they name, mujoco, mujoco-mjx, brax, flax, optax,
orbax-checkpoint, evosax, scipy, msgspec, filelock, tyro, rich, matplotlib, jinja2, markupsafe, pillow, warp-lang.

Each part runs in a separate process with its share of the time.  Where one fails or is stopped, its measurements so far
are kept and the others run:

| part | measures |
|---|---|
| c | physics steps per second of the door in the C engine, on all cores of this machine |
| jax | the same of this program's replay, populations 32 to 65536, compiled side by side |
| warp | the same of mjx.step with MuJoCo Warp (`mjx.put_model(impl="warp")`), or why there is none |
| fit | a CMA-ES search of the paper's size: 30 samples, 100 generations, one opening |
| ppo | training of the preset "gpu": simulation steps per second, time to 95 % success |
| gap | a search for the missing effect of one door (a hidden magnetic catch) |

Replay and C engine step the same samples through the first STEPS steps of demonstration A.  Warp steps one model from
the same start under the same commands, without parameter samples, so that only the simulation is compared.
Writes DIR/gpu.json after every part, and one line of JSON at the end.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks"), str(ROOT / "experiments")]

import tyro  # noqa: E402

from benchmarks.common import CODE, empty_cache, origin, peak_memory_gib, stem  # noqa: E402
from droid_jax import runtime  # noqa: E402
from droid_jax.quiet import import_mjx  # noqa: E402
from droid_jax.storage import write_json  # noqa: E402

SHARES = {"c": 1.0, "jax": 5.0, "warp": 4.0, "fit": 3.0, "ppo": 6.0, "gap": 4.0}  # of the time, in this order
POPULATIONS = (32, 256, 1024, 4096, 16384, 65536)
WARP_POPULATIONS = (1024, 16384, 256, 4096)
STEPS, QUICK_STEPS = 1000, 50  # of 2 ms
QUICK_SECONDS = 5.0  # of a demonstration: the door moves in it
REPEATS = 2  # timed calls, after one that compiles
LEAVING = 8.0  # s that a part keeps to end by itself
STARTING = 0.35  # share of a measurement's time that the next one, of the same kind, may take longer
ENOUGH = 0.95  # success in the evaluations during training
HIDDEN = {"magnetic_catch": 1.5}  # N m
CONTACTS = 64  # of a world that Warp holds
ROWS = 256  # constraints of a world that Warp holds


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """Small sizes on any device: shows that it runs; its numbers mean nothing."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of gpu.json."""
    only: tuple[str, ...] = tuple(SHARES)
    """Parts to run; results of the others from an earlier run of the same code and samples are kept."""
    seconds: float | None = None
    """Seconds for all parts together; default: 480, with --quick 220."""
    seed: int = 0
    """Seed of the samples, the search, the robot and the policy."""
    commit: str = CODE.get("git", "")
    """Commit of the code, where git is missing."""
    part: str = ""
    """Run this part in this process, and write to --kept; used by the script itself."""
    kept: Path = Path()
    """File of a part's results."""
    until: float = 0.0
    """End of the part's time, s since 1970."""

    def __post_init__(self) -> None:
        if unknown := [part for part in (*self.only, self.part) if part and part not in SHARES]:
            raise SystemExit(f"error: there is no part {', '.join(unknown)}; there are {', '.join(SHARES)}")

    @property
    def limit(self) -> float:
        """s for all parts."""
        return self.seconds if self.seconds is not None else 220.0 if self.quick else 480.0


class Measuring:
    """Measurements of a part so far, written to disk after every addition, and its remaining time."""

    def __init__(self, arguments: Arguments) -> None:
        self.arguments = arguments
        self._until = (arguments.until or time.time() + arguments.limit) - LEAVING
        self.found: dict[str, Any] = {}

    @property
    def left(self) -> float:
        """s."""
        return self._until - time.time()

    def keep(self, **found: Any) -> None:
        """Add measurements, and write all to disk."""
        self.found |= found
        write_json(self.arguments.kept, self.found)

    def while_there_is_time(self, items: Sequence[Any]) -> Iterator[Any]:
        """Yields the first item, and others while the next should end in time; the rest is recorded as left out."""
        longest = 0.0
        for number, item in enumerate(items):
            if number and longest * (1 + STARTING) > self.left:
                self.keep(no_time_for=list(items[number:]))
                return
            began = time.monotonic()
            yield item
            longest = max(longest, time.monotonic() - began)


def of_c(now: Measuring) -> None:
    """The C engine on all cores."""
    import replays
    from common import interleave

    case = replays.make_case(now.arguments.seed, _steps(now))
    rows = []
    for population in now.while_there_is_time((32,) if now.arguments.quick else (256, 1024)):
        _, median = interleave({"c": replays.c_engine(case, population)}, REPEATS)
        rows.append(_row(population, case.steps, median["c"]))
        now.keep(rows=rows, cores=runtime.cores(), steps_per_s=max(row["steps_per_s"] for row in rows))


def of_jax(now: Measuring) -> None:
    """This program's replay, every population as one block."""
    import replays

    case = replays.make_case(now.arguments.seed, _steps(now))
    _throughput(now, case.steps, POPULATIONS, lambda population: replays.as_one_block(case, population), True)


def of_warp(now: Measuring) -> None:
    """mjx.step with MuJoCo Warp."""
    try:
        import mujoco.mjx.third_party.mujoco_warp  # noqa: F401
        import warp  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        now.keep(not_available=f"{type(error).__name__}: {error}")
        return
    import replays

    case = replays.make_case(now.arguments.seed, _steps(now))
    _throughput(now, case.steps, WARP_POPULATIONS, lambda population: _warp(case, population))


def _warp(case: Any, population: int) -> Callable[[], Any]:
    """A run of `population` worlds of one model through a command: it returns their joint torques, [P, T, nu]."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    put, make = mjx.put_model, mjx.make_data
    model: Any = put(case.scene.model, impl="warp")
    limits = {"naconmax": CONTACTS * population, "njmax": ROWS}
    command = jnp.asarray(case.drive.command, jnp.float32)
    start = jnp.asarray(case.drive.qpos0, jnp.float32)

    @jax.jit
    def run(qpos: jax.Array) -> jax.Array:
        data: Any = jax.vmap(lambda q: make(case.scene.model, impl="warp", **limits).replace(qpos=q))(qpos)

        def step(data: Any, ctrl: jax.Array) -> tuple[Any, jax.Array]:
            data = jax.vmap(lambda d: mjx.step(model, d.replace(ctrl=ctrl)))(data)
            return data, data.actuator_force

        return jax.lax.scan(step, data, command)[1]

    many = jnp.tile(start[None], (population, 1))
    return lambda: jax.block_until_ready(run(many))


def _throughput(
    now: Measuring,
    steps: int,
    populations: Sequence[int],
    make: Callable[[int], Callable[[], Any]],
    side_by_side: bool = False,
) -> None:
    """Each population's speed.  side_by_side: of the first calls, which compile."""
    from common import interleave

    asked = (32, 64) if now.arguments.quick else populations
    runs = {population: make(population) for population in asked}
    compiled: dict[int, float] = {}
    failed: dict[int, str] = {}
    with ThreadPoolExecutor(len(runs) if side_by_side else 1) as pool:
        firsts = {pool.submit(_timed, run): population for population, run in runs.items()}
        for done in as_completed(firsts):
            try:
                compiled[firsts[done]] = done.result()
            except Exception as error:  # out of memory at the largest: the others stay
                failed[firsts[done]] = f"{type(error).__name__}: {error!s:.300}"
                now.keep(failed=failed)
            else:
                now.keep(first_call_s=compiled)
    rows = []
    for population in sorted(compiled):
        _, median = interleave({"run": runs[population]}, REPEATS)
        rows.append(_row(population, steps, median["run"]))
        now.keep(rows=rows, steps_per_s=max(row["steps_per_s"] for row in rows), peak_gib=peak_memory_gib())


def _timed(run: Callable[[], Any]) -> float:
    """s of one call."""
    began = time.monotonic()
    run()
    return time.monotonic() - began


def of_fit(now: Measuring) -> None:
    """CMA-ES of the paper's size; stopped where time is short."""
    import time_to_fit

    quick = now.arguments.quick
    found = time_to_fit.fit(2 if quick else time_to_fit.GENERATIONS, most=max(1.0, 0.8 * now.left))
    took = found["seconds"] - found["first_generation_s"]
    now.keep(
        **found,
        whole=quick or found["generations"] == time_to_fit.GENERATIONS,
        generation_s=took / max(1, found["generations"] - 1),
        after_compilation_s=took,
    )


def of_ppo(now: Measuring) -> None:
    """PPO on doors drawn from the prior, until it succeeds in 95 % of an evaluation or time is short."""
    from droid_jax.door.environment import DoorEnv
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space
    from droid_jax.door.task import Task
    from droid_jax.identify.gaussian import prior
    from droid_jax.policy.randomise import randomised
    from droid_jax.policy.train import PRESETS, TrainProgress, train
    from experiments.policies.cases import TIMESTEP, Options

    quick = now.arguments.quick
    scene = door_scene(timestep=TIMESTEP, limits=True)
    budget = Options(quick=quick, preset="gpu", evaluations=PRESETS["gpu"].evaluations).budget
    env = DoorEnv(scene, budget.task(Task()))
    doors = randomised(scene, prior(door_space(scene) + door_nuisances(scene)))
    physics = round(env.task.control / TIMESTEP)  # steps of the simulation in an action
    history: list[TrainProgress] = []

    class Enough(Exception):
        pass

    def tell(at: TrainProgress) -> None:
        history.append(at)
        rates = [h.rate for h in history[2:]]  # before, it compiled
        rate = sum(rates) / len(rates) if rates else None
        there = [h for h in history if h.success >= ENOUGH]
        now.keep(
            actions_per_s=rate,
            steps_per_s=None if rate is None else physics * rate,
            seconds_to_95=there[0].seconds if there else None,
            first_evaluation_s=history[0].seconds,
            history=[asdict(h) for h in history],
        )
        longest = max((b.seconds - a.seconds for a, b in itertools.pairwise(history)), default=0.0)
        if there or longest * (1 + STARTING) > now.left:
            raise Enough

    with contextlib.suppress(Enough):
        train(env, doors, replace(budget.config, seed=now.arguments.seed), progress=tell)
    now.keep(envs=budget.config.envs, whole=now.found["seconds_to_95"] is not None or quick)


def of_gap(now: Measuring) -> None:
    """A whole search on the built-in door with a hidden effect, as the command makes it with its preset."""
    from droid_jax.commands.synthetic import DEMONSTRATIONS
    from droid_jax.discrepancy.config import DiscrepancyConfig
    from droid_jax.discrepancy.missing import find_missing_effects
    from droid_jax.door.demonstration import demonstration_path
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space
    from droid_jax.identify.multistart import RefineConfig
    from droid_jax.identify.search import CmaConfig
    from droid_jax.model.effects.registry import library
    from droid_jax.recordings.formats import load_recording
    from droid_jax.synthetic.hidden_effects import record_hidden
    from droid_jax.synthetic.robot import synthetic_truth

    began = time.monotonic()
    quick, seed = now.arguments.quick, now.arguments.seed
    scene = door_scene(timestep=0.004)
    space = door_space(scene) + door_nuisances(scene)
    truth = synthetic_truth(scene, 1, seed)
    recordings = []
    for number, name in enumerate(("A", "C") if quick else DEMONSTRATIONS.values()):
        demonstration = load_recording(demonstration_path(name))
        if quick:
            demonstration = demonstration.window(
                float(demonstration.time[0]), float(demonstration.time[0]) + QUICK_SECONDS
            )
        recordings.append(record_hidden(scene, demonstration, truth, HIDDEN, seed=1000 * seed + number, name=name))
        now.keep(recorded_s=time.monotonic() - began)
    config, effects = DiscrepancyConfig(seed=seed, budget_minutes=max(0.1, 0.5 * now.left / 60)), None
    if quick:
        few = RefineConfig(iterations=1, basin_hops=0, spreads=0)
        search = CmaConfig(population=8, parents=None, generations=1)
        config = replace(config, search=search, refine=few, refit=few, polish=few, max_effects=1, full_refits=1)
        effects = library(scene, ("hinge_preload",))
    stages: dict[str, float] = {}
    since = [time.monotonic(), "compile"]

    def tell(stage: str, _: Any) -> None:
        at = time.monotonic()
        stages[since[1]] = stages.get(since[1], 0.0) + at - since[0]
        since[:] = [at, stage]
        now.keep(stages=stages, whole=False)

    verdict, _ = find_missing_effects(scene, space, recordings, effects=effects, config=config, progress=tell)
    tell("end", None)
    now.keep(whole=True, seconds=time.monotonic() - began, sentence=verdict.sentence, hidden=HIDDEN)


PARTS: dict[str, Callable[[Measuring], None]] = {
    "c": of_c, "jax": of_jax, "warp": of_warp, "fit": of_fit, "ppo": of_ppo, "gap": of_gap,
}  # fmt: skip


def _steps(now: Measuring) -> int:
    return QUICK_STEPS if now.arguments.quick else STEPS


def _row(population: int, steps: int, seconds: float) -> dict[str, Any]:
    return {"population": population, "steps": steps, "seconds": seconds, "steps_per_s": population * steps / seconds}


def run_part(arguments: Arguments) -> None:
    """One part, in this process."""
    if arguments.part == "c":  # the replay's module imports jax, which need not take the GPU's memory
        os.environ["JAX_PLATFORMS"] = "cpu"
    runtime.tune()
    import_mjx()
    now = Measuring(arguments)
    import jax

    now.keep(platform=jax.default_backend())
    PARTS[arguments.part](now)


def in_own_process(part: str, arguments: Arguments, seconds: float, cache: str) -> dict[str, Any]:
    """Measurements of a part within a time limit; "error" states why it did not end."""
    kept = Path(cache) / f"{part}.json"
    options = {"part": part, "kept": kept, "until": time.time() + seconds, "seed": arguments.seed}
    words = [sys.executable, __file__, *(str(word) for k, v in options.items() for word in (f"--{k}", v))]
    began = time.monotonic()
    wrong = {}
    with (Path(cache) / f"{part}.log").open("w+", errors="replace") as log:
        process = subprocess.Popen(
            [*words, *(["--quick"] if arguments.quick else [])], env=empty_cache(cache), stdout=log, stderr=log
        )
        try:
            if code := process.wait(seconds):
                log.seek(0)
                wrong = {"error": f"exit status {code}", "said": log.read().strip().splitlines()[-12:]}
        except subprocess.TimeoutExpired:
            wrong = {"error": f"stopped after {seconds:.0f} s"}
        finally:
            process.kill()
            process.wait()
    found = json.loads(kept.read_text()) if kept.is_file() else {}
    return {**found, **wrong, "part_s": time.monotonic() - began}


def headline(parts: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The main figures; None where they were not measured."""

    def of(part: str, name: str) -> Any:
        return parts.get(part, {}).get(name)

    jax_rate, c_rate, warp_rate = (of(part, "steps_per_s") for part in ("jax", "c", "warp"))
    return {
        "platform": of("jax", "platform"),
        "jax_steps_per_s": jax_rate,
        "warp_steps_per_s": warp_rate,
        "warp_not_available": of("warp", "not_available"),
        "c_steps_per_s": c_rate,
        "c_cores": of("c", "cores"),
        "ratio_to_c": jax_rate / c_rate if jax_rate and c_rate else None,
        "warp_ratio_to_c": warp_rate / c_rate if warp_rate and c_rate else None,
        "fit_after_compilation_s": of("fit", "after_compilation_s") if of("fit", "whole") else None,
        "fit_generation_s": of("fit", "generation_s"),
        "gap_s": of("gap", "seconds"),
        "ppo_steps_per_s": of("ppo", "steps_per_s"),
        "ppo_seconds_to_95": of("ppo", "seconds_to_95"),
        "errors": {part: found["error"] for part, found in parts.items() if "error" in found},
    }


def main() -> None:
    arguments = tyro.cli(Arguments, description=__doc__)
    if arguments.part:
        run_part(arguments)
        return
    began = time.monotonic()
    parts: dict[str, dict[str, Any]] = {}
    path = arguments.out / f"{stem('gpu', arguments.quick)}.json"
    asked = [part for part in SHARES if part in arguments.only]
    machine = {"quick": arguments.quick, "commit": arguments.commit, "seed": arguments.seed}
    if arguments.commit and path.is_file() and (earlier := json.loads(path.read_text())).items() >= machine.items():
        parts |= earlier["parts"]
    with tempfile.TemporaryDirectory(prefix="gpu_") as cache:
        for number, part in enumerate(asked):
            left = arguments.limit - (time.monotonic() - began)
            share = left * SHARES[part] / sum(SHARES[p] for p in asked[number:])
            parts[part] = in_own_process(part, arguments, share, cache)
            write_json(path, {**headline(parts), **machine, "parts": parts}, indent=2)
            print(
                f"{part}: {parts[part]['part_s']:.0f} s of {share:.0f}, {parts[part].get('error', 'done')}", flush=True
            )
    seconds = time.monotonic() - began  # queried only now, so that the parts had the device's memory
    result = {**headline(parts), **origin(arguments.seed), **machine, "seconds": seconds, "parts": parts}
    write_json(path, result, indent=2)
    print(json.dumps({**headline(parts), "device": result["device"], "seconds": seconds}))


if __name__ == "__main__":
    main()
