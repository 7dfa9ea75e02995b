"""Progress of a run: a bar per stage on a terminal, a line now and then in a log file, scalars for TensorBoard."""

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
_COUNTS = ("generation", "iteration", "step")  # what a progress value counts with
QUIET = 20.0  # s between two lines of one stage where there is no terminal


@contextlib.contextmanager
def stages(names: Sequence[str], most: Mapping[str, int] | None = None) -> Iterator[Report]:
    """Show one bar per stage; yields the function that stages report to: (stage, its progress value).

    most: of stages that report a text as each of their steps begins, how many steps one round has at most; the time
    left is that of so many.  A stage that comes again, after another, begins a round of its own.
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
    """What to show of what stages report, with the steps counted of those that report a text for each."""

    def __init__(self, most: Mapping[str, int]) -> None:
        self._most = most
        self._stage, self._begun = "", 0

    def line(self, stage: str, value: Any) -> dict[str, Any]:
        """Text, and how much is done of how much where that is known; empty where a stage only says that it began."""
        if stage != self._stage:
            self._stage, self._begun = stage, 0
        if not isinstance(value, str):
            return {} if value is None else _line(value)
        self._begun += 1
        if stage not in self._most:
            return {"text": value}
        return {"text": value, "completed": self._begun - 1, "total": max(self._begun, self._most[stage])}


def _line(value: Any) -> dict[str, Any]:
    """What to show of a stage's progress value."""
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
    """Show one bar for a number of equal things; yields the function that takes how many are done."""
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
    """What to show of a `TrainProgress`."""
    rate = f"{now.rate:,.0f} actions/s" if now.rate else "started"
    return f"reward {now.reward:.0f}  success {now.success:.0%}  {rate}"


class Lines:
    """Lines in place of bars: one where a stage begins, then at most one every QUIET seconds and one at its end."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, line: Callable[[str, Any], dict[str, Any]] | None = None
    ) -> None:
        self._clock, self._line = clock, line or Steps({}).line
        self._stage = ""
        self._began = self._last = 0.0
        self._first = (0.0, 0.0)  # s and count of the stage's first line: what compiled before it tells no rate

    def report(self, stage: str, value: Any) -> None:
        """What `stages` yields."""
        line = self._line(stage, value)
        counts = line.get("completed", 0), line.get("total", 0)
        self.show(stage, line.get("text", ""), *counts, left=line.get("left", "about"))

    def show(self, stage: str, text: str, done: float, total: float, *, left: str = "about") -> None:
        """Print where a stage stands, if it is time to; left: how sure the time left is."""
        now = self._clock()
        new = stage != self._stage
        if new:
            self._stage, self._began, self._first = stage, now, (now, done)
        elif not self._first[1] and done:  # the first count: the clock of the rate starts here
            self._first = (now, done)
        elif now - self._last < QUIET and not (total and done >= total):
            return
        self._last, spent = now, now - self._began
        more, since = done - self._first[1], now - self._first[0]
        rest = f", {left} {since * (total - done) / more:.0f} s left" if more > 0 and done < total else ""
        count = f" {done:.0f}/{total:.0f}" if total else ""
        print(f"{stage}{count} {text}".rstrip() + f" ({spent:.0f} s{rest})", flush=True)


def needs_writer(wanted: bool) -> None:
    """ValueError that says what to install where scalars are wanted and nothing can write them."""
    if wanted:
        needs("--tensorboard needs", "tensorboard", "tensorboardX")


@contextlib.contextmanager
def scalars(folder: Path | None) -> Iterator[Callable[[str, Any], None]]:
    """Write FOLDER/events*; yields the function that stages report to: (stage, its progress value).

    folder: None for nothing.  Raises ValueError where tensorboardX is not installed.
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
