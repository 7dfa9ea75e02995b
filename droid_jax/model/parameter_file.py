"""Read the parameters of a user's scene from a JSON file.

    [{"field": "dof_damping", "element": "elbow", "unit": "N m s/rad", "std": 0.5, "high": 10, "scaling": "log",
      "log_offset": 0.05},
     {"field": "body_mass", "element": "forearm", "std": 0.2, "high": 5}]

Every entry needs field, element, std and high; optional: column, name, unit, mean, low, mode
(set, scale, divide, add, negative), scaling (linear, log), log_offset, width, nuisance, group.

    {"sensor": "coulomb", "element": "elbow", "std": 0.5, "high": 5}

A parameter of a joint's sensors has "sensor" in place of "field": viscous, coulomb, torque_offset, torque_gain
(model/joint_friction.py) or encoder_offset (model/encoders.py).  Its mean is zero, its bounds are -high and high.

    {"sensor": "time_offset", "std": 0.001, "high": 0.05}
    {"servo": "elbow", "std": 0.03}

The delay of the commands [s], a nuisance by default, and a factor on the position gain of a joint's servo have no
element.

    {"motor": "stall_torque", "element": "elbow", "std": 0.2}

A factor on a property of the DC motor of a joint's servo: stall_torque, no_load_speed, torque_constant or resistance
(model/dc_motor.py).

    {"field": "dof_armature", "element": ["shoulder", "elbow"], "name": "rotor", "std": 0.01, "high": 0.2}

A list of elements (for "servo" and "motor" of joints) or of columns makes one shared parameter.

    {"field": "dof_armature", "element": ["shoulder", "elbow"], "each": true, "name": "rotor", "std": 0.01, "high": 0.2}

With "each" it makes one parameter for each element, "rotor_shoulder" and "rotor_elbow".

    {"like": "rotor", "name": "second rotor"}

A parameter with the bounds and prior of another one, which it replaces in recordings that say so (`Recording.known`).

    {"inertia": "forearm", "std": 0.1}

The whole inertia of a body, as ten parameters that are physically consistent at all values (model/inertia.py).
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import msgspec

from droid_jax.arguments import instance, path_of
from droid_jax.errors import faults
from droid_jax.model.dc_motor import motor_parameter
from droid_jax.model.fields import (
    ENCODER,
    body_mass,
    joint_encoder_offset,
    model_parameter,
    servo_scale,
    shared,
    time_offset,
)
from droid_jax.model.inertia import check_single_inertia, inertia_parameters
from droid_jax.model.joint_friction import TERMS, sensor_parameter
from droid_jax.model.parameters import Mode, Parameter, Role, Scaling, Space
from droid_jax.model.scene import Scene
from droid_jax.read_json import read_json, typed

_KINDS = ("field", "sensor", "servo", "motor")  # keys that choose the type of an entry of one parameter
_INERTIA, _LIKE = "inertia", "like"
_OF_LIKE = (_LIKE, "name", "std", "high", "low", "mean", "nuisance", "group")
_OF_INERTIA = (_INERTIA, "std", "high", "nuisance", "group")
_NEEDED = ("element", "std", "high")
_TIME = Role.TIME_OFFSET.value
LEAST_LOG_MEAN = 1e-3  # of its deviation, least mean + log_offset from which a logarithmic search can progress


class _Entry(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of all types of entries."""

    field: str | msgspec.UnsetType = msgspec.UNSET
    sensor: str | msgspec.UnsetType = msgspec.UNSET
    servo: str | list[str] | msgspec.UnsetType = msgspec.UNSET
    motor: str | msgspec.UnsetType = msgspec.UNSET
    inertia: str | msgspec.UnsetType = msgspec.UNSET
    like: str | msgspec.UnsetType = msgspec.UNSET
    element: str | list[str] | msgspec.UnsetType = msgspec.UNSET
    name: str | msgspec.UnsetType = msgspec.UNSET
    unit: str | msgspec.UnsetType = msgspec.UNSET
    group: str | msgspec.UnsetType = msgspec.UNSET
    std: float | msgspec.UnsetType = msgspec.UNSET
    high: float | msgspec.UnsetType = msgspec.UNSET
    low: float | msgspec.UnsetType = msgspec.UNSET
    mean: float | msgspec.UnsetType = msgspec.UNSET
    log_offset: float | msgspec.UnsetType = msgspec.UNSET
    width: float | msgspec.UnsetType = msgspec.UNSET
    mode: Mode | msgspec.UnsetType = msgspec.UNSET
    scaling: Scaling | msgspec.UnsetType = msgspec.UNSET
    column: int | list[int] | msgspec.UnsetType = msgspec.UNSET
    nuisance: bool | msgspec.UnsetType = msgspec.UNSET
    each: bool | msgspec.UnsetType = msgspec.UNSET


_KNOWN = _Entry.__struct_fields__


def load_parameters(path: str | Path, scene: Scene) -> Space:
    """The space described in a JSON file (its format: the module's text).

    Args:
        path: of the file.
        scene: with the elements.

    Returns:
        The parameters in the file's order: one for each entry, ten for an inertia, one for each element of an entry
        with "each".

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an entry is wrong; the message names the file, the entry and what is wrong with it.
    """
    entries, first = _entries(path_of(path, "the path of a parameter file")), dict[str, int]()
    instance(scene, "scene", Scene)
    parameters = list[tuple[int, Parameter]]()
    for i, entry in enumerate(entries, 1):
        before = {p.name: p for _, p in parameters}
        parameters += [(i, p) for p in _parameters(scene, entry, f"{path}, entry {i}", before)]
    for i, p in parameters:
        if first.setdefault(p.name, i) != i:
            raise ValueError(f'{path}, entry {i}: {p.name!r} is entry {first[p.name]} already; give it a unique "name"')
    space = Space(tuple(p for _, p in parameters))
    try:
        check_single_inertia(space)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    for p in space.parameters:
        if p.scaling is Scaling.LOG and p.mean + p.log_offset < LEAST_LOG_MEAN * p.std:
            warnings.warn(
                f"{path}: {p.name!r} is searched in the logarithm from {p.mean:g} {p.unit}, where it has no effect "
                'yet: give a "mean" of the size that you expect, or a "log_offset"',
                stacklevel=2,
            )
    return space


def friction_joints(path: str | Path) -> tuple[str, ...]:
    """Joints with a friction loss in the file, for which the scene must be compiled with a constraint row."""
    entries: list[dict[str, Any]] = [e for e in _entries(Path(path)) if isinstance(e, dict)]
    elements = [e["element"] for e in entries if e.get("field") == "dof_frictionloss" and "element" in e]
    return tuple(str(joint) for element in elements for joint in _as_list(element))


def _entries(path: Path) -> list[Any]:
    if not path.is_file():
        raise FileNotFoundError(f"no parameter file at {path}")
    content = read_json(path)
    if not isinstance(content, list) or not content:
        got = "an empty one" if content == [] else type(cast(Any, content)).__name__
        raise ValueError(f"{path}: expected a list of parameters, got {got}")
    return cast(list[Any], content)


def _parameters(scene: Scene, given: Any, where: str, before: Mapping[str, Parameter]) -> Sequence[Parameter]:
    """The parameters of an entry; before: the parameters of the entries before it, by name."""
    if not isinstance(given, dict):
        raise ValueError(f"{where}: expected an object, got {type(given).__name__}")
    entry = cast(dict[str, Any], given)
    missing = [k for k in _needed(entry) if k not in entry]
    if sum(kind in entry for kind in (*_KINDS, _INERTIA, _LIKE)) != 1:
        missing.insert(0, "one of field, sensor, servo, motor, inertia and like")
    unknown = [k for k in entry if k not in _KNOWN]
    if wrong := faults({"missing": missing, "unknown": unknown}):
        raise ValueError(f"{where}: {wrong}; known keys: {', '.join(_KNOWN)}")
    if extra := [k for k in _useless(entry) if k in entry]:
        raise ValueError(f"{where}: leave {', '.join(extra)} out, which an entry of its type does not have")
    read = msgspec.structs.asdict(typed(entry, _Entry, where))
    options: dict[str, Any] = {key: value for key, value in read.items() if value is not msgspec.UNSET}
    try:
        if _INERTIA in options:
            return inertia_parameters(scene, options.pop(_INERTIA), **options)
        if _LIKE in options:
            return [_replacement(before, options.pop(_LIKE), **options)]
        separate = _for_each(options) if options.pop("each", False) else [options]
        return [_shared(scene, one) if _several(one) else _single(scene, one) for one in separate]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from None


def _replacement(before: Mapping[str, Parameter], like: str, **options: Any) -> Parameter:
    """A parameter that replaces one of `before` in some recordings."""
    if like not in before:
        raise ValueError(f"no entry before it has the name {like!r}; names are: {', '.join(before) or 'none'}")
    return replace(before[like], writes=(), role=Role.STANDS_FOR, **options)


def _needed(entry: Mapping[str, Any]) -> tuple[str, ...]:
    if _LIKE in entry:
        return ("name",)
    if "servo" in entry or _INERTIA in entry:
        return ("std",)
    if "motor" in entry:
        return ("element", "std")
    return ("std", "high") if entry.get("sensor") == _TIME else _NEEDED


def _several(options: Mapping[str, Any]) -> bool:
    """Whether an entry names several elements or columns."""
    return isinstance(options.get("element", options.get("servo")), list) or isinstance(options.get("column"), list)


def _for_each(options: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One entry for each element, with a name that contains the element's."""
    which = "servo" if "servo" in options else "element"
    elements = options.get(which)
    if not isinstance(elements, list) or not elements:
        raise ValueError(f'"each" needs a list of elements; {which} is {elements!r}')
    name = options.get("name")
    names = [{} if name is None else {"name": f"{name}_{element}"} for element in cast(list[str], elements)]
    return [
        {**options, which: element, **named} for element, named in zip(cast(list[str], elements), names, strict=True)
    ]


def _shared(scene: Scene, options: Mapping[str, Any]) -> Parameter:
    """One parameter of several elements, of several columns, or both."""
    which = "servo" if "servo" in options else "element"
    if "sensor" in options:
        raise ValueError("a sensor's term belongs to one joint: write an entry for each joint")
    columns = {"column": _as_list(options["column"])} if "column" in options else {}
    keys, choices = (which, *columns), (_as_list(options[which]), *columns.values())
    if not all(choices):
        raise ValueError(f"{which}: the list is empty")
    combinations = [dict(zip(keys, choice, strict=True)) for choice in itertools.product(*choices)]
    parts = [_single(scene, {**options, **combination}) for combination in combinations]
    return shared(parts, name=options.get("name"))


def _as_list(value: Any) -> list[Any]:
    return cast(list[Any], value) if isinstance(value, list) else [value]


def _single(scene: Scene, given: Mapping[str, Any]) -> Parameter:
    """The parameter of one element."""
    options: dict[str, Any] = dict(given)
    field, sensor, servo, motor = (options.pop(kind, None) for kind in _KINDS)
    if servo is not None:
        return servo_scale(scene, servo, **options)
    if motor is not None:
        return motor_parameter(scene, motor, options.pop("element"), **options)
    if sensor == _TIME:
        return replace(time_offset(options.pop("std"), options.pop("high")), **options)
    element = options.pop("element")
    if sensor is not None and sensor not in (*TERMS, ENCODER):
        raise ValueError(f"unknown sensor term {sensor!r}; valid: {', '.join((*TERMS, ENCODER))}")
    if sensor == ENCODER:
        _check_measured(scene, element)
        return joint_encoder_offset(scene, element, **options)
    if sensor is not None:
        _check_measured(scene, element)
        return sensor_parameter(scene.joints, sensor, element, slides=scene.slides(element), **options)
    if field == "body_mass" and options.get("mode", Mode.SET) is Mode.SET:
        options.pop("mode", None)
        return body_mass(scene, element, **options)
    options.setdefault("unit", "")
    return model_parameter(scene, field, element, options.pop("column", None), **options)


def _check_measured(scene: Scene, joint: str) -> None:
    if joint not in scene.joints:
        raise ValueError(f"unknown joint {joint!r}; measured joints: {', '.join(scene.joints)}")


def _useless(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys that an entry of this type does not have.  A sensor's has no name, since the replay reads a fixed one."""
    if _INERTIA in entry:
        return tuple(key for key in _KNOWN if key not in (*_KINDS, *_OF_INERTIA))
    if _LIKE in entry:
        return tuple(key for key in _KNOWN if key not in (*_KINDS, *_OF_LIKE))
    if "servo" in entry:
        return ("element", "column", "mode")
    if "motor" in entry:
        return ("column", "mode")
    if "sensor" in entry:
        return ("column", "mode", "name", *(["element"] if entry["sensor"] == _TIME else []))
    return ("column",) if entry["field"] == "body_mass" else ()
