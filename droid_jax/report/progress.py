"""Shows the progress of a run: bars on a terminal, lines in a log file, scalars for TensorBoard."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from droid_jax.console import at_the_end
from droid_jax.errors import needs

Report = Callable[[str, Any], None]
COMPILING = "compiling, a minute"
FOLDER = "tensorboard"
_COUNTS = ("generation", "iteration", "step")  # fields of progress values that count
LINE_PERIOD = 20.0  # s, shortest time between two lines of one stage where there is no terminal


@contextlib.contextmanager
def stages(names: Sequence[str], most: Mapping[str, int] | None = None) -> Iterator[Report]:
    """Show one bar per stage; yields the function that stages report to: (stage, its progress value).

    Args:
        names: of the stages.
        most: for stages that report a text at the beginning of each step, the largest number of steps; the remaining
            time is that of so many.  A stage that comes again after another one counts its steps from zero.
    """
    line = Steps(most or {}).line
    if not Console().is_terminal:
        yield Lines(line=line).report
        return
    columns = (
        TextColumn("{task.description:>8}"),
        BarColumn(bar_width=30),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bars, at_the_end(bars.stop):  # which shows the cursor again
        tasks = {n: bars.add_task(n, total=1, text="", start=False) for n in names}
        current: list[str] = []

        def finish() -> None:
            for done in current:
                bars.update(tasks[done], completed=bars.tasks[tasks[done]].total)
                bars.stop_task(tasks[done])

        def report(stage: str, value: Any) -> None:
            if current != [stage]:
                finish()
                current[:] = [stage]
                bars.reset(tasks[stage], total=1, text="")
            if shown := line(stage, value):
                bars.update(tasks[stage], **shown)

        yield report
        finish()


class Steps:
    """Turns reports of stages into text and counts; counts the steps of stages that report only a text."""

    def __init__(self, most: Mapping[str, int]) -> None:
        self._most = most
        self._stage, self._begun = "", 0

    def line(self, stage: str, value: Any) -> dict[str, Any]:
        """Text, and steps done and in total where known; empty where a stage only reports its beginning."""
        if stage != self._stage:
            self._stage, self._begun = stage, 0
        if not isinstance(value, str):
            return {} if value is None else _line(value)
        self._begun += 1
        if stage not in self._most:
            return {"text": value}
        return {"text": value, "completed": self._begun - 1, "total": max(self._begun, self._most[stage])}


def _line(value: Any) -> dict[str, Any]:
    """Text and counts of a stage's progress value."""
    if hasattr(value, "generation"):
        text = f"cost {value.best_cost:.4g}  sigma {value.sigma:.2g}"
        return {"completed": value.generation, "total": value.generations, "text": text}
    text = f"mean square {value.mean_square:.3g} (noise: 1)"
    return {"completed": value.iteration, "total": value.iterations, "text": text, "left": "at most"}  # mostly fewer


@contextlib.contextmanager
def training(steps: int) -> Iterator[Callable[[Any], None]]:
    """Show one bar for training, in actions; yields the function that takes each `TrainProgress`."""
    if not Console().is_terminal:
        lines = Lines()
        lines.show("training", COMPILING, 0, steps)
        yield lambda now: lines.show("training", _trained(now), min(now.step, steps), steps)
        return
    columns = (
        TextColumn("training"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
        TextColumn("left {task.fields[left]}"),
    )
    with Progress(*columns) as bars, at_the_end(bars.stop):  # which shows the cursor again
        task = bars.add_task("training", total=steps, text=COMPILING, left="–")

        def report(now: Any) -> None:
            left = f"{now.remaining / 60:.0f} min" if math.isfinite(now.remaining) else "–"
            bars.update(task, completed=min(now.step, steps), text=_trained(now), left=left)

        yield report


@contextlib.contextmanager
def counting(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show one bar for a number of equal steps; yields the function that takes how many are done."""
    if not Console().is_terminal:
        lines = Lines()
        lines.show(what, "", 0, total)
        yield lambda done: lines.show(what, "", done, total)
        return
    columns = (
        TextColumn(what),
        BarColumn(bar_width=30),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bars, at_the_end(bars.stop):  # which shows the cursor again
        task = bars.add_task(what, total=total)
        yield lambda done: bars.update(task, completed=done)


def _trained(now: Any) -> str:
    """Text of a `TrainProgress`."""
    rate = f"{now.rate:,.0f} actions/s" if now.rate else "started"
    return f"reward {now.reward:.0f}  success {now.success:.0%}  {rate}"


class Lines:
    """Lines in place of bars: at the beginning and end of a stage, and at most every LINE_PERIOD seconds."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, line: Callable[[str, Any], dict[str, Any]] | None = None
    ) -> None:
        self._clock, self._line = clock, line or Steps({}).line
        self._stage = ""
        self._began = self._last = 0.0
        self._first = (0.0, 0.0)  # s and count where the rate is measured from: the time before includes compilation

    def report(self, stage: str, value: Any) -> None:
        """Print a stage's progress value; the function that `stages` yields."""
        line = self._line(stage, value)
        counts = line.get("completed", 0), line.get("total", 0)
        self.show(stage, line.get("text", ""), *counts, left=line.get("left", "about"))

    def show(self, stage: str, text: str, done: float, total: float, *, left: str = "about") -> None:
        """Print the state of a stage, if LINE_PERIOD has passed; left: word before the remaining time."""
        now = self._clock()
        new = stage != self._stage
        if new:
            self._stage, self._began, self._first = stage, now, (now, done)
        elif not self._first[1] and done:  # the first count: the rate is measured from here
            self._first = (now, done)
        elif now - self._last < LINE_PERIOD and not (total and done >= total):
            return
        self._last, spent = now, now - self._began
        more, since = done - self._first[1], now - self._first[0]
        rest = f", {left} {since * (total - done) / more:.0f} s left" if more > 0 and done < total else ""
        count = f" {done:.0f}/{total:.0f}" if total else ""
        print(f"{stage}{count} {text}".rstrip() + f" ({spent:.0f} s{rest})", flush=True)


def needs_writer(wanted: bool) -> None:
    """ValueError, with what to install, where scalars are wanted and tensorboardX is missing."""
    if wanted:
        needs("--tensorboard needs", "tensorboard", "tensorboardX")


@contextlib.contextmanager
def scalars(folder: Path | None) -> Iterator[Callable[[str, Any], None]]:
    """Write FOLDER/events*; yields the function that stages report to: (stage, its progress value).

    folder: None writes nothing.  Raises ValueError where tensorboardX is not installed.
    """
    needs_writer(folder is not None)
    if folder is None:
        yield lambda stage, value: None
        return
    from tensorboardX import SummaryWriter

    with SummaryWriter(str(folder)) as writer:

        def report(stage: str, value: Any) -> None:
            if dataclasses.is_dataclass(value):
                at, numbers = numbers_of(value)
                for name, number in numbers.items():
                    writer.add_scalar(f"{stage}/{name}", number, at)
                writer.flush()

        yield report


def numbers_of(value: Any) -> tuple[int, dict[str, float]]:
    """A progress value's count, and its other numbers by name; limits ("of how many") are left out."""
    count = next(name for name in _COUNTS if hasattr(value, name))
    left_out = {count, f"{count}s", "of"}
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.name not in left_out}
    return int(getattr(value, count)), {name: float(v) for name, v in fields.items() if isinstance(v, Real)}
