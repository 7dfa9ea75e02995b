"""Functions of the gap searches in single real logs: the search, its controls, its false alarms, its report.

Every experiment answers four questions about its log:

1. What is missing in the base model?
2. Control: with that effect in the model, is it named again?  (It must not be.)
3. Control: is a known effect found that is added to the real measurement?  The torque that the effect adds to the
   simulation is added to the measured torque; the real residual stays.
4. False alarms: synthetic logs of the real motion with nothing missing, with torques of the fitted base model and
   coloured noise fitted to the real residual.  In how many is something found to be missing, and in how many named?
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import tuned  # noqa: F401  before anything that imports jax

# isort: split
import hashlib

import numpy as np
import scipy.linalg
import scipy.signal
from inverse_fit import rms, rounded

from benchmarks.common import CODE
from benchmarks.sharing import code_name, kept
from droid_jax.cost.lone_log import LoneLog
from droid_jax.cost.residuals import CompareConfig
from droid_jax.discrepancy.case import Case, only_comparison
from droid_jax.discrepancy.config import DiscrepancyConfig, SelectionConfig
from droid_jax.discrepancy.fitting import base_model
from droid_jax.discrepancy.log_case import make_log, single_case
from droid_jax.discrepancy.posterior import deviations, intervals
from droid_jax.discrepancy.search import search_effects
from droid_jax.discrepancy.statistics import Blocks
from droid_jax.discrepancy.verdict import Verdict
from droid_jax.identify.multistart import RefineConfig
from droid_jax.model.effect_interface import Effect, Theta
from droid_jax.model.effects.registry import effect_space
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.policy.trials import wilson
from droid_jax.recordings.recording import Recording
from experiments.trials import answer_json, validation_json

ORDER = 20  # of the noise's autoregression, at 20 Hz: one second
BURN = 400  # samples before the noise is stationary


# Search ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Search:
    """A log, the base model, and the effects that may be missing in it.

    sealed: another log as test data, or None.
    base: parameters of the base model, including those of `known`, the effects that it has.
    """

    log: LoneLog
    sealed: LoneLog | None
    base: Space
    effects: tuple[Effect, ...]
    config: DiscrepancyConfig
    known: tuple[Effect, ...] = ()

    def case(self, log: LoneLog | None = None, start: np.ndarray | None = None) -> Case:
        """Of this log, or of another with the same motion."""
        return single_case(log or self.log, self.base, self.effects, self.sealed, self.config, start)


def settings(motion_cutoff: float, seed: int) -> DiscrepancyConfig:
    """Settings without a search before the refinement: inverse dynamics is smooth in its parameters."""
    return DiscrepancyConfig(
        refine=RefineConfig(iterations=12, basin_hops=0, spreads=0),
        compare=CompareConfig(whitened=True, motion_cutoff=motion_cutoff),
        seed=seed,
    )


def make_search(
    scene: Scene,
    base: Space,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    config: DiscrepancyConfig,
    known: Sequence[Effect] = (),
) -> Search:
    """A search in one recording, or in the first of two with the second sealed.

    known: effects that the base has beside the parameters `base` (see `as_known`).
    """
    base = base + effect_space(known) if known else base
    logs = [make_log(scene, base, effects, r, config, known) for r in recordings]
    return Search(logs[0], logs[1] if len(logs) > 1 else None, base, tuple(effects), config, tuple(known))


def run_search(search: Search, log: LoneLog | None = None, start: np.ndarray | None = None) -> tuple[Case, Verdict]:
    """Its case and the verdict."""
    case = search.case(log, start)
    return case, search_effects(case, base_model(case, start), 0.0)


def answer(search: Search, log: LoneLog | None = None) -> dict[str, Any]:
    """The report of a search, or the reason why the search was refused."""
    try:
        return report(*run_search(search, log))
    except ValueError as error:
        silent = {"effects": [], "indistinguishable": [], "p": [], "rms": {}}
        return {"verdict": "refused", "sentence": str(error), **silent}


def as_known(effect: Effect) -> Effect:
    """The same effect with parameters `known_...`, for a base model that has it while it is a candidate again."""

    def own(theta: Theta) -> Theta:
        return {p.name: theta[f"known_{p.name}"] for p in effect.parameters}

    def renamed(function: Callable[..., Any] | None) -> Callable[..., Any] | None:
        return None if function is None else lambda theta, *rest: function(own(theta), *rest)

    return Effect(
        f"known {effect.name}",
        tuple(replace(p, name=f"known_{p.name}", group="Model") for p in effect.parameters),
        force=renamed(effect.force),
        frictionloss=renamed(effect.frictionloss),
        observe=renamed(effect.observe),
    )


def adding(log: LoneLog, values: np.ndarray, added: Mapping[str, float]) -> LoneLog:
    """The log plus the change of the simulation by the parameters `added`, at `values` [D]."""
    without, with_it = log.simulated(np.stack([values, _changed(log, values, added)]))
    return log.with_torques(log.measured + with_it - without)


def _changed(log: LoneLog, values: np.ndarray, added: Mapping[str, float]) -> np.ndarray:
    out = values.copy()
    for name, value in added.items():
        out[log.space.index(name)] = value
    return out


# False alarms ------------------------------------------------------------------------------


def coloured(residuals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[K, C] noise with the autocorrelation of residuals [K, C], column by column (Yule and Walker)."""
    out = []
    for column in (residuals - residuals.mean(axis=0)).T:
        size = len(column)
        lags = np.array([column[: size - k] @ column[k:] / size for k in range(ORDER + 1)])
        weights = scipy.linalg.solve_toeplitz(lags[:-1], lags[1:])
        deviation = np.sqrt(max(lags[0] - weights @ lags[1:], 0.0))
        drawn = scipy.signal.lfilter([1.0], np.r_[1.0, -weights], rng.normal(0.0, deviation, size + BURN))
        out.append(np.asarray(drawn)[BURN:])
    return np.stack(out, axis=1)


def false_alarms(search: Search, verdict: Verdict, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """The whole search on `count` synthetic logs in which nothing is missing; shares are of those not refused.

    Torques are those of the fitted base model; the noise is like the residuals of the extended model in the real log.
    folder: the result of each log is kept there, so that a stopped run can be continued.
    """
    rng = np.random.default_rng(seed)
    truth, left = verdict.base.values, search.log.residual(verdict.model.values)
    simulated = search.log.simulated(truth[None])[0]
    code = code_name(CODE.get("git"))
    missing, named = [], []
    for number in range(count):
        log = search.log.with_torques(simulated + coloured(left, rng))
        path = folder / f"{number:04d}_{_key(log, code)}.json"
        said = kept(path, lambda log=log: _said_of(search, log, truth))
        print(f"  {number + 1:4d}: {said}", flush=True)
        if "refused" in said:
            continue
        missing.append(said["p"] < SelectionConfig().significance)
        named.extend([{"case": number, "effects": said["effects"]}] if said["effects"] else [])
    return {
        "cases": count,
        "refused": count - len(missing),
        "said_to_be_missing": share(int(np.sum(missing)), len(missing)),
        "named": share(len(named), len(missing)),
        "names": named,
        "noise": f"autoregression of order {ORDER} of the residual that the extended model leaves, column by column",
        "level": SelectionConfig().significance,
    }


def _said_of(search: Search, log: LoneLog, start: np.ndarray) -> dict[str, Any]:
    """Result of a search in a log: p, verdict, effects, blocks; or why it was refused."""
    try:
        case, found = run_search(search, log, start)
    except ValueError as error:  # too short for the residual's correlation time
        return {"refused": str(error)}
    answer = answer_json(found)
    said = {"p": found.score_tests[0].p, "verdict": answer["verdict"], "effects": answer["effects"]}
    return {**said, "blocks": case.train.resampling.units}


def _key(log: LoneLog, code: str) -> str:
    """Key of a kept result: hash of the log's torques and the program's commit."""
    return hashlib.sha256(np.ascontiguousarray(log.measured).tobytes() + code.encode()).hexdigest()[:12]


def share(hits: int, count: int) -> dict[str, Any]:
    """Hits, their share and its 95 % interval, which is 0 to 1 without cases."""
    if count == 0:
        return {"hits": 0, "share": None, "interval": [0.0, 1.0]}
    return {"hits": hits, "share": round(hits / count, 4), "interval": rounded(wilson(hits, count))}


# Report ------------------------------------------------------------------------------------


def report(case: Case, verdict: Verdict) -> dict[str, Any]:
    """A verdict with its grounds as JSON values."""
    spans, widths = intervals(case.train, verdict.model), deviations(case.train, verdict.model)
    torque = only_comparison(case.train.cost).channel("torque")
    return {
        **answer_json(verdict),
        "sentence": verdict.sentence,
        "values": {
            p.name: {
                "unit": p.unit,
                "value": float(verdict.model.values[case.full_space.index(p.name)]),
                **({"interval": rounded(spans[p.name]), "deviation": widths[p.name]} if p.name in spans else {}),
                "base": float(verdict.base.values[case.full_space.index(p.name)]),
            }
            for p in verdict.model.space.parameters
        },
        "p": [s.p for s in verdict.score_tests],
        "discrepancies": {
            role: {"before": b, "after": a, "closed": 1 - a / b} for role, (b, a) in verdict.discrepancies.items()
        },
        "rms": {role: _rms_of(case, verdict, role) for role in ("train", "validation", "test")},
        "noise_stated": rounded(1 / torque.noise.weight.max(axis=0)),
        "blocks": {"each": case.train.resampling.units, "seconds": round(_block_seconds(case), 3)},
        "where": [
            {**asdict(b.key), "axis": b.key.axis.value, "before": b.discrepancy, "after": a.discrepancy}
            for b, a in zip(verdict.before, verdict.after, strict=True)
        ],
        "validation_tests": [validation_json(trial) for trial in verdict.validation_tests],
    }


def _block_seconds(case: Case) -> float:
    """Shortest of the blocks."""
    rows, time = case.train.resampling, case.train.time
    assert isinstance(rows, Blocks)
    block = rows.block[case.train.column == 0]
    return min(float(np.sum(block == b)) for b in range(rows.units)) * float(time[1] - time[0])


def _rms_of(case: Case, verdict: Verdict, role: str) -> dict[str, list[float]]:
    """RMS of each column before and after, in its unit, over the instants of a role."""
    evidence = case.residual_sets[role]
    inside, log = evidence.instants_of(evidence.comparison.leading), evidence.cost
    assert isinstance(log, LoneLog)
    return {
        when: rounded(rms(log.residual(model.values)[inside]))
        for when, model in (("before", verdict.base), ("after", verdict.model))
    }


def show(title: str, found: Mapping[str, Any]) -> None:
    """Print a few lines about the result."""
    print(f"{title}: {found['sentence']}  (p {', '.join(f'{p:.2g}' for p in found['p'])})", flush=True)
    for role, r in found["rms"].items():
        print(f"  {role:8s} RMS {r['before']} -> {r['after']}", flush=True)


def names_one_of(found: Mapping[str, Any], names: Sequence[str]) -> bool | None:
    """Whether one of some effects is named, possibly as indistinguishable; None where the search was refused."""
    if found["verdict"] == "refused":
        return None
    said = [*found["effects"], *(n for t in found["indistinguishable"] for n in t)]
    return any(s.split(" at ")[0] in names for s in said)


def silent_about(found: Mapping[str, Any], names: Sequence[str]) -> bool | None:
    """Whether none of the effects is named; None where the search was refused."""
    named = names_one_of(found, names)
    return None if named is None else not named
