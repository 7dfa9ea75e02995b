"""Figures of a policy: how it learned, and how far it opened the door in each trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from droid_jax.report.style import AFTER, BEFORE, INK, MUTED, WIDE, legend, styled

COLOURS = {"simulation": AFTER, "synthetic robot": BEFORE}


@styled
def learning(history: Sequence[Mapping[str, Any]], width: float = WIDE) -> Figure:
    """Reward of an episode and share of episodes that succeed, over millions of actions."""
    figure = Figure(figsize=(width, 3.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    steps = np.array([now["step"] for now in history]) / 1e6
    above.plot(steps, [now["reward"] for now in history], color=INK, marker="o", ms=3)
    above.set(ylabel="Reward of an episode")
    below.plot(steps, [100 * now["success"] for now in history], color=AFTER, marker="o", ms=3)
    below.set(ylabel="Success [%]", xlabel="Actions [millions]", ylim=(-3, 103))
    return figure


@styled
def angles(trials: Mapping[str, Mapping[str, Any]], opened: float, width: float = WIDE) -> Figure:
    """Histogram of the largest angle of each trial that counts, by where it took place.

    opened: degrees that success asks for.
    """
    figure = Figure(figsize=(width, 2.7), layout="constrained")
    axes = figure.add_subplot()
    widest = max(max(found["angles"], default=0.0) for found in trials.values())
    bins = np.arange(0.0, max(widest, opened) + 4.0, 2.0).tolist()
    axes.hist(  # beside each other: over each other they would make a third colour
        [found["angles"] for found in trials.values()],
        bins,
        weights=[np.full(len(found["angles"]), 100.0 / max(len(found["angles"]), 1)) for found in trials.values()],
        color=[COLOURS[where] for where in trials],
        label=list(trials),
    )
    axes.axvline(opened, color=MUTED, linewidth=1.1, linestyle=(0, (5, 2)), label="asked for")
    axes.set(xlabel="Largest angle of a trial [degrees]", ylabel="Trials [%]")
    legend(figure, axes, width, columns=3)
    return figure
