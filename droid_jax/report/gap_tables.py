"""The candidates' tables: models with one effect, with two, with three; in rank order, and why each one lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from droid_jax.report.gap_words import BETWEEN, model_words, readable

SIZES = ("One effect", "Two effects", "Three effects")


@dataclass(frozen=True)
class Row:
    """A candidate, or a model that holds it.

    t, explained: of the screening, None where it is not ranked.  trial: entry of gap.json, None where it
    was screened only.  fate: what became of it.  kept: whether all of it is in the final model.
    """

    name: str
    t: float | None
    explained: float | None
    trial: Mapping[str, Any] | None
    fate: str
    kept: bool


@dataclass(frozen=True)
class Group:
    """Models with as many effects.

    beside: the model that was screened, empty for the base model; p: of that screening, None where there was
    none.  discrepancy_train, discrepancy_validation: U of that model.  tried: rows with a trial; others: rows that
    were screened only.
    """

    title: str
    beside: str
    p: float | None
    discrepancy_train: float | None
    discrepancy_validation: float | None
    tried: tuple[Row, ...]
    others: tuple[Row, ...]


def groups(found: Mapping[str, Any]) -> list[Group]:
    """One for each number of effects that was screened or tried."""
    screens = found["screens"]
    if len(screens) > 1 and screens[-1] == screens[0]:
        screens = screens[:-1]  # files of version 0.1 before December 2026 list the first one again for pairs
    count = max([len(screens), *(t["round"] + 1 for t in found["trials"])])
    return [_group(found, k, screens[k] if k < len(screens) else None) for k in range(count)]


def _group(found: Mapping[str, Any], k: int, screen: Mapping[str, Any] | None) -> Group:
    trials: dict[str, Mapping[str, Any]] = {}
    for t in _of_size(found, k):
        if t["name"] not in trials or t["passed"]:  # a pair may be tried twice, beside one of the two and from scratch
            trials[t["name"]] = t
    stood = _stood(found, k)
    before = _gaps(found, k, stood)
    ranking = {_joined(stood, r["candidate"]): r for r in reversed(screen["ranking"] if screen else [])}
    names = [*reversed(ranking), *(name for name in trials if name not in ranking)]
    rows = [_row(found, name, ranking.get(name), trials.get(name)) for name in names]
    return Group(
        title=SIZES[k] if k < len(SIZES) else f"{k + 1} effects",
        beside=model_words(stood),
        p=screen["p"] if screen else None,
        discrepancy_train=before.get("discrepancy_train"),
        discrepancy_validation=before.get("discrepancy_validation"),
        tried=tuple(r for r in rows if r.trial is not None),
        others=tuple(r for r in rows if r.trial is None),
    )


def _of_size(found: Mapping[str, Any], k: int) -> Sequence[Mapping[str, Any]]:
    return [t for t in found["trials"] if t["round"] == k]


def _stood(found: Mapping[str, Any], k: int) -> str:
    """Name of the model that the k-th effect was added to: what most models of this size begin with."""
    if k == 0:
        return ""
    begins = Counter(t["name"].rpartition(BETWEEN)[0] for t in _of_size(found, k))
    passed = [t for t in _of_size(found, k - 1) if t["passed"]]
    if begins:
        return begins.most_common(1)[0][0]
    return min(passed, key=lambda t: t["discrepancy_validation"])["name"] if passed else ""


def _gaps(found: Mapping[str, Any], k: int, stood: str) -> Mapping[str, Any]:
    """U of the model that stood, where gap.json says it."""
    if not stood:
        gaps = found["gaps"]
        return {"discrepancy_train": gaps["train"]["before"], "discrepancy_validation": gaps["validation"]["before"]}
    return next((t for t in _of_size(found, k - 1) if t["name"] == stood), {})


def _joined(stood: str, candidate: str) -> str:
    return f"{stood}{BETWEEN}{candidate}" if stood else candidate


def _row(found: Mapping[str, Any], name: str, entry: Any, trial: Mapping[str, Any] | None) -> Row:
    parts, effects = set(name.split(BETWEEN)), found["effects"]
    rivals = {part for ties in found["indistinguishable"] for n in ties for part in n.split(BETWEEN)}
    kept = trial is not None and trial["passed"] and parts <= set(effects)
    if trial is None:
        fate = "screened only: explains less"
    elif trial["reasons"]:
        fate = "; ".join(readable(r, found) for r in trial["reasons"])
        if parts < set(effects):
            fate = f"without the model's other effects: {fate}"
    elif kept:
        tied = any(ties for effect, ties in zip(effects, found["indistinguishable"], strict=False) if effect in parts)
        fate = "in the model, and others do as well" if tied else "in the model"
    else:
        fate = "is equivalent: a tie" if parts <= {*effects, *rivals} else _passed_over(found, trial)
    ranked = entry or {"t": None, "explained": None}
    return Row(model_words(name), ranked["t"], ranked["explained"], trial, fate, kept)


def _passed_over(found: Mapping[str, Any], trial: Mapping[str, Any]) -> str:
    """Why a model that passed its trial is not the answer."""
    if any(set(trial["name"].split(BETWEEN)) <= set(hint["effects"]) for hint in found.get("hints", [])):
        return "passed, but closes too little for a name: a hint"
    if found["verdict"] == "fit not converged":
        return "passed, but a fit did not converge"
    left = [found["gaps"]["validation"]["after"], *(t["discrepancy_validation"] for t in found["trials"])]
    if trial["discrepancy_validation"] > min(u for u in left if u is not None):
        return "passed, but another leaves less"
    if BETWEEN in trial["name"]:
        return "passed, but takes too little more away than fewer effects do"
    return "passed, but a plainer one leaves about as much"
