"""The search of the command `gap`: with progress, timing, and continuation after a stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droid_jax.read_json import read_json, typed
from droid_jax.storage import write_json

if TYPE_CHECKING:
    import numpy as np

    from droid_jax.discrepancy.case import Case
    from droid_jax.discrepancy.fitting import FinalModel
    from droid_jax.discrepancy.missing import Amended
    from droid_jax.discrepancy.verdict import Verdict
    from droid_jax.recordings.recording import Recording
    from droid_jax.recordings.split import Split

# Stages that are shown and timed; docs/gap.md explains them.
BARS = (
    "search",
    "refine",
    "discretisation_error",
    "score_test",
    "one_step_fit",
    "refit",
    "restart",
    "verdict",
    "final_refit",
)
IN_WINDOWS = (
    "refine",
    "discretisation_error",
    "score_test",
    "one_step_fit",
    "refit",
    "verdict",
)  # commanded logs: several starts in place of a search
IN_BLOCKS = (
    "refine",
    "score_test",
    "one_step_fit",
    "refit",
    "verdict",
)  # a log without commands: no search, and no time step


def searched(
    split: Split,
    case: Case,
    roles: Mapping[str, Recording],
    checkpoints: Path,
    start: np.ndarray | None = None,
    board: Path | None = None,
    keep: Callable[[Case, Amended, Mapping[str, float]], None] = lambda case, now, seconds: None,
) -> tuple[Case, Verdict, FinalModel, dict[str, float]]:
    """Run the search, continuing from `checkpoints`.

    Args:
        split: how the recordings are divided.
        case: the recordings, base parameters and effects.
        roles: recording by role.
        checkpoints: folder of replays and times of a stopped run.
        start: [F] values of the base parameters at which their fit begins, instead of a search.
        board: folder for TensorBoard scalars of the base fit and other iterative stages.
        keep: called with the verdict and the seconds so far, and again after each amendment.

    Returns:
        The case, its verdict, the final model, and the seconds of each stage.
    """
    from droid_jax.discrepancy.missing import amended, search
    from droid_jax.discrepancy.step_error import with_finer_step
    from droid_jax.report.progress import scalars, stages

    names = _stages(split, start is not None)
    with (
        stages(names, {"one_step_fit": case.config.one_step_fits, "refit": case.config.full_refits}) as show,
        scalars(board) as write,
    ):
        clock = Clock(names, (show, write), checkpoints / "seconds.json")
        clock(names[0], None)
        case = case.with_replay_cache(checkpoints / "replays")
        fine = with_finer_step(case.train, case.base, roles["train"])
        case, verdict = search(split, case, fine, start, clock)
        for now in amended(case, verdict, roles["train"], clock):
            clock.stop()
            keep(case, now, clock.seconds)
            verdict, final = now.verdict, now.final
    return case, verdict, final, clock.seconds


def _stages(split: Split, started: bool) -> tuple[str, ...]:
    """Names of the stages that are shown and timed."""
    from droid_jax.recordings.split import Split

    known = {Split.BLOCKS: IN_BLOCKS, Split.WINDOWS: IN_WINDOWS}
    return known.get(split, BARS[1:] if started else BARS)


class Clock:
    """Forwards progress and measures the seconds of each stage; `kept` is the file with those of a stopped run."""

    def __init__(self, stages: Sequence[str], reports: Sequence[Callable[[str, Any], None]], kept: Path) -> None:
        self.stages, self.reports, self.kept = stages, reports, kept
        self.seconds: dict[str, float] = _seconds(kept)
        self._stage, self._since = stages[0], time.monotonic()

    def stop(self) -> None:
        """Add the seconds of the current stage."""
        now = time.monotonic()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._since = now

    def __call__(self, stage: str, value: Any) -> None:
        self.stop()
        if stage != self._stage:
            write_json(self.kept, self.seconds)
        self._stage = stage
        if stage in self.stages:
            for report in self.reports:
                report(stage, value)


def _seconds(kept: Path) -> dict[str, float]:
    """Seconds of a stopped run; empty if the file cannot be read, since no result depends on it."""
    try:
        before = typed(read_json(kept), dict[str, float], str(kept))
        return {stage: before[stage] for stage in BARS if stage in before}
    except (OSError, ValueError):
        return {}
