"""What a policy is trained on: the distribution in a run's folder, with the scene and the effects that belong to it."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from droid_jax.commands.hidden import known_stand_in

if TYPE_CHECKING:
    from droid_jax.identify.gaussian import Gaussian
    from droid_jax.model.scene import Scene
    from droid_jax.model.seam import Effect

TIMESTEP = 0.004  # s
GAUSSIAN = "gaussian.json"


def source(folder: Path | None, knob: int) -> tuple[Scene, Gaussian, tuple[Effect, ...]]:
    """The scene to train in, the Gaussian in a folder of `identify`, `gap` or `train`, and the effects of its model.

    folder: None for the prior of the built-in door.
    Raises ValueError where the folder holds no Gaussian, or one of another scene or servo.
    """
    from droid_jax.gap.extended import load_extended
    from droid_jax.identify.gaussian import load, prior
    from droid_jax.model.door import door_space
    from droid_jax.model.door_scene import door_scene

    scene = door_scene(timestep=TIMESTEP, limits=True, knob=knob)
    if folder is None:
        return scene, prior(door_space(scene)), ()
    other = setup(folder)
    if other.get("preset") == "paper" and "generations" in other:
        raise ValueError(f"{folder} was fitted with the paper's stiff servo: train on a fit of another preset")
    if other.get("scene"):
        raise ValueError(f"{folder} was fitted in {other['scene']}: policies are trained in the built-in scene")
    at, model = folder / GAUSSIAN, extended_of(folder)
    if model is None:
        if not at.is_file():
            raise ValueError(f"{folder} holds no {GAUSSIAN}: it is no folder of `identify`, `gap` or `train`")
        own = load(at)
        _check_door(at, own, scene)
        return scene, own, ()
    extended = load_extended(model, scene)
    own = load(at) if at.is_file() else extended.gaussian
    effects = {name for part in extended.parts for name in part.free}
    return extended.scene, own if effects <= set(own.space.names) else extended.gaussian, extended.effects


def _check_door(path: Path, gaussian: Gaussian, scene: Scene) -> None:
    """ValueError where a Gaussian speaks of something else than the built-in door's parameters.

    Its entries of the model may exist here too and mean another joint.
    """
    from droid_jax.model.door import door_nuisances, door_space

    known = {p.name: p for p in (door_space(scene) + door_nuisances(scene)).parameters}
    for p in gaussian.space.parameters:
        if p.name not in known:
            raise ValueError(f"{path} belongs to another scene: {p.name} is no parameter of the built-in door")
        if p.writes != known[p.name].writes:
            raise ValueError(f"{path} belongs to another scene: its {p.name} is not the built-in door's")


def model_folder(whole: Path) -> Path:
    """Where, in a folder of `all`, the model is that a policy shall be trained on: the extended one, if an effect was
    named.

    A search in other recordings than the fit's, left over from an earlier run, does not count.
    """
    try:
        named = bool(json.loads((whole / "gap" / "gap.json").read_text())["effects"])
    except FileNotFoundError:
        named = False
    fit, gap = (setup(whole / stage).get("recordings_sha256") for stage in ("identify", "gap"))
    stale = fit is not None and gap is not None and gap[: len(fit)] != fit
    return whole / ("gap" if named and not stale else "identify")


def has_model(folder: Path) -> bool:
    """Whether there is something in a folder that a policy can be trained on."""
    return (folder / GAUSSIAN).is_file() or extended_of(folder) is not None


def extended_of(folder: Path) -> Path | None:
    """The extended model that a run's Gaussian belongs to: its own file, or the one that it was told to fit."""
    from droid_jax.gap.extended import FILE

    told = setup(folder).get("extended")
    return folder / FILE if (folder / FILE).is_file() else Path(told) if told else None


def stand_in_of(folder: Path | None) -> dict[str, Any]:
    """Which stand-in robot a fit was made of, if it was one: its springs, seed and hidden effects."""
    known = {} if folder is None else setup(folder)
    if known.get("command") == "train":
        return known.get("stand_in", {})
    if known.get("recording"):  # as named where the command ran; those of `all` lie beside its stages
        beside = [folder.parent / "recordings" / Path(name).name for name in known["recording"]] if folder else []
        return known_stand_in(known["recording"]) or known_stand_in(beside)
    return {k: known[k] for k in ("springs", "seed", "hide") if k in known}


def fingerprint(folder: Path | None) -> str | None:
    """Hash of what a policy is trained on; None for the prior."""
    if folder is None:
        return None
    files = [folder / GAUSSIAN, extended_of(folder)]
    return hashlib.sha256(b"".join(f.read_bytes() for f in files if f is not None and f.is_file())).hexdigest()


def needs_brax() -> None:
    """ValueError that says what to install where brax is not."""
    if importlib.util.find_spec("brax") is None:
        raise ValueError("policies need brax: pip install -e '.[train]' in the checkout")


def setup(folder: Path) -> dict[str, Any]:
    """setup.json of a run's folder; empty where there is none."""
    try:
        return json.loads((folder / "setup.json").read_text())
    except (OSError, ValueError):
        return {}
