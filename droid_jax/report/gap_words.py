"""The search for a missing effect in words: what was fitted, how large the gap is, what is missing, what to do."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from droid_jax.files import EXTENDED, NOT_MADE, TO_BE_MADE
from droid_jax.report.gap_folder import Gap
from droid_jax.report.gap_parts import parts_of
from droid_jax.report.words import counted, label, listed, number, percent, was

DECISIVE = 6.0  # standardised difference from which ten repeats decide between rivals
COARSE = 0.1  # share of U that is the numerical floor, from which that is worth a word
TOLD = 0.8  # share of what is left on the validation motion: where more is left beyond the fit's uncertainty, no word
OTHER = "the other demonstration"  # as the search calls what confirms, whatever it is
OF = " of "  # between what is said of a joint and its name
TIME = "joint x phase"  # the variable of the cells that have a joint and a phase of the motion
BETWEEN = " + "  # between the effects in a model's name
ROLES = {"train": "training", "validation": "validation", "test": "test"}


def effect_words(name: str) -> str:
    """ "latch at door_hinge" -> "latch at door hinge", "cable_pull at panda_joint3" -> "cable pull at joint 3"."""
    effect, at, place = name.partition(" at ")
    return label(effect).lower() + at + (label(place).lower() if at else "")


def variable_words(name: str, where: str = "") -> str:
    """ "object angle" -> "Object angle", "position of panda_joint2" -> "Position of joint 2".

    where: one of its bins, which tells by its unit that an object slides and has no angle.
    """
    if name == "object angle" and where.endswith(" m"):
        return "Object position"
    what, of, joint = name.partition(OF)
    return label(what) + of + (label(joint).lower() if of else "")


def model_words(name: str) -> str:
    """ "latch at door_hinge + drag at door_hinge" -> "latch at door hinge + drag at door hinge"."""
    return BETWEEN.join(effect_words(part) for part in name.split(BETWEEN))


def role_words(gap: Gap, role: str) -> str:
    """ "A (fitted)"."""
    return f"{gap.recording(role)} ({ROLES[role]})"


def readable(text: str, found: Mapping[str, Any]) -> str:
    """A text of gap.json, the names of candidates and parameters in it, and what confirms, as they are read."""
    text = text.replace(OTHER, parts_of(found).other)
    names = {r["candidate"] for screen in found["screens"] for r in screen["ranking"]}
    for said in (found, *found.get("hints", [])):
        names |= {*said["effects"], *(name for rivals in said["indistinguishable"] for name in rivals)}
    for name in sorted(names, key=len, reverse=True):
        text = text.replace(name, model_words(name))
    return re.sub(r"\b\w+_\w+(\[\w+\])?", lambda m: label(m[0]).lower(), text)


def unit_words(unit: str) -> str:
    """ "N m s^2/rad^2" -> "N m s²/rad²"; nothing for a number without a unit ("-")."""
    return "" if unit == "-" else unit.replace("^2", "²").replace("^3", "³")


def quantity(value: float | None, unit: str, digits: int = 3) -> str:
    """(0.7213, "N m") -> "0.721 N m"."""
    return f"{number(value, digits)} {unit_words(unit)}".rstrip()


def gap_summary(gap: Gap) -> list[str]:
    """The sentences under the answer, from the numbers alone; the last says what to do."""
    sentences = [_fitted(gap), _significance(gap), _size(gap), _allowed(gap), *_added(gap.sizes)]
    said = [*sentences, *_trends(gap.found), gap.limits, *amendment_words(gap.found)]
    return [*(s for s in said if s), _next(gap)]


AMENDMENTS = {  # of gap.json: what it is called, and what there is without it
    "experiments": ("The candidate experiments that would tell the tied effects apart", "the tie stands without them"),
    "final_refit": ("The final refit to both motions", f"{EXTENDED} holds the model of the first motion"),
}


def amendment_words(found: Mapping[str, Any]) -> list[str]:
    """Of a gap.json, a sentence for each addition to the verdict that is not there: why, and what that means."""
    out = []
    for name, (what, without) in AMENDMENTS.items():
        state, verb = found.get("amendments", {}).get(name, ""), "were" if name == "experiments" else "was"
        if state == TO_BE_MADE:
            out.append(f"{what} {verb} not made yet, since the run was stopped: the same command makes it; {without}.")
        elif state.startswith(NOT_MADE):
            out.append(f"{what} {verb} {state.rstrip('.')}; {without}.")
    return out


def largest_shifts(shifts: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Entries of "shifts" with a known shift, the largest first."""
    known = [s for s in shifts if math.isfinite(deviations(s))]
    return sorted(known, key=lambda s: -abs(deviations(s)))


def deviations(shift: Mapping[str, Any]) -> float:
    """A shift in deviations; NaN where one of its numbers is not known."""
    before, after, deviation = (shift[k] for k in ("before", "after", "deviation_before"))
    if None in (before, after, deviation) or not deviation > 0:
        return math.nan
    return (after - before) / deviation


def settings(gap: Gap) -> list[str]:
    """What was asked for, one text per setting; what only tells a run that goes on from another stays in its file."""
    out, untold = [], ("command", "start", "synthetic_robot", "robot", "hidden")
    for name, value in gap.found["setup"].items():
        if value not in (None, [], "") and name not in untold and not name.endswith("_sha256"):
            words = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            out.append(f"{name.replace('_', ' ')} {words}")
    return out


def _fitted(gap: Gap) -> str:
    found = gap.found
    text = f"The base model was fitted to “{gap.recording('train')}”"
    if not found["screens"]:
        return text + "; no candidate was asked about."
    asked = len({r["candidate"] for s in found["screens"] for r in s["ranking"]})
    text += f", {counted(asked, 'candidate effect')} {was(asked)} screened against what it leaves"
    tried = len({t["name"] for t in found["trials"]})
    if tried:
        text += f", and {counted(tried, 'extended model')} {was(tried)} refitted "
        text += f"and judged on “{gap.recording('validation')}”"
    blown = [model_words(name) for name in gap.blown_up]
    left_out = f" Left out, because the simulation blew up with it: {listed(blown)}."
    return f"{text}.{left_out if blown else ''}"


def _significance(gap: Gap) -> str:
    from droid_jax.discrepancy.select import SIGNIFICANT  # only here: it imports the search

    p, bar = gap.found["p"], number(SIGNIFICANT, 1)
    if p is None:
        return ""
    if gap.found["verdict"] == "none" and p < SIGNIFICANT:
        small = (
            "U is not above zero" if gap.timeless else "no larger than what the simulation's own time step may leave"
        )
        return f"What it leaves is no chance (p = {number(p, 2)}), but it is small: {small}."
    chance = f"If nothing were missing, noise would look this much like one of them with p = {number(p, 2)}"
    return f"{chance}; below {bar} something is missing." if p < SIGNIFICANT else f"{chance}, not below {bar}."


def _size(gap: Gap) -> str:
    one = gap.found["gaps"][gap.judge]
    without = "the test one could not be replayed" if gap.lost else "none was kept as test data"
    seen = {
        "test": "which was opened once, at the end",
        "validation": f"which also chose the effects, since {without}",
        "train": "the only one there is",
    }
    where = f"On “{one['recording']}”" + (f", {seen[gap.judge]}," if gap.extended else "")
    at, size = _floor(gap), gap.parts.gap
    if not gap.extended:
        torque = f"{number(one['torque_before'])} {gap.unit}"
        return f"{where} {size} is {number(one['before'])} and the torque distance {torque}; {at}."
    share = "" if one["closed"] is None else ", " + gap.parts.closed.format(share=percent(max(one["closed"], 0.0)))
    text = f"{where} {size} was {number(one['before'])} before and is {number(one['after'])} after{share}; {at}"
    torque = f"{number(one['torque_before'])} to {number(one['torque_after'])} {gap.unit}"
    return f"{text}. The torque distance went from {torque}."


def _allowed(gap: Gap) -> str:
    """What of the validation motion's gap is the fit's own uncertainty, where that is worth a word."""
    left, validation = gap.found.get("remainder"), gap.found["gaps"].get("validation")
    if left is None or validation is None or not gap.extended:
        return ""
    if validation["after"] <= max(gap.floor or 0.0, 0.0) or left > TOLD * validation["after"]:
        return ""
    after, share = number(validation["after"]), percent(1.0 - max(left, 0.0) / validation["after"])
    return (
        f"Of U = {after} that is left on “{validation['recording']}”, {share} lies within the uncertainty of the "
        "fitted "
        "parameters: that motion shows some that the fitted one does not tell."
    )


def _floor(gap: Gap) -> str:
    if gap.timeless:
        return "there is no numerical floor, since a measured motion is replayed without a time step"
    if gap.floor is None:
        return "the numerical floor is not known"
    floor, fit = f"the numerical floor is {number(gap.floor)}", gap.found["gaps"]["train"]
    if not gap.floor > COARSE * fit["before"] > 0:
        return floor
    share, base = percent(gap.floor / fit["before"]), " of the base model" if gap.extended else ""
    return f"{floor}, {share} of U{base} on “{fit['recording']}”: a finer timestep would tell more"


def _added(sizes: Sequence[Mapping[str, Any]]) -> list[str]:
    """One sentence per effect."""
    effects: dict[str, list[Mapping[str, Any]]] = {}
    for a in sizes:
        effects.setdefault(a["effect"], []).append(a)
    out = []
    for name, mine in effects.items():
        words = effect_words(name)
        out.append(f"The {words} is {mine[0]['what']}: {listed([size_words(a) for a in mine])} (90 % intervals).")
    return out


def size_words(a: Mapping[str, Any]) -> str:
    """ "latch 0.72 N m, 0.60 to 0.84 N m": an amplitude or a shape of gap.json with its interval."""
    bound = f" (at its {side})" if (side := at_bound(a)) else ""
    low, high = span_of(a)
    return f"{label(a['name']).lower()} {quantity(a['value'], a['unit'])}{bound}, {number(low)} to " + quantity(
        high, a["unit"]
    )


def span_of(a: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """A size's interval; of an older search, whose intervals could leave out a value at a bound, up to the value."""
    if a["low"] is None or a["high"] is None or a["value"] is None:
        return a["low"], a["high"]
    return min(a["low"], a["value"]), max(a["high"], a["value"])


def at_bound(a: Mapping[str, Any]) -> str:
    """ "lower bound", "upper bound"; empty off them.  An older search does not tell: outside its interval lies a value
    at a bound alone.
    """
    if "bound" in a:
        return f"{a['bound']} bound" if a["bound"] else ""
    if a["low"] is None or a["high"] is None or a["low"] <= a["value"] <= a["high"]:
        return ""
    return "lower bound" if a["value"] < a["low"] else "upper bound"


def _trends(found: Mapping[str, Any]) -> list[str]:
    """What changes from repeat to repeat, which is in no gap: the repeats pass for the same."""
    from droid_jax.discrepancy.select import SIGNIFICANT  # only here: it imports the search

    return [
        f"The repeats are not alike: {effect_words(t['candidate'])} changes by about "
        f"{quantity(t['per_repeat'], t['unit'], 2)} from one to the next (p = {number(t['p'], 2)} if their "
        "order said nothing); let the robot warm up first, or look for what works loose."
        for t in found["trends"]
        if t["p"] is not None and t["p"] < SIGNIFICANT
    ]


def _next(gap: Gap) -> str:
    named = listed([effect_words(e) for e in gap.found["effects"]])
    it = "it" if len(gap.found["effects"]) == 1 else "them"
    clearly = " clearly enough" if any(t["passed"] for t in gap.found["trials"]) else " its trial"
    steps = {
        "none": f"go on with the base model; a smaller effect would need {gap.parts.more}",
        "named": f"look for the {named} on the hardware, and simulate with {it}{_file(gap)}{_doubted(gap)}",
        "tie": f"take no name for the cause yet. {_separate(gap)}",
        "partly explained": _partly(gap, named),
        "unexplained": _unnamed(gap, clearly),
        "fit not converged": f"{_longer(gap)}give the parameters tighter priors, and run again; take no number from "
        "this page until the fit settles",
    }
    return f"Next: {steps[gap.found['verdict']]}."


def _doubted(gap: Gap) -> str:
    return "; take its numbers with care, for the reason given above" if gap.found.get("doubts") else ""


def _unnamed(gap: Gap, clearly: str) -> str:
    """What to do where something is missing and nothing is named."""
    hinted = [model_words(BETWEEN.join(hint["effects"])) for hint in gap.hints]
    if hinted:
        least = percent(gap.found.get("thresholds", {}).get("least_closed", math.nan))
        what = (
            f"{listed(hinted)} passed, but closes less than {least} on a held-out recording and leaves the rest, so it "
            "may only imitate what is there: write an effect of your own"
        )
    else:
        what = (
            f"No effect of the library passed{clearly}: where one came close it needs {gap.parts.more}, else write one "
            "of your own"
        )
    return (
        f"look at the hardware {_where(gap)}. {what[:1].upper()}{what[1:]} or correct the scene there, and run again. "
        "Do not train on this part of the motion"
    )


def _longer(gap: Gap) -> str:
    """How to search longer than `gap` itself can; nothing in blocks, whose fit needs no search."""
    if gap.parts.in_turns:
        return ""
    recording = "the recording" if gap.parts.halves else f"“{gap.recording('train')}”"
    return (
        f"fit {recording} by python -m droid_jax.run identify --preset standard --restarts 3 and hand its "
        "folder on (gap --fit FOLDER), or "
    )


def untrusted(gap: Gap) -> bool:
    """Whether nothing should be trained on the model: no fit settled, or most of the gap has no name."""
    return gap.found["verdict"] in ("unexplained", "fit not converged") or _mostly_open(gap)


def _mostly_open(gap: Gap) -> bool:
    from droid_jax.discrepancy.verdict import HALF  # only here: it imports what computes

    explained = gap.found.get("explained")
    return gap.found["verdict"] == "partly explained" and explained is not None and explained < HALF


def _partly(gap: Gap, named: str) -> str:
    if not _mostly_open(gap):
        return f"{_kept(gap, named)}, and look at the hardware {_where(gap)}; that part has no name yet"
    return (
        f"look at the hardware {_where(gap)}, and take no name for the cause yet: the {named} may only imitate what is "
        "there (of blind answers that left more than half open, two in five held a wrong name). Write an effect of "
        "your own or correct the scene there, and run again. Do not train on this part of the motion"
    )


def _kept(gap: Gap, named: str) -> str:
    """What to do with a part that was named, or that several effects explain as well."""
    doubt = ", which need not be the cause: others do as well," if any(gap.found["indistinguishable"]) else ""
    return f"keep the {named}{doubt} in the model{_file(gap)}"


def _file(gap: Gap) -> str:
    return f" ({EXTENDED})" if (gap.folder / EXTENDED).is_file() else ""


def _separate(gap: Gap) -> str:
    known = [e for e in gap.found["experiments"] if e["distance"] is not None]
    if gap.timeless:
        return (
            "Without commands no other motion can be tried in simulation: record one that is slower, faster or comes "
            "back, and run again"
        )
    if not known:
        return "No experiment on the menu was found that separates them; for torques they act alike"
    best = max(known, key=lambda e: e["distance"])
    apart = f"{number(best['distance'])} standard deviations apart"
    if best["distance"] >= DECISIVE:
        return f"Record this too and run again: {best['what']}. There the rivals are {apart}, and ten repeats decide"
    bar = number(DECISIVE, 1)
    return (
        f"The best to record is: {best['what']}. There the rivals are only {apart}; ten repeats decide from {bar} on, "
        "so record more of them"
    )


def _where(gap: Gap) -> str:
    """The largest cell that the test found in what is left; of all, where there are no repeats to test."""
    cells = [c for c in gap.found["cells"]["after"] if c["discrepancy"] is not None]
    found = [c for c in cells if c["found"] or not gap.parts.repeated]
    if not found:
        return "(no single place stands out)"
    over_time = [c for c in found if c["variable"] == TIME]
    kinds = [kind for kind in (over_time, _others(found)) if kind] or [found]
    noise = "" if gap.parts.repeated else ", noise included"
    return f"where the most is left{noise}: " + listed(
        [place_words(max(kind, key=lambda c: c["discrepancy"])) for kind in kinds]
    )


def _others(found: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [c for c in found if c["variable"].startswith("object")]


def place_words(cell: Mapping[str, Any]) -> str:
    """ "joint 2 in opening, from 2.0 s on", "object angle 0.10 to 0.20 rad"."""
    if cell["variable"] != TIME:
        words = variable_words(cell["variable"], cell["where"])
        return f"{words[:1].lower()}{words[1:]} {span_words(cell['where'])}"
    joint, phase, start = joint_phase(cell["where"])
    return label(joint).lower() + (f" in {phase}, from {start} s on" if phase not in ("", "all") else "")


def span_words(where: str) -> str:
    """A bin without a sign before its zero: "-0.00 to 0.15 rad" -> "0.00 to 0.15 rad"."""
    return re.sub(r"-(?=0\.?0*( |$))", "", where)


def joint_phase(where: str) -> tuple[str, str, str]:
    """ "panda_joint2, opening 2.0 s" -> ("panda_joint2", "opening", "2.0")."""
    parts = re.fullmatch(r"(.+?), (.+) (-?[\d.]+) s", where)
    return (parts[1], parts[2], parts[3]) if parts else (where, "", "")
