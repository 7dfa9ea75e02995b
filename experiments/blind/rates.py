"""Rates over judged cases, with their intervals: by scene, class and factor, and what was taken for what."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from droid_jax.policy.trials import wilson

NAMING = ("named", "indistinguishable", "partly explained")  # verdicts that give a name
ANSWERED = ("none", *NAMING, "unexplained")  # verdicts that say something; an error or an unconverged fit does not
CLOSED = 0.8  # share of a gap that a named effect has to close
NAMEABLE = 0.5  # share of the gap that the right names have to close from the truth: less explains nothing
ABOVE = 3.0  # multiple of its detection limit from which an effect counts in the rates of what is named


def grouped(judged: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """By scene and class, and by factor too."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for case in judged:
        for name in (f"{case['scene']}/{case['class']}", _label(case)):
            groups.setdefault(name, []).append(case)
    return dict(sorted(groups.items()))


def _label(case: Mapping[str, Any]) -> str:
    return f"{case['scene']}/{case['class']}/{case['factor']:g}x"


def summarise(judged: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """All rates of some cases, those that do not apply left away.

    What is named is counted of effects at three times their limit or more (at the limit half shall be detected at all),
    what is named falsely of everything hidden.
    """
    none = [c for c in judged if c["class"] == "none" and c["verdict"] in ANSWERED]
    known = [c for c in judged if c["class"] in ("single", "pair") and c["factor"] >= ABOVE]
    single, pair = [c for c in known if c["class"] == "single"], [c for c in known if c["class"] == "pair"]
    nameable = [c for c in known if (c["reachable"] or 0.0) >= NAMEABLE]
    alone, both = [c for c in nameable if c["class"] == "single"], [c for c in nameable if c["class"] == "pair"]
    strange = [c for c in judged if c["class"] in ("outside", "left_out")]
    hidden = [c for c in judged if c["class"] != "none"]
    named = [c for c in known if c["named"]]
    rates = {
        "false_alarm_rate": rate(none, lambda c: c["verdict"] != "none"),
        "false_names_where_nothing": rate(none, lambda c: bool(c["effects"])),
        "wrong_name_rate": rate(hidden, lambda c: c["wrong_confident"]),
        "false_names": rate(hidden, lambda c: bool(c["false_names"])),
        "detected": rate(known, lambda c: c["verdict"] in (*NAMING, "unexplained")),
        "named_up_to_tie": rate(single, lambda c: c["named"]),
        "named_by_its_own_name": rate(single, lambda c: c["own"]),
        "named_alone": rate(single, lambda c: c["alone"]),
        "named_exactly": rate(single, lambda c: c["exact"]),
        **{
            f"{name}_{size}": rate([c for c in single if c["larger"] == larger], lambda c, key=key: c[key])
            for size, larger in (("at_the_multiple", False), ("larger", True))
            for name, key in (("named_up_to_tie", "named"), ("named_alone", "alone"))
        },
        "nameable": rate([c for c in known if c["reachable"] is not None], lambda c: c["reachable"] >= NAMEABLE),
        "nameable_unknown": rate(known, lambda c: c["reachable"] is None),
        "nameable_named_up_to_tie": rate(alone, lambda c: c["named"]),
        "nameable_named_exactly": rate(alone, lambda c: c["exact"]),
        "nameable_pair_one_named_none_false": rate(both, lambda c: any(c["met"]) and not c["false_names"]),
        "nameable_pair_both_named": rate(both, lambda c: c["named"]),
        "alternatives": _alternatives(named),
        "partly": rate(single, lambda c: c["verdict"] == "partly explained"),
        "pair_one_named_none_false": rate(pair, lambda c: any(c["met"]) and not c["false_names"]),
        "pair_both_named": rate(pair, lambda c: c["named"]),
        "unexplained_recall": rate(strange, lambda c: c["open"]),
        "unconverged_or_error": rate(judged, lambda c: c["verdict"] not in ANSWERED),
        "gap_closed_validation": closing(named, "validation"),
        "gap_closed": closing(named, "test"),
        "gap_closed_whatever_was_named": closing([c for c in judged if c["effects"]], "test"),
        "within_floor": rate(named, lambda c: bool(c["within_floor"])),
        **{
            f"amplitude_{key}": rate([inside for c in named for inside in c[key]], bool)
            for key in ("coverage", "counterpart_coverage")
        },
        "baselines": summarise_baselines(judged),
        "seconds": _seconds(judged),
    }
    return {"cases": len(judged), **{name: figure for name, figure in rates.items() if figure is not None}}


def summarise_baselines(judged: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The same cases by simpler means: BIC's names, the gap that the base model leaves, and the black box.

    Its share of the gap is beside the search's, of everything hidden and whatever the search named.
    """
    done = [c for c in judged if c["baselines"]]
    if not done:
        return None
    none, known = ([c for c in done if c["class"] in kinds] for kinds in (("none",), ("single", "pair")))
    shares = [c["baselines"]["closed"] for c in done if c["class"] != "none"]
    sealed = [
        c["discrepancies"]["test"][0] for c in done if "test" in c["discrepancies"]
    ]  # not of one that blew up there
    return {
        "base_gap_test_median": float(np.median(sealed)) if sealed else None,
        "bic_names_where_nothing": rate(none, lambda c: bool(c["baselines"]["bic"])),
        "bic_names_all_hidden": rate(known, lambda c: c["baselines"]["bic_all"]),
        "bic_false_names": rate(done, lambda c: c["baselines"]["bic_false"]),
        **{
            f"{who}_closed_{role}": closing([{"closed": s[who]} for s in shares], role)
            for who in ("search", "black_box")
            for role in ("validation", "test")
        },
    }


def rate(cases: Sequence[Any], hit: Callable[[Any], bool]) -> dict[str, Any] | None:
    """Share of cases with its 95 % interval; None of no case."""
    if not cases:
        return None
    hits = sum(bool(hit(c)) for c in cases)
    interval = list(wilson(hits, len(cases)))
    return {"hits": hits, "of": len(cases), "rate": hits / len(cases), "interval_95": interval}


def closing(cases: Sequence[dict[str, Any]], role: str) -> dict[str, Any] | None:
    """Median of the gap closed with a bootstrap over cases, and the share of cases that close `CLOSED` of it.

    Of cases that show a gap there.
    """
    values = np.array([c["closed"][role] for c in cases if role in c["closed"]])
    if not len(values):
        return None
    draws = np.median(np.random.default_rng(0).choice(values, (2000, len(values))), axis=1)
    return {
        "median": float(np.median(values)),
        "interval_95": np.quantile(draws, [0.025, 0.975]).tolist(),
        "at_least": rate(values.tolist(), lambda v: v >= CLOSED),
    }


def confusion(judged: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """What was hidden -> what the verdict says (`saying`), or its kind where it names nothing."""
    table: dict[str, Counter[str]] = {}
    for case in judged:
        hidden = "+".join(sorted(h.split("[")[0] for h in case["hidden"])) or "nothing"
        said = " + ".join(sorted(case["said"])) or f"({case['verdict']})"
        table.setdefault(f"{hidden}{' left out' if case['class'] == 'left_out' else ''}", Counter())[said] += 1
    return {hidden: dict(said.most_common()) for hidden, said in sorted(table.items())}


def _alternatives(named: Sequence[dict[str, Any]]) -> dict[str, float] | None:
    """How many names an answer gives for one effect, itself among them: a tie of everything names nothing."""
    counts = [1 + len(ties) for c in named for ties in c["indistinguishable"]]
    return {"median": float(np.median(counts)), "mean": float(np.mean(counts)), "most": max(counts)} if counts else None


def _seconds(judged: Sequence[dict[str, Any]]) -> dict[str, float] | None:
    """Median seconds of a case by stage, and in all."""
    taken = [c["seconds"] for c in judged if c["seconds"]]
    if not taken:
        return None
    stages = {s: float(np.median([t.get(s, 0.0) for t in taken])) for s in dict.fromkeys(s for t in taken for s in t)}
    return {**stages, "whole": float(np.median([sum(t.values()) for t in taken]))}
