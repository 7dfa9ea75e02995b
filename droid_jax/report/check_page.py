"""The page of `check`: signals and findings of recordings; templates/check.html.jinja lays it out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from droid_jax.identify.additions import MotionProposal
from droid_jax.identify.excitation import Excitation
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.inspect_log import Signal
from droid_jax.recordings.recording import Recording
from droid_jax.report.style import (
    AFTER,
    BEFORE,
    MEASURED,
    WIDE,
    inline_svg,
    label_bottom,
    legend,
    panel_grid,
    settled,
    styled,
)
from droid_jax.report.text import html, label

MOST_POINTS = 1200  # of a drawn line
MOST_JOINTS = 12  # that are drawn


def check_page(
    recordings: Sequence[tuple[Recording, Sequence[Signal], Sequence[Finding]]],
    scene: str | None,
    excited: tuple[Excitation, MotionProposal] | None = None,
) -> str:
    """HTML of recordings with their signals and findings.

    Args:
        recordings: each with its signals and findings.
        scene: name of the scene that they were checked in; None without one.
        excited: which parameters are identifiable in the recordings, and a motion that would make more of them so.
    """
    parts: list[dict[str, Any]] = []
    for i, (recording, tracks, findings) in enumerate(recordings):
        figure = Markup(inline_svg(settled(signals(recording)), f"f{i}"))
        parts.append({"recording": recording, "tracks": tracks, "findings": findings, "figure": figure})
    rows = [] if excited is None else list(zip(excited[0].space.parameters, excited[0].identifiability, strict=True))
    return html(
        "check.html.jinja", parts=parts, scene=scene, rows=rows, sentence=excited[1].sentence if excited else ""
    )


@styled
def signals(recording: Recording, width: float = WIDE) -> Figure:
    """Command, position and torque of each joint over time, the mean of the repeats.

    Args:
        recording: what is drawn; only its first MOST_JOINTS joints.
        width: inches.
    """
    joints = list(
        dict.fromkeys([*recording.command_names, *(j for c in recording.channels.values() for j in c.columns)])
    )
    figure, panels = panel_grid(min(len(joints), MOST_JOINTS), width, 1.9)
    for joint, axes in zip(joints[:MOST_JOINTS], panels, strict=True):
        axes.set_title(label(joint))
        if joint in recording.command_names:
            command = recording.command[:, recording.command_names.index(joint)]
            axes.plot(*_thinned(recording.time, command), color=BEFORE, label="command")
        for key, colour in {"position": MEASURED, "object_angle": MEASURED, "torque": AFTER}.items():
            channel = recording.channels.get(key)
            if channel is None or joint not in channel.columns:
                continue
            c = channel.columns.index(joint)
            seen = channel.mask[..., c].any(axis=0)
            values = np.where(channel.mask[..., c], channel.values[..., c], np.nan)[:, seen]
            where = axes.twinx() if key == "torque" and len(recording.channels) > 1 else axes
            text = f"{key.replace('_', ' ')}, {channel.unit}"
            where.plot(
                *_thinned(channel.time[seen], np.nanmean(values, axis=0)), color=colour, label=text, linewidth=0.9
            )
    label_bottom(panels, width, "time, s")
    legend(figure, figure.axes, width, 3)
    return figure


def _thinned(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every k-th point of a line, about MOST_POINTS of them."""
    step = max(1, len(time) // MOST_POINTS)
    return time[::step], values[::step]
