"""The score as a table: what was asked of the search, and what it reached in each scene, with 95 % intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.blind.rates import ANSWERED, CLOSED, NAMEABLE, NAMING, closing, rate

Case = Mapping[str, Any]
Chosen = Callable[[Case], bool]


def score_table(judged: Sequence[Mapping[str, Any]], missing: Mapping[str, Sequence[str]]) -> str:
    """Markdown, one column for each scene.

    judged: the `cases` of hidden_effects.json; missing: scene -> those made and not searched.  Targets are those that
    were set before the first run.
    """
    scenes = sorted({c["scene"] for c in judged})
    counts = [sum(c["scene"] == s for c in judged) for s in scenes]
    heads = [_head(scene, count, len(missing.get(scene, ()))) for scene, count in zip(scenes, counts, strict=True)]
    rows = [["", "target", *heads], ["---"] * (2 + len(scenes))]
    for label, target, chosen, hit in _rows():
        cells = [_share([c for c in judged if c["scene"] == s and chosen(c)], hit) for s in scenes]
        if any(cells):
            rows.append([label, target, *(c or "-" for c in cells)])
    rows.append(
        ["sealed gap closed where rightly named, median", "80 %", *(_closed(judged, s, _named) for s in scenes)]
    )
    rows.append(["the same, whatever was named", "", *(_closed(judged, s, _names) for s in scenes)])
    rows.append(
        ["amplitudes in their 90 % interval", "85 to 95 %", *(_amplitudes(judged, s) for s in scenes)],
    )
    minutes = "minutes of a search, median (least to most)"
    rows.append([minutes, "6 on the door, 0.5", *(_minutes(judged, s) for s in scenes)])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def _head(scene: str, count: int, missing: int) -> str:
    return f"{scene} ({f'{count} of {count + missing}' if missing else count} cases)"


def _kind(*kinds: str, factors: Sequence[float] = ()) -> Chosen:
    return lambda c: c["class"] in kinds and (not factors or c["factor"] in factors)


def _named(case: Case) -> bool:
    return case["class"] in ("single", "pair") and bool(case["named"])


def _names(case: Case) -> bool:
    return bool(case["effects"])


def _answered(case: Case) -> bool:
    return case["class"] == "none" and case["verdict"] in ANSWERED


def _reachable(case: Case) -> bool:
    return _kind("single", factors=(3.0, 10.0))(case) and (case["reachable"] or 0.0) >= NAMEABLE


def _hidden(case: Case) -> bool:
    return case["class"] != "none"


def _false(case: Case) -> bool:
    return bool(case["false_names"])


def _rows() -> Iterator[tuple[str, str, Chosen, Chosen]]:
    """What is counted, what was asked for, of which cases, and which of them count."""
    at_limit, above = _kind("single", factors=(1.0,)), _kind("single", factors=(3.0, 10.0))
    ten, three = _kind("single", factors=(10.0,)), _kind("single", factors=(3.0,))
    own = "by its own name, not by a declared equivalent's alone"
    yield "nothing hidden: an alarm", "under 1 %", _answered, lambda c: c["verdict"] != "none"
    yield "one at 10 times its limit: named, alone or in a tie", "95 %", ten, _named
    yield f"one at 10 times: the same, {own}", "", ten, lambda c: c["own"]
    yield "one at 3 times: named, alone or in a tie", "90 %", three, _named
    yield f"one at 3 times: the same, {own}", "", three, lambda c: c["own"]
    yield "one at its limit: named, alone or in a tie", "", at_limit, _named
    yield "one at its limit: detected", "50 %", at_limit, lambda c: c["verdict"] in (*NAMING, "unexplained")
    yield "one at 3 or 10 times: named alone, a remainder or not", "", above, lambda c: c["alone"]
    yield "one at 3 or 10 times: named alone, nothing left open", "80 %", above, lambda c: c["exact"]
    yield "of these at that multiple: named, alone or in a tie", "", lambda c: above(c) and not c["larger"], _named
    yield "of these at that multiple: named alone", "", lambda c: above(c) and not c["larger"], lambda c: c["alone"]
    yield (
        "of these above the minimum effect size: named, alone or in a tie",
        "",
        lambda c: above(c) and c["larger"],
        _named,
    )
    yield "of these larger: named alone", "", lambda c: above(c) and c["larger"], lambda c: c["alone"]
    yield "one whose right name closes half of the gap from the truth: named, alone or in a tie", "", _reachable, _named
    unknown = "one at 3 or 10 times: what its right name closes from the truth is not known"
    yield unknown, "", above, lambda c: c["reachable"] is None
    yield "two: one named, nothing false", "90 %", _kind("pair"), lambda c: any(c["met"]) and not _false(c)
    yield "two: both named, nothing false", "70 %", _kind("pair"), _named
    yield "no form in the library: called open", "80 %", _kind("outside"), lambda c: c["open"]
    yield "its form taken away: called open", "80 %", _kind("left_out"), lambda c: c["open"]
    yield "either of these two: holds a false name", "", _kind("outside", "left_out"), _false
    yield "anything hidden: wrong and confident", "at most 3 %", _hidden, lambda c: c["wrong_confident"]
    yield "anything hidden: holds a false name", "", _hidden, _false
    yield "anything hidden: stepwise BIC holds a false name", "", _judged_by_bic, lambda c: c["baselines"]["bic_false"]
    yield "any: error, or fit not converged", "", lambda c: True, lambda c: c["verdict"] not in ANSWERED
    closed = f"rightly named: at least {CLOSED:.0%} of the sealed gap closed"
    yield closed, "", lambda c: _named(c) and "test" in c["closed"], lambda c: c["closed"]["test"] >= CLOSED
    yield "rightly named: sealed gap within two floors of the floor", "all", _named, lambda c: bool(c["within_floor"])
    near = "nothing hidden: sealed gap within two floors of the floor"  # what the base model itself leaves
    yield near, "", _kind("none"), lambda c: bool(c["within_floor"])


def _judged_by_bic(case: Case) -> bool:
    return _hidden(case) and bool(case["baselines"])


def _share(cases: Sequence[Any], hit: Callable[[Any], bool]) -> str:
    """ "22 of 25 (70 to 96 %)"; empty where there is no case."""
    found = rate(cases, hit)
    if found is None:
        return ""
    low, high = (100.0 * v for v in found["interval_95"])
    return f"{found['hits']} of {found['of']} ({low:.0f} to {high:.0f} %)"


def _closed(judged: Sequence[Mapping[str, Any]], scene: str, chosen: Chosen) -> str:
    found = closing([dict(c) for c in judged if c["scene"] == scene and chosen(c)], "test")
    if found is None:
        return "-"
    low, high = found["interval_95"]
    return f"{found['median']:.0%} ({100 * low:.0f} to {100 * high:.0f} %)"


def _minutes(judged: Sequence[Mapping[str, Any]], scene: str) -> str:
    """Base fit, floor and search, on whatever the machine had free; the baselines' time is not a search's."""
    stages = ("prepare", "base", "discretisation_error", "find")
    taken = [sum(c["seconds"].get(s, 0.0) for s in stages) / 60 for c in judged if c["scene"] == scene]
    return f"{np.median(taken):.1f} ({min(taken):.1f} to {max(taken):.1f})"


def _amplitudes(judged: Sequence[Mapping[str, Any]], scene: str) -> str:
    return _share([i for c in judged if c["scene"] == scene and _named(c) for i in c["coverage"]], bool) or "-"
