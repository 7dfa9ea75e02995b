"""The paragraph at the top of a page with several parts: what was fitted, how large the gap is, what is missing, what
next."""

from __future__ import annotations

from droid_jax.report.gap_folder import Gap
from droid_jax.report.gap_words import gap_summary, readable, untrusted
from droid_jax.report.policy_folder import Trained
from droid_jax.report.policy_words import policy_summary
from droid_jax.report.run_folder import Run
from droid_jax.report.words import DOUBT, counted, far_off, judged, listed, number, percent, summary, was


def doubt(run: Run | None, gap: Gap | None, policy: Trained) -> str:
    """Why a policy that was trained on these should not be taken to a robot; empty where nothing speaks against it."""
    on_the_fit = policy.training["setup"]["fit"] is not None and not policy.training["effects"]
    if run and far_off(run.fit) and on_the_fit:
        why = "a fit that is far from the data"
    elif gap and gap.found["verdict"] == "fit not converged":
        why = "a model of which no search could say whether it is right"
    elif gap and untrusted(gap):
        why = "a model that is known to be wrong somewhere"
    else:
        return ""
    return f"The policy was trained all the same, on {why}: do not take it to a robot."


def lead(run: Run | None, gap: Gap | None, policy: Trained | None, hidden: str = "") -> list[str]:
    """From the numbers alone; the last sentence says what to do next.

    hidden: what the synthetic robot hides, in words.
    """
    sentences, following = [], ""
    if run:
        sentences.append(_fitted(run))
        following = summary(run, gap is not None)[-1]
    if gap:
        sentences += [readable(gap.found["sentence"], gap.found), *_closed(gap)]
        sentences += [f"What the synthetic robot hid: {hidden}."] if hidden else []
        following = gap_summary(gap)[-1]
        if run and far_off(run.fit):
            following = following.replace("Next: ", f"Next: {DOUBT}; then ", 1)
    if policy:
        sentences += [_opened(where, found["success_rate"]) for where, found in policy.trials.items()]
        why_not = doubt(run, gap, policy)
        last = policy_summary(policy, gap, why_not)[-1]
        following = f"{following} {last}" if why_not else last
    return [*sentences, following]


def _fitted(run: Run) -> str:
    gaps = run.fit["gap"]
    sizes = [
        f"from {number(g['before'])} to {number(g['after'])} {run.torque_unit} in “{name}” ({judged(g)})"
        for name, g in gaps.items()
    ]
    went = "fell" if all(g["after"] < g["before"] for g in gaps.values()) else "went"
    count = len(run.parameters)
    return (
        f"{counted(count, 'parameter')} {was(count)} fitted to what the {run.robot} measured: the distance between "
        f"measured and simulated torques {went} {listed(sizes)}."
    )


def _closed(gap: Gap) -> list[str]:
    one = gap.found["gaps"][gap.judge]
    if not gap.extended or one["closed"] is None:
        return []
    return [f"With that in the model {percent(max(one['closed'], 0.0))} of the gap on “{one['recording']}” is closed."]


def _opened(where: str, rate: float) -> str:
    place = {"simulation": "in the simulation", "synthetic robot": "on the synthetic robot"}[where]
    return f"The policy opens the door in {percent(rate)} of its trials {place}."
