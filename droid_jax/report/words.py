"""Numbers, names and results of a run in words."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from droid_jax.report.run_folder import Run

# Words before "joint" that name the arm as a whole: its number alone tells a joint.
ARM = re.compile(r"panda|fr3|fer|(lbr_)?iiwa\d*|lbr|gen3|kinova|xarm\d*|ur\d+e?")
JUDGED = {  # by `judged` of a fit.json's gap
    "repeats": "on repeats that the fit did not see",
    "time": "on the last part of the log, which the fit did not see",
    "same": "on its one repeat, which was fitted too",
}
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")  # digits of an exponent
FAR = 3.0  # floors: a fit that leaves more, and half of the gap, has another fault than a missing effect
DOUBT = "check joint order, signs, units and servo gains before anything else"  # of recording and scene


def label(name: str) -> str:
    """A name as it is read: "hinge_stiffness" -> "Hinge stiffness", "panda_joint3" -> "Joint 3".

    "torque_offset[panda_joint3]" -> "Torque offset, joint 3"; "thumb_joint3" stays "Thumb joint3".
    """
    indexed = re.fullmatch(r"(.+)\[(.+)\]", name)
    if indexed:
        return f"{label(indexed[1])}, {label(indexed[2]).lower()}"
    joint = re.fullmatch(r"(?:(\w+)_)?joint_?(\d+)", name)
    if joint and (joint[1] is None or ARM.fullmatch(joint[1])):
        return f"Joint {joint[2]}"
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def counted(count: int, thing: str) -> str:
    """ "1 repeat", "2 repeats"."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def was(count: int) -> str:
    """The verb of `counted`."""
    return "was" if count == 1 else "were"


def number(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits, a real minus sign, and a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size and not 1e-4 <= size < 1e5:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10".replace("-", "−") + str(int(exponent)).translate(RAISED)
    decimals = max(0, digits - 1 - math.floor(math.log10(size))) if size else 0
    return f"{value:.{decimals}f}".replace("-", "−")


def like(value: float | None, deviation: float) -> str:
    """A number with as many decimals as show two significant digits of its deviation."""
    if value is None or not math.isfinite(value) or not math.isfinite(deviation) or deviation <= 0:
        return number(value)
    decimals = max(0, 1 - math.floor(math.log10(deviation)))
    if decimals > 6 or abs(value) >= 1e6:
        return number(value)
    return f"{value:.{decimals}f}".replace("-", "−")


def percent(share: float) -> str:
    """A share as a whole percentage: 100 % only when it is all of it, 0 % only when it is nothing, a dash for none."""
    if not math.isfinite(100 * share):
        return "–"
    nearest = round(100 * share)
    if nearest == 100 and share < 1.0:
        nearest = 99
    if nearest == 0 and share > 0.0:
        return "< 1 %"
    return f"{nearest} %".replace("-", "−")


def listed(names: Sequence[str]) -> str:
    """ "a", "a and b", "a, b and c"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def judged(gap: Mapping[str, Any]) -> str:
    """On what a fit.json's gap was measured; a fit from before it said so held repeats out."""
    return JUDGED[gap.get("judged", "repeats")]


def summary(run: Run, searched: bool = False) -> list[str]:
    """The sentences at the top of the page, from the numbers alone; searched: the page has a search of the gap too."""
    sentences = [_what(run), *(_gap(run, name) for name in run.fit["gap"]), *_settled(run), *_told(run), *_truth(run)]
    bound = [_bound(p) for p in run.fit["parameters"] if p["on_bound"]]
    if bound:
        sentences.append(f"On a bound of its range: {listed(bound)}.")
    sentences += _simulated(run)
    return [*sentences, _next(run, searched)]


def _simulated(run: Run) -> list[str]:
    """What the time step and the engine leave, where it is too much."""
    said = []
    for name, check in run.fit.get("checks", {}).items():
        where = f" in “{name}”" if len(run.fit["checks"]) > 1 else ""
        if check["too_coarse"]:
            said.append(
                f"The time step of {number(1e3 * check['time_step'])} ms is too coarse for this scene: at half of it "
                f"the fitted torques{where} change by {number(check['discretisation'])} {check['unit']}, where the fit "
                f"leaves {number(check['remaining'])} {check['unit']} (root mean squares)."
            )
        elif check["engines_differ"]:
            said.append(
                f"MJX and plain C MuJoCo differ at the fitted values{where} by {number(check['parity_rms'])} "
                f"{check['unit']}, where the fit leaves {number(check['remaining'])} {check['unit']} (root mean "
                "squares)."
            )
    return said


def _what(run: Run) -> str:
    groups = {g: len(ps) for g, ps in grouped(run.parameters).items()}
    robot = run.robot
    parts = listed([f"{n} of the {robot if g == 'Robot' else g.lower()}" for g, n in groups.items()])
    nuisances = len(run.fit["parameters"]) - len(run.parameters)
    beside = f", and {counted(nuisances, 'nuisance')} beside them," if nuisances else ""
    were = was(len(run.parameters) + nuisances)
    recordings = [r["name"] for r in run.config["recordings"]]
    return (
        f"{counted(len(run.parameters), 'parameter')} ({parts}){beside} {were} fitted so that the simulation "
        f"reproduces the joint torques which the {robot} measured in "
        f"the demonstration{'s' if len(recordings) > 1 else ''} {listed([f'“{r}”' for r in recordings])}."
    )


def _gap(run: Run, name: str) -> str:
    gap = run.fit["gap"][name]
    on = judged(gap)
    where = f"In “{name}”, {on}" if len(run.fit["gap"]) > 1 else on[:1].upper() + on[1:]
    text = (
        f"{where}, simulation and {run.robot} differed by "
        f"{number(gap['before'])} {run.torque_unit} before the fit (norm over the joints, averaged over time) and "
        f"differ by {number(gap['after'])} {run.torque_unit} after it"
    )
    floor, closed = gap.get("noise_floor"), gap.get("closed")
    if gap["after"] > gap["before"]:
        return text + ": the fit made it worse."
    if floor is None:
        return text + "; how much repeats differ among themselves is not known."
    share = f", so {percent(closed)} of what can be closed was closed" if closed is not None else ""
    return f"{text}; repeats differ among themselves by {number(floor)} {run.torque_unit}{share}."


def _settled(run: Run) -> list[str]:
    if run.fit.get("converged") is not False:
        return []
    return ["The refinement did not converge: take values and intervals with care, and fit again with a longer preset."]


def _told(run: Run) -> list[str]:
    from droid_jax.report.told import told_words  # only here: it takes its words from this module

    if unjudged(run.fit):
        return ["Which of them the demonstration tells was not judged: this preset ends with the search."]
    return told_words(run.parameters)


def _truth(run: Run) -> list[str]:
    known = [p for p in run.parameters if p["truth"] is not None and p["identifiable"]]
    if not known:
        return []
    inside = sum(p["interval"][0] <= p["truth"] <= p["interval"][1] for p in known)
    return [
        f"Of the parameters that the demonstration tells, the true value is known for {len(known)}; for {inside} of "
        "them it lies in the 90 % interval."
    ]


def _bound(p: Mapping[str, Any]) -> str:
    """ "hinge friction loss (lower bound 0 N m)", "servo scale (more than 1.50, its upper bound)"."""
    low = abs(p["best"] - p["low"]) <= abs(p["best"] - p["high"])
    if low and p["low"] == 0.0:  # there is nothing below
        return f"{label(p['name']).lower()} ({which_bound(p)})"
    end = f"{number(p['low' if low else 'high'])} {p['unit']}".removesuffix(" -").strip()
    than, side = ("less", "lower") if low else ("more", "upper")
    return f"{label(p['name']).lower()} ({than} than {end}, its {side} bound)"


def which_bound(p: Mapping[str, Any]) -> str:
    """ "lower bound 0 N m", for a parameter that sits on one."""
    low = abs(p["best"] - p["low"]) <= abs(p["best"] - p["high"])
    value = number(p["low"] if low else p["high"])
    return f"{'lower' if low else 'upper'} bound {value} {p['unit']}".removesuffix(" -").strip()


def unjudged(fit: Mapping[str, Any]) -> bool:
    """Whether a fit.json is of a search without refinement, which tells no widths."""
    return "converged" in fit and fit["converged"] is None


def _next(run: Run, searched: bool) -> str:
    steps = []
    if any(check["too_coarse"] for check in run.fit.get("checks", {}).values()):
        steps.append("give the scene a smaller timestep and fit again: these values make up for its error")
    if wrong := [f["kind"] for f in run.fit.get("findings", ()) if f["severity"] == "certain"]:
        steps.append(f"do not train on this fit: mend the {listed(list(dict.fromkeys(wrong)))} of the recording")
    elif far_off(run.fit):
        steps.append(f"do not train on this fit: {DOUBT}")
    if any(p["on_bound"] for p in run.fit["parameters"]):
        steps.append("ask whether the bound is real; if not, widen it and fit again")
    if unjudged(run.fit):
        steps.append("fit with another preset (quick, standard, gpu) to know how sure the values are")
    elif any(not p["identifiable"] for p in run.parameters):
        steps.append("record a motion that moves what is not told, or leave it at its initial spread")
    if lacks_something(run.fit):
        lacks = "what is left is well above noise, so the model lacks something, or its timestep is too coarse"
        steps.append(
            f"{lacks}, and these values may be bent by it: go on with the search for it, below"
            if searched
            else f"{lacks}: see below in which joint and phase, and let python -m droid_jax.run gap look for the "
            f"missing effect{needed([r['repeats'] for r in run.config['recordings']])}"
        )
    elif noiseless(run.fit):
        steps.append(
            "whether the model lacks something is asked by the search below"
            if searched
            else "one repeat does not tell noise from what the model lacks, and these values may be bent by it: "
            + asked_of(run.fit)
        )
    elif not steps:
        steps.append("draw the simulations you train on from gaussian.json")
    return "Next: " + "; ".join(steps) + "."


def needed(repeats: Sequence[int]) -> str:
    """What the search of the gap takes beside recordings of so many repeats, in brackets; empty where they will do."""
    from droid_jax.recordings.split import (
        FEWEST_REPEATS,  # only here: these import distributions of scipy
        HALVES,
    )

    alone = len(repeats) == 1
    if (alone and (repeats[0] == 1 or repeats[0] >= HALVES)) or (not alone and min(repeats) >= FEWEST_REPEATS):
        return ""
    if alone and repeats[0] >= FEWEST_REPEATS:
        return f" (it takes a second motion, or {HALVES} repeats of this one)"
    return f" (it takes {FEWEST_REPEATS} repeats of each of two motions, or {HALVES} of one)"


def noiseless(fit: Mapping[str, Any]) -> bool:
    """Whether a fit.json is of single repeats, which do not tell noise from what the model lacks."""
    return any(gap.get("noise_floor") is None for gap in fit["gap"].values())


def asked_of(fit: Mapping[str, Any]) -> str:
    """What tells whether the model of a `noiseless` fit lacks something."""
    if len(fit["gap"]) <= 2 and all(gap.get("judged") == "time" for gap in fit["gap"].values()):
        return "let python -m droid_jax.run gap ask what it lacks"
    return "record repeats of the motion"


def lacks_something(fit: Mapping[str, Any]) -> bool:
    """Whether a fit.json says that noise alone does not explain what the fit left.

    By the mean square of its whitened residuals (0.6 to 1.4 in fits where nothing is missing), and by equation 1.
    """
    far = any(g.get("noise_floor") and g["after"] > 1.5 * g["noise_floor"] for g in fit["gap"].values())
    return far or (fit.get("mean_square") or 0.0) > 2.0


def far_off(fit: Mapping[str, Any]) -> bool:
    """Whether a fit.json says that the fit made it worse, or stayed so far from the data that its set-up is in doubt.

    Where repeats do not tell what noise leaves, two parameters at a bound have to say so.
    """
    bounds = sum(p["on_bound"] for p in fit["parameters"] if not p["nuisance"])

    def far(gap: Mapping[str, Any]) -> bool:
        floor = gap.get("noise_floor")
        most = bounds >= 2 if floor is None else gap["after"] > FAR * floor
        return gap["after"] > gap["before"] or (most and gap["after"] > 0.5 * (gap["before"] + (floor or 0.0)))

    return any(far(gap) for gap in fit["gap"].values())


def speaker(run: Run) -> Callable[[str], str]:
    """For texts of others: with a synthetic robot, "robot" becomes "synthetic robot"."""

    def speak(text: str) -> str:
        if not run.config["synthetic_robot"]:
            return text
        text = re.sub(r"(?<!synthetic )(?<!Synthetic )\brobot", "synthetic robot", text)
        return re.sub(r"(?<!synthetic )(?<!Synthetic )\bRobot", "Synthetic robot", text)

    return speak


def grouped(parameters: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Parameters by group, in the order of the paper's Table I, other groups after it."""
    groups: dict[str, list[Mapping[str, Any]]] = {"Door": [], "Robot": [], "Gripper": []}
    for p in parameters:
        groups.setdefault(p["group"], []).append({**p, "bound": which_bound(p) if p["on_bound"] else ""})
    return {g: ps for g, ps in groups.items() if ps}
