"""What a fit tells of each parameter in sentences: what it does not tell, and what moved far and is yet not sure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from droid_jax.report.words import label, listed, number, which_bound

MOVED = 1.0  # deviations of the stated prior: a value that is not sure and moved no less is told as one that moved


def moved(p: Mapping[str, Any]) -> float:
    """Deviations of its stated prior by which an entry of fit.json moved; an older fit tells it in physical units."""
    told = p.get("moved")
    return (p["best"] - p["initial_mean"]) / p["initial_std"] if told is None else told


def went_far(p: Mapping[str, Any]) -> bool:
    """Whether a parameter moved, and yet its value is not sure."""
    return not p["identifiable"] and abs(moved(p)) >= MOVED


def moved_words(p: Mapping[str, Any]) -> str:
    """ "moved from 0.100 to 0.350 N m (5.0 prior deviations), to its upper bound 0.350 N m"."""
    bound = f", to its {which_bound(p)}" if p["on_bound"] else ""
    there = f"{number(p['best'])} {p['unit']}".removesuffix(" -").strip()
    return f"moved from {number(p['initial_mean'])} to {there} ({abs(moved(p)):.1f} prior deviations){bound}"


def unsure_words(p: Mapping[str, Any]) -> str:
    """Why a number is not sure: "the data leave 40% of the prior's width, and it moves together with b (−0.93)"."""
    whys = [p["reason"]] if p["reason"] else []
    if p["partners"]:
        partners = [f"{label(q['name']).lower()} ({number(q['correlation'], 2)})" for q in p["partners"]]
        whys.append(f"it moves together with {listed(partners)}")
    if p["on_bound"]:
        whys.append("the truth may lie beyond the bound")
    return listed(whys)


def told_words(parameters: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the parameters of interest that are not identifiable; one where all are."""
    untold = [p for p in parameters if not p["identifiable"]]
    if not untold:
        return ["Every parameter of interest can be told from this demonstration."]
    still = [label(p["name"]).lower() for p in untold if not went_far(p)]
    rows = "its row" if len(still) == 1 else "their rows"
    said = [f"This demonstration does not tell {listed(still)}; take no number from {rows}."] if still else []
    for p in untold:
        if went_far(p):
            why = f", since {unsure}" if (unsure := unsure_words(p)) else ""
            said.append(f"{label(p['name'])} {moved_words(p)}, but its value is not sure{why}.")
    return said
