"""CPU seconds of the quick test suite: which tests and which files take the time?

    python benchmarks/durations.py [--quick] [--out DIR] [--warm] [--processes N] [--paths PATH ...]

Runs pytest as `.ci/run` does and writes DIR/durations.json.  CPU seconds count user and system time of the test's own
process and of the processes that it started and that have ended.  Unlike wall time, they do not depend on other work
of the machine.  The suite starts with an empty compilation cache, as a fresh checkout does, unless --warm is given.

The functions pytest_* below are the plugin that measures: `pytest -p benchmarks.durations --durations-json FILE`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

# ruff: noqa: E402  (what is imported lies in folders that are no packages)
import pytest
import tyro

from benchmarks.common import empty_cache, publish
from droid_jax import runtime

LONGEST = 50  # tests that are listed one by one
QUICK_PATHS = ("tests/preflight", "tests/test_arguments.py")
OPTION = "--durations-json"


@dataclass(frozen=True)
class Arguments:
    """Measure the CPU seconds of the test suite."""

    quick: bool = False
    """Two short parts of the suite instead of all."""
    out: Path = Path("benchmarks/results")
    """Folder of durations.json."""
    warm: bool = False
    """Keep the compilation cache of earlier runs."""
    processes: int = 2
    """pytest processes side by side."""
    paths: tuple[str, ...] = ()
    """Files or folders of tests; default: all."""


def main(arguments: Arguments) -> None:
    """Run the suite, write durations.json and print one line of JSON."""
    paths = arguments.paths or (QUICK_PATHS if arguments.quick else ())
    with tempfile.TemporaryDirectory() as folder:
        measured = Path(folder) / "measured.json"
        environment = {**os.environ, "PYTHONPATH": str(ROOT)} if arguments.warm else empty_cache(folder)
        command = [sys.executable, "-m", "pytest", "-q", "-n", str(arguments.processes), "--dist", "worksteal"]
        command += ["-p", "benchmarks.durations", f"{OPTION}={measured}", *paths]
        run = subprocess.run(command, cwd=ROOT, env=environment, stdout=sys.stderr)
        if not measured.is_file():
            raise SystemExit(f"error: pytest ended with exit code {run.returncode} and no durations")
        found = json.loads(measured.read_text())
    result = {
        "cache": "warm" if arguments.warm else "cold",
        "processes": arguments.processes,
        "paths": list(paths),
        "exit_code": run.returncode,
        **found,
    }
    totals = {key: result[key] for key in ("cache", "tests", "minutes", "cpu_seconds", "exit_code")}
    runtime.tune()
    publish(arguments.out, "durations", arguments.quick, 0, result, totals)


def summary(tests: dict[str, float], total: float) -> dict[str, Any]:
    """Content of durations.json for the measured tests.

    Args:
        tests: CPU s of each test by its node id.
        total: CPU s of all test processes, imports and collection included.
    """
    files: Counter[str] = Counter()
    for name, seconds in tests.items():
        files[name.split("::")[0]] += seconds
    return {
        "tests": len(tests),
        "cpu_seconds": {"all": round(total, 1), "in_tests": round(sum(tests.values()), 1)},
        "files": {name: round(seconds, 1) for name, seconds in files.most_common()},
        "longest": {name: round(seconds, 1) for name, seconds in Counter(tests).most_common(LONGEST)},
    }


# ----- the plugin


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(OPTION, type=Path, help="write the CPU seconds of all tests to this file")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption(OPTION):
        config.pluginmanager.register(CpuClock(config))


def cpu_seconds() -> float:
    """CPU s of this process and of those that it started and waited for."""
    return sum(os.times()[:4])


class CpuClock:
    """Plugin that adds CPU seconds to each test report; the controller sums and writes them."""

    def __init__(self, config: pytest.Config) -> None:
        self.config, self.last = config, cpu_seconds()
        self.began = time.monotonic()
        self.tests: Counter[str] = Counter()
        self.workers = 0.0

    def pytest_runtest_logstart(self) -> None:
        self.last = cpu_seconds()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Iterator[Any]:
        report = yield
        now = cpu_seconds()
        report.cpu_seconds, self.last = now - self.last, now  # pytest-xdist carries attributes to its controller
        return report

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.tests[report.nodeid] += report.cpu_seconds

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        self.workers += getattr(node, "workeroutput", {}).get(OPTION, 0.0)

    def pytest_sessionfinish(self) -> None:
        output = getattr(self.config, "workeroutput", None)
        if output is not None:  # a process of pytest-xdist
            output[OPTION] = cpu_seconds()
        else:
            total = self.workers or cpu_seconds()
            minutes = (time.monotonic() - self.began) / 60
            found = {"minutes": round(minutes, 1), **summary(dict(self.tests), total)}
            self.config.getoption(OPTION).write_text(json.dumps(found))


if __name__ == "__main__":
    main(tyro.cli(Arguments))
