"""The search behind `gap` as its command makes it: shown while it runs, timed, going on after a stop."""

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
)  # of commanded logs: several starts in place of a search
IN_BLOCKS = (
    "refine",
    "score_test",
    "one_step_fit",
    "refit",
    "verdict",
)  # of a log: no search, and no time step to refine


def searched(
    split: Split,
    case: Case,
    roles: Mapping[str, Recording],
    checkpoints: Path,
    start: np.ndarray | None = None,
    board: Path | None = None,
    keep: Callable[[Case, Amended, Mapping[str, float]], None] = lambda case, now, seconds: None,
) -> tuple[Case, Verdict, FinalModel, dict[str, float]]:
    """The case, its verdict and the model to hand on, going on from `checkpoints`; and each stage's seconds.

    start: [F] values of the base parameters from which their fit begins, instead of a search.
    board: folder for scalars of the base fit, and of the others that report iterations.
    keep: called with what there is and the seconds so far once the verdict is known, and after each amendment to it.
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
    """What is shown and timed."""
    from droid_jax.recordings.split import Split

    known = {Split.BLOCKS: IN_BLOCKS, Split.WINDOWS: IN_WINDOWS}
    return known.get(split, BARS[1:] if started else BARS)


class Clock:
    """Hands progress on, and counts the seconds of each stage; those of an earlier part of this run are in `kept`."""

    def __init__(self, stages: Sequence[str], tell: Sequence[Callable[[str, Any], None]], kept: Path) -> None:
        self.stages, self.tell, self.kept = stages, tell, kept
        self.seconds: dict[str, float] = _seconds(kept)
        self._stage, self._since = stages[0], time.monotonic()

    def stop(self) -> None:
        """Count the seconds of the stage that is on."""
        now = time.monotonic()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._since = now

    def __call__(self, stage: str, value: Any) -> None:
        self.stop()
        if stage != self._stage:
            write_json(self.kept, self.seconds)
        self._stage = stage
        if stage in self.stages:
            for tell in self.tell:
                tell(stage, value)


def _seconds(kept: Path) -> dict[str, float]:
    """What was counted before; nothing where that cannot be read, it decides nothing."""
    try:
        before = typed(read_json(kept), dict[str, float], str(kept))
        return {stage: before[stage] for stage in BARS if stage in before}
    except (OSError, ValueError):
        return {}
