"""Trials of many policies summed up: a column of Table II for each method, intervals by bootstrap over policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.policies.settings import Setting

PLACES = ("simulation", "stand_in")
RESAMPLES = 4000
LEVEL = 0.95
# Table II of the paper: success in %, largest angle in degrees and steps (mean, deviation), in simulation and on the
# real robot; three policies of each method, ten trials each.
PAPER = {
    "prior": {"simulation": (100.0, (91.3, 0.4), (96.3, 107.2)), "robot": (20.0, (22.4, 8.2), (68.7, 8.4))},
    "mean": {"simulation": (100.0, (70.8, 16.0), (60.3, 2.6)), "robot": (86.7, (42.2, 11.1), (73.6, 7.0))},
    "fitted": {"simulation": (100.0, (91.2, 0.2), (38.7, 14.1)), "robot": (80.0, (45.4, 13.6), (68.3, 11.0))},
}


def summed_up(cases: Sequence[Mapping[str, Any]], settings: Mapping[str, Setting]) -> dict[str, Any]:
    """For each setting and method, both places; and how much better the fitted Gaussian is than the others."""
    table: dict[str, Any] = {}
    for name in settings:
        of = {m: [c for c in cases if c["setting"] == name and c["method"] == m] for m in PAPER}
        columns = {m: {place: column(own, place) for place in PLACES} for m, own in of.items() if own}
        others = [m for m in ("prior", "mean") if of[m] and of["fitted"]]
        better = {m: {what: apart(of["fitted"], of[m], what) for what in ("success", "angle")} for m in others}
        table[name] = {"methods": columns, "fitted_better_than": better}
    line = {
        name: {m: {place: round(c[place]["success_rate"], 3) for place in PLACES} for m, c in found["methods"].items()}
        for name, found in table.items()
    }
    return {"table": table, "paper": PAPER, "line": line}


def column(cases: Sequence[Mapping[str, Any]], place: str) -> dict[str, Any]:
    """Success, largest angle and steps of one method's policies in one place; steps of the trials that succeeded."""
    each = [trials(case, place) for case in cases]
    return {
        "policies": len(each),
        "trials": sum(len(t["success"]) for t in each),
        "seeds": [case["seed"] for case in cases],
        "success_rate": float(np.mean(np.concatenate([t["success"] for t in each]))),
        "success_interval_95": span(resampled([t["success"] for t in each])),
        "success_of_each": [float(np.mean(t["success"])) for t in each],
        "angle_deg": spread([t["angle"] for t in each]),
        "steps": spread([t["steps"][t["success"] > 0] for t in each]),
    }


def spread(each: Sequence[np.ndarray]) -> dict[str, Any]:
    """Mean and deviation over all trials, interval of the mean; None where no policy has any."""
    there = [values for values in each if len(values)]
    if not there:
        return {"mean": None, "std": None, "interval_95": None}
    both = np.concatenate(there)
    return {"mean": float(both.mean()), "std": float(both.std()), "interval_95": span(resampled(there))}


def trials(case: Mapping[str, Any], place: str) -> dict[str, np.ndarray]:
    """One policy's trials: success [T], largest angle [T] in degrees, steps [T]."""
    found = case[place]
    return {
        "success": np.array(found["success"], float),
        "angle": np.array(found["angle_deg"]["all"], float),
        "steps": np.array(found["steps"]["all"], float),
    }


def apart(better: Sequence[Mapping[str, Any]], worse: Sequence[Mapping[str, Any]], what: str) -> dict[str, Any]:
    """Difference of two methods' means on the stand-in robot, with its interval."""
    a, b = ([trials(case, "stand_in")[what] for case in own] for own in (better, worse))
    draws = resampled(a, 1) - resampled(b, 2)
    difference = float(np.mean(np.concatenate(a)) - np.mean(np.concatenate(b)))
    return {"difference": difference, "interval_95": span(draws)}


def resampled(each: Sequence[np.ndarray], seed: int = 0) -> np.ndarray:
    """[RESAMPLES] means over all trials, policies drawn with replacement and trials within them too."""
    rng = np.random.default_rng(seed)
    means = np.empty((RESAMPLES, len(each)))  # of every policy's trials, drawn again for each place it takes
    policies = rng.integers(len(each), size=means.shape)
    for k, own in enumerate(each):
        taken = policies == k
        means[taken] = rng.choice(own, (int(taken.sum()), len(own))).mean(axis=1)
    return means.mean(axis=1)


def span(draws: np.ndarray) -> list[float]:
    """Equal-tailed interval of draws."""
    low, high = np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return [float(low), float(high)]
