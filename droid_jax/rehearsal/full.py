"""The complete rehearsal: synthetic logs with hidden effects, and the same identification and search on each.

The synthetic robot is plain C MuJoCo, and its hidden effects are written independently of the library
(`droid_jax.synthetic`).  It has no law for some effects, such as user effects.  The library's law is simulated for
these, and the result states it.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.cost.cost import without_unused
from droid_jax.discrepancy.candidates import project
from droid_jax.discrepancy.config import DiscrepancyConfig
from droid_jax.discrepancy.log_case import case_of
from droid_jax.discrepancy.missing import search
from droid_jax.discrepancy.step_error import with_finer_step
from droid_jax.errors import reason
from droid_jax.identify.pipeline import IdentifyConfig, identify_parameters
from droid_jax.model.effect_interface import Effect
from droid_jax.model.effects.registry import beside, joined, ready
from droid_jax.model.parameters import Role, Space
from droid_jax.model.scene import Scene
from droid_jax.read_json import read_json
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import roles_of, split_of
from droid_jax.rehearsal.config import DEFAULT_REHEARSAL, RehearsalConfig
from droid_jax.rehearsal.linearised import Rehearsed, one_shape_each
from droid_jax.rehearsal.plan import (
    HiddenCase,
    RehearsalPlan,
    hidden_form,
    planned_recording,
    robot_trace,
    simulated_channels,
)
from droid_jax.rehearsal.quick import robot_whitened
from droid_jax.storage import write_json

RESULT = "result.json"


def hidden_cases(
    scene: Scene, known: Sequence[Mapping[str, Any]], count: int, config: RehearsalConfig = DEFAULT_REHEARSAL
) -> list[HiddenCase]:
    """Return cases: one of `empty_every` without a hidden effect, the others with the effects in turn.

    Args:
        scene: the robot.
        known: effects of a quick rehearsal; those that it would not find at any size are left out.
        count: of cases.
        config: factors on the predicted sizes.
    """
    findable = [e for e in known if e["smallest"] is not None and np.isfinite(e["smallest"])]
    pairs = [(e, factor) for factor in config.times for e in findable]
    out, turn = list[HiddenCase](), 0
    for number in range(count):
        if number % config.empty_every == 0 or not pairs:
            out.append(HiddenCase(number))
            continue
        entry, factor = pairs[turn % len(pairs)]
        turn += 1
        out.append(hidden_case(scene, number, entry, factor))
    return out


def hidden_case(scene: Scene, number: int, entry: Mapping[str, Any], times: float) -> HiddenCase:
    """Return a case with one effect of a quick rehearsal, at `times` its predicted size and within its bounds."""
    name, joint = hidden_form(scene, entry["effect"], entry["location"], entry["unit"])
    size = times * min(float(entry["smallest"]), float(entry["bound"]) / max(times, 1.0))
    effect = (entry["effect"], entry["location"], entry["coefficient"], dict(entry["shape"]))
    return HiddenCase(number, *effect, size, times, name, joint, size)


def drawn_values(
    space: Space, known: np.ndarray, rng: np.random.Generator, config: RehearsalConfig = DEFAULT_REHEARSAL
) -> np.ndarray:
    """Draw the parameters [D] of a synthetic robot, nuisances from their priors, the others around known values [D].

    A parameter that is neither of the model nor a nuisance is not drawn: the synthetic robot has no such sensor.
    """
    spread = np.where(space.nuisance, 1.0, config.spread)
    step = np.clip(rng.normal(size=len(space)), -config.farthest, config.farthest) * spread
    fixed = np.array([not p.writes and not p.nuisance for p in space.parameters])
    x = np.where(space.nuisance, 0.0, space.to_search(known)) + np.where(fixed, 0.0, step)
    return np.clip(np.where(fixed, known, space.from_search(x)), space.low, space.high)


def synthetic_log(
    scene: Scene,
    space: Space,
    effects: Sequence[Effect],
    recording: Recording,
    values: np.ndarray,
    case: HiddenCase,
    plan: RehearsalPlan,
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig,
    seed: int,
) -> Recording:
    """Return the log of a synthetic robot with a hidden effect, which follows a recording's commands, with noise.

    Args:
        scene: the robot.
        space: base parameters.
        effects: of the library.
        recording: whose commands it follows.
        values: [D] of the base parameters.
        case: the hidden effect.
        plan: what replaces the measurement.
        config: of the search.
        rehearsal: of the rehearsal.
        seed: of robot and noise.

    Raises:
        ValueError: the simulation blows up or loses its object.
    """
    simulated = replace(plan, repeats=plan.repeats or recording.repeats)
    if case.effect and not case.hidden:
        full = joined(space, effects)
        at = full.embed(space, values[None])[0]
        p = full[case.coefficient]
        at[full.index(case.coefficient)] = p.mean + case.size * (1.0 if p.high > p.mean else -1.0)
        for name, value in (case.shape or {}).items():
            at[full.index(name)] = value
        trace = simulated_channels(ready(scene), full, effects, recording, at, config)
    else:
        trace = robot_trace(scene, space, recording, values, case, config, seed, rehearsal)
    return planned_recording(scene, recording, trace, simulated, rehearsal, seed)[0]


def equally_strong(
    found: Rehearsed,
    space: Space,
    recording: Recording,
    case: HiddenCase,
    config: DiscrepancyConfig,
    rehearsal: RehearsalConfig = DEFAULT_REHEARSAL,
) -> HiddenCase:
    """Return a case whose synthetic robot's law is as strong in the score test as the library's law of its size.

    Sizes of the two laws of an effect may have different definitions, for example friction in one direction, or the
    difference of both directions.  The case is unchanged for windows or blocks.

    Args:
        found: the linear model.
        space: base parameters.
        recording: whose commands the robot follows.
        case: with the amplitude of the library's size.
        config: of the search.
        rehearsal: of the rehearsal.
    """
    if not case.hidden or not found.model.repeated:
        return case
    model = found.model

    hidden, nothing = robot_whitened(found, space, recording, [case, HiddenCase(0)], config, rehearsal)
    if hidden is None or nothing is None:
        return case
    some = np.isin(model.train.channel, found.compared)
    part = model.of(found.compared)
    residual = project((hidden - nothing)[None, some], part.train.base, part.prior_of_repeat(part.slack))[0]
    sensitivities, best = part.projected(), 0.0
    groups: dict[object, list[int]] = {}
    for k, direction in enumerate(part.directions):
        if (direction.candidate.effect, direction.candidate.location) == (case.effect, case.location):
            groups.setdefault(direction.candidate.shaped_key, []).append(k)
    for rows in groups.values():
        span, _ = np.linalg.qr(sensitivities[rows].T)
        best = max(best, float(np.linalg.norm(span.T @ residual)))
    own = [k for k in one_shape_each(part.directions) if part.directions[k].coefficient == case.coefficient]
    if not own or best <= 0 or not np.isfinite(best):
        return case
    factor = case.size * float(np.linalg.norm(sensitivities[own[0]])) / best
    factor = float(np.clip(factor, 1 / rehearsal.strongest, rehearsal.strongest))
    return replace(case, amplitude=case.size * factor, form=best**2 / max(float(residual @ residual), 1e-30))


@dataclass(frozen=True, eq=False)
class FullRehearsal:
    """What all cases have in common.

    scene, space, effects, recordings, plan, config, rehearsal: as in `quick_rehearsal`.
    identify: settings of the identification of cases with nothing hidden.
    found: the linear model from which the sizes are predicted.  seed: of the robots.
    """

    scene: Scene
    space: Space
    effects: tuple[Effect, ...]
    recordings: tuple[Recording, ...]
    plan: RehearsalPlan
    config: DiscrepancyConfig
    identify: IdentifyConfig
    rehearsal: RehearsalConfig
    found: Rehearsed
    seed: int = 0

    @property
    def known(self) -> np.ndarray:
        """[D] values of the base parameters."""
        return self.found.base.values[self.found.case.full_space.columns(self.space)]

    @property
    def channels(self) -> tuple[str, ...]:
        """The compared channels."""
        return self.found.compared


def run_case(of: FullRehearsal, case: HiddenCase, folder: Path) -> dict[str, Any]:
    """Return the result of one case, and keep it in the case's folder; a failure is a result too.

    An interrupted case resumes: its replays are cached until it has a result.
    """
    path = folder / case.name / RESULT
    if path.is_file():
        return dict(read_json(path))
    began = time.monotonic()
    case = equally_strong(of.found, of.space, of.recordings[0], case, of.config, of.rehearsal)
    result: dict[str, Any] = {**asdict(case), "same_law": bool(case.effect and not case.hidden)}
    try:
        result |= _rehearse(of, case, folder / case.name / "replays")
    except (ValueError, ArithmeticError) as error:
        result |= {"verdict": "error", "error": reason(error), "effects": [], "found": False, "taken_for": []}
    result["seconds"] = time.monotonic() - began
    write_json(path, result)
    shutil.rmtree(folder / case.name / "replays", ignore_errors=True)
    return result


def _rehearse(of: FullRehearsal, case: HiddenCase, replays: Path) -> dict[str, Any]:
    rng = np.random.default_rng([of.seed, case.number])
    scene, effects = of.scene, beside(of.space, of.effects)
    values = drawn_values(of.space, of.known, rng, of.rehearsal)
    offsets = [p.name for p in of.space.of_role(Role.TORQUE_OFFSET) if p.nuisance]
    logs = list[Recording]()
    for recording in of.recordings:
        of_recording = values.copy()
        for name in offsets:  # a torque sensor has another offset in each recording
            p = of.space[name]
            of_recording[of.space.index(name)] = np.clip(rng.normal(p.mean, p.std), p.low, p.high)
        seed = int(rng.integers(1 << 31))
        log = synthetic_log(
            scene, of.space, effects, recording, of_recording, case, of.plan, of.config, of.rehearsal, seed
        )
        channels = {n: c for n, c in log.channels.items() if n in (*of.channels, "position")}
        logs.append(replace(log, channels=channels))
        if recording is of.recordings[0]:
            values = of_recording
    split = split_of(logs)
    roles = roles_of(split, logs)
    config = replace(of.config, channels=of.channels)
    search_case = case_of(split, scene, of.space, effects, roles, config)
    fine = with_finer_step(search_case.train, search_case.base, roles["train"])
    _, verdict = search(split, search_case.with_replay_cache(replays), fine)
    named = [str(k) for k in verdict.effects]
    indistinguishable = [[[str(k) for k in keys] for keys in each] for each in verdict.indistinguishable]
    right = f"{case.effect} at {case.location}"
    alternatives = {name for each in indistinguishable for keys in each for name in keys}
    out: dict[str, Any] = {
        "verdict": verdict.conclusion.value,
        "sentence": verdict.sentence,
        "p": verdict.score_tests[0].p if verdict.score_tests else None,
        "effects": named,
        "indistinguishable": indistinguishable,
        "found": bool(case.effect) and (right in named or (bool(named) and right in alternatives)),
        "taken_for": [n for n in named if n != right],
        "truth": dict(zip(of.space.names, values.tolist(), strict=True)),
    }
    if not case.effect:
        out["parameters"] = judged_parameters(of, logs, values)
    return out


def judged_parameters(of: FullRehearsal, logs: Sequence[Recording], values: np.ndarray) -> list[dict[str, Any]]:
    """Return for every parameter of interest whether an identification recovers it, and its interval holds the truth.

    logs: of a synthetic robot.  values: [D] of the robot.
    """
    space = without_unused(of.space, logs[:1])
    main = space.select([p.name for p in space.parameters if not p.nuisance])
    names = [p.name for p in space.parameters if p.nuisance]
    config = replace(of.identify, channels=of.channels)
    found = identify_parameters(
        of.scene, main, list(logs[:1]), nuisances=space.select(names) if names else None, config=config
    )
    low, high = found.full_gaussian.interval(of.rehearsal.interval_level)
    verdicts = {verdict.name: verdict for verdict in found.identifiability}
    best = dict(zip(found.full.names, found.best, strict=True))
    out = []
    for k, name in enumerate(found.full_gaussian.space.names):
        if name not in main.names:
            continue
        truth = float(values[of.space.index(name)])
        out.append(
            {
                "name": name,
                "truth": truth,
                "value": float(best[name]),
                "interval": [float(low[k]), float(high[k])],
                "holds": bool(low[k] <= truth <= high[k]),
                "recovered": bool(verdicts[name].identifiable) if name in verdicts else False,
            }
        )
    return out


def run_cases(
    of: FullRehearsal, cases: Iterable[HiddenCase], folder: Path, report: Callable[[str], None] = lambda line: None
) -> list[dict[str, Any]]:
    """Return the results of all cases; existing ones are read.

    of: common settings.  folder: of the results.  report: called with a line for each new result.
    """
    out = []
    for case in cases:
        done = (folder / case.name / RESULT).is_file()
        result = run_case(of, case, folder)
        out.append(result)
        if not done:
            named = " + ".join(result["effects"]) or result["verdict"]
            report(f"{case.name}: {named} ({result['seconds']:.0f} s)")
    return out


def scores(results: Sequence[Mapping[str, Any]], share: float) -> dict[str, Any]:
    """Return the scores of complete rehearsals as plain data.

    results: of `run_case`.  share: of rehearsals in which an effect must be found.
    """
    hidden = [r for r in results if r["effect"] and r["verdict"] != "error"]
    empty = [r for r in results if not r["effect"] and r["verdict"] != "error"]
    effects = []
    for key in dict.fromkeys((r["effect"], r["location"], r["coefficient"]) for r in hidden):
        of_effect = [r for r in hidden if (r["effect"], r["location"], r["coefficient"]) == key]
        sizes = sorted({r["size"] for r in of_effect})
        rates = [(s, [r["found"] for r in of_effect if r["size"] == s]) for s in sizes]
        enough = [s for i, (s, _) in enumerate(rates) if all(np.mean(f) >= share for _, f in rates[i:])]
        wrong = sorted({n for r in of_effect for n in r["taken_for"] if not r["found"]})
        effects.append(
            {
                "effect": key[0],
                "location": key[1],
                "coefficient": key[2],
                "sizes": [{"size": s, "cases": len(f), "found": int(sum(f))} for s, f in rates],
                "smallest": enough[0] if enough else None,
                "taken_for": wrong,
                "same_law": of_effect[0]["same_law"],
            }
        )
    verdicts = [p for r in empty for p in r.get("parameters", ())]
    parameters = [
        {
            "name": name,
            "cases": len(mine),
            "recovered": sum(p["recovered"] for p in mine),
            "holds": sum(p["holds"] for p in mine),
        }
        for name in dict.fromkeys(p["name"] for p in verdicts)
        if (mine := [p for p in verdicts if p["name"] == name])
    ]
    return {
        "cases": len(results),
        "failed": sum(r["verdict"] == "error" for r in results),
        "nothing_hidden": {"cases": len(empty), "named": sum(bool(r["effects"]) for r in empty)},
        "effects": effects,
        "parameters": parameters,
    }
