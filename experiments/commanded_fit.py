"""Functions of the experiments on logs of commanded servos: fits and evaluations with the program's commands."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tuned  # noqa: F401  before anything that imports jax

from droid_jax.files import CONFIG, EVALUATION, FIT
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Recording
from droid_jax.run import main

HERE = Path(__file__).parent


def kept(recordings: Sequence[Recording], folder: Path) -> dict[str, Path]:
    """Write the recordings as files; returns the paths by name."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {r.name: folder / f"{r.name}.npz" for r in recordings}
    for recording in recordings:
        save_recording(recording, paths[recording.name])
    return paths


def command(words: Sequence[str | Path]) -> None:
    """Run a command of `python -m droid_jax.run`; ValueError where it fails."""
    if code := main([str(word) for word in words]):
        raise ValueError(f"`{' '.join(map(str, words[:1]))}` ended with exit code {code}")


def fitted(
    scene: Path, parameters: Path, fit: Sequence[Path], judge: Sequence[Path], out: Path, options: Sequence[str | Path]
) -> tuple[dict[str, Any], float]:
    """fit.json of an identification and its seconds; a finished run is read, not repeated."""
    began = time.monotonic()
    command(
        ["identify", "--scene", scene, "--parameters", parameters, "--recording", *fit, "--test-recording", *judge,
         *options, "--out", out]
    )  # fmt: skip
    assert (out / CONFIG).is_file()
    found = json.loads((out / FIT).read_text())
    seconds = found["seconds"]["total"]
    return found, seconds if seconds > 0 else time.monotonic() - began


def evaluated(fit: Path, recordings: Sequence[Path], out: Path) -> dict[str, Any]:
    """evaluation.json of a fit on recordings."""
    command(["evaluate-fit", "--fit", fit, "--recording", *recordings, "--out", out])
    return json.loads((out / EVALUATION).read_text())


def parameters_of(fit: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Value, interval and verdict of each parameter."""
    keys = ("unit", "best", "interval", "identifiable", "on_bound")
    return {p["name"]: {key: p[key] for key in keys} for p in fit["parameters"]}
