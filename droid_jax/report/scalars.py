"""Scalars of a long run for TensorBoard, written while it runs."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from numbers import Real
from pathlib import Path
from typing import Any

from droid_jax.errors import needs

FOLDER = "tensorboard"
_COUNTS = ("generation", "iteration", "step")  # what a progress value counts with


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
