"""What a policy is trained on: the distribution in a run's folder, with the scene and the effects that belong to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from droid_jax.identify.gaussian import Gaussian
    from droid_jax.model.scene import Scene
    from droid_jax.model.seam import Effect

TIMESTEP = 0.004  # s
GAUSSIAN = "gaussian.json"


def source(folder: Path | None, knob: int) -> tuple[Scene, Gaussian, tuple[Effect, ...]]:
    """The scene to train in, the Gaussian in a folder of `identify`, `gap` or `train`, and the effects of its model.

    folder: None for the prior of the built-in door.
    Raises ValueError where the folder holds no Gaussian, or one of another scene.
    """
    from droid_jax.gap.extended import load_extended
    from droid_jax.identify.gaussian import load, prior
    from droid_jax.model.door import door_space
    from droid_jax.model.door_scene import door_scene

    scene = door_scene(timestep=TIMESTEP, limits=True, knob=knob)
    if folder is None:
        return scene, prior(door_space(scene)), ()
    at, model = folder / GAUSSIAN, extended_of(folder)
    if model is None:
        if not at.is_file():
            raise ValueError(f"{folder} holds no {GAUSSIAN}: it is no folder of `identify`, `gap` or `train`")
        return scene, load(at), ()
    extended = load_extended(model, scene)
    own = load(at) if at.is_file() else extended.gaussian
    whole = own if set(extended.space.names) <= set(own.space.names) else extended.gaussian
    return extended.scene, whole, extended.effects


def extended_of(folder: Path) -> Path | None:
    """The extended model that a run's Gaussian belongs to: its own file, or the one that it was told to fit."""
    from droid_jax.gap.extended import FILE

    told = setup(folder).get("extended")
    return folder / FILE if (folder / FILE).is_file() else Path(told) if told else None


def stand_in_of(folder: Path | None) -> dict[str, Any]:
    """Which stand-in robot a fit was made of, if it was one: its springs, seed and hidden effects."""
    known = {} if folder is None else setup(folder)
    if known.get("recording"):
        return {}
    return {k: known[k] for k in ("springs", "seed", "hide") if k in known}


def setup(folder: Path) -> dict[str, Any]:
    """setup.json of a run's folder; empty where there is none."""
    try:
        return json.loads((folder / "setup.json").read_text())
    except (OSError, ValueError):
        return {}
