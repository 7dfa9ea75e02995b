"""Progress without a terminal: lines now and then, so that a log file shows where a run stands."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from droid_jax.report import progress


def test_a_log_gets_a_line_where_a_stage_begins_now_and_then_and_at_its_end(capsys: pytest.CaptureFixture) -> None:
    times = iter([0.0, 78.0, 80.0, 102.0, 103.0, 110.0, 111.0])
    lines = progress.Lines(clock=lambda: next(times))
    for generation in (0, 1, 2, 5, 6, 10):
        lines.report(
            "search",
            SimpleNamespace(generation=generation, generations=10, best_cost=0.5 / (generation + 1), sigma=1.0),
        )
    lines.report("judge", None)
    assert capsys.readouterr().out.splitlines() == [
        "search 0/10 cost 0.5  sigma 1 (0 s)",
        "search 1/10 cost 0.25  sigma 1 (78 s)",  # what compiled until then tells no rate
        "search 5/10 cost 0.08333  sigma 1 (102 s, about 30 s left)",
        "search 10/10 cost 0.04545  sigma 1 (110 s)",
        "judge (0 s)",
    ]


def test_stages_and_training_write_lines_where_there_is_no_terminal(capsys: pytest.CaptureFixture) -> None:
    with progress.stages(["refine"]) as report:
        report("refine", SimpleNamespace(iteration=1, iterations=30, mean_square=2.0))
    with progress.training(100) as told:
        told(SimpleNamespace(step=100, reward=3.0, success=0.5, rate=1000.0, left=0.0))
    refine, compiling, done = capsys.readouterr().out.splitlines()
    assert refine.startswith("refine 1/30 mean square 2 (noise: 1) (0 s")
    assert compiling == "training 0/100 compiling, a minute (0 s)"
    assert done.startswith("training 100/100 reward 3  success 50%  1,000 actions/s")


def test_equal_things_are_counted(capsys: pytest.CaptureFixture) -> None:
    with progress.counting("trials", 3) as count:
        for done in (1, 2, 3):
            count(done)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "trials 0/3 (0 s)" and lines[-1].startswith("trials 3/3 (0 s")
