"""The search on one case folder after another: recordings in, a small JSON file out.  Knows no truth.

One process takes many cases: those of a scene repeat the same commands, so their replays are compiled once.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.common import CODE
from benchmarks.sharing import claimed
from droid_jax.cost.cost import Cost
from droid_jax.discrepancy.case import Case, ResidualSet, make_case, residual_set
from droid_jax.discrepancy.fitting import FittedModel, base_fit
from droid_jax.discrepancy.posterior import intervals
from droid_jax.discrepancy.search import search_effects
from droid_jax.discrepancy.step_error import discretisation_error, with_finer_step, with_step_difference
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.model.effects.candidate import names_of
from droid_jax.recordings.formats import load_recording
from droid_jax.recordings.recording import Recording
from droid_jax.storage import write_json
from experiments.blind.baselines import baselines
from experiments.blind.scenes import ROLES, Setting, setting
from experiments.trials import answer_json, validation_json

# What is kept as the result of a case that fails; running out of memory is none, and a later start tries it again.
FAILED = (ValueError, ArithmeticError)


@dataclass
class Bench:
    """Settings and compiled replays that later cases use again."""

    settings: dict[str, Setting] = field(default_factory=dict)
    compiled: dict[str, Case] = field(default_factory=dict)
    fine: dict[str, Cost | None] = field(default_factory=dict)

    def setting(self, name: str) -> Setting:
        """The setting of a scene, made once."""
        if name not in self.settings:
            self.settings[name] = setting(name)
        return self.settings[name]

    def case(self, scene: str, recordings: Mapping[str, Recording], without: Iterable[str] = ()) -> Case:
        """The case of recordings by role; effects left out stay at neutral and are not asked for.

        Where there is nothing to confirm or to judge on, the fitted recording stands in.
        """
        where = self.setting(scene)
        given = {role: recordings.get(role, recordings["train"]) for role in ROLES}
        key = ", ".join((scene, *sorted(recordings)))
        if key not in self.compiled:
            self.compiled[key] = make_case(where.scene, where.base, where.effects(), **given)
        known = self.compiled[key]
        of = {role: _again(known.residual_sets[role], recording) for role, recording in recordings.items()}
        kept = {e.name for e in where.effects(without)}
        return replace(known, **of, effects=tuple(e for e in known.effects if e.name in kept))

    def with_step(self, scene: str, case: Case, model: FittedModel, recording: Recording) -> Case:
        """The case that knows what its time step does; the finer replay is compiled once a scene."""
        if scene not in self.fine:
            self.fine[scene] = with_finer_step(case.train, model.space, recording)
        fine = self.fine[scene]
        return replace(case, train=with_step_difference(case.train, model, fine and fine.against([recording])))


def _again(known: ResidualSet, recording: Recording) -> ResidualSet:
    """The evidence of another recording of the same commands, on the same compiled replay."""
    fresh = residual_set(known.cost.against([recording]))
    return fresh.with_nuisances(known.nuisances) if known.nuisances else fresh


@dataclass
class Stopwatch:
    """Seconds by stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    def __call__(self, stage: str, work: Callable[[], Any]) -> Any:
        began = time.monotonic()
        try:
            return work()
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.monotonic() - began


def search_case(folder: Path, bench: Bench) -> dict[str, Any]:
    """The result of one case folder; an error of the search is a result too."""
    told = json.loads((folder / "case.json").read_text())
    recordings = {role: load_recording(folder / "recordings" / f"{role}.npz") for role in ROLES}
    watch = Stopwatch()
    result: dict[str, Any] = {"scene": told["scene"], "without": told["without"], "code": CODE.get("git")}
    try:
        case = watch("prepare", lambda: bench.case(told["scene"], recordings, told["without"]))
        model = watch("base", lambda: base_fit(case.train, case.base, case.config, silent))
        case = watch("discretisation_error", lambda: bench.with_step(told["scene"], case, model, recordings["train"]))
        verdict = watch("find", lambda: search_effects(case, model, discretisation_error(case.train, model)))
    except FAILED as error:
        return {**result, "verdict": "error", "error": str(error), "seconds": watch.seconds}
    result |= describe(case, verdict)
    first = verdict.score_tests[0] if verdict.score_tests else None
    try:
        result["baselines"] = watch("baselines", lambda: baselines(case, model, first, recordings))
    except FAILED as error:  # what they are compared with stands
        result["baselines_failed"] = str(error)
    return {**result, "seconds": watch.seconds}


def describe(case: Case, verdict: Verdict) -> dict[str, Any]:
    """A verdict as plain numbers."""
    spans = intervals(case.train, verdict.model) if verdict.model.parts else {}
    space = case.full_space
    return {
        **answer_json(verdict),
        "sentence": verdict.sentence,
        "hints": [
            {
                "effects": list(map(str, hint.effects)),
                "indistinguishable": [list(map(names_of, each)) for each in hint.indistinguishable],
                "closed": hint.closed,
            }
            for hint in verdict.hints
        ],
        "doubts": list(verdict.doubts),
        "remainder": verdict.remainder,
        "p": verdict.score_tests[0].p if verdict.score_tests else None,
        "discrepancies": {role: list(pair) for role, pair in verdict.discrepancies.items()},
        "discretisation_error": verdict.discretisation_error,
        "converged": verdict.base.refined.converged,
        "coefficients": {
            name: {"value": float(verdict.model.values[space.index(name)]), "interval": list(span)}
            for name, span in spans.items()
        },
        "shape_parameters": {
            name: float(verdict.model.values[space.index(name)])
            for part in verdict.model.parts
            for name in part.shape_parameters
        },
        "validation_tests": [validation_json(trial) for trial in verdict.validation_tests],
    }


def search_all(wanted: Iterable[tuple[Path, Path]], bench: Bench, tell: Callable[[str], None] = print) -> int:
    """Search every (case folder, folder of results) that has no result yet; how many there were.

    Processes that run the same command share them.
    """
    count = 0
    for folder, results in wanted:
        path = results / f"{folder.name}.json"
        with claimed(path, wait=False) as mine:
            if not mine or path.is_file():
                continue
            result = search_case(folder, bench)
            write_json(path, result)
        count += 1
        taken = ", ".join(f"{stage} {seconds:.0f}" for stage, seconds in result["seconds"].items())
        tell(f"{folder.name}: {result.get('sentence', result.get('error'))} ({taken} s)")
    return count


def silent(stage: str, value: Any) -> None:
    """Progress that nobody follows."""
