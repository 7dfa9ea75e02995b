"""Scoring: what the searches said against what was hidden, case by case; the rates over them are in `rates`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from droid_jax.storage import file_sha256
from droid_jax.synthetic.hidden_effects import Applied
from experiments.blind.answers import beside, matched, parts, right
from experiments.blind.baselines import bic_outcome
from experiments.blind.cases import amplitude, key
from experiments.blind.rates import NAMEABLE, NAMING, confusion, grouped, rate, summarise
from experiments.blind.scenes import setting

CLEAN = ("named", "indistinguishable")  # and say that this is all
OPEN = ("unexplained", "partly explained")
ROUNDED = 1.05  # beyond this times the stated multiple of its limit an effect is larger than that says
SEEN = 0.02  # U above the floor below which a recording shows no gap
COMPARABLE = 0.5  # of an effect's own size, left over by its library form, up to which amplitudes are compared

# {"truth": sealed file, "result": its search's file, "right", "parts": [names of each hidden effect], "oracle": file}
Case = Mapping[str, Any]


def score_folder(results: Path, sealed: Path, limits: Mapping[str, Any], oracles: Path | None = None) -> dict[str, Any]:
    """Everything about all cases with a result.  oracles: folder of what the right names could reach, if known."""
    scenes: dict[str, Any] = {}
    found, missing = [], dict[str, list[str]]()
    for path in sorted(sealed.glob("*.json")):
        result, truth = results / path.name, json.loads(path.read_text())
        if not result.is_file():
            missing.setdefault(truth["scene"], []).append(path.stem)
            continue
        if truth["scene"] not in scenes:
            scenes[truth["scene"]] = setting(truth["scene"]).scene
        scene = scenes[truth["scene"]]
        names = [list(right(scene, Applied(**h))) for h in truth["hidden"]]
        found.append(
            {
                "truth": truth,
                "result": json.loads(result.read_text()),
                "right": names,
                "parts": [list(parts(scene, Applied(**h))) for h in truth["hidden"]],
                "oracle": oracle_of(result, oracles / path.name) if oracles else None,
            }
        )
    refuse_other_limits((case["truth"] for case in found), limits)
    judged = [judge(case, limits) for case in found]
    by_scene = {s: [c for c in judged if c["scene"] == s] for s in sorted(scenes)}
    hidden = [c for c in judged if c["class"] != "none"]
    return {
        "summary": {scene: summarise(cases) for scene, cases in by_scene.items()},
        "all_scenes": {"wrong_name_rate": rate(hidden, lambda c: c["wrong_confident"])},
        "not_searched": missing,
        "by_group": {name: summarise(cases) for name, cases in grouped(judged).items()},
        "confusion": {scene: confusion(cases) for scene, cases in by_scene.items()},
        "commits": sorted({c["truth"]["commit"] for c in found}),
        **{
            f"searched_by_{whose}_code": sorted(c["truth"]["name"] for c in found if code_of(c) == whose)
            for whose in ("other", "unknown")
        },
        "cases": judged,
    }


def code_of(case: Case) -> str:
    """Whether the commit that searched is the "frozen" one that the case's seed is of, an "other" one or "unknown"."""
    code = case["result"].get("code")
    return "unknown" if code is None else "frozen" if code == case["truth"]["commit"] else "other"


def judge(case: Case, limits: Mapping[str, Any]) -> dict[str, Any]:
    """One case: what was hidden, what is right and wrong about the verdict, and what it closed."""
    truth, result = case["truth"], case["result"]
    times = times_limit(truth, limits)
    return {
        "name": truth["name"],
        "seed": truth.get("seed"),
        "scene": truth["scene"],
        "class": truth["kind"],
        "factor": truth["factor"],
        "hidden": {key(h["name"], h["joint"]): h["amplitude"] for h in truth["hidden"]},
        "times_limit": times,
        "larger": any(t > ROUNDED * truth["factor"] for t in times.values()),
        "code": result.get("code"),
        "p": result.get("p"),
        **answered(case),
        "reachable": reachable(case),
        "discrepancies": result.get("discrepancies", {}),
        "closed": _shares(result) if result.get("effects") else {},
        "within_floor": within_floor(result),
        "coverage": coverage(case),
        "counterpart_coverage": counterpart_coverage(case, limits),
        "baselines": against_baselines(case),
        "seconds": result.get("seconds", {}),
    }


def answered(case: Case) -> dict[str, Any]:
    """What the verdict says, and what of its names is right: where a form was taken away, none can be.

    named: by right names, own or equivalent, in a tie or not.  own: every hidden effect's own name is among them.
    """
    result, left_out = case["result"], case["truth"]["kind"] == "left_out"
    verdict, effects, ties = result["verdict"], result.get("effects", ()), result.get("indistinguishable", ())
    right_names = [[] for _ in case["right"]] if left_out else case["right"]
    slots = slots_of(result, right_names)
    met = matched(slots, right_names)
    own_names = [names[:1] for names in right_names]
    allowed = [*right_names, *beside([] if left_out else case["parts"], met)]
    false = [sorted(slot) for slot in slots if not any(slot & set(names) for names in allowed)]
    exact = [any(e == names[0] for e in effects) for names in right_names if names]
    named = bool(met) and all(met) and not false and verdict in NAMING
    alone = bool(exact) and all(exact) and len(effects) == len(exact) and not any(ties)
    return {
        "verdict": verdict,
        "effects": list(effects),
        "indistinguishable": [list(t) for t in ties],
        "false_names": false,
        "wrong_confident": bool(false) and verdict in CLEAN,
        "said": [saying(*part, right_names, allowed) for part in zip(effects, ties, strict=True)],
        "met": met,
        "named": named,
        "own": named and all(matched(slots_of(result, own_names), own_names)),
        "alone": alone and verdict in NAMING,
        "exact": alone and verdict == "named",
        "open": verdict in OPEN,
    }


def slots_of(result: Mapping[str, Any], right_names: Sequence[Sequence[str]]) -> list[set[str]]:
    """The parts of an answer: each effect with its ties.

    A tie of several at once ("a + b" is equivalent) gives as many answers, where each of them is right.
    """
    known, out = {name for names in right_names for name in names}, list[set[str]]()
    for effect, ties in zip(result.get("effects", ()), result.get("indistinguishable", ()), strict=True):
        slot = {effect, *ties}
        several = [t.split(" + ") for t in ties if " + " in t]
        whole = next((names for names in several if known.issuperset(names)), None)
        out += [slot | {name} for name in whole] if whole else [slot]
    return out


def saying(
    effect: str, ties: Sequence[str], right_names: Sequence[Sequence[str]], allowed: Sequence[Sequence[str]]
) -> str:
    """An effect of an answer, without its place: by the exact name of what it or a tie of it names rightly, or its own.

    "(elsewhere)": a right effect, or a part of one, in the wrong place.  Ties of several at once are not looked at.
    """
    said = [effect, *(tie for tie in ties if " + " not in tie)]
    hits = [names[0] for name in said for names in right_names if name in names]
    if hits:
        return _plain(hits[0])
    right_ones = [name for names in allowed for name in names]
    elsewhere = [name for name in said if name not in right_ones and _plain(name) in map(_plain, right_ones)]
    return f"{_plain(elsewhere[0])} (elsewhere)" if elsewhere else _plain(effect)


def _plain(name: str) -> str:
    return name.split(" at ")[0]


def times_limit(truth: Mapping[str, Any], limits: Mapping[str, Any]) -> dict[str, float]:
    """How many times its detection limit each hidden effect is: more than the factor where its worth sets its size."""
    known = limits.get(truth["scene"], {})
    names = {key(h["name"], h["joint"]): abs(h["amplitude"]) for h in truth["hidden"]}
    return {n: size / known[n]["limit"] for n, size in names.items() if known.get(n, {}).get("limit")}


def refuse_other_limits(truths: Iterable[Mapping[str, Any]], limits: Mapping[str, Any]) -> None:
    """ValueError where a case does not hide what its factor and these limits say."""
    for truth in truths:
        known = limits.get(truth["scene"], {})
        for h in truth["hidden"]:
            size = amplitude(h["name"], h["joint"], truth["factor"], known)
            if size is None or not np.isclose(abs(h["amplitude"]), size):
                raise ValueError(
                    f"{truth['name']} hides {abs(h['amplitude']):.4g} of {h['name']}, by these limits it would be "
                    f"{size}: give those that the cases were made with (--limits)"
                )


def oracle_of(result: Path, oracle: Path) -> dict[str, Any] | None:
    """What the right names could reach on the case of a result; None where that is not known, or of another result.

    Oracles before 2be0ce3 do not tell whose they are.
    """
    known = json.loads(oracle.read_text()) if oracle.is_file() else None
    whose = file_sha256(result)
    return known if known and known.get("of", whose) == whose else None


def closed(result: Mapping[str, Any], role: str) -> float | None:
    """1 - (U after - U0) / (U before - U0); None where there was hardly a gap to close."""
    before, after = result["discrepancies"][role]
    if before - result["discretisation_error"] < SEEN:
        return None
    return 1.0 - (after - result["discretisation_error"]) / (before - result["discretisation_error"])


def _shares(result: Mapping[str, Any]) -> dict[str, float]:
    """Role -> share of its gap that was closed, of the recordings that show one."""
    shares = {role: closed(result, role) for role in result.get("discrepancies", {})}
    return {role: share for role, share in shares.items() if share is not None}


def reachable(case: Case) -> float | None:
    """Share of the confirming recording's gap that the oracle's names close from the truth; None where not known.

    Of the oracle alone, whatever was named, so that what is missed and what is named are asked alike.  It is no upper
    bound: a search that begins elsewhere may close more.  One that has not settled tells only that so much can be
    closed, which says something where it is `NAMEABLE`.  0 where the base model leaves hardly a gap: nothing can be
    named there.
    """
    oracle, result = case["oracle"] or {}, case["result"]
    if "discrepancies" not in oracle or "validation" not in result.get("discrepancies", {}):
        return None
    before, floor = result["discrepancies"]["validation"][0], result["discretisation_error"]
    if before - floor < SEEN:
        return 0.0
    share = (before - oracle["discrepancies"]["validation"]) / (before - floor)
    return share if share >= NAMEABLE or oracle.get("converged") else None


def within_floor(result: Mapping[str, Any]) -> bool | None:
    """Whether what is left on the sealed recording is within 2 U0 of the floor."""
    if "test" not in result.get("discrepancies", {}):
        return None
    return bool(result["discrepancies"]["test"][1] <= 3.0 * result["discretisation_error"])


def coverage(case: Case) -> list[bool]:
    """For each amplitude of the answer: whether its interval holds what the same model settles at without noise."""
    settled = (case["oracle"] or {}).get("settled") or {}
    found = case["result"].get("coefficients", {})
    return [bool(found[n]["interval"][0] <= at <= found[n]["interval"][1]) for n, at in settled.items() if n in found]


def counterpart_coverage(case: Case, limits: Mapping[str, Any]) -> list[bool]:
    """For each amplitude that was named exactly and has a counterpart: whether its interval holds that.

    The counterpart is what the library form takes when it is fitted to what the hidden effect adds to the torques
    of another robot (`forms.py`); only forms with one amplitude that leave little over are compared.  The error of
    the form is in it, and in no interval.
    """
    truth, out = case["truth"], []
    for hidden in truth["hidden"]:
        form = limits.get(truth["scene"], {}).get(key(hidden["name"], hidden["joint"]), {}).get("form", {})
        if len(form.get("per_unit", ())) != 1 or form["left_after_refit"] > COMPARABLE:
            continue
        ((name, per_unit),) = form["per_unit"].items()
        span = case["result"].get("coefficients", {}).get(name)
        if span is not None:
            low, high = span["interval"]
            out.append(bool(low <= per_unit * hidden["amplitude"] <= high))
    return out


def against_baselines(case: Case) -> dict[str, Any] | None:
    """What BIC named, and what search and black box closed of the same gaps, on this case."""
    found = case["result"].get("baselines")
    if not found:
        return None
    left_out = case["truth"]["kind"] == "left_out"
    names = [[] for _ in case["right"]] if left_out else case["right"]
    box = _shares({"discrepancies": found["black_box"], "discretisation_error": case["result"]["discretisation_error"]})
    search = _shares(case["result"])  # 0 where nothing was named
    return {
        "bic": found["bic"],
        **{f"bic_{k}": v for k, v in bic_outcome(found["bic"], names, [] if left_out else case["parts"]).items()},
        "closed": {"search": search, "black_box": {role: share for role, share in box.items() if role in search}},
    }
