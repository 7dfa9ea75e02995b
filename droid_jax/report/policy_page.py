"""The page of a trained policy: its doubts, next step and figures.

templates/policy.html.jinja lays it out, templates/policy_sentences.jinja has the sentences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from droid_jax.policy.trials import LEARNED
from droid_jax.report import style
from droid_jax.report.gap_folder import Gap
from droid_jax.report.gap_page import untrusted
from droid_jax.report.identify_folder import Run
from droid_jax.report.identify_page import far_off
from droid_jax.report.policy_folder import Progress, Trained, Training, TrialsEntry
from droid_jax.report.style import AFTER, BEFORE, INK, MUTED, WIDE, Drawing, data_uri, legend, styled

ENOUGH_SUCCESS = 0.8  # success rate on the synthetic robot from which the next step is the real robot
COLOURS = {"simulation": AFTER, "synthetic robot": BEFORE}


def policy_view(trained: Trained, run: Run | None = None, gap: Gap | None = None) -> dict[str, Any]:
    """The values that the templates show of a policy.

    Args:
        trained: its folder.
        run: the identification that the page holds too.
        gap: the search that the page holds too.

    Returns:
        The context of policy.html.jinja.
    """
    wrong = wrong_model(trained.training, run, gap)
    return {
        "policy": trained,
        "wrong": wrong,
        "doubts": policy_doubts(trained, wrong),
        "next": "not to a robot" if wrong else policy_next_step(trained, gap),
        "gap_folder": gap.folder if gap else "",
        "best": max(trained.training.history, key=lambda now: (now.success, now.reward), default=None),
        "drawings": _draw(trained),
        "films": {
            name: data_uri(path.read_bytes(), "webp") for name, path in sorted(trained.films.items(), reverse=True)
        },
    }


def wrong_model(training: Training, run: Run | None, gap: Gap | None) -> str:
    """Why the model that a policy was trained on should not be trusted: "far_off", "unknown" or "wrong"; else empty."""
    if run and far_off(run.fit) and training.setup.fit is not None and not training.effects:
        return "far_off"
    if gap and gap.found.verdict == "fit not converged":
        return "unknown"
    return "wrong" if gap and untrusted(gap) else ""


def policy_doubts(trained: Trained, wrong: str = "") -> list[str]:
    """The doubts about a policy, by their names in policy_sentences.jinja."""
    history = trained.training.history
    early = bool(history) and history[-1].step < history[-1].of
    asked = {
        "ended_early": early and not trained.training.held,  # by weights that are not finite
        "another_robot": bool(trained.trials) and trained.training.another_robot,
        "wrong_model": bool(wrong),
    }
    return [name for name, holds in asked.items() if holds]


def policy_next_step(trained: Trained, gap: Gap | None) -> str:
    """The next step, by its name in policy_sentences.jinja."""
    transfer, training = trained.transfer, trained.training
    if transfer is None:
        return "evaluate" if any(now.success >= LEARNED for now in training.history) else "train longer"
    if transfer.synthetic_robot.success_rate >= ENOUGH_SUCCESS:
        return "export"
    if transfer.simulation.success_rate < ENOUGH_SUCCESS:
        return "train longer"
    if training.another_robot:
        return "another robot"
    if gap is not None and gap.extended and not training.effects:
        return "train on the extended model"
    return "film" if gap is not None or training.effects else "search"


def _draw(trained: Trained) -> dict[str, list[Drawing]]:
    """All figures by section of the page; PNG and PDF copies go to FOLDER/figures/."""
    folder, training = trained.folder, trained.training
    sections: dict[str, list[Drawing]] = {"learning": [], "trials": []}
    if training.history:
        title = "Reward and success during training"
        sections["learning"].append(style.drawing(folder, "learning", title, learning, training.history))
    if trained.trials:
        opened = float(np.rad2deg(training.task.opened))
        title = "How far the door was opened"
        sections["trials"].append(style.drawing(folder, "angles", title, angles, trained.trials, opened))
    return sections


@styled
def learning(history: Sequence[Progress], width: float = WIDE) -> Figure:
    """Reward of an episode and share of episodes that succeed, over millions of actions."""
    figure = Figure(figsize=(width, 3.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    steps = np.array([now.step for now in history]) / 1e6
    above.plot(steps, [now.reward for now in history], color=INK, marker="o", ms=3)
    above.set(ylabel="Reward of an episode")
    below.plot(steps, [100 * now.success for now in history], color=AFTER, marker="o", ms=3)
    below.set(ylabel="Success [%]", xlabel="Actions [millions]", ylim=(-3, 103))
    return figure


@styled
def angles(trials: Mapping[str, TrialsEntry], opened: float, width: float = WIDE) -> Figure:
    """Histogram of the largest angle of each trial that counts, by where it took place.

    opened: degrees that success asks for.
    """
    figure = Figure(figsize=(width, 2.7), layout="constrained")
    axes = figure.add_subplot()
    widest = max(max(found.angles, default=0.0) for found in trials.values())
    bins = np.arange(0.0, max(widest, opened) + 4.0, 2.0).tolist()
    axes.hist(  # beside each other: over each other they would make a third colour
        [found.angles for found in trials.values()],
        bins,
        weights=[np.full(len(found.angles), 100.0 / max(len(found.angles), 1)) for found in trials.values()],
        color=[COLOURS[where] for where in trials],
        label=list(trials),
    )
    axes.axvline(opened, color=MUTED, linewidth=1.1, linestyle=(0, (5, 2)), label="required")
    axes.set(xlabel="Largest angle of a trial [degrees]", ylabel="Trials [%]")
    legend(figure, axes, width, columns=3)
    return figure
