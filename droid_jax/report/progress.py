"""Progress bars of a run, one per stage, with cost and time left."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Report = Callable[[str, Any], None]


@contextlib.contextmanager
def stages(names: Sequence[str]) -> Iterator[Report]:
    """Show one bar per stage; yields the function that stages report to: (stage, its progress value)."""
    columns = (
        TextColumn("{task.description:>8}"),
        BarColumn(bar_width=30),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bars:
        tasks = {n: bars.add_task(n, total=1, text="", start=False) for n in names}
        current: list[str] = []

        def report(stage: str, value: Any) -> None:
            if stage not in current:
                for done in current:
                    bars.update(tasks[done], completed=bars.tasks[tasks[done]].total)
                    bars.stop_task(tasks[done])
                current.append(stage)
                bars.start_task(tasks[stage])
            if value is not None:
                bars.update(tasks[stage], **_line(value))

        yield report
        for name in current:
            bars.update(tasks[name], completed=bars.tasks[tasks[name]].total)


def _line(value: Any) -> dict[str, Any]:
    """What to show of a stage's progress value, or a text in place of one."""
    if isinstance(value, str):
        return {"text": value}
    if hasattr(value, "generation"):
        text = f"cost {value.best_cost:.4g}  sigma {value.sigma:.2g}"
        return {"completed": value.generation, "total": value.generations, "text": text}
    return {
        "completed": value.iteration,
        "total": value.iterations,
        "text": f"mean square {value.mean_square:.3g} (noise: 1)",
    }


@contextlib.contextmanager
def training(steps: int) -> Iterator[Callable[[Any], None]]:
    """Show one bar for training, in actions; yields the function that takes each `TrainProgress`."""
    columns = (
        TextColumn("training"),
        BarColumn(bar_width=30),
        TextColumn("{task.percentage:>3.0f}%"),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
        TextColumn("left {task.fields[left]}"),
    )
    with Progress(*columns) as bars:
        task = bars.add_task("training", total=steps, text="compiling, a minute", left="–")

        def report(now: Any) -> None:
            rate = f"{now.rate:,.0f} actions/s" if now.rate else "started"
            text = f"reward {now.reward:.0f}  success {now.success:.0%}  {rate}"
            left = f"{now.left / 60:.0f} min" if math.isfinite(now.left) else "–"
            bars.update(task, completed=min(now.step, steps), text=text, left=left)

        yield report
