"""Physics steps per second of the door's replay: this program, the C engine, and MJX with default settings.

    python benchmarks/throughput.py                # everything; 20 to 40 minutes on two cores
    python benchmarks/throughput.py --quick        # does it all work?  about two minutes

Needs the package installed (`pip install -e .`), or the checkout on PYTHONPATH.

A step is 2 ms of one sample.  Every engine replays demonstration A (a whole opening, with grasp
contact) for the same random samples with the same cone and time step.  C and `mjx.step` have the model's own solver
options and integrator, the replay its own step and solver (`solver_options` in the result); replay and C take turns.
"Own blocks" is the replay as a search runs it, on a CPU with a kernel for the whole loop; "one block" has a kernel for
each operation.
Writes OUT/throughput.json, prints a table and, as the last line, one line of JSON.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import tyro
from common import in_process, interleave, origin, peak_memory_gib, stem
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from droid_jax import runtime
from droid_jax.storage import write_json

CPU_POPULATIONS = tuple(2**k for k in range(11))  # 1 to 1024
GPU_POPULATIONS = tuple(2**k for k in range(15))  # 1 to 16384
QUICK_POPULATIONS = (2, 64)
QUICK_STEPS = 200
HEADLINE = 256  # samples behind the numbers of the last line
MEMORY_POPULATION = 1024
BARE_POPULATION = 32
UNTUNED_STEPS = 20  # as it comes, MJX on a CPU takes half a minute for these
OWN, WHOLE, C = "replay, own blocks", "replay, one block", "C, all cores"
UNTUNED, OPTION, SHARDED = "MJX as it comes", "mjx.step, option", "mjx.step, sharded"


@dataclass(frozen=True)
class Throughput:
    """Physics steps per second of the door's replay: MJX here, the C engine, and MJX as it comes.

    quick: 200 steps and two populations, to see that everything works; its numbers mean little.
    out: folder for throughput.json.
    populations: samples at once; default 1, 2, 4 ... 1024 on a CPU, to 16384 on an accelerator.
    steps: steps of 2 ms, from the start; default the whole demonstration.
    repeats: timed runs of each, after one that compiles; the median counts.
    seed: of the random samples.
    untuned: measure MJX with default settings; auto is yes unless quick.
    timeout: s that each separate process (MJX with default settings, memory) may take.
    part: all; the others are started by it in processes of their own.
    """

    quick: bool = False
    out: Path = Path(__file__).parent / "results"
    populations: tuple[int, ...] = ()
    steps: int | None = None
    repeats: int = 3
    seed: int = 0
    untuned: Literal["auto", "yes", "no"] = "auto"
    timeout: float = 1800.0
    part: Literal["all", "untuned", "memory"] = "all"

    def __post_init__(self) -> None:
        if any(p < 1 for p in self.populations):
            raise ValueError(f"populations: expected at least 1 sample each, got {self.populations}")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps: expected at least 1, got {self.steps}")
        if self.repeats < 1:
            raise ValueError(f"repeats: expected at least 1, got {self.repeats}")

    @property
    def length(self) -> int | None:
        """Steps to replay; None for the whole demonstration."""
        return QUICK_STEPS if self.steps is None and self.quick else self.steps


@dataclass(frozen=True)
class Row:
    """A line of the table: `population` samples of `steps` steps took `seconds`, the median run.

    compile_s: s that the first run took longer; None where nothing is compiled.
    """

    engine: str
    population: int
    steps: int
    seconds: float
    compile_s: float | None

    @property
    def rate(self) -> float:
        """Physics steps per second."""
        return self.population * self.steps / self.seconds


def time_rows(
    runs: dict[str, Callable[[], Any]], population: int, steps: int, repeats: int, done: Callable[[], Any]
) -> list[Row]:
    """One row for each run, by engine; they take turns."""
    first, median = interleave(runs, repeats, done)
    return [
        Row(name, population, steps, seconds, None if name == C else max(0.0, first[name] - seconds))
        for name, seconds in median.items()
    ]


def untuned_part(config: Throughput) -> dict[str, Any]:
    """MJX with default settings, for a process in which `tune` was not called."""
    with runtime.quiet():
        import replays

    case = replays.make_case(config.seed, UNTUNED_STEPS)
    runs = {UNTUNED: replays.mjx_on_one_device(case, BARE_POPULATION)}
    (row,) = time_rows(runs, BARE_POPULATION, case.steps, config.repeats, lambda: None)
    return asdict(row)


def memory_part(config: Throughput) -> dict[str, Any]:
    """Peak memory of one population in a process of its own, with compilation and results."""
    tune()
    with runtime.quiet():
        import replays

    case = replays.make_case(config.seed, config.length)
    rollout = replays.in_blocks(case)(case.values(config.populations[0]))
    return {"population": len(rollout.finite), "steps": case.steps, "gib": peak_memory_gib()}


def tune() -> None:
    """Tune jax as the program does, but without a compilation cache, since compile times are a result."""
    runtime.tune()
    import jax

    jax.config.update("jax_enable_compilation_cache", False)


def child(config: Throughput, part: str, **options: Any) -> dict[str, Any]:
    """Run one part in a process of its own; {"error": ...} where it fails or takes too long."""
    asked = {"part": part, "seed": config.seed, "repeats": config.repeats, **options}
    arguments = [str(a) for k, v in asked.items() if v is not None for a in (f"--{k}", v)]
    tuned = ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES") if part == "untuned" else ()
    environment = {k: v for k, v in os.environ.items() if k not in tuned}
    return in_process(__file__, arguments, config.timeout, environment)


def alternate(case: Any, populations: Sequence[int], repeats: int, progress: Progress) -> list[Row]:
    """The replay of this program and the C engine in turn, for every population; then mjx.step itself."""
    import replays

    search = replays.in_blocks(case)  # on a CPU one compiled program serves every population
    task = progress.add_task("", total=3 * (len(populations) + 1) * (repeats + 1))
    rows: list[Row] = []

    def take(runs: dict[str, Callable[[], Any]], population: int) -> None:
        progress.update(task, description=f"{', '.join(runs)}: {population} samples")
        rows.extend(time_rows(runs, population, case.steps, repeats, lambda: progress.advance(task)))

    for population in populations:
        values = case.values(population)
        take(
            {
                OWN: lambda values=values: search(values),
                WHOLE: replays.as_one_block(case, population),
                C: replays.c_engine(case, population),
            },
            population,
        )
    take(
        {
            OPTION: replays.mjx_on_one_device(case, BARE_POPULATION, runtime.compiler_options()),
            SHARDED: replays.mjx_on_all_devices(case, BARE_POPULATION),
            C: replays.c_engine(case, BARE_POPULATION),
        },
        BARE_POPULATION,
    )
    return rows


def agreement(case: Any) -> dict[str, float]:
    """Difference of both engines: median over samples of the RMS torque difference, N m.

    It is small but not zero, because the replay is of second order in the time step and C of first order.
    finite: share of the MJX samples without NaN or infinity.
    """
    import replays

    rollout = replays.in_blocks(case)(case.values(BARE_POPULATION))
    torque = replays.c_engine(case, BARE_POPULATION)()
    difference = np.sqrt(np.mean((np.asarray(rollout.torque) - torque) ** 2, axis=(1, 2)))
    return {"torque_difference_n_m": float(np.nanmedian(difference)), "finite": float(np.mean(rollout.finite))}


def solver_options(scene: Any) -> dict[str, Any]:
    """Cone, time step [s] and solver limits; C and mjx.step have the model's, the replay has its own."""
    from droid_jax.model import step

    option = scene.model.opt
    return {
        "timestep": float(option.timestep),
        "cone": mujoco.mjtCone(int(option.cone)).name.removeprefix("mjCONE_").lower(),
        "integrator": mujoco.mjtIntegrator(int(option.integrator)).name.removeprefix("mjINT_").lower(),
        "iterations": int(option.iterations),
        "ls_iterations": int(option.ls_iterations),
        "replay_iterations": step.ITERATIONS,
        "replay_line_search": step.LINE_SEARCH,
    }


def headline(rows: Sequence[Row], untuned: dict[str, Any] | None, memory: dict[str, Any]) -> dict[str, Any]:
    """The numbers of the last line: this program's own blocks against C, at 256 samples where measured."""
    measured = [row.population for row in rows if row.engine == OWN]
    population = HEADLINE if HEADLINE in measured else max(measured)

    def beside(population: int) -> dict[str, Row]:
        # C is measured once more beside mjx.step: the first row of a name is the replay's partner.
        return {row.engine: row for row in reversed(rows) if row.population == population}

    at, few = beside(population), beside(BARE_POPULATION)
    bare = {row.engine: row.rate for row in rows}
    return {
        "population": population,
        "mjx_steps_per_s": at[OWN].rate,
        "mjx_one_block_steps_per_s": at[WHOLE].rate,
        "c_steps_per_s": at[C].rate,
        "ratio_to_c": at[OWN].rate / at[C].rate,
        "ratio_to_c_32": few[OWN].rate / few[C].rate if OWN in few else None,
        "mjx_step_option_steps_per_s": bare[OPTION],
        "mjx_step_all_devices_steps_per_s": bare[SHARDED],
        "untuned_steps_per_s": Row(**untuned).rate if untuned and "error" not in untuned else None,
        "compile_s": max(row.compile_s or 0.0 for row in rows if row.engine == OWN),
        "peak_memory_gib": memory.get("gib"),
    }


def table_of(rows: Sequence[Row]) -> Table:
    """All rows; the last column compares with the C engine at the same number of samples, when it took turns."""
    table = Table(title="Physics steps per second")
    for name in ("engine", "samples", "steps", "compile s", "run s", "steps/s", "of C"):
        table.add_column(name, justify="left" if name == "engine" else "right")
    c = dict[int, float]()
    for row in rows:
        if row.engine == C:
            c.setdefault(row.population, row.rate)
    for row in rows:
        compiling = "" if row.compile_s is None else f"{row.compile_s:.1f}"
        share = f"{row.rate / c[row.population]:.2g}" if row.population in c else ""
        counts = (str(row.population), str(row.steps))
        table.add_row(row.engine, *counts, compiling, f"{row.seconds:.2f}", f"{row.rate:,.0f}", share)
    return table


def measure(config: Throughput) -> dict[str, Any]:
    """Everything, as one JSON object."""
    with Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=Console(stderr=True),
    ) as progress:  # fmt: skip
        # Processes of their own come first: an accelerator's memory is still free then.
        task = progress.add_task("memory", total=2)
        most = max(config.populations or (64 if config.quick else MEMORY_POPULATION,))
        memory = child(config, "memory", populations=most, steps=config.length)
        progress.update(task, advance=1, description=UNTUNED)
        skip = config.untuned == "no" or (config.untuned == "auto" and config.quick)
        untuned = None if skip else child(config, "untuned")
        progress.advance(task)

        tune()
        import jax

        with runtime.quiet():
            import replays
        standard = CPU_POPULATIONS if jax.default_backend() == "cpu" else GPU_POPULATIONS
        populations = config.populations or (QUICK_POPULATIONS if config.quick else standard)
        case = replays.make_case(config.seed, config.length)
        rows = alternate(case, populations, config.repeats, progress)
        same = agreement(case)
    if untuned and "error" not in untuned:
        rows.append(Row(**untuned))
    return {
        **headline(rows, untuned, memory),
        "quick": config.quick,
        "steps": case.steps,
        "repeats": config.repeats,
        **solver_options(case.scene),
        **same,
        "memory": memory,
        "untuned": untuned,
        **origin(config.seed),
        "rows": [{**asdict(row), "steps_per_s": row.rate} for row in rows],
    }


def main(config: Throughput) -> None:
    """Run one part and print its JSON line, or everything: file, table, JSON line."""
    if config.part != "all":
        result = untuned_part(config) if config.part == "untuned" else memory_part(config)
    else:
        result = measure(config)
        write_json(config.out / f"{stem('throughput', config.quick)}.json", result, indent=2)
        rows = [Row(**{k: v for k, v in row.items() if k != "steps_per_s"}) for row in result["rows"]]
        Console().print(table_of(rows))
    print(json.dumps(result))


if __name__ == "__main__":
    main(tyro.cli(Throughput, description=__doc__))
