"""Trials of many policies summed up: a column of Table II for each method, intervals by bootstrap over policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.stats

from droid_jax.policy.trials import BLOWN_UP, wilson

METHODS = ("prior", "mean", "fitted")
PLACES = ("simulation", "synthetic_robot")
SLIPPERY = "slippery"  # the synthetic robot with pads that do not hold
RESAMPLES = 40_000  # the tails of five policies hold a thousandth each
LEVEL = 0.95
OPENED = 30.0  # degrees: a success of the paper; here it must also be held for half a second with the grip on
# Table II of the paper: success in %, largest angle in degrees and steps (mean, deviation), in simulation and on the
# real robot; three policies of each method, ten trials each.
PAPER = {
    "prior": {"simulation": (100.0, (91.3, 0.4), (96.3, 107.2)), "robot": (20.0, (22.4, 8.2), (68.7, 8.4))},
    "mean": {"simulation": (100.0, (70.8, 16.0), (60.3, 2.6)), "robot": (86.7, (42.2, 11.1), (73.6, 7.0))},
    "fitted": {"simulation": (100.0, (91.2, 0.2), (38.7, 14.1)), "robot": (80.0, (45.4, 13.6), (68.3, 11.0))},
}


def summed_up(cases: Sequence[Mapping[str, Any]], settings: Sequence[str]) -> dict[str, Any]:
    """For each setting and method, both places; and how much better the fitted Gaussian is than the others."""
    table: dict[str, Any] = {}
    for name in settings:
        of = {m: [c for c in cases if c["setting"]["name"] == name and c["method"] == m] for m in METHODS}
        better = better_than("fitted", ("prior", "mean"), of)
        table[name] = {"methods": columns(of, (*PLACES, SLIPPERY)), "fitted_better_than": better}
    line = {name: line_of(found["methods"]) for name, found in table.items()}
    return {"table": table, "paper": PAPER, "line": line}


def columns(of: Mapping[str, Sequence[Mapping[str, Any]]], places: Sequence[str] = PLACES) -> dict[str, Any]:
    """For each kind of policies that there are, the column of every place.  of: kind -> its cases."""
    return {kind: {place: column(own, place) for place in places} for kind, own in of.items() if own}


def better_than(best: str, others: Sequence[str], of: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """How much better one kind of policies is than each of the others, of those that there are (`apart`)."""
    known = [kind for kind in others if of[kind] and of[best]]
    return {kind: {what: apart(of[best], of[kind], what) for what in ("success", "angle")} for kind in known}


def line_of(found: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Success of each kind of policies (`columns`) by place, for one line."""
    rates = {kind: {place: by[place]["success_rate"] for place in PLACES} for kind, by in found.items()}
    return {k: {p: None if r is None else round(r, 3) for p, r in by.items()} for k, by in rates.items()}


def column(cases: Sequence[Mapping[str, Any]], place: str) -> dict[str, Any]:
    """Success, largest angle, grip and steps of one method's policies in one place; steps of those that succeeded.

    Episodes that blew up are counted and are in nothing else.  stopped: share of trials that the control loop stopped;
    in simulation there is none.  grip: share of a trial's actions with the grip on.  beyond_30_deg: share of trials
    whose largest angle is above `OPENED`, the paper's success.  None where nothing is left to count.
    """
    each = [trials(case, place) for case in cases]
    success, angle, stopped = ([t[what] for t in each] for what in ("success", "angle", "stopped"))
    counted = sum(map(len, success))
    return {
        "policies": len(each),
        "trials": counted,
        "blown_up": sum(len(case[place]["success"]) for case in cases) - counted,
        "seeds": [case["seed"] for case in cases],
        "success_rate": float(np.mean(np.concatenate(success))) if counted else None,
        "success_interval_95": rate_interval(success) if counted else None,
        "success_of_each": [float(np.mean(own)) if len(own) else None for own in success],
        "beyond_30_deg": float(np.mean(np.concatenate(angle) > OPENED)) if counted else None,
        "stopped": float(np.mean(np.concatenate(stopped))) if counted else None,
        "grip": spread([t["grip"] for t in each]),
        "angle_deg": spread(angle),
        "steps": spread([t["steps"][t["success"] > 0] for t in each]),
    }


def spread(each: Sequence[np.ndarray]) -> dict[str, Any]:
    """Mean and deviation over all trials, interval of the mean; None where no policy has any.

    The interval is None too where only one of several has any: how policies differ is not known then.
    """
    both, counted = np.concatenate(each), sum(len(own) > 0 for own in each)
    if not len(both):
        return {"mean": None, "std": None, "interval_95": None}
    interval = span(resampled(each), counted) if counted > 1 or len(each) == 1 else None
    return {"mean": float(both.mean()), "std": float(both.std()), "interval_95": interval}


def trials(case: Mapping[str, Any], place: str) -> dict[str, np.ndarray]:
    """One policy's trials, without those that blew up: success, largest angle in degrees, steps, share of actions with
    the grip on, whether the control loop stopped it, [T] each; T is 0 where all of them blew up.
    """
    found = case[place]
    why = np.array(found["stopped_each"])
    counted = why != BLOWN_UP
    every = {
        "success": found["success"],
        "angle": found["angle_deg"]["all"],
        "steps": found["steps"]["all"],
        "grip": found["grip"]["all"],
        "stopped": why != "",
    }
    return {name: np.array(values, float)[counted] for name, values in every.items()}


def apart(better: Sequence[Mapping[str, Any]], worse: Sequence[Mapping[str, Any]], what: str) -> dict[str, Any]:
    """Difference of two methods' means on the synthetic robot, with its interval, and Welch's of the policies'
    means.
    """
    a, b = ([t for case in own if len(t := trials(case, "synthetic_robot")[what])] for own in (better, worse))
    if not (a and b):  # nothing is left to compare
        return {"difference": None, "interval_95": None, "welch_95": None}
    draws = resampled(a, 1) - resampled(b, 2)
    difference = float(np.mean(np.concatenate(a)) - np.mean(np.concatenate(b)))
    means = [[float(t.mean()) for t in own] for own in (a, b)]
    welch = None
    if min(map(len, means)) > 1 and max(np.ptp(m) for m in means) > 0:
        found = scipy.stats.ttest_ind(*means, equal_var=False).confidence_interval(LEVEL)
        welch = [float(found.low), float(found.high)]
    interval = span(draws, min(len(a), len(b)))
    if what == "success" and np.ptp(draws) == 0.0:
        interval = _newcombe(*(np.concatenate(own) for own in (a, b)))
    return {"difference": difference, "interval_95": interval, "welch_95": welch}


def rate_interval(each: Sequence[np.ndarray]) -> list[float]:
    """Of a success rate: by bootstrap over policies, or Wilson's over all trials where they all ended alike."""
    both = np.concatenate(each)
    counted = sum(len(own) > 0 for own in each)
    return list(_wilson(both)) if np.ptp(both) == 0.0 else span(resampled(each), counted)


def _wilson(success: np.ndarray) -> tuple[float, float]:
    return wilson(int(success.sum()), len(success), LEVEL)


def _newcombe(a: np.ndarray, b: np.ndarray) -> list[float]:
    """Of a difference of two shares, out of Wilson's intervals (Newcombe 1998, method 10)."""
    (p, q), (low_a, high_a), (low_b, high_b) = (a.mean(), b.mean()), _wilson(a), _wilson(b)
    low = p - q - np.hypot(p - low_a, high_b - q)
    return [float(low), float(p - q + np.hypot(high_a - p, q - low_b))]


def resampled(each: Sequence[np.ndarray], seed: int = 0) -> np.ndarray:
    """[RESAMPLES] means over all trials, policies drawn with replacement and trials within them too.

    A policy without a trial (no success has no number of steps) weighs nothing; NaN where none drawn has any.
    """
    rng = np.random.default_rng(seed)
    policies = rng.integers(len(each), size=(RESAMPLES, len(each)))
    sums, counts = np.zeros(policies.shape), np.zeros(policies.shape)  # of every policy's trials, drawn anew each time
    for k, own in enumerate(each):
        taken = policies == k
        if len(own):
            sums[taken] = rng.choice(own, (int(taken.sum()), len(own))).sum(axis=1)
            counts[taken] = len(own)
    total = counts.sum(axis=1)
    return np.where(total > 0, sums.sum(axis=1) / np.maximum(total, 1.0), np.nan)


def span(draws: np.ndarray, policies: int) -> list[float]:
    """Equal-tailed interval of draws over so many policies."""
    tail = 0.5 * (1.0 - _expanded(policies))
    low, high = np.nanquantile(draws, [tail, 1.0 - tail])
    return [float(low), float(high)]


def _expanded(count: int) -> float:
    """Level at which quantiles of a bootstrap over so few hold as much as Student's t does.

    Hesterberg, What teachers should know about the bootstrap, Am. Stat. 2015: plain quantiles of five draws are
    too narrow (a test simulates it).  Of one policy nothing is known but its trials.
    """
    if count < 2:
        return LEVEL
    reach = scipy.stats.t.ppf(0.5 * (1.0 + LEVEL), count - 1) * np.sqrt(count / (count - 1))
    return float(2.0 * scipy.stats.norm.cdf(reach) - 1.0)
