"""Thousands of damaged files, damaged scenes and wrong arguments: is each refused with a clear message?

    python benchmarks/robustness.py [--quick] [--out DIR] [--only WORD ...]

Mutations of every kind of file that the program reads back (tests/fuzz/run_kinds.py) and every public function with
every wrong argument (tests/fuzz/api_calls.py), in worker processes that a watchdog ends.  An input must either be
accepted, with usable content, or refused by a ValueError or an OSError whose message is one line that names it.  A
stopped run can be continued; its results so far are in runs/robustness.  Numbers about kills of whole runs are read
from the result of benchmarks/kills.py in the same folder.
"""

from __future__ import annotations

import collections
import contextlib
import json
import multiprocessing
import os
import resource
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "experiments"), str(ROOT / "tests" / "fuzz")]

# ruff: noqa: E402  (what is imported lies in folders that are no packages)
# isort: split

import tuned  # noqa: F401  (before jax starts)

# isort: split

import api_calls
import kinds
import run_kinds
import tyro
from outcome import MOST_SECONDS, Outcome

from benchmarks.common import CODE, publish
from benchmarks.sharing import code_name

WORKERS = 2
STILL = 60.0  # s for which a worker may neither compute nor wait for a processor: it is blocked
ROOM = 16 << 30  # bytes of address space that a worker may map beyond what it has before its first case
TOO_MUCH = 2 << 30  # bytes of memory in use beyond that, at which a worker is ended at once
START, READY = 1800.0, "ready"  # s in which a worker must start; what it then says
SLOWER = 2.0  # than the valid page may a damaged one be
BEHIND = 5.0  # s of processor time beyond the limit that a worker is given to say by itself that it took too long
EXAMPLES = 5  # faults kept of each place in the code
ARGUMENTS = "arguments"
SEVERAL = 0.3  # share of calls with two wrong arguments

Case = tuple[str, int]  # kind, number


@dataclass(frozen=True)
class Arguments:
    """Options."""

    quick: bool = False
    """A hundredth of the cases."""
    files: int = 20_000
    """Mutated files."""
    arguments: int = 4_000
    """Calls with wrong arguments."""
    seed: int = 0
    """Seed of all mutations."""
    only: tuple[str, ...] = ()
    """Kinds whose name holds one of these words."""
    workers: int = WORKERS
    """Processes."""
    out: Path = ROOT / "benchmarks" / "results"
    """Folder of robustness.json."""


def main(arguments: Arguments) -> None:
    state = ROOT / "runs" / "robustness" / f"{code_name(CODE.get('git'))}_{arguments.seed}.jsonl"
    state.parent.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    asked = list(cases(arguments))
    found = {} if arguments.only else kept(state)
    waiting = collections.deque(case for case in asked if case not in found)
    lock = threading.Lock()
    with state.open("a") as file:

        def done(case: Case, outcome: Outcome) -> None:
            with lock:
                found[case] = outcome
                file.write(json.dumps([*case, outcome.to_json()]) + "\n")
                file.flush()
                if outcome.fault or len(found) % 1000 == 0:
                    print(f"{len(found)} of {len(asked)}: {case} {outcome}", file=sys.stderr, flush=True)

        def serve() -> None:
            worker = Worker(arguments.seed)
            with contextlib.closing(worker):
                while True:
                    try:
                        case = waiting.popleft()
                    except IndexError:
                        return
                    done(case, worker.judged_twice(case))

        threads = [threading.Thread(target=serve) for _ in range(arguments.workers)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    if missing := [case for case in asked if case not in found]:
        sys.exit(f"error: {len(missing)} cases were not tried, {missing[0]} the first: the next start goes on")
    result = summary({case: found[case] for case in asked}) | kills(arguments.out)
    result["seconds"] = round(time.monotonic() - began, 1)
    line = {key: result[key] for key in KEYS}
    publish(arguments.out, "robustness", arguments.quick or bool(arguments.only), arguments.seed, result, line)


def cases(arguments: Arguments) -> Iterator[Case]:
    """All cases, alternating between kinds."""
    share = 100 if arguments.quick else 1
    tried = run_kinds.EVERY.values()
    whole = sum(kind.weight for kind in tried)
    counts = {kind.name: max(3, round(arguments.files * kind.weight / whole / share)) for kind in tried}
    counts[ARGUMENTS] = max(3, arguments.arguments // share)
    if arguments.only:
        counts = {name: n for name, n in counts.items() if any(word in name for word in arguments.only)}
    last = {kind.name for kind in tried if kind.drawn}  # they are slow
    order = [(name in last, number / count, name, number) for name, count in counts.items() for number in range(count)]
    yield from ((name, number) for *_, name, number in sorted(order))


def kept(path: Path) -> dict[Case, Outcome]:
    """Results of an earlier run of the same code."""
    if not path.is_file():
        return {}
    lines = [json.loads(line) for line in path.read_text().splitlines() if line.endswith("]")]
    return {(name, number): Outcome(**outcome) for name, number, outcome in lines}


# ---------------------------------------------------------------- a worker and its watchdog


class Worker:
    """A process that tests one case after the other; restarted where a case ended it."""

    def __init__(self, seed: int) -> None:
        self.seed, self.process = seed, None
        self.pipe: Connection

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=serve_cases, args=(theirs, self.seed), daemon=True)
        self.process.start()
        theirs.close()
        said = self.pipe.recv() if self.pipe.poll(START) else "nothing"
        if said != READY:
            raise RuntimeError(f"a worker did not start, it said: {said}")

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None

    def judged_twice(self, case: Case) -> Outcome:
        """Test a case; one that took too long is tried once more, since the machine may have been busy."""
        outcome = self.judged(case)
        return self.judged(case) if outcome.result == "hang" else outcome

    def judged(self, case: Case) -> Outcome:
        if self.process is None:
            self._start()
        assert self.process is not None
        try:
            self.pipe.send(case)
            if not self.pipe.poll(START):  # it makes the kind's valid example: imports, and compiles
                raise RuntimeError(f"a worker did not begin with {case}")
            most = self.pipe.recv()
            used, held = processor_seconds(self.process.pid), resident(self.process.pid)
            moved, before = time.monotonic(), used
            while not self.pipe.poll(0.2):
                if resident(self.process.pid) - held > TOO_MUCH:
                    self.close()
                    return Outcome("memory", f"ended at {TOO_MUCH >> 20} MiB")
                now = processor_seconds(self.process.pid)
                if now > before or runnable(self.process.pid):
                    moved, before = time.monotonic(), now
                if now - used > most + BEHIND or time.monotonic() - moved > STILL:
                    self.close()
                    return Outcome("hang", f"ended after {now - used:.0f} s of processor time", seconds=now - used)
            return Outcome(**self.pipe.recv())
        except (EOFError, OSError):
            self.process.join(10)
            code = self.process.exitcode
            self.close()
            return Outcome("foreign", f"the process ended with exit code {code}")


def runnable(pid: int | None) -> bool:
    """Whether a process computes or waits for a processor."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "R"
    except OSError:
        return False


def processor_seconds(pid: int | None) -> float:
    """Processor time of a process so far, s."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def resident(pid: int | None) -> int:
    """Bytes of memory that a process has in use."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


def serve_cases(pipe: Connection, seed: int) -> None:
    """Test the cases that come through the pipe, in a separate folder, with a memory limit."""
    with tempfile.TemporaryDirectory(prefix="robustness-") as folder:
        os.chdir(folder)
        said = os.open("said.txt", os.O_WRONLY | os.O_CREAT)
        for stream in (1, 2):  # MuJoCo and XLA write there
            os.dup2(said, stream)
        try:
            bench = Bench(Path(folder), seed)
        except Exception:
            pipe.send(traceback.format_exc())
            raise
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + ROOM, resource.RLIM_INFINITY))
        pipe.send(READY)
        while True:
            try:
                name, number = pipe.recv()
            except EOFError:
                return
            try:
                try:
                    bench.prepare(name)
                finally:
                    pipe.send(bench.most(name))
                outcome = bench.judged(name, number)
            except Exception:  # of the tests themselves
                outcome = Outcome("harness", traceback.format_exc())
            pipe.send(outcome.to_json())
            os.ftruncate(said, 0)


class Bench:
    """Valid files of every kind, and the cases made from them."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.seed = folder, seed
        self.valid: dict[str, Path] = {}
        self.seconds: dict[str, float] = {}  # of processor time, of valid pages
        (folder / "api").mkdir()
        self.calls = api_calls.calls(folder / "api")
        self.wrong = api_calls.cases(self.calls)
        for call in self.calls:  # imported, and found to be valid
            with contextlib.suppress(api_calls.Read):
                call.run(**call.valid)

    def judged(self, name: str, number: int) -> Outcome:
        """Test a case of a prepared kind."""
        random = Random(f"{self.seed}/{name}/{number}")
        if name == ARGUMENTS:
            call, argument, wrong = random.choice(self.wrong)
            return api_calls.attempt(self.calls[call], argument, wrong, random if random.random() < SEVERAL else None)
        kind, valid = run_kinds.EVERY[name], self.valid[name]
        return kinds.attempt(kind, valid, self.folder / "input", random, most=self.most(name))

    def most(self, name: str) -> float:
        """Processor seconds above which a case of a kind counts as hanging; pages may take longer than files."""
        return max(MOST_SECONDS, SLOWER * self.seconds.get(name, 0.0))

    def prepare(self, name: str) -> None:
        """Make a kind's valid example, where it does not exist yet."""
        if name != ARGUMENTS and name not in self.valid:
            self.valid[name] = self._made(run_kinds.EVERY[name])

    def _made(self, kind: kinds.Kind) -> Path:
        """A folder with the valid example; RuntimeError where that is not accepted."""
        at = self.folder / f"valid_{len(self.valid)}"
        at.mkdir(exist_ok=True)
        kind.make(at)
        outcome = kinds.attempt_valid(kind, at, self.folder / "input")
        if outcome.result == "hang":  # the first of a kind imports, and may compile
            outcome = kinds.attempt_valid(kind, at, self.folder / "input")
        if outcome.fault and not (kind.drawn and outcome.result == "hang"):
            raise RuntimeError(f"{kind.name}: the valid example is not accepted: {outcome}")
        if kind.drawn:
            self.seconds[kind.name] = outcome.seconds
        return at


# ---------------------------------------------------------------- what is written

KEYS = ("tried", "foreign_exceptions", "hangs", "memory_over_1gib", "kills", "kills_resumed_identical")


def summary(found: dict[Case, Outcome]) -> dict[str, Any]:
    """Counts over all cases and by kind, and some faults of each place in the code."""
    results = collections.Counter(outcome.result for outcome in found.values())
    by_kind = collections.defaultdict[str, collections.Counter[str]](collections.Counter)
    faults = collections.defaultdict[str, list[dict[str, Any]]](list)
    for (name, number), outcome in sorted(found.items()):
        by_kind[name][outcome.result] += 1
        if outcome.fault:
            faults[f"{outcome.result}: {outcome.place or outcome.message}"].append(
                {"kind": name, "number": number, "message": outcome.message}
            )
    return {
        "tried": len(found),
        "foreign_exceptions": results["foreign"],
        "hangs": results["hang"],
        "memory_over_1gib": results["memory"],
        "bad_messages": results["message"],
        "warning_floods": results["warnings"],
        "accepted": results["accepted"],
        "refused": results["refused"],
        "slowest_s": round(max((o.seconds for o in found.values()), default=0.0), 2),
        "by_kind": {
            name: {"tried": sum(of.values()), **dict(sorted(of.items()))} for name, of in sorted(by_kind.items())
        },
        "faults": {place: {"count": len(of), "examples": of[:EXAMPLES]} for place, of in sorted(faults.items())},
    }


def kills(out: Path) -> dict[str, Any]:
    """Number of killed runs that resumed to the same result, from kills.json; None where there is no file."""
    path = out / "kills.json"
    found = json.loads(path.read_text()) if path.is_file() else {}
    keys = ("kills", "kills_resumed_identical", "kills_resumed_to_an_end")
    return {**{key: found.get(key) for key in keys}, "kills_commit": found.get("commit")}


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
