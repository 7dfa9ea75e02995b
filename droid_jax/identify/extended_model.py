"""The extended model: base parameters and the effects that a search named.

    extended = load_extended("runs/gap/extended.json", scene)
    cost = make_cost(extended.scene, extended.space, [recording], effects=extended.effects)

extended.json holds the complete model.  extended.xml is the scene as MJCF with the fitted values.  It lacks the effects
that MJCF cannot express; extended.json lists them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from droid_jax.arguments import instance, path_of, shown
from droid_jax.files import EXTENDED, EXTENDED_MJCF
from droid_jax.identify.gaussian import Coordinates, Gaussian, ParameterEntry, matrix, space_of, space_to_json
from droid_jax.identify.neutral_result import write_neutral
from droid_jax.model.effect_interface import MOVING, Effect, has_law
from droid_jax.model.effects.candidate import Candidate, Keys
from droid_jax.model.effects.registry import effect_space, library, ready
from droid_jax.model.fields import check_space
from droid_jax.model.mjcf import WORDS, native
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene
from droid_jax.read_json import read_json, typed
from droid_jax.storage import write_json

FORMAT, VERSION = "droid_jax extended model", 2


@dataclass(frozen=True, eq=False)
class Extended:
    """A fitted model with its effects.

    scene: prepared for the effects (`registry.ready`).  parts: the effects with their locations.
    effects: for `make_cost(..., effects=...)`.  values: [D] physical, over `space`.
    gaussian: over `space`, base parameters first.
    """

    scene: Scene
    parts: tuple[Candidate, ...]
    effects: tuple[Effect, ...]
    values: np.ndarray
    gaussian: Gaussian

    @property
    def space(self) -> Space:
        """Base parameters, then those of the effects at their locations."""
        return self.gaussian.space

    @property
    def effect_space(self) -> Space:
        """The effects' parameters alone, with the fitted values as means and their prior deviations.

        Raises:
            ValueError: the model has no effect.
        """
        if not self.parts:
            raise ValueError("the extended model names no effect: it is the base model")
        names = dict.fromkeys(name for part in self.parts for name in part.free)
        at = dict(zip(self.space.names, self.values.tolist(), strict=True))
        return Space(tuple(replace(self.space[name], mean=at[name]) for name in names))

    @property
    def lacking(self) -> Keys:
        """The parts that an MJCF cannot express completely: of a payload, for example, only the mass."""
        effects = {e.name: e for e in self.effects}
        model = make_c_model(self.scene, self.space, self.values)
        in_mjcf = {n for n, e in effects.items() if native(e, self.space, self.values, model) is not None}
        parts = (p for p in self.parts if p.effect not in in_mjcf)
        return tuple(p.key for p in parts if not _in_mjcf(effects[p.effect], self.space.select(p.free)))


def save_extended(folder: Path, model: Extended) -> None:
    """Write extended.json and extended.xml into a folder; extended.json gives the reason if there is no MJCF."""
    mjcf: dict[str, Any] = {"file": EXTENDED_MJCF, "lacks": list(map(str, model.lacking))}
    error = write_neutral(folder, model.scene, model.gaussian, model.values, model.effects, main=EXTENDED_MJCF)
    if error:
        mjcf |= {"file": None, "error": error}
    write_json(folder / EXTENDED, _to_json(model) | {"mjcf": mjcf})


def load_extended(path: str | Path, scene: Scene) -> Extended:
    """Load the extended model that `gap` wrote: base parameters and the effects that were found.

    Args:
        path: an extended.json.
        scene: the one that it was fitted with; the time step may differ.

    Returns:
        The model, for `make_cost(model.scene, model.space, ..., effects=model.effects)`.

    Raises:
        ValueError: the file is missing or damaged, or belongs to another scene; the message names it.
    """
    scene, path = instance(scene, "scene", Scene), path_of(path, "the path of an extended model")
    try:
        return _of_file(_read(path), scene)
    except ValueError as error:
        raise ValueError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def base_parameters(path: Path) -> tuple[Parameter, ...]:
    """Return the base parameters in an extended.json.

    Raises:
        ValueError: the file is missing or damaged.
    """
    file = _read(path)
    of_effects = {name for effect in file.effects for name in (*effect.coefficients, *effect.shape_parameters)}
    return tuple(p for p in space_of(file.space).parameters if p.name not in of_effects)


def _read(path: Path) -> _File:
    try:
        content = read_json(path)
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file; `python -m droid_jax.run gap` writes one") from None
    if not isinstance(content, dict) or (content.get("format"), content.get("version")) != (FORMAT, VERSION):
        raise ValueError(f"{path}: expected a JSON object with format {FORMAT!r}, version {VERSION}")
    return typed(content, _File, str(path))


def _in_mjcf(effect: Effect, free: Space) -> bool:
    """Whether an effect only writes numbers of the model that MJCF has attributes for; free: its free parameters."""
    fields = [{w.field for w in p.writes} for p in free.parameters]
    return not has_law(effect, (*MOVING, "observe")) and all(written and written <= WORDS for written in fields)


class _Effect(msgspec.Struct, forbid_unknown_fields=True):
    effect: str
    location: str
    description: str
    coefficients: list[str]
    shape_parameters: list[str]


class _Normal(msgspec.Struct, forbid_unknown_fields=True):
    coordinates: Coordinates
    rule: str
    mean: list[float]
    cov: list[list[float]]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The content of an extended.json."""

    format: str
    version: int
    scene: dict[str, str | int | list[str] | None]
    effects: list[_Effect]
    values: dict[str, float]
    gaussian: _Normal
    space: list[ParameterEntry]
    mjcf: dict[str, str | list[str] | None] = {}


def _to_json(model: Extended) -> dict[str, Any]:
    what = {e.name: e.description for e in model.effects}
    gaussian = model.gaussian
    return {
        "format": FORMAT,
        "version": VERSION,
        "scene": _scene_to_json(model.scene),
        "effects": [
            {
                "effect": part.effect,
                "location": part.location,
                "description": what[part.effect],
                "coefficients": list(part.coefficients),
                "shape_parameters": list(part.shape_parameters),
            }
            for part in model.parts
        ],
        "values": dict(zip(model.space.names, model.values.tolist(), strict=True)),
        "gaussian": {
            "coordinates": gaussian.coordinates,
            "rule": gaussian.rule,
            "mean": gaussian.mean.tolist(),
            "cov": gaussian.cov.tolist(),
        },
        "space": space_to_json(model.space),
    }


def _of_file(file: _File, scene: Scene) -> Extended:
    if (given := _scene_to_json(scene)) | {"name": ""} != file.scene | {"name": ""}:
        raise ValueError(f"it was fitted with another scene, {file.scene}; this one is {given}")
    space = space_of(file.space)
    free = [name for effect in file.effects for name in (*effect.coefficients, *effect.shape_parameters)]
    if without := [effect.effect for effect in file.effects if not effect.coefficients]:
        raise ValueError(f"'effects': {shown(without[0])} has no coefficients")
    if absent := [name for name in free if name not in space.names]:
        raise ValueError(f"the effects have parameters that the space lacks: {', '.join(absent)}")
    if absent := [name for name in space.names if name not in file.values]:
        raise ValueError(f"'values': missing keys: {', '.join(absent)}")
    parts = tuple(
        Candidate(e.effect, e.location, tuple(e.coefficients), {name: file.values[name] for name in e.shape_parameters})
        for e in file.effects
    )
    effects = library(scene, dict.fromkeys(p.effect for p in parts))
    _check_known(parts, effects, space)
    check_space(prepared := ready(scene), space)
    g = file.gaussian
    gaussian = Gaussian(space, matrix("mean", g.mean), matrix("cov", g.cov), g.rule, g.coordinates)
    values = space.check(np.array([file.values[name] for name in space.names]))
    return Extended(prepared, parts, effects, values, gaussian)


def _check_known(parts: tuple[Candidate, ...], effects: tuple[Effect, ...], space: Space) -> None:
    """Raise ValueError unless the library has these effects, with parameters that write the same numbers."""
    in_library = {p.name: p for p in (effect_space(effects).parameters if effects else ())}
    for name in (name for part in parts for name in part.free):
        if name not in in_library or in_library[name].writes != space[name].writes:
            raise ValueError(f"the effect parameter {name!r} is not in this version's library, or another one there")


def _scene_to_json(scene: Scene) -> dict[str, Any]:
    """Names and sizes of a scene that must equal those of the fit, since parameters write by index."""
    sizes = {size: int(getattr(scene.model, size)) for size in ("nbody", "nv", "nu", "npair")}
    return {"name": scene.name, "joints": list(scene.joints), "object_joint": scene.object_joint, **sizes}
