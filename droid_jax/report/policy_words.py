"""A trained policy in words."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

import numpy as np

from droid_jax.policy.trials import LEARNED
from droid_jax.report.gap_folder import Gap
from droid_jax.report.policy_folder import Trained
from droid_jax.report.words import label, listed, number, percent

METHODS = {
    "fitted": "doors drawn from the fitted distribution",
    "mean": "one door, with the fitted means",
    "prior": "doors drawn from what was assumed before any fit",
}
ENOUGH = 0.8  # success on the synthetic robot from which the next step is the robot


def policy_summary(trained: Trained, gap: Gap | None = None, doubt: str = "") -> list[str]:
    """The sentences at the top, from the numbers alone; the last says what to do next.

    gap: the search that the page holds too.  doubt: why it should not be taken to a robot.
    """
    training = trained.training
    history = training["history"]
    known = training["setup"]["fit"] is not None
    method = METHODS[training["setup"]["method"] if known else "prior"]
    sentences = [f"A policy was trained on {method}{_with(training['effects'])}."]
    if history:
        best = max(history, key=lambda now: (now["success"], now["reward"]))
        sentences.append(
            f"Training saw {history[-1]['step'] / 1e6:.2g} million actions in {history[-1]['seconds'] / 60:.0f} "
            f"minutes; of the policies tried on the way the best was kept, which succeeded in "
            f"{percent(best['success'])} of its episodes in simulation."
        )
        asked = history[-1].get("of", 0.0)
        if history[-1]["step"] < asked:  # the one thing that ends a training early and leaves a policy
            sentences.append(
                f"It ended before the {asked / 1e6:.2g} million actions that were asked for, since its weights were no "
                "finite numbers any more: another --seed may do better."
            )
    sentences += [_tried(where, found, training["task"]) for where, found in trained.trials.items()]
    if trained.trials and (other := another_robot(training)):
        sentences.append(other)
    return [*sentences, doubt or _next(trained, gap)]


def another_robot(training: Mapping[str, Any]) -> str:
    """What trials on the synthetic robot do not tell where another one was fitted, of training.json; empty
    elsewhere.
    """
    if training["setup"]["fit"] is None or training["synthetic_robot"]:
        return ""
    return "The fit is of your own recordings: the synthetic robot is another one, and says little of it."


def _with(effects: list[str]) -> str:
    names = [label(e).lower() for e in effects]
    return f", whose model holds {listed(names)}" if names else ""


def _tried(where: str, found: Mapping[str, Any], task: Mapping[str, Any]) -> str:
    low, high = found["interval_95"]
    place = {"simulation": "In the simulation", "synthetic robot": "On the synthetic robot"}[where]
    stopped = "; ".join(f"{count} stopped: {why}" for why, count in found["stopped"].items())
    return (
        f"{place} it held the door open for {number(task['held'], 2)} s at {np.rad2deg(task['opened']):.0f} degrees "
        f"or more, knob in hand, in {percent(found['success_rate'])} of {found['counted']} trials (95 % interval "
        f"{percent(low)} to {percent(high)}); it opened to {found['angle_deg']['mean']:.1f} ± "
        f"{found['angle_deg']['std']:.1f} degrees{'; ' + stopped if stopped else ''}."
    )


def _next(trained: Trained, gap: Gap | None) -> str:
    folder = shlex.quote(str(trained.folder))
    longer = "It has not learned the task in simulation yet: train longer (--steps), or with another --seed."
    if trained.transfer is None:
        learned = any(now["success"] >= LEARNED for now in trained.training["history"])
        return f"Next: python -m droid_jax.run evaluate {folder}" if learned else longer
    if trained.transfer["synthetic_robot"]["success_rate"] >= ENOUGH:
        return f"Next: python -m droid_jax.run export {folder}, and docs/policy-on-a-robot.md."
    if trained.transfer["simulation"]["success_rate"] < ENOUGH:
        return longer
    if another_robot(trained.training):
        return "It works in simulation and not on a robot that it was not fitted to, which was to be expected."
    where = "It works in simulation and not on the synthetic robot"
    held = trained.training["effects"]
    if gap is not None and gap.extended and not held:
        train = f"python -m droid_jax.run train --fit {shlex.quote(str(gap.folder))}"
        return f"{where}: train on the model that the search extended ({train})."
    if gap is not None or held:
        return f"{where}, although what the model lacks was searched for: look at the film of a bad trial."
    return f"{where}: search the gap (python -m droid_jax.run gap)."
