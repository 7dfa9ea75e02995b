"""Progress without a terminal, in lines that a log file shows; scalars for TensorBoard, read back from their file."""

from __future__ import annotations

import io
import re
import struct
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from droid_jax.identify.multistart import RefineProgress
from droid_jax.policy.train import TrainProgress
from droid_jax.report import progress
from droid_jax.report.progress import numbers_of, scalars


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


def test_a_limit_of_iterations_tells_the_most_time_left(capsys: pytest.CaptureFixture) -> None:
    times = iter([0.0, 10.0, 40.0])
    lines = progress.Lines(clock=lambda: next(times))
    for iteration in (1, 2, 3):
        lines.report("refine", SimpleNamespace(iteration=iteration, iterations=30, mean_square=2.0))
    assert capsys.readouterr().out.splitlines()[-1].endswith("(40 s, at most 540 s left)")


def test_stages_and_training_write_lines_where_there_is_no_terminal(capsys: pytest.CaptureFixture) -> None:
    with progress.stages(["refine"]) as report:
        report("refine", SimpleNamespace(iteration=1, iterations=30, mean_square=2.0))
    with progress.training(100) as show:
        show(SimpleNamespace(step=100, reward=3.0, success=0.5, rate=1000.0, remaining=0.0))
    refine, compiling, done = capsys.readouterr().out.splitlines()
    assert refine.startswith("refine 1/30 mean square 2 (noise: 1) (0 s")
    assert compiling == "training 0/100 compiling, a minute (0 s)"
    assert done.startswith("training 100/100 reward 3  success 50%  1,000 actions/s")


def test_steps_that_are_named_are_counted_against_the_most_that_a_round_has(capsys: pytest.CaptureFixture) -> None:
    """A text announces a step; the remaining time is that of the other steps of its round."""
    times = iter([0.0, 0.0, 30.0, 60.0, 60.0, 90.0, 120.0, 120.0])
    lines = progress.Lines(clock=lambda: next(times), line=progress.Steps({"look": 4, "refit": 1}).line)
    for stage, value in (
        ("screen", "base model"), ("look", "latch"), ("look", "drag"), ("look", "closer"),
        ("refit", "latch"), ("refit", "drag"), ("look", "latch + drag"), ("judge", None),
    ):  # fmt: skip
        lines.report(stage, value)
    assert capsys.readouterr().out.splitlines() == [
        "screen base model (0 s)",
        "look 0/4 latch (0 s)",
        "look 1/4 drag (30 s)",
        "look 2/4 closer (60 s, about 60 s left)",
        "refit 0/1 latch (0 s)",
        "refit 1/2 drag (30 s)",
        "look 0/4 latch + drag (0 s)",
        "judge (0 s)",
    ]


def test_bars_take_every_kind_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal; a stage that comes again begins anew."""
    terminal = Console(force_terminal=True, file=io.StringIO(), width=120)
    monkeypatch.setattr(progress, "Console", lambda: terminal)
    monkeypatch.setattr("rich.progress.get_console", lambda: terminal)
    with progress.stages(["search", "look", "judge"], {"look": 3}) as report:
        report("search", SimpleNamespace(generation=1, generations=2, best_cost=0.5, sigma=1.0))
        for name in ("latch", "drag"):
            report("look", name)
        report("judge", None)
        report("look", "closer")
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal.file.getvalue())  # type: ignore[attr-defined]
    assert re.search(r"look .* 3/3 closer", shown) and re.search(r"judge .* 1/1", shown)


def test_equal_things_are_counted(capsys: pytest.CaptureFixture) -> None:
    with progress.counting("trials", 3) as count:
        for done in (1, 2, 3):
            count(done)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "trials 0/3 (0 s)" and lines[-1].startswith("trials 3/3 (0 s")


pytest.importorskip("tensorboardX")


def written(folder: Path) -> dict[str, dict[int, float]]:
    """Tag -> step -> value, out of the event files: records of (length, its checksum, data, its checksum)."""
    from tensorboardX.proto import event_pb2

    found: dict[str, dict[int, float]] = {}
    for path in folder.glob("events*"):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event = event_pb2.Event.FromString(data[12 : 12 + length])
            for value in event.summary.value:
                found.setdefault(value.tag, {})[event.step] = value.simple_value
            data = data[16 + length :]
    return found


def test_every_number_of_a_stage_is_a_scalar(tmp_path: Path):
    with scalars(tmp_path) as write:
        write("refine", RefineProgress(3, 30, 1.5))
        write("train", TrainProgress(1000, 4000, 12.0, 250.0, 80.0, 0.5))
        write("judge", None)
        write("look", "latch at door_hinge")
    found = written(tmp_path)
    assert found["refine/mean_square"] == {3: 1.5}
    assert found["train/success"] == {1000: 0.5} and found["train/reward"] == {1000: 80.0}
    names = ("seconds", "rate", "reward", "success", "blown_up")
    assert set(found) == {"refine/mean_square", *(f"train/{n}" for n in names)}


def test_limits_are_no_scalars():
    assert numbers_of(RefineProgress(3, 30, 1.5)) == (3, {"mean_square": 1.5})


def test_nothing_is_written_unless_asked(tmp_path: Path):
    with scalars(None) as write:
        write("refine", RefineProgress(3, 30, 1.5))
    assert not list(tmp_path.iterdir())
