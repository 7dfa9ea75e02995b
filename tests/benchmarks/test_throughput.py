"""The throughput benchmark: its bookkeeping, and one quick run whose JSON line is checked. Nothing is timed."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "benchmarks"


def benchmark(name: str):
    """A module of the benchmarks folder, which is no package."""
    if str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))
    return importlib.import_module(name)


common, throughput = benchmark("common"), benchmark("throughput")


class Clock:
    """A clock that only its owner moves, s."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_runs_take_turns_and_the_median_of_the_later_ones_counts():
    clock, called = Clock(), []
    costs = {"a": iter([10.0, 1.0, 3.0, 2.0]), "b": iter([20.0, 5.0, 5.0, 8.0])}

    def run(name: str) -> None:
        called.append(name)
        clock.now += next(costs[name])

    steps = []
    runs = {name: (lambda n=name: run(n)) for name in costs}
    first, median = common.interleave(runs, 3, lambda: steps.append(1), clock)
    assert "".join(called) == "abababab"
    assert (first, median) == ({"a": 10.0, "b": 20.0}, {"a": 2.0, "b": 5.0})
    assert len(steps) == 8


def test_interleave_needs_a_timed_call():
    with pytest.raises(ValueError, match="repeats: expected at least 1 timed call, got 0"):
        common.interleave({"a": lambda: None}, 0)


def test_a_process_of_its_own(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import json, os, sys\nprint('talk')\nprint(json.dumps([sys.argv[1:], os.environ.get('MARK')]))")
    assert common.in_process(script, ["--x", "1"], 60, {"MARK": "m"}) == [["--x", "1"], "m"]
    script.write_text("raise SystemExit('it broke')")
    assert common.in_process(script, [], 60) == {"error": "exit status 1: it broke"}
    script.write_text("import time; time.sleep(60)")
    assert common.in_process(script, [], 0.5) == {"error": "not done after 0.5 s"}


def test_peak_memory_counts_what_was_freed_again(tmp_path):
    script = tmp_path / "script.py"
    lines = (
        f"import sys; sys.path.append({str(FOLDER)!r})",
        "import json, common",
        "before = common.peak_memory_gib()",
        "held = bytearray(512 * 2**20); del held",
        "print(json.dumps([before, common.peak_memory_gib()]))",
    )
    script.write_text("\n".join(lines))
    before, after = common.in_process(script, ["cpu"], 120)
    assert 0.01 < before < 2.0
    # The bytes come out of pages that are touched; what ran before may have left some room below its own peak.
    assert after - before == pytest.approx(0.5, abs=0.1)


def rows_by_hand() -> list:
    rows = [
        throughput.Row(throughput.OWN, 32, 100, 0.4, 0.0),
        throughput.Row(throughput.C, 32, 100, 0.2, None),
        throughput.Row(throughput.OWN, 256, 100, 2.0, 9.0),
        throughput.Row(throughput.WHOLE, 256, 100, 4.0, 11.0),
        throughput.Row(throughput.C, 256, 100, 0.5, None),
        throughput.Row(throughput.OWN, 512, 100, 2.0, 0.0),
        throughput.Row(throughput.WHOLE, 512, 100, 2.0, 0.0),
        throughput.Row(throughput.C, 512, 100, 2.0, None),
        throughput.Row(throughput.OPTION, 256, 100, 8.0, 1.0),
        throughput.Row(throughput.SHARDED, 256, 100, 5.0, 1.0),
        throughput.Row(throughput.C, 256, 100, 1.0, None),
    ]
    return rows


def test_headline_compares_at_256_with_the_c_runs_between():
    untuned = asdict(throughput.Row(throughput.UNTUNED, 32, 20, 16.0, 1.0))
    line = throughput.headline(rows_by_hand(), untuned, {"gib": 1.25})
    assert line == {
        "population": 256,
        "mjx_steps_per_s": 12800.0,
        "mjx_one_block_steps_per_s": 6400.0,
        "c_steps_per_s": 51200.0,
        "ratio_to_c": 0.25,
        "ratio_to_c_32": 0.5,
        "mjx_step_option_steps_per_s": 3200.0,
        "mjx_step_all_devices_steps_per_s": 5120.0,
        "untuned_steps_per_s": 40.0,
        "compile_s": 9.0,
        "peak_memory_gib": 1.25,
    }


def test_headline_without_256_and_with_parts_that_failed():
    others = [row for row in rows_by_hand() if row.population != 256]
    bare = [row for row in rows_by_hand() if row.engine in (throughput.OPTION, throughput.SHARDED)]
    line = throughput.headline([*others, *bare], {"error": "not done after 3 s"}, {"error": "exit status 1: x"})
    assert (line["population"], line["untuned_steps_per_s"], line["peak_memory_gib"]) == (512, None, None)


@pytest.mark.parametrize("wrong", [{"populations": (4, 0)}, {"steps": 0}, {"repeats": 0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))}: expected at least 1"):
        throughput.Throughput(**wrong)


def test_samples_of_a_larger_population_start_with_those_of_a_smaller():
    replays = benchmark("replays")
    case = replays.make_case(seed=3, steps=7)
    small, large = case.values(5), case.values(64)
    np.testing.assert_array_equal(small, large[:5])
    case.space.check(large)
    assert case.steps == 7 and np.all(large.std(axis=0) > 0)
    assert not np.array_equal(replays.make_case(seed=4, steps=7).values(5), small)
    rows = replays.padded(small, 4)
    assert rows.shape == (8, len(case.space))
    np.testing.assert_array_equal(rows[5:], np.repeat(small[4:], 3, axis=0))
    assert replays.padded(small, 5).shape == small.shape


@pytest.mark.slow
def test_a_quick_run_ends_in_one_line_of_json(tmp_path):
    arguments = ["--quick", "--repeats", "1", "--seed", "5", "--out", str(tmp_path / "results")]
    result = common.in_process(FOLDER / "throughput.py", arguments, 900)
    assert "error" not in result, result
    assert json.loads((tmp_path / "results" / "throughput_quick.json").read_text()) == result

    assert (result["population"], result["steps"], result["seed"], result["quick"]) == (64, 200, 5, True)
    assert (result["timestep"], result["cone"], result["iterations"]) == (0.002, "pyramidal", 100)
    assert result["versions"]["mujoco"] == importlib.metadata.version("mujoco")
    git = subprocess.run(["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True)
    if git.returncode == 0:
        assert result["commit"].removesuffix("-dirty") == git.stdout.strip()
    assert 0.1 < result["peak_memory_gib"] < 8.0
    assert result["untuned_steps_per_s"] is None
    # Free motion: what is left is the C engine's first order in the time step, 0.005 N m of tens.
    assert result["finite"] == 1.0 and result["torque_difference_n_m"] < 0.03

    rows = result["rows"]
    measured = {(row["engine"], row["population"]) for row in rows}
    replays = {(e, p) for e in (throughput.OWN, throughput.WHOLE, throughput.C) for p in (2, 64)}
    assert measured == replays | {(e, 32) for e in (throughput.OPTION, throughput.SHARDED, throughput.C)}
    for row in rows:
        assert row["steps_per_s"] * row["seconds"] == pytest.approx(row["population"] * 200)
    at = {(row["engine"], row["population"]): row["steps_per_s"] for row in rows}
    assert result["mjx_steps_per_s"] == at[throughput.OWN, 64]
    assert result["c_steps_per_s"] == at[throughput.C, 64]
    assert result["ratio_to_c"] == pytest.approx(at[throughput.OWN, 64] / at[throughput.C, 64])
