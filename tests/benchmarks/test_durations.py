"""CPU seconds of tests: a test's own, and those of the processes that it starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from benchmarks.durations import OPTION, summary

ROOT = Path(__file__).resolve().parents[2]
TESTS = """
import subprocess, sys, time
BURN = "import time\\nwhile time.process_time() < 0.3: pass"
def test_idle(): time.sleep(0.1)
def test_busy(): subprocess.run([sys.executable, "-c", BURN], check=True)
def test_wrong(): assert False
"""


def test_the_plugin_counts_cpu_and_not_wall_time_in_all_processes(tmp_path: Path):
    (tmp_path / "test_made_up.py").write_text(TESTS)
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "benchmarks.durations", f"{OPTION}=found.json"]
    done = subprocess.run(
        [*command, "test_made_up.py"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True
    )
    found = json.loads((tmp_path / "found.json").read_text())
    tests = {name.split("::")[1]: seconds for name, seconds in found["longest"].items()}
    assert done.returncode == 1 and set(tests) == {"test_idle", "test_busy", "test_wrong"}
    assert tests["test_busy"] >= 0.3 > 0.09 >= tests["test_idle"]
    assert found["tests"] == 3 and found["cpu_seconds"]["all"] > found["cpu_seconds"]["in_tests"] >= 0.3


def test_files_are_summed_the_longest_first():
    found = summary({"a.py::one": 1.0, "b.py::two": 2.5, "a.py::three": 2.0}, 6.0)
    assert list(found["files"].items()) == [("a.py", 3.0), ("b.py", 2.5)]
    assert list(found["longest"]) == ["b.py::two", "a.py::three", "a.py::one"]
    assert found["cpu_seconds"] == {"all": 6.0, "in_tests": 5.5}
