"""A finished fit as a model for replays: of `identify`, or the extended model of `gap`."""

from __future__ import annotations

import importlib.metadata
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from droid_jax.commands.folder import PATHS
from droid_jax.files import CONFIG, EXTENDED, FIT, FULL_GAUSSIAN, GAP
from droid_jax.read_json import read_json
from droid_jax.report.stages import left_over, needs_whole, setup

if TYPE_CHECKING:
    import numpy as np

    from droid_jax.cost.residuals import CompareConfig
    from droid_jax.model.effect_interface import Effect
    from droid_jax.model.parameters import Parameter, Space
    from droid_jax.model.scene import Scene

Options = TypeVar("Options")


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted model.

    stage: "identify" or "gap".  before, after: [D] initial means and fitted values over the space.  recordings: hashes
    of the fitted recordings.
    """

    stage: str
    scene: Scene
    space: Space
    effects: tuple[Effect, ...]
    before: np.ndarray
    after: np.ndarray
    engine: str
    config: CompareConfig
    recordings: tuple[str, ...]


def fitted_folder(given: Path) -> tuple[str, Path]:
    """The stage and the folder of a finished fit: `given`, or one of its stages; the extended model first.

    Raises ValueError if there is none.
    """
    old = left_over(given)
    for stage, name in (("gap", GAP), ("identify", CONFIG)):
        for folder in (given, *(() if stage in old else (given / stage,))):
            if (folder / name).is_file() and (stage == "gap" or (folder / FIT).is_file()):
                needs_whole(folder)
                return stage, folder
    if given.is_dir():
        needs_whole(given)
    raise ValueError(f"{given} holds no finished fit: give the folder that `identify` or `gap` wrote (--fit)")


def load_fitted(given: Path, scene: Path | None = None) -> Fitted:
    """The model of a finished fit.

    Args:
        given: folder of `identify`, `gap` or `all`.
        scene: MJCF in place of the fitted one, which may have moved.

    Raises:
        ValueError: there is no finished fit, or its scene is missing or has changed.
    """
    stage, folder = fitted_folder(given)
    asked = setup(folder)
    return _extended(folder, asked, scene) if stage == "gap" else _identified(folder, asked, scene)


def _identified(folder: Path, asked: dict[str, Any], given: Path | None) -> Fitted:
    from droid_jax.commands.identify import Identify, effects_in, identify_config
    from droid_jax.identify.gaussian import load_gaussian
    from droid_jax.report.identify_folder import read_fit

    own = folder / EXTENDED
    command = replace(_command(Identify, asked), extended=own if own.is_file() else None)
    fit, space = read_fit(folder), load_gaussian(folder / FULL_GAUSSIAN).space
    known = {p.name: p for p in fit.parameters}
    if absent := [name for name in space.names if name not in known]:
        raise ValueError(f"{folder / FIT} lacks {', '.join(absent)} of {FULL_GAUSSIAN}: they are of two runs")
    scene, known_scene = _scene_of(asked, given, _rubbed(space.parameters)), asked.get("scene_sha256")
    if scene.sha256 != known_scene:  # it may have been compiled for nuisances too, which were not fitted
        other = _scene_of(asked, given, _rubbed_in_file(asked))
        scene = other if other.sha256 == known_scene else scene
    scene, effects = effects_in(command, scene)
    _check_same(folder, asked, scene, given)
    return Fitted(
        stage="identify",
        scene=scene,
        space=space,
        effects=effects,
        before=space.values({name: known[name].initial_mean for name in space.names}),
        after=space.values({name: known[name].best for name in space.names}),
        engine=command.engine,
        config=identify_config(command).compare,
        recordings=tuple(asked.get("recordings_sha256", ())),
    )


def _extended(folder: Path, asked: dict[str, Any], given: Path | None) -> Fitted:
    from droid_jax.commands.options import compared
    from droid_jax.identify.extended_model import base_parameters, load_extended

    scene = _scene_of(asked, given, _rubbed(base_parameters(folder / EXTENDED)))
    _check_same(folder, asked, scene, given)
    model = load_extended(folder / EXTENDED, scene)
    return Fitted(
        stage="gap",
        scene=model.scene,
        space=model.space,
        effects=model.effects,
        before=model.space.mean,
        after=model.values,
        engine="auto",
        config=compared(asked.get("motion_cutoff")),
        recordings=_fitted_by_search(folder, asked.get("recordings_sha256", ())),
    )


def _fitted_by_search(folder: Path, hashes: Sequence[str]) -> tuple[str, ...]:
    """Hashes of a search's fitted recordings: the third of three motions is test data."""
    from droid_jax.recordings.split import Split

    by = read_json(folder / GAP).get("split", {}).get("by")
    return tuple(hashes[:2] if by == Split.RECORDINGS.value else hashes)


def _scene_of(asked: dict[str, Any], given: Path | None, rubbed: tuple[str, ...]) -> Scene:
    """The scene of a setup.json, or `given` in its place; rubbed: joints whose friction loss was fitted."""
    from droid_jax.commands.options import TIMESTEP
    from droid_jax.door.scene import door_scene
    from droid_jax.model.scene import load_scene

    if not asked.get("scene"):
        if given is not None:
            raise ValueError("--scene: this fit is of the built-in door, which has no file")
        preset = asked.get("preset", "quick")
        return door_scene(gains="paper" if preset == "paper" else "impedance", timestep=TIMESTEP[preset])
    path = Path(asked["scene"]) if given is None else given
    if not path.is_file():
        raise ValueError(f"the fitted scene {path} does not exist: give its new path (--scene)")
    return load_scene(
        path,
        joints=asked.get("joints") or None,
        object_joint=asked.get("object_joint"),
        friction_joints=rubbed,
        hold=asked.get("joint_friction") == "held",  # earlier versions had no such option
        engine="mujoco" if asked.get("engine") == "mujoco" else "mjx",
        mj_step=asked.get("mj_step", False),
    )


def _check_same(folder: Path, asked: dict[str, Any], scene: Scene, given: Path | None) -> None:
    """ValueError for a scene that was changed after the fit; a warning if it was given explicitly."""
    if asked.get("scene_sha256") in (None, scene.sha256):
        return
    before, now = asked.get("versions", {}).get("mujoco"), importlib.metadata.version("mujoco")
    if before not in (None, now):  # compiled models of other versions have other hashes
        warnings.warn(
            f"{folder} was fitted with MuJoCo {before}, not {now}: its scene is assumed to be unchanged", stacklevel=2
        )
        return
    if given is None:
        raise ValueError(
            f"{asked.get('scene') or 'the built-in door'} is another model than {folder} was fitted with: fit again, "
            "or name the scene to evaluate in (--scene)"
        )
    warnings.warn(f"{given} is another model than {folder} was fitted with", stacklevel=2)


def _rubbed(parameters: Iterable[Parameter]) -> tuple[str, ...]:
    """Joints whose friction loss is a parameter; the scene was compiled with a constraint for each."""
    writes = (w for p in parameters for w in p.writes)
    return tuple(dict.fromkeys(w.element for w in writes if w.field == "dof_frictionloss" and w.element))


def _rubbed_in_file(asked: dict[str, Any]) -> tuple[str, ...]:
    """Those of the parameter file, nuisances included; none if it is no longer there."""
    from droid_jax.model.parameter_file import friction_joints

    file = asked.get("parameters")
    return friction_joints(Path(file)) if file and Path(file).is_file() else ()


def _command(kind: type[Options], asked: dict[str, Any]) -> Options:
    """A command from its options in a setup.json; options that are missing there have their defaults."""

    def option(name: str, value: Any) -> Any:
        if isinstance(value, list):
            entries = cast(list[Any], value)
            return tuple(Path(v) if name in PATHS else v for v in entries)
        return Path(value) if name in PATHS and value is not None else value

    return kind(**{f.name: option(f.name, asked[f.name]) for f in fields(cast(Any, kind)) if f.name in asked})
