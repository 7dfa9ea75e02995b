"""The pictures of a policy's part of the page: its figures, and its films."""

from __future__ import annotations

import numpy as np

from droid_jax.report.drawings import Drawing, drawing
from droid_jax.report.export import data_uri
from droid_jax.report.policy_figures import angles, learning
from droid_jax.report.policy_folder import Trained

CAPTIONS = {  # of a film, and what it shows to those who cannot see it
    "good": (
        "A trial that succeeded, on the synthetic robot",
        "Film of the arm in front of the door: it takes the knob, pulls the door open and holds it there",
    ),
    "bad": (
        "A trial that failed, on the synthetic robot",
        "Film of the arm in front of the door: it does not hold the door open far enough with the knob in hand",
    ),
}


def draw_policy(trained: Trained) -> dict[str, list[Drawing]]:
    """All figures by section of the page; PNG and PDF copies go to FOLDER/figures/."""
    folder, opened = trained.folder, float(np.rad2deg(trained.training["task"]["opened"]))
    sections: dict[str, list[Drawing]] = {"learning": [], "trials": []}
    if trained.training["history"]:
        sections["learning"].append(
            drawing(
                folder, "learning", "Reward and success while it learned",
                "Of the deterministic policy, in episodes of its own beside the training.",
                learning, trained.training["history"],
            )
        )  # fmt: skip
    if trained.trials:
        sections["trials"].append(
            drawing(
                folder, "angles", "How far the door was opened",
                "Largest angle of every trial. Success also asks for the grip, held at that angle.",
                angles, trained.trials, opened,
            )
        )  # fmt: skip
    return sections


def film_row(trained: Trained) -> list[tuple[str, str, str]]:
    """Films as data URIs, each behind its caption and its description."""
    return [
        (*CAPTIONS.get(name, (name, f"Film of the trial {name}")), data_uri(path.read_bytes(), "webp"))
        for name, path in sorted(trained.films.items(), reverse=True)
    ]
