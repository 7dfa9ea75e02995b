"""The quick form: what would be found and recovered, from sensitivities alone, without a search."""

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
from droid_jax.rehearsal.linear import (
    LinearModel,
    RehearsalConfig,
    alternatives_of,
    distinguishable,
    leftover_of,
    taken_by,
)
from droid_jax.rehearsal.linearised import Rehearsed, Tell, one_shape_each, rehearsed
from droid_jax.rehearsal.plan import (
    HiddenCase,
    RehearsalPlan,
    faster_motion,
    hidden_form,
    robot_trace,
)
from droid_jax.rehearsal.power import smallest_sizes


def parameter_identifiability(found: Rehearsed, model: LinearModel, more: float = 1.0) -> tuple[Identifiability, ...]:
    """What the recordings would say of each base parameter; more: times as many of them."""
    refined, train = found.base.refined, found.case.train
    seen = np.isin(found.model.train.channel, np.unique(model.train.channel))
    if not found.model.repeated:  # the validation blocks are fitted by `identify` too
        more = 2 * more
    jacobian = refined.jacobian[seen] * np.sqrt(more * model.repeats / max(found.model.repeats, 1))
    part = replace(refined, jacobian=jacobian, residual=refined.residual[seen])
    gaussian = with_stated_prior(_posterior(part, model, train), part)
    return identifiability(gaussian, part.prior, train.identifiability)


def _posterior(refined: Refined, model: LinearModel, train: ResidualSet) -> Gaussian:
    rows = model.train.rows
    # Of the mean of the repeats, as the slopes are.
    deviations = [rows.deviations * rows.units**0.5] if model.repeated else [np.zeros((1, len(refined.jacobian)))]  # type: ignore[attr-defined]
    return calibrated(refined, deviations, None, train.identifiability.pooling)


def answers(found: Rehearsed, config: DiscrepancyConfig, rehearsal: RehearsalConfig) -> list[dict[str, Any]]:
    """Of each coefficient at each place: the smallest size that is found, and what it is taken for."""
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
                    {"effect": r.key.effect, "location": r.key.location, "share": r.share, "below": r.apart}
                    for r in others
                ],
            }
        )
    return out


def robot_whitened(
    found: Rehearsed, space: Space, recording: Recording, cases: Sequence[HiddenCase], config: DiscrepancyConfig
) -> list[np.ndarray | None]:
    """[M] of each case what the synthetic robot measures of the training motion, in one repeat's noise.

    None where its simulation blows up.  MuJoCo's steps leave Python to the other threads.
    """
    comparison, scene = found.case.train.comparison, found.case.train.cost.scene
    known = found.base.values[found.case.full_space.columns(space)]
    clock = comparison.clock - comparison.clock[0]

    def simulated(case: HiddenCase) -> Rollout | None:
        try:
            return robot_trace(scene, space, recording, known, case, config, 0)
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
    """Of each answer whether an effect of that size would be known for what it is; None where none is found.

    The linear model takes effects to be small and the robot's law to be the library's.  Here each is simulated at the
    size that was found.  One whose law has a shape is simulated at its best place once more with the law of the
    synthetic robot, which has another.  Of the two the worse counts: `own` is the share of what the base parameters
    leave of it that the library's effect takes, `other` a candidate that takes clearly more.
    """
    out: list[dict[str, Any] | None] = [None] * len(known)
    sizes = [e["smallest"] for e in known]
    asked = [i for i, size in enumerate(sizes) if np.isfinite(size)]
    if not found.model.repeated or not asked:
        return out
    train, wanted, model = found.case.train, one_shape_each(found.model.directions), found.model.of(found.compared)
    seen = np.isin(found.model.train.channel, found.compared)

    def check(i: int, difference: np.ndarray, law: str) -> None:
        if not np.isfinite(difference).all():
            return
        left = leftover_of(model, difference[seen], np.zeros(len(model.validation.base)), 1.0)
        taken = taken_by(model, left.at(1.0)[0], left.free[-1])
        own = max(v for key, v in taken.items() if (key.effect, key.location) == _place(known[i]))
        alternative = max(taken, key=taken.__getitem__)
        apart = known[i]["noncentrality"] ** 2 * (taken[alternative] - own)
        confused = apart > distinguishable(model, config, rehearsal.share)
        confused &= 1 - own > config.selection.equivalence_factor * (1 - taken[alternative])
        other = (
            {"effect": alternative.effect, "location": alternative.location, "share": taken[alternative]}
            if confused
            else None
        )
        before, sure = out[i], bool(own >= rehearsal.known and not confused)
        if before is None or (own < before["own"] and not (before["sure"] is False and sure)):
            out[i] = {"law": law, "own": own, "other": other, "sure": sure}

    far = [sizes[i] * float(found.model.sign[wanted[i]]) for i in asked]
    slopes = sensitivities(train, found.base.values, [found.model.directions[wanted[i]] for i in asked], far)
    for i, slope, size in zip(asked, slopes, far, strict=True):
        check(i, slope * size, "the library's")
    for i, difference in _other_laws(found, space, known, config):
        check(i, difference, "the synthetic robot's")
    return out


def _other_laws(
    found: Rehearsed, space: Space, known: Sequence[Mapping[str, Any]], config: DiscrepancyConfig
) -> Iterator[tuple[int, np.ndarray]]:
    """Of each effect with a shape, at its best place, what the synthetic robot's law adds to the training part, [M]."""
    recording, scene = found.roles["train"], found.case.train.cost.scene
    if not recording.command.size:
        return
    best = [entry for entry, _ in _one_each(known, range(len(known)))]
    asked, cases = list[int](), [HiddenCase(0)]
    shaped = {effect.name for effect in found.case.effects if effect.shape_parameters}
    for i, entry in enumerate(known):
        if entry["effect"] not in shaped:
            continue
        name, joint = hidden_form(scene, entry["effect"], entry["location"], entry["unit"])
        if name and np.isfinite(entry["smallest"]) and any(entry is one for one in best):
            asked.append(i)
            cases.append(HiddenCase(0, hidden=name, joint=joint, amplitude=entry["smallest"]))
    if not asked:
        return
    plain, *others = robot_whitened(found, space, recording, cases, config)
    for i, other in zip(asked, others, strict=True):
        if plain is not None and other is not None:
            yield i, other - plain


def _place(entry: Mapping[str, Any]) -> tuple[str, str]:
    return entry["effect"], entry["location"]


def improvements(
    found: Rehearsed,
    known: Sequence[Mapping[str, Any]],
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
    faster: Rehearsed | None = None,
) -> list[dict[str, Any]]:
    """What more repeats, another channel or another motion would change, the most helpful first."""
    model, every = found.model.of(found.compared), one_shape_each(found.model.directions)
    known, wanted = zip(*_one_each(known, every), strict=True)
    before = np.array([e["smallest"] for e in known])
    recovered = _recovered(found, model, rehearsal)
    out = []

    def helped(what: str, before: np.ndarray, after: np.ndarray, now: int) -> None:
        both = np.isfinite(before) & np.isfinite(after)
        ratio = float(np.exp(np.mean(np.log(before[both] / after[both])))) if both.any() else 1.0
        out.append(
            {
                "what": what,
                "times_smaller": ratio,
                "newly_found": int(np.sum(~np.isfinite(before) & np.isfinite(after))),
                "lost": int(np.sum(np.isfinite(before) & ~np.isfinite(after))),
                "recovered_more": now - recovered,
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
        helped(what, before, after, _recovered(found, other, rehearsal, more))
    if faster is not None:  # of the training motion alone, as this one
        moved, here = faster.model.of(found.compared), without_step(model.alone(every))  # nor does the other know it
        rows = [every.index(k) for k in wanted]
        helped("the faster motion", sizes(here, rows), sizes(moved, rows), _recovered(faster, moved, rehearsal))
    return sorted(out, key=lambda o: -(o["newly_found"] - o["lost"] + 10 * np.log(o["times_smaller"])))


def _of_longer_log(entry: Mapping[str, Any], more: float) -> float:
    """What is asked for of a log so many times as long, without the margin: all but the smallest size that is named."""
    least = entry["minimum"]
    limits = {name: (limit, least if name == "minimum effect size" else 0.0) for name, limit in entry["limits"].items()}
    return max((fixed + (limit - fixed) / np.sqrt(more) for limit, fixed in limits.values()), default=np.inf)


def without_step(model: LinearModel) -> LinearModel:
    """The model without what the time step leaves."""
    return replace(model, train=replace(model.train, step=None), validation=replace(model.validation, step=None))


def _one_each(known: Sequence[Mapping[str, Any]], wanted: Sequence[int]) -> list[tuple[Mapping[str, Any], int]]:
    """Of each effect the place and coefficient that is found at the smallest share of its bound."""
    best: dict[str, tuple[Mapping[str, Any], int]] = {}
    for entry, k in zip(known, wanted, strict=True):
        other = best.get(entry["effect"])
        if other is None or entry["smallest"] / entry["bound"] < other[0]["smallest"] / other[0]["bound"]:
            best[entry["effect"]] = entry, k
    return list(best.values())


def _variants(found: Rehearsed) -> Iterator[tuple[str, LinearModel, float]]:
    """What could be changed of the same motion, its linear model, and how many times as long a log is."""
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
    tell: Tell = lambda stage: None,
    *,
    faster: bool = True,
    step_error: bool = True,
) -> tuple[Rehearsed, dict[str, Any]]:
    """What a search in these recordings would find.

    Args:
        scene: the robot.
        space: all that is fitted without any effect.
        effects: that could be hidden.
        recordings: as given to the search.
        plan: repeats, noise, channels and parameter values that are stated; None: as measured.
        config: of the search.
        rehearsal: what counts as found.
        tell: called with each stage's name.
        faster: whether a faster motion is looked at too.
        step_error: whether to measure what the time step leaves.

    Returns:
        The linear model of the search, and its answers as plain data (rehearsal.json).

    Raises:
        ValueError: what the search refuses too, or a simulation that blows up.
    """
    began, used = time.monotonic(), time.process_time()
    plan, config = plan or RehearsalPlan(), config or DiscrepancyConfig()
    rehearsal = rehearsal or RehearsalConfig()
    found = rehearsed(scene, space, effects, recordings, plan, config, rehearsal, tell, step_error=step_error)
    tell("tests")
    known = answers(found, config, rehearsal)
    tell("laws")
    checks = law_checks(found, space, known, config, rehearsal)
    known = [{**entry, "law": check} for entry, check in zip(known, checks, strict=True)]
    model = found.model.of(found.compared)
    other = None
    if faster and found.model.repeated and all(r.command.size for r in recordings):
        tell("a faster motion")
        moved = [faster_motion(r, rehearsal.faster) for r in recordings]
        other_plan = replace(plan, repeats=found.model.repeats * (2 if found.split is Split.REPEATS else 1))
        try:
            with warnings.catch_warnings():  # what there is to warn of was said of the motion itself
                warnings.simplefilter("ignore", UserWarning)
                other = rehearsed(
                    scene, space, effects, moved, other_plan, config, rehearsal, tell, step_error=False, train_only=True
                )
        except ValueError as error:
            warnings.warn(f"the faster motion was not looked at: {error}", stacklevel=2)
    tell("improvements")
    helps = improvements(found, known, config, rehearsal, other)
    limit = rehearsal.recovered or config.identifiability.identifiable
    verdicts = parameter_identifiability(found, model)
    of = {p.name: p for p in found.base.space.parameters}
    at = dict(zip(found.case.full_space.names, found.base.values, strict=True))
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
                "name": t.name,
                "unit": of[t.name].unit,
                "value": float(at[t.name]),
                "nuisance": bool(of[t.name].nuisance),
                "shrinkage": t.shrinkage,
                "recovered": bool(t.shrinkage < limit),
                "partners": [list(p) for p in t.partners],
            }
            for t in verdicts
        ],
        "effects": known,
        "helps": helps,
        "seconds": {**dict(found.seconds), "whole": time.monotonic() - began, "cpu": time.process_time() - used},
    }
    return found, answer
