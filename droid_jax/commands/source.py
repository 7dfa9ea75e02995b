"""What a policy is trained on: the distribution in a run's folder, with the scene and the effects that belong to it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from droid_jax.commands.synthetic import known_robot
from droid_jax.errors import needs
from droid_jax.files import CONFIG, GAP, GAUSSIAN
from droid_jax.read_json import read_json, typed
from droid_jax.report.stages import (
    described_in,
    extended_of,
    gaussian_of,
    left_over,
    needs_whole,
    setup,
    unfinished,
)

if TYPE_CHECKING:
    from droid_jax.identify.gaussian import Gaussian
    from droid_jax.model.effect_interface import Effect
    from droid_jax.model.scene import Scene

TIMESTEP = 0.004  # s


def source(folder: Path | None, knob: int) -> tuple[Scene, Gaussian, tuple[Effect, ...]]:
    """The scene to train in, the Gaussian in a folder of `identify`, `gap` or `train`, and the effects of its model.

    folder: None for the prior of the built-in door.
    Raises ValueError where the folder holds no Gaussian, one of another scene or servo, or a run that is not whole.
    """
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space
    from droid_jax.identify.extended_model import load_extended
    from droid_jax.identify.gaussian import load_gaussian, prior

    scene = door_scene(timestep=TIMESTEP, limits=True, knob=knob)
    if folder is None:  # over what a fit is over, so that what a policy meets differs in nothing but the ranges
        return scene, prior(door_space(scene) + door_nuisances(scene)), ()
    needs_whole(folder)
    other = setup(folder)
    if other.get("preset") == "paper" and "generations" in other:
        raise ValueError(f"{folder} was fitted with the paper's stiff servo: train on a fit of another preset")
    if other.get("scene"):
        raise ValueError(f"{folder} was fitted in {other['scene']}: policies are trained in the built-in scene")
    at, model = gaussian_of(folder), extended_of(folder)
    if model is None:
        if not at.is_file():
            raise ValueError(f"{folder} holds no {GAUSSIAN}: it is no folder of `identify`, `gap` or `train`")
        if other.get("effects"):
            raise ValueError(
                f"{folder} was fitted with --effects {' '.join(other['effects'])}, which no extended model brings: "
                "train on a folder of `gap`, or on a fit with --extended"
            )
        own = load_gaussian(at)
        _check_door(at, own, scene)
        return scene, own, ()
    extended = load_extended(model, scene)
    own = load_gaussian(at) if at.is_file() else extended.gaussian
    lacking = {name for part in extended.parts for name in part.free} - set(own.space.names)
    if lacking:
        raise ValueError(f"{at} lacks {', '.join(sorted(lacking))} of {model}, which is of another search by now")
    return extended.scene, own, extended.effects


def _check_door(path: Path, gaussian: Gaussian, scene: Scene) -> None:
    """ValueError where a Gaussian speaks of something else than the built-in door's parameters.

    Its entries of the model may exist here too and mean another joint.
    """
    from droid_jax.door.space import door_nuisances, door_space

    known = {p.name: p for p in (door_space(scene) + door_nuisances(scene)).parameters}
    for p in gaussian.space.parameters:
        if p.name not in known:
            raise ValueError(f"{path} belongs to another scene: {p.name} is no parameter of the built-in door")
        if p.writes != known[p.name].writes:
            raise ValueError(f"{path} belongs to another scene: its {p.name} is not the built-in door's")


class _Verdict(TypedDict):
    """What training reads of a gap.json."""

    effects: list[dict[str, str]]


def model_folder(whole: Path) -> Path:
    """Where, in a folder of `all`, the model is that a policy shall be trained on: the extended one, if an effect was
    named.

    A search in other recordings than the fit's, left over from an earlier run, does not count.
    Raises ValueError for a verdict that cannot be read.
    """
    path = whole / "gap" / GAP
    try:
        named = path.is_file() and bool(typed(read_json(path), _Verdict, GAP)["effects"])
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}): run gap again with --again") from None
    return whole / ("gap" if named and "gap" not in left_over(whole) else "identify")


def has_model(folder: Path) -> bool:
    """Whether there is something in a folder that a policy can be trained on."""
    if unfinished(folder):
        return False
    return gaussian_of(folder).is_file() or extended_of(folder) is not None


def untrainable(folder: Path) -> tuple[str, ...]:
    """Effects of a folder's extended model that no policy can be trained with: `DoorEnv` has no whole command yet."""
    from droid_jax.door.scene import door_scene
    from droid_jax.identify.extended_model import load_extended

    model = extended_of(folder)
    if model is None or not model.is_file():
        return ()
    return tuple(effect.name for effect in load_extended(model, door_scene()).effects if effect.profile is not None)


def synthetic_robot_of(folder: Path | None) -> dict[str, Any]:
    """Which synthetic robot a fit was made of, if it was one: its springs, seed and hidden effects."""
    known = {} if folder is None else setup(folder)
    if known.get("command") == "train":
        return known.get("synthetic_robot", {})
    if kept := _robot(folder):
        return kept
    if known.get("recording"):  # not kept by this run: as named where it ran; those of `all` lie beside its stages
        beside = [folder.parent / "recordings" / Path(name).name for name in known["recording"]] if folder else []
        hashes = known.get("recordings_sha256", [])
        return next((known_robot(at) for at in (known["recording"], beside) if _hold(at, hashes)), {})
    return {k: known[k] for k in ("springs", "seed", "hide") if k in known}


def _robot(folder: Path | None) -> dict[str, Any]:
    """The same as a finished run of `identify` or `gap` keeps it; empty where it does not."""
    if folder is None:
        return {}
    told = (described_in(folder / CONFIG), described_in(folder / GAP).get("setup", {}))
    return next((of["robot"] for of in told if of.get("synthetic_robot") and of.get("robot")), {})


def _hold(paths: Sequence[str | Path], hashes: Sequence[str]) -> bool:
    """Whether these files are there and hold a synthetic robot's recordings of these hashes: others may have
    their names.
    """
    from droid_jax.recordings.formats import load_recording
    from droid_jax.synthetic.robot import is_synthetic

    try:
        recordings = [load_recording(path) for path in paths]
    except (OSError, ValueError):
        return False
    return [r.sha256 for r in recordings] == list(hashes) and all(map(is_synthetic, recordings))


def needs_brax() -> None:
    """ValueError that says what to install where brax is not."""
    needs("policies need", "train", "brax")
