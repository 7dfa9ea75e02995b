"""The quick rehearsal: which effects would be found and which parameters recovered, from sensitivities alone."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from droid_jax import runtime
from droid_jax.discrepancy.candidates import sensitivities
from droid_jax.discrepancy.case import ResidualSet
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.identify.gaussian import Gaussian
from droid_jax.identify.identifiability import Identifiability, calibrated, identifiability, with_stated_prior
from droid_jax.identify.multistart import Refined
from droid_jax.model.effect_interface import Effect, Rollout
from droid_jax.model.parameters import Space
from droid_jax.model.scene import Scene
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import Split
from droid_jax.rehearsal.config import DEFAULT_REHEARSAL, RehearsalConfig
from droid_jax.rehearsal.imitations import alternatives_of, distinguishable, explained_shares
from droid_jax.rehearsal.linear import LinearModel, unabsorbed_part
from droid_jax.rehearsal.linearised import Rehearsed, ReportStage, one_shape_each, rehearsed
from droid_jax.rehearsal.plan import (
    HiddenCase,
    RehearsalPlan,
    faster_motion,
    hidden_form,
    robot_trace,
)
from droid_jax.rehearsal.power import smallest_sizes


def parameter_identifiability(found: Rehearsed, model: LinearModel, more: float = 1.0) -> tuple[Identifiability, ...]:
    """Return which base parameters are identifiable from the recordings, or from `more` times as many of them.

    found: the rehearsal.  model: its linear model, or a variant with other channels or repeats.
    """
    refined, train = found.base.refined, found.case.train
    some = np.isin(found.model.train.channel, np.unique(model.train.channel))
    if not found.model.repeated:  # `identify` fits the validation blocks too
        more = 2 * more
    jacobian = refined.jacobian[some] * np.sqrt(more * model.repeats / max(found.model.repeats, 1))
    part = replace(refined, jacobian=jacobian, residual=refined.residual[some])
    gaussian = with_stated_prior(_posterior(part, model, train), part)
    return identifiability(gaussian, part.prior, train.identifiability)


def _posterior(refined: Refined, model: LinearModel, train: ResidualSet) -> Gaussian:
    rows = model.train.rows
    # In units of the noise of the repeats' mean, as the Jacobian is.
    deviations = [rows.deviations * rows.units**0.5] if model.repeated else [np.zeros((1, len(refined.jacobian)))]  # type: ignore[attr-defined]
    return calibrated(refined, deviations, None, train.identifiability.pooling)


def answers(found: Rehearsed, config: DiscrepancyConfig, rehearsal: RehearsalConfig) -> list[dict[str, Any]]:
    """Return for each coefficient at each location the smallest size that is found, and effects named instead."""
    model, space = found.model.of(found.compared), found.case.full_space
    wanted = one_shape_each(model.directions)
    out = []
    for k, size in zip(wanted, smallest_sizes(model, wanted, rehearsal, config), strict=True):
        direction, p = model.directions[k], space[model.directions[k].coefficient]
        others = alternatives_of(model, k, size.size, config, rehearsal.share)
        out.append(
            {
                "effect": direction.candidate.effect,
                "location": direction.candidate.location,
                "coefficient": direction.coefficient,
                "unit": p.unit,
                "shape": dict(direction.candidate.shape_parameters),
                "smallest": size.size,
                "limit": size.limit,
                "limits": dict(size.limits),
                "minimum": float(model.minimum[k]),
                "bound": float(model.largest[k]),
                "noncentrality": size.noncentrality,
                "taken_for": [
                    {
                        "effect": other.key.effect,
                        "location": other.key.location,
                        "share": other.share,
                        "below": other.distinguishable_from,
                    }
                    for other in others
                ],
            }
        )
    return out


def robot_whitened(
    found: Rehearsed,
    space: Space,
    recording: Recording,
    cases: Sequence[HiddenCase],
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig = DEFAULT_REHEARSAL,
) -> list[np.ndarray | None]:
    """Return for each case the residual [M] of the synthetic robot's training motion, in one repeat's noise.

    None where its simulation blows up.  The cases are simulated in threads: mj_step releases Python's lock.
    """
    comparison, scene = found.case.train.comparison, found.case.train.cost.scene
    values = found.base.values[found.case.full_space.columns(space)]
    clock = comparison.clock - comparison.clock[0]

    def simulated(case: HiddenCase) -> Rollout | None:
        try:
            return robot_trace(scene, space, recording, values, case, config, 0, rehearsal)
        except ValueError:
            return None

    def whitened(trace: Rollout) -> np.ndarray:
        fields = {n: interpolate(clock, trace.time, getattr(trace, n)) for n in ("torque", "position", "velocity")}
        angle = np.interp(clock, trace.time, trace.object_angle)
        on_clock = replace(trace, time=clock, object_angle=angle, contact=np.zeros((len(clock), 0), bool), **fields)
        return np.asarray(comparison.whitened(on_clock), float) / comparison.repeats**0.5

    with ThreadPoolExecutor(runtime.cores()) as pool:
        traces = list(pool.map(simulated, cases))
    return [None if trace is None else whitened(trace) for trace in traces]


def law_checks(
    found: Rehearsed,
    space: Space,
    known: Sequence[Mapping[str, Any]],
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
) -> list[dict[str, Any] | None]:
    """Return for each answer whether the search would name an effect of that size; None for effects not found.

    The linear model assumes that effects are small and that the robot's law is the library's.  Here each effect is
    simulated at the size that was found.  An effect whose law has a shape is also simulated at its best location with
    the synthetic robot's law, which has another shape; the worse result counts.

    Args:
        found: the rehearsal.
        space: base parameters.
        known: results of `answers`.
        config: of the search.
        rehearsal: of the rehearsal.

    Returns:
        law: whose law it is.  own: share of the unabsorbed part that the library's effect explains.  other: a candidate
        that explains clearly more, or None.  sure: whether the effect would be named.
    """
    out: list[dict[str, Any] | None] = [None] * len(known)
    sizes = [e["smallest"] for e in known]
    numbers = [i for i, size in enumerate(sizes) if np.isfinite(size)]
    if not found.model.repeated or not numbers:
        return out
    train, wanted, model = found.case.train, one_shape_each(found.model.directions), found.model.of(found.compared)
    some = np.isin(found.model.train.channel, found.compared)

    def check(i: int, change: np.ndarray, law: str) -> None:
        if not np.isfinite(change).all():
            return
        part = unabsorbed_part(model, change[some], np.zeros(len(model.validation.base)), 1.0)
        shares = explained_shares(model, part.at(1.0)[0], part.free[-1])
        own = max(share for key, share in shares.items() if (key.effect, key.location) == _place(known[i]))
        best = max(shares, key=shares.__getitem__)
        distance = known[i]["noncentrality"] ** 2 * (shares[best] - own)
        confused = distance > distinguishable(model, config, rehearsal.share)
        confused &= 1 - own > config.selection.equivalence_factor * (1 - shares[best])
        other = {"effect": best.effect, "location": best.location, "share": shares[best]} if confused else None
        before, sure = out[i], bool(own >= rehearsal.known and not confused)
        if before is None or (own < before["own"] and not (before["sure"] is False and sure)):
            out[i] = {"law": law, "own": own, "other": other, "sure": sure}

    signed = [sizes[i] * float(found.model.sign[wanted[i]]) for i in numbers]
    secants = sensitivities(train, found.base.values, [found.model.directions[wanted[i]] for i in numbers], signed)
    for i, secant, size in zip(numbers, secants, signed, strict=True):
        check(i, secant * size, "the library's")
    for i, change in _robot_laws(found, space, known, config, rehearsal):
        check(i, change, "the synthetic robot's")
    return out


def _robot_laws(
    found: Rehearsed,
    space: Space,
    known: Sequence[Mapping[str, Any]],
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
) -> Iterator[tuple[int, np.ndarray]]:
    """Number of each effect with a shape, and the change [M] of the training part by the synthetic robot's law.

    It is at the effect's best location.
    """
    recording, scene = found.roles["train"], found.case.train.cost.scene
    if not recording.command.size:
        return
    best = [entry for entry, _ in _best_of_each_effect(known, range(len(known)))]
    numbers, cases = list[int](), [HiddenCase(0)]
    shaped = {effect.name for effect in found.case.effects if effect.shape_parameters}
    for i, entry in enumerate(known):
        if entry["effect"] not in shaped:
            continue
        name, joint = hidden_form(scene, entry["effect"], entry["location"], entry["unit"])
        if name and np.isfinite(entry["smallest"]) and any(entry is one for one in best):
            numbers.append(i)
            cases.append(HiddenCase(0, hidden=name, joint=joint, amplitude=entry["smallest"]))
    if not numbers:
        return
    without, *with_law = robot_whitened(found, space, recording, cases, config, rehearsal)
    for i, residual in zip(numbers, with_law, strict=True):
        if without is not None and residual is not None:
            yield i, residual - without


def _place(entry: Mapping[str, Any]) -> tuple[str, str]:
    return entry["effect"], entry["location"]


def improvements(
    found: Rehearsed,
    known: Sequence[Mapping[str, Any]],
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
    faster: Rehearsed | None = None,
) -> list[dict[str, Any]]:
    """Return what more repeats, another channel or a faster motion would change, the most helpful first.

    known: results of `answers`.  faster: the rehearsal of the faster motion, or None.
    """
    model, every = found.model.of(found.compared), one_shape_each(found.model.directions)
    known, wanted = zip(*_best_of_each_effect(known, every), strict=True)
    before = np.array([e["smallest"] for e in known])
    recovered = _recovered(found, model, rehearsal)
    out = []

    def add(what: str, before: np.ndarray, after: np.ndarray, recovered_after: int) -> None:
        both = np.isfinite(before) & np.isfinite(after)
        ratio = float(np.exp(np.mean(np.log(before[both] / after[both])))) if both.any() else 1.0
        out.append(
            {
                "what": what,
                "times_smaller": ratio,
                "newly_found": int(np.sum(~np.isfinite(before) & np.isfinite(after))),
                "lost": int(np.sum(np.isfinite(before) & ~np.isfinite(after))),
                "recovered_more": recovered_after - recovered,
            }
        )

    def sizes(of: LinearModel, rows: Sequence[int]) -> np.ndarray:
        return np.array([s.size for s in smallest_sizes(of, rows, rehearsal, config)])

    for what, other, more in _variants(found):
        if not other.repeated and more > 1:
            needed = np.array([_of_longer_log(e, more) for e in known]) * rehearsal.margin
            after = np.where(needed <= [e["bound"] for e in known], needed, np.inf)
        else:
            after = sizes(other, wanted)
        add(what, before, after, _recovered(found, other, rehearsal, more))
    if faster is not None:  # of the training part alone, without the time step's error, which both models then lack
        changed, unchanged = faster.model.of(found.compared), without_step(model.alone(every))
        rows = [every.index(k) for k in wanted]
        add("the faster motion", sizes(unchanged, rows), sizes(changed, rows), _recovered(faster, changed, rehearsal))
    return sorted(out, key=lambda o: -(o["newly_found"] - o["lost"] + 10 * np.log(o["times_smaller"])))


def _of_longer_log(entry: Mapping[str, Any], more: float) -> float:
    """Required size for a log `more` times as long, without the margin; the minimum effect size does not change."""
    minimum = entry["minimum"]
    limits = {
        name: (limit, minimum if name == "minimum effect size" else 0.0) for name, limit in entry["limits"].items()
    }
    return max((fixed + (limit - fixed) / np.sqrt(more) for limit, fixed in limits.values()), default=np.inf)


def without_step(model: LinearModel) -> LinearModel:
    """Return the model without the time step's error."""
    return replace(model, train=replace(model.train, step=None), validation=replace(model.validation, step=None))


def _best_of_each_effect(
    known: Sequence[Mapping[str, Any]], wanted: Sequence[int]
) -> list[tuple[Mapping[str, Any], int]]:
    """The location and coefficient of each effect that is found at the smallest share of its bound."""
    best: dict[str, tuple[Mapping[str, Any], int]] = {}
    for entry, k in zip(known, wanted, strict=True):
        other = best.get(entry["effect"])
        if other is None or entry["smallest"] / entry["bound"] < other[0]["smallest"] / other[0]["bound"]:
            best[entry["effect"]] = entry, k
    return list(best.values())


def _variants(found: Rehearsed) -> Iterator[tuple[str, LinearModel, float]]:
    """Changes without another motion, the linear model of each, and the factor on the length of a log."""
    model = found.model.of(found.compared)
    for factor in (2, 4):
        if model.repeated:
            yield f"{factor} times as many repeats", replace(model, repeats=factor * model.repeats), 1.0
        else:
            yield f"a log {factor} times as long", model, float(factor)
    for name in dict.fromkeys(found.model.train.channel.tolist()):
        if name not in found.compared:
            yield f"{name.replace('_', ' ')} compared too", found.model.of((*found.compared, name)), 1.0


def _recovered(found: Rehearsed, model: LinearModel, rehearsal: RehearsalConfig, more: float = 1.0) -> int:
    """Number of parameters of interest that are recovered."""
    verdicts = parameter_identifiability(found, model, more)
    limit = rehearsal.recovered or found.case.train.identifiability.identifiable
    nuisance = dict(zip(found.base.space.names, found.base.space.nuisance, strict=True))
    return sum(t.shrinkage < limit for t in verdicts if not nuisance[t.name])


def quick_rehearsal(
    scene: Scene,
    space: Space,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    plan: RehearsalPlan | None = None,
    config: DiscrepancyConfig | None = None,
    rehearsal: RehearsalConfig | None = None,
    report: ReportStage = lambda stage: None,
    *,
    faster: bool = True,
    step_error: bool = True,
) -> tuple[Rehearsed, dict[str, Any]]:
    """Return what a search in these recordings would find.

    Args:
        scene: the robot.
        space: all parameters that are fitted without any effect.
        effects: that could be hidden.
        recordings: as given to the search.
        plan: stated repeats, noise, channels and parameter values; None for those of the measurement.
        config: of the search; None for the defaults.
        rehearsal: settings of the rehearsal; None for the defaults.
        report: called with each stage's name.
        faster: whether to rehearse a faster motion too.
        step_error: whether to measure the error of the time step.

    Returns:
        The linear model of the search, and the answers as plain data (rehearsal.json).

    Raises:
        ValueError: the search refuses the inputs too, or a simulation blows up.
    """
    began, used = time.monotonic(), time.process_time()
    plan, config = plan or RehearsalPlan(), config or DiscrepancyConfig()
    rehearsal = rehearsal or RehearsalConfig()
    found = rehearsed(scene, space, effects, recordings, plan, config, rehearsal, report, step_error=step_error)
    report("tests")
    known = answers(found, config, rehearsal)
    report("laws")
    checks = law_checks(found, space, known, config, rehearsal)
    known = [{**entry, "law": check} for entry, check in zip(known, checks, strict=True)]
    model = found.model.of(found.compared)
    other = None
    if faster and found.model.repeated and all(r.command.size for r in recordings):
        report("a faster motion")
        fast = [faster_motion(r, rehearsal.faster) for r in recordings]
        fast_plan = replace(plan, repeats=found.model.repeats * (2 if found.split is Split.REPEATS else 1))
        try:
            with warnings.catch_warnings():  # the same warnings were given for the original motion
                warnings.simplefilter("ignore", UserWarning)
                other = rehearsed(
                    scene, space, effects, fast, fast_plan, config, rehearsal, report, step_error=False, train_only=True
                )
        except ValueError as error:
            warnings.warn(f"the faster motion was not rehearsed: {error}", stacklevel=2)
    report("improvements")
    helps = improvements(found, known, config, rehearsal, other)
    limit = rehearsal.recovered or config.identifiability.identifiable
    verdicts = parameter_identifiability(found, model)
    parameters = {p.name: p for p in found.base.space.parameters}
    values = dict(zip(found.case.full_space.names, found.base.values, strict=True))
    answer = {
        "format": "droid_jax rehearsal 1",
        "form": "quick",
        "recordings": [r.name for r in recordings],
        "split": found.split.value,
        "limits": [*filter(None, (found.split.limits, *found.case.limits))],
        "how": {
            "compared": list(found.compared),
            "repeats": found.model.repeats if found.model.repeated else None,
            "blocks": None if found.model.repeated else found.model.train.rows.units,
            "simulated": plan.simulated,
            "noise": [
                dict(zip(("channel", "column", "unit", "deviation", "source"), row, strict=True))
                for row in found.noise
                if row[0] in found.compared
            ],
            "step_error": model.step_error,
            "level": model.train.level,
            "directions": len(model.directions),
            "rehearsal": asdict(rehearsal),
            "significance": config.selection.significance,
            "confirmation": config.selection.confirmation,
            "recovered_below": limit,
        },
        "parameters": [
            {
                "name": verdict.name,
                "unit": parameters[verdict.name].unit,
                "value": float(values[verdict.name]),
                "nuisance": bool(parameters[verdict.name].nuisance),
                "shrinkage": verdict.shrinkage,
                "recovered": bool(verdict.shrinkage < limit),
                "partners": [list(p) for p in verdict.partners],
            }
            for verdict in verdicts
        ],
        "effects": known,
        "helps": helps,
        "seconds": {**dict(found.seconds), "whole": time.monotonic() - began, "cpu": time.process_time() - used},
    }
    return found, answer
