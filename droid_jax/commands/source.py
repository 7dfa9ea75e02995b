"""The distribution in a run's folder from which training draws, with its scene and its effects."""

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
    Raises ValueError if the folder has no Gaussian, one of another scene or servo, or an incomplete run.
    """
    from droid_jax.door.scene import door_scene
    from droid_jax.door.space import door_nuisances, door_space
    from droid_jax.identify.extended_model import load_extended
    from droid_jax.identify.gaussian import load_gaussian, prior

    scene = door_scene(timestep=TIMESTEP, limits=True, knob=knob)
    if folder is None:  # the same parameters as in a fit, so that methods differ only in the distribution
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
                f"{folder} was fitted with --effects {' '.join(other['effects'])}, which no extended model has: "
                "train on a folder of `gap`, or on a fit with --extended"
            )
        own = load_gaussian(at)
        _check_door(at, own, scene)
        return scene, own, ()
    extended = load_extended(model, scene)
    own = load_gaussian(at) if at.is_file() else extended.gaussian
    lacking = {name for part in extended.parts for name in part.free} - set(own.space.names)
    if lacking:
        raise ValueError(f"{at} lacks {', '.join(sorted(lacking))} of {model}, which now is of another search")
    return extended.scene, own, extended.effects


def _check_door(path: Path, gaussian: Gaussian, scene: Scene) -> None:
    """ValueError for a Gaussian over other parameters than the built-in door's.

    Entries of the model with the same index may belong to another joint.
    """
    from droid_jax.door.space import door_nuisances, door_space

    known = {p.name: p for p in (door_space(scene) + door_nuisances(scene)).parameters}
    for p in gaussian.space.parameters:
        if p.name not in known:
            raise ValueError(f"{path} belongs to another scene: {p.name} is no parameter of the built-in door")
        if p.writes != known[p.name].writes:
            raise ValueError(f"{path} belongs to another scene: its {p.name} is not the built-in door's")


class _Verdict(TypedDict):
    """The entries of gap.json that training reads."""

    effects: list[dict[str, str]]


def model_folder(whole: Path) -> Path:
    """Folder, below one of `all`, of the model to train on: that of `gap` if an effect was named, else `identify`.

    A search of an earlier run in other recordings than the fit's is ignored.
    Raises ValueError for a damaged gap.json.
    """
    path = whole / "gap" / GAP
    try:
        named = path.is_file() and bool(typed(read_json(path), _Verdict, GAP)["effects"])
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}): run gap again with --again") from None
    return whole / ("gap" if named and "gap" not in left_over(whole) else "identify")


def has_model(folder: Path) -> bool:
    """Whether a folder has a Gaussian or an extended model to train on."""
    if unfinished(folder):
        return False
    return gaussian_of(folder).is_file() or extended_of(folder) is not None


def untrainable(folder: Path) -> tuple[str, ...]:
    """Effects of a folder's extended model that need the whole command in advance, so that no policy can be trained."""
    from droid_jax.door.scene import door_scene
    from droid_jax.identify.extended_model import load_extended

    model = extended_of(folder)
    if model is None or not model.is_file():
        return ()
    return tuple(effect.name for effect in load_extended(model, door_scene()).effects if effect.profile is not None)


def synthetic_robot_of(folder: Path | None) -> dict[str, Any]:
    """Springs, seed and hidden effects of the fitted synthetic robot; empty for a real robot."""
    known = {} if folder is None else setup(folder)
    if known.get("command") == "train":
        return known.get("synthetic_robot", {})
    if kept := _robot(folder):
        return kept
    if known.get("recording"):  # paths as given to that run; in a folder of `all`, next to its stages
        beside = [folder.parent / "recordings" / Path(name).name for name in known["recording"]] if folder else []
        hashes = known.get("recordings_sha256", [])
        return next((known_robot(at) for at in (known["recording"], beside) if _hold(at, hashes)), {})
    return {k: known[k] for k in ("springs", "seed", "hide") if k in known}


def _robot(folder: Path | None) -> dict[str, Any]:
    """The synthetic robot stored in config.json or gap.json; empty if there is none."""
    if folder is None:
        return {}
    described = (described_in(folder / CONFIG), described_in(folder / GAP).get("setup", {}))
    return next((of["robot"] for of in described if of.get("synthetic_robot") and of.get("robot")), {})


def _hold(paths: Sequence[str | Path], hashes: Sequence[str]) -> bool:
    """Whether these files exist and are a synthetic robot's recordings with these hashes."""
    from droid_jax.recordings.formats import load_recording
    from droid_jax.synthetic.robot import is_synthetic

    try:
        recordings = [load_recording(path) for path in paths]
    except (OSError, ValueError):
        return False
    return [r.sha256 for r in recordings] == list(hashes) and all(map(is_synthetic, recordings))


def needs_brax() -> None:
    """ValueError with the installation command if brax is missing."""
    needs("policies need", "train", "brax")
