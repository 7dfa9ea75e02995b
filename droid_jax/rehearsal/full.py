"""The full form: synthetic logs with something hidden, and the same identification and search on each.

The synthetic robot is plain C MuJoCo, and its hidden effects are written without the library (`droid_jax.synthetic`).
Of an effect that it has no law of its own for, such as one of the user's, the library's law is simulated instead, and
the result says so.
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
from droid_jax.rehearsal.linear import RehearsalConfig
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

SPREAD = 0.5  # prior deviations by which parameters of interest are drawn
FAR = 2.5  # prior deviations from which on a nuisance is drawn no further
LEVEL = 0.9  # of the intervals that are judged
TIMES = (1.0, 0.5, 2.0)  # of the size that the quick form predicts, in turns
EMPTY = 5  # one case of so many has nothing hidden
FARTHEST = 10.0  # times the library's size that an amplitude is taken to be, and the other way round
RESULT = "result.json"


def hidden_cases(
    scene: Scene, known: Sequence[Mapping[str, Any]], count: int, times: Sequence[float] = TIMES
) -> list[HiddenCase]:
    """N cases: every fifth with nothing hidden, the others go through the effects at the predicted sizes in turns.

    known: the effects of a quick rehearsal; those that it would not find at any size are left out.
    """
    able = [e for e in known if e["smallest"] is not None and np.isfinite(e["smallest"])]
    asked = [(e, factor) for factor in times for e in able]
    out, turn = list[HiddenCase](), 0
    for number in range(count):
        if number % EMPTY == 0 or not asked:
            out.append(HiddenCase(number))
            continue
        entry, factor = asked[turn % len(asked)]
        turn += 1
        out.append(hidden_case(scene, number, entry, factor))
    return out


def hidden_case(scene: Scene, number: int, entry: Mapping[str, Any], times: float) -> HiddenCase:
    """One effect of a quick rehearsal, at some times its predicted size."""
    name, joint = hidden_form(scene, entry["effect"], entry["location"], entry["unit"])
    size = times * min(float(entry["smallest"]), float(entry["bound"]) / max(times, 1.0))
    where = (entry["effect"], entry["location"], entry["coefficient"], dict(entry["shape"]))
    return HiddenCase(number, *where, size, times, name, joint, size)


def drawn_values(space: Space, known: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[D] a robot around known values: nuisances by their priors, parameters of interest by half of theirs.

    A parameter that is neither of the model nor a nuisance stays: the synthetic robot has no such sensor.
    """
    spread = np.where(space.nuisance, 1.0, SPREAD)
    step = np.clip(rng.normal(size=len(space)), -FAR, FAR) * spread
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
    """What a robot of values [D] with something hidden measures of a recording's commands, with its noise.

    Raises:
        ValueError: a simulation that blows up or loses its object.
    """
    full = replace(plan, repeats=plan.repeats or recording.repeats)
    if case.effect and not case.hidden:
        whole = joined(space, effects)
        at = whole.embed(space, values[None])[0]
        p = whole[case.coefficient]
        at[whole.index(case.coefficient)] = p.mean + case.size * (1.0 if p.high > p.mean else -1.0)
        for name, value in (case.shape or {}).items():
            at[whole.index(name)] = value
        trace = simulated_channels(ready(scene), whole, effects, recording, at, config)
    else:
        trace = robot_trace(scene, space, recording, values, case, config, seed)
    return planned_recording(scene, recording, trace, full, rehearsal, seed)[0]


def equally_strong(
    found: Rehearsed, space: Space, recording: Recording, case: HiddenCase, config: DiscrepancyConfig
) -> HiddenCase:
    """A case whose amplitude makes the synthetic robot's law as strong in the score test as the library's size.

    Two laws of one effect count their sizes differently: friction one way is as much both ways, and half of it as a
    difference.  Unchanged where windows or blocks take the place of repeats.
    """
    if not case.hidden or not found.model.repeated:
        return case
    model = found.model

    hidden, nothing = robot_whitened(found, space, recording, [case, HiddenCase(0)], config)
    if hidden is None or nothing is None:
        return case
    seen = np.isin(model.train.channel, found.compared)
    part = model.of(found.compared)
    left = project((hidden - nothing)[None, seen], part.train.base, part.held(part.slack))[0]
    sensitivities, best = part.projected(), 0.0
    groups: dict[object, list[int]] = {}
    for k, direction in enumerate(part.directions):
        if (direction.candidate.effect, direction.candidate.location) == (case.effect, case.location):
            groups.setdefault(direction.candidate.shaped_key, []).append(k)
    for rows in groups.values():
        span, _ = np.linalg.qr(sensitivities[rows].T)
        best = max(best, float(np.linalg.norm(span.T @ left)))
    own = [k for k in one_shape_each(part.directions) if part.directions[k].coefficient == case.coefficient]
    if not own or best <= 0 or not np.isfinite(best):
        return case
    factor = case.size * float(np.linalg.norm(sensitivities[own[0]])) / best
    share = best**2 / max(float(left @ left), 1e-30)
    return replace(case, amplitude=case.size * float(np.clip(factor, 1 / FARTHEST, FARTHEST)), form=share)


@dataclass(frozen=True, eq=False)
class FullRehearsal:
    """What all cases share.

    identify: settings of the identification of cases with nothing hidden.  found: the linear model that sizes are of.
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
        """[D] where the parameters stand."""
        return self.found.base.values[self.found.case.full_space.columns(self.space)]

    @property
    def channels(self) -> tuple[str, ...]:
        """Those that are compared."""
        return self.found.compared


def run_case(of: FullRehearsal, case: HiddenCase, folder: Path) -> dict[str, Any]:
    """The result of one case, kept in a folder of its own; what fails is a result too.

    A case that was stopped goes on: its replays are kept until it has its result.
    """
    path = folder / case.name / RESULT
    if path.is_file():
        return dict(read_json(path))
    began = time.monotonic()
    case = equally_strong(of.found, of.space, of.recordings[0], case, of.config)
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
    values = drawn_values(of.space, of.known, rng)
    own = [p.name for p in of.space.of_role(Role.TORQUE_OFFSET) if p.nuisance]
    logs = list[Recording]()
    for recording in of.recordings:
        mine = values.copy()
        for name in own:  # a sensor's offset is another one in each recording
            p = of.space[name]
            mine[of.space.index(name)] = np.clip(rng.normal(p.mean, p.std), p.low, p.high)
        seed = int(rng.integers(1 << 31))
        log = synthetic_log(scene, of.space, effects, recording, mine, case, of.plan, of.config, of.rehearsal, seed)
        kept = {n: c for n, c in log.channels.items() if n in (*of.channels, "position")}
        logs.append(replace(log, channels=kept))
        if recording is of.recordings[0]:
            values = mine
    split = split_of(logs)
    roles = roles_of(split, logs)
    config = replace(of.config, channels=of.channels)
    cased = case_of(split, scene, of.space, effects, roles, config)
    fine = with_finer_step(cased.train, cased.base, roles["train"])
    _, verdict = search(split, cased.with_replay_cache(replays), fine)
    named = [str(k) for k in verdict.effects]
    ties = [[[str(k) for k in keys] for keys in each] for each in verdict.indistinguishable]
    right = f"{case.effect} at {case.location}"
    also = {name for each in ties for keys in each for name in keys}
    out: dict[str, Any] = {
        "verdict": verdict.conclusion.value,
        "sentence": verdict.sentence,
        "p": verdict.score_tests[0].p if verdict.score_tests else None,
        "effects": named,
        "indistinguishable": ties,
        "found": bool(case.effect) and (right in named or (bool(named) and right in also)),
        "taken_for": [n for n in named if n != right],
        "truth": dict(zip(of.space.names, values.tolist(), strict=True)),
    }
    if not case.effect:
        out["parameters"] = judged_parameters(of, logs, values)
    return out


def judged_parameters(of: FullRehearsal, logs: Sequence[Recording], values: np.ndarray) -> list[dict[str, Any]]:
    """Of every parameter of interest: whether an identification recovers it, and whether its interval holds."""
    space = without_unused(of.space, logs[:1])
    main = space.select([p.name for p in space.parameters if not p.nuisance])
    names = [p.name for p in space.parameters if p.nuisance]
    config = replace(of.identify, channels=of.channels)
    found = identify_parameters(
        of.scene, main, list(logs[:1]), nuisances=space.select(names) if names else None, config=config
    )
    low, high = found.full_gaussian.interval(LEVEL)
    verdicts = {t.name: t for t in found.identifiability}
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
    of: FullRehearsal, cases: Iterable[HiddenCase], folder: Path, tell: Callable[[str], None] = lambda said: None
) -> list[dict[str, Any]]:
    """The results of all cases; those that are there are read."""
    out = []
    for case in cases:
        done = (folder / case.name / RESULT).is_file()
        result = run_case(of, case, folder)
        out.append(result)
        if not done:
            named = " + ".join(result["effects"]) or result["verdict"]
            tell(f"{case.name}: {named} ({result['seconds']:.0f} s)")
    return out


def scores(results: Sequence[Mapping[str, Any]], share: float) -> dict[str, Any]:
    """What N rehearsals say, as plain data.

    share: of rehearsals in which an effect must be found.
    """
    hidden = [r for r in results if r["effect"] and r["verdict"] != "error"]
    empty = [r for r in results if not r["effect"] and r["verdict"] != "error"]
    effects = []
    for key in dict.fromkeys((r["effect"], r["location"], r["coefficient"]) for r in hidden):
        mine = [r for r in hidden if (r["effect"], r["location"], r["coefficient"]) == key]
        sizes = sorted({r["size"] for r in mine})
        rates = [(s, [r["found"] for r in mine if r["size"] == s]) for s in sizes]
        enough = [s for i, (s, _) in enumerate(rates) if all(np.mean(f) >= share for _, f in rates[i:])]
        wrong = sorted({n for r in mine for n in r["taken_for"] if not r["found"]})
        effects.append(
            {
                "effect": key[0],
                "location": key[1],
                "coefficient": key[2],
                "sizes": [{"size": s, "cases": len(f), "found": int(sum(f))} for s, f in rates],
                "smallest": enough[0] if enough else None,
                "taken_for": wrong,
                "same_law": mine[0]["same_law"],
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
