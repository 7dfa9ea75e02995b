"""The search behind `gap`, from top to bottom, going on from what an earlier part of the run kept."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droid_jax.storage import write_json

if TYPE_CHECKING:
    import numpy as np

    from droid_jax.gap.case import Case, GapConfig
    from droid_jax.gap.split import Split
    from droid_jax.gap.verdict import Verdict
    from droid_jax.measure.recording import Recording
    from droid_jax.model.parameters import Space
    from droid_jax.model.scene import Scene
    from droid_jax.model.seam import Effect

STAGES = ("search", "refine", "floor", "screen", "look", "refit", "judge")
IN_BLOCKS = ("refine", "screen", "look", "refit", "judge")  # of a log: no search, and no time step to refine


def searched(
    split: Split,
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    roles: Mapping[str, Recording],
    config: GapConfig,
    checkpoints: Path,
    start: np.ndarray | None = None,
    board: Path | None = None,
) -> tuple[Case, Verdict, dict[str, float]]:
    """Case and verdict of recordings by role, going on from `checkpoints`; and each stage's seconds.

    start: [F] values of the base parameters from which their fit begins, instead of a search.
    board: folder for scalars of the base fit.
    """
    from droid_jax.gap.floor import numerical_floor
    from droid_jax.gap.menu import separating
    from droid_jax.gap.resume import kept_model, kept_number, remembering
    from droid_jax.gap.single import base_model
    from droid_jax.gap.split import Split
    from droid_jax.gap.workflow import base_fit, find
    from droid_jax.report.progress import stages
    from droid_jax.report.scalars import scalars

    names = IN_BLOCKS if split is Split.BLOCKS else STAGES if start is None else STAGES[1:]
    with stages(names, {"look": config.looked, "refit": config.refitted}) as show, scalars(board) as write:
        clock = Clock(names, (show, write), checkpoints / "seconds.json")
        clock(names[0], None)
        case = remembering(_case(split, scene, base, effects, roles, config), checkpoints / "replays")
        if split is Split.BLOCKS:
            model, floor = kept_model(checkpoints / "base", case.base, lambda: base_model(case)), 0.0
        else:
            model = kept_model(checkpoints / "base", case.base, lambda: base_fit(case, clock, start))
            clock("floor", None)
            floor = kept_number(checkpoints / "floor", lambda: numerical_floor(case.fit, model, roles["fit"]))
        verdict = find(case, model, floor, clock)
        clock("judge", None)
        if verdict.rivals:
            tied = (verdict.model, *verdict.rivals)
            verdict = replace(verdict, experiments=separating(case, tied, roles["fit"]))
        clock("judge", None)  # its seconds count
    return case, verdict, clock.seconds


def _case(
    split: Split,
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    roles: Mapping[str, Recording],
    config: GapConfig,
) -> Case:
    """Of recordings with repeats, or of one or two logs without."""
    from droid_jax.gap.case import make_case
    from droid_jax.gap.single import make_log, single_case
    from droid_jax.gap.split import Split

    if split is not Split.BLOCKS:
        return make_case(scene, base, effects, **roles, config=config)
    config = replace(config, refine=replace(config.refine, hops=0, spreads=0))  # inverse dynamics is smooth
    logs = {role: make_log(scene, base, effects, recording, config) for role, recording in roles.items()}
    return single_case(logs["fit"], base, effects, logs.get("sealed"), config)


class Clock:
    """Hands progress on, and counts the seconds of each stage; those of an earlier part of this run are in `kept`."""

    def __init__(self, stages: Sequence[str], tell: Sequence[Callable[[str, Any], None]], kept: Path) -> None:
        self.stages, self.tell, self.kept = stages, tell, kept
        self.seconds: dict[str, float] = _seconds(kept)
        self._stage, self._since = stages[0], time.monotonic()

    def __call__(self, stage: str, value: Any) -> None:
        now = time.monotonic()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        if stage != self._stage:
            write_json(self.kept, self.seconds)
        self._stage, self._since = stage, now
        if stage in self.stages:
            for tell in self.tell:
                tell(stage, value)


def _seconds(kept: Path) -> dict[str, float]:
    """What was counted before; nothing where that cannot be read, it decides nothing."""
    try:
        before = json.loads(kept.read_text())
        return {stage: float(before[stage]) for stage in STAGES if stage in before}
    except (OSError, ValueError, TypeError):
        return {}
