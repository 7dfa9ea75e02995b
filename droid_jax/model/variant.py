"""Variants of a scene: numbers of the MJCF that are different for one recording.

A variant has the same bodies, joints, geoms and actuators as the scene.  Some of its numbers differ: the pose of the
base, the mass of a payload.  The recording holds these numbers by field of MjModel and name of the element,
{"body_mass": {"payload": [0.5]}}.  Numbers that MuJoCo's compiler derives from them are derived again.  Parameters act
on the variant's numbers.  Each variant is a scene: MJX compiles its replays once more, plain C compiles nothing.
"""

from __future__ import annotations

import copy
import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from droid_jax.arguments import lists_of_numbers, shown
from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Mode, Space, Write
from droid_jax.model.physics import DERIVED, UNIT, model_writes, settle
from droid_jax.model.scene import TINY_FRICTIONLOSS, Scene
from droid_jax.model.unsupported_features import refuse_ignored

Numbers = Mapping[str, Mapping[str, Any]]

OPTION = "opt"  # field of the options, of which a variant may have its own gravity
GRAVITY = "gravity"
# Beginning of a field's name -> what its rows belong to, and how many of these there are.
_KINDS = {
    "body": ("body", "nbody"),
    **dict.fromkeys(("jnt", "dof", "qpos0", "qpos"), ("joint", "njnt")),
    "geom": ("geom", "ngeom"),
    "site": ("site", "nsite"),
    "pair": ("pair", "npair"),
    "actuator": ("actuator", "nu"),
    "tendon": ("tendon", "ntendon"),
    "eq": ("equality", "neq"),
}
_PLURAL = {"body": "bodies", "equality": "equalities"}
# Beginnings of further fields that a replay reads, none of whose numbers can be a recording's.
_FIXED = ("exclude", "wrap", "mesh", "hfield", "flex")
# Ends of fields that no replay reads, that are the looks, or that say where a text or a tree of boxes stands.
_UNREAD = ("rgba", "user", "matid", "group", "plugin", "pathadr", "bvhadr", "bvhnum", "texcoordadr", "texcoordnum")
# What C may spare, and boxes around geoms: `physics.settle` takes the one away and makes the other.  And what sleeps.
_SPARED = (
    "body_sameframe",
    "body_simple",
    "dof_simplenum",
    "geom_sameframe",
    "site_sameframe",
    "geom_rbound",
    "geom_aabb",
    "dof_length",
)
_DERIVED = (*(set(DERIVED) - {"eq_data"}), *_SPARED, "actuator_acc0", "actuator_length0")
NAMED = 4  # numbers that a message names
_CLOSE = 1e-6  # relative, of numbers that were derived twice


def variant_scene(scene: Scene, numbers: Numbers, recording: str = "") -> Scene:
    """The scene with the numbers that a recording states, the same object each time; itself where it states none.

    Raises ValueError, with the name of the recording, for fields, elements or counts of numbers that the scene does not
    have.
    """
    key = json.dumps(lists_of_numbers(numbers), sort_keys=True) if numbers else ""
    if scene.variant == key:
        return scene
    with of_recording(recording):
        if scene.variant:
            raise ValueError(
                f"scene {scene.name!r} has the numbers of another recording already: give the scene as loaded"
            )
        return _made(scene, key)


@contextmanager
def of_recording(name: str) -> Iterator[None]:
    """Begin errors about a variant with the name of its recording, if it is known."""
    try:
        yield
    except ValueError as error:
        if not name:
            raise
        raise ValueError(f"recording {name!r}: {str(error).removeprefix('a recording ')}") from error


@functools.lru_cache(maxsize=64)
def _made(scene: Scene, key: str) -> Scene:
    model, written = copy.copy(scene.model), list[tuple[str, tuple[int, ...]]]()
    for field, name, value in _stated(key):
        array, rows = _entries(scene, field, name)
        if array[rows].size != len(value):
            raise ValueError(
                f"a recording states {len(value)} numbers of {field} of {name!r} (variant), and scene {scene.name!r} "
                f"has {array[rows].size}"
            )
        if field in UNIT and not np.any(value):
            raise ValueError(f"a recording states {field} of {name!r} (variant), a direction of length 0")
        if field in ("body_pos", "body_quat"):
            _check_placed(scene, rows.start, name, key)
        if field == "body_gravcomp" and not scene.model.body_gravcomp.any():
            raise ValueError(
                f"a recording states body_gravcomp of {name!r} (variant), and scene {scene.name!r} compensates no "
                "weight, which is then left out of its replays: give a body gravcomp in both MJCF files"
            )
        new = model.opt.gravity if field == OPTION else getattr(model, field)
        new[rows] = np.reshape(value, array[rows].shape)
        written += [(field, (row,)) for row in range(rows.start, rows.stop)] if field != OPTION else []
    rows_of_friction = scene.model.dof_frictionloss > 0  # MJX lays them out at compilation
    least = np.where(rows_of_friction, TINY_FRICTIONLOSS, 0.0)
    model.dof_frictionloss[:] = np.maximum(model.dof_frictionloss, least)
    settle(model, written, derive=True)
    refuse_ignored(model, scene.name)
    return replace(scene, model=model, variant=key, varied=scene)


def _stated(key: str) -> Iterator[tuple[str, str, list[float]]]:
    """Field, element and numbers of all that a variant states."""
    for field, of in (json.loads(key) if key else {}).items():
        for name, value in of.items():
            yield field, name, value


def _entries(scene: Scene, field: str, name: str) -> tuple[np.ndarray, slice]:
    """The array of a field, and an element's rows in it; ValueError lists what there is."""
    if field == OPTION:
        if name != GRAVITY:
            raise ValueError(f"a recording states the option {name!r} (variant): of the options it can only gravity")
        return scene.model.opt.gravity, slice(0, 3)
    if field not in _numbers(scene.model):
        raise ValueError(
            f"a recording states {shown(field)} (variant), which is no number of a body, joint, geom, site, pair, "
            "actuator, tendon or equality in mujoco.MjModel that it can state"
        )
    kind = _KINDS[field.split("_")[0]][0]
    names = _names(scene.model, kind)
    if name not in names:
        raise ValueError(
            f"a recording states {field} of {shown(name)} (variant), and scene {scene.name!r} has no such {kind}; it "
            f"has: {', '.join(names)}"
        )
    return getattr(scene.model, field), _rows(scene.model, field, names.index(name))


def _check_placed(scene: Scene, body: int, name: str, key: str) -> None:
    """ValueError for a body whose place in the model no replay reads: it is in qpos, or that of a mocap body."""
    model = scene.model
    free = model.body_jntnum[body] and model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE
    if model.body_mocapid[body] >= 0 or (free and "qpos0" not in json.loads(key)):
        raise ValueError(
            f"a recording states the pose of body {name!r} (variant), which in scene {scene.name!r} is a mocap body or "
            "on a free joint: take mocap or that joint out of the MJCF where the robot is bolted down"
        )


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind; one without a name goes by its number, "#3"."""
    count = next(count for of, count in _KINDS.values() if of == kind)
    number = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    return [mujoco.mj_id2name(model, number, i) or f"#{i}" for i in range(getattr(model, count))]


def _rows(model: mujoco.MjModel, field: str, number: int) -> slice:
    """Rows of a field that an element has."""
    if field.startswith(("dof_", "qpos")):
        first, count = (model.jnt_dofadr, model.nv) if field.startswith("dof_") else (model.jnt_qposadr, model.nq)
        ends = np.append(first, count)
        return slice(int(ends[number]), int(ends[number + 1]))
    return slice(number, number + 1)


def _arrays(model: mujoco.MjModel, beginnings: Sequence[str]) -> dict[str, np.ndarray]:
    """Name -> array of the fields that begin so, without those that no replay reads."""
    names = [n for n in dir(model) if n.split("_")[0] in beginnings and not n.endswith(_UNREAD)]
    found = {name: getattr(model, name) for name in names}
    return {name: array for name, array in found.items() if isinstance(array, np.ndarray)}


def _numbers(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """The fields whose numbers a variant may state."""
    arrays = _arrays(model, tuple(_KINDS))
    return {name: a for name, a in arrays.items() if a.dtype.kind == "f" and name not in _DERIVED}


def numbers_that_differ(scene: Scene, variant: Scene) -> dict[str, dict[str, list[float]]]:
    """Return the numbers that a recording of `variant` states if `scene` is fitted.

    Raises:
        ValueError: they differ in anything else: in names, in the tree, in options.
    """
    one, other = scene.model, variant.model
    for kind in dict.fromkeys(kind for kind, _ in _KINDS.values()):
        here, there = _names(one, kind), _names(other, kind)
        if here != there:
            less, more = ([n for n in a if n not in b] for a, b in ((here, there), (there, here)))
            said = [f"it {does} {', '.join(n)}" for does, n in (("lacks", less), ("has also", more)) if n]
            raise ValueError(
                f"{variant.name!r} has not the same {_PLURAL.get(kind, f'{kind}s')} as {scene.name!r}: "
                f"{', and '.join(said) or 'their order differs'}. A variant has other numbers alone: give both files "
                'the same elements, a payload that is not there a mass of 1e-6, and visual geoms group="2"'
            )
    found = dict[str, dict[str, list[float]]]()
    for field, here in _numbers(one).items():
        there = getattr(other, field)
        for number, name in enumerate(_names(one, _KINDS[field.split("_")[0]][0]) if here.shape == there.shape else ()):
            rows = _rows(one, field, number)
            if not np.array_equal(here[rows], there[rows]):
                found.setdefault(field, {})[name] = there[rows].ravel().tolist()
    if not np.array_equal(one.opt.gravity, other.opt.gravity):
        found[OPTION] = {GRAVITY: other.opt.gravity.tolist()}
    further = list(_further_differences(variant_scene(scene, found).model, other))
    if further:
        raise ValueError(
            f"{variant.name!r} differs from {scene.name!r} in {', '.join(further)}, which a recording cannot state: "
            "give both files the same"
        )
    return found


def _further_differences(one: mujoco.MjModel, other: mujoco.MjModel) -> Iterator[str]:
    """Differences of two models that a replay reads, in words."""
    for name in (n for n in dir(one.opt) if not n.startswith("_")):
        here, there = getattr(one.opt, name), getattr(other.opt, name)
        if name == "disableflags":  # a model whose geoms were moved goes without boxes around them
            here, there = here | mujoco.mjtDisableBit.mjDSBL_MIDPHASE, there | mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        if not callable(here) and not np.array_equal(here, there):
            yield f"option {name} ({here} and {there})"
    for field, here in _arrays(one, (*_KINDS, *_FIXED)).items():
        there = getattr(other, field)
        if field in _SPARED and here.shape == there.shape:
            continue
        if here.shape != there.shape:
            yield field
        elif not _same(here, there).all():
            yield _where(one, field, here, there)


def _same(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Where two arrays are alike: numbers that were derived twice nearly."""
    return np.isclose(here, there, rtol=_CLOSE, atol=1e-9) if here.dtype.kind == "f" else here == there


def _where(model: mujoco.MjModel, field: str, here: np.ndarray, there: np.ndarray) -> str:
    """A field that differs, and the first element whose number does."""
    if field.split("_")[0] not in _KINDS:
        return field
    names = _names(model, _KINDS[field.split("_")[0]][0])
    off = ~_same(here, there)
    return f"{field} of {next((n for i, n in enumerate(names) if off[_rows(model, field, i)].any()), '?')}"


def check_writes(scene: Scene, space: Space, effects: Sequence[Effect] = ()) -> None:
    """Raise ValueError for parameters that would write over numbers that the recording of a variant states."""
    effect_of = {p.name: effect.name for effect in effects for p in effect.parameters}
    stated = set[tuple[str, int]]()
    for field, name, _ in _stated(scene.variant):
        rows = _entries(scene, field, name)[1]
        stated |= {(field, row) for row in range(rows.start, rows.stop)}
    for column, write in model_writes(space):
        if (write.field, write.index[0]) in stated and not _relative(write):
            effect = effect_of.get(space.names[column])
            raise ValueError(
                f"parameter {space.names[column]!r} sets {write.field} of {write.element!r}, which the recording "
                "states (variant): "
                + (
                    f"leave the effect out (--without {effect})"
                    if effect
                    else 'leave the parameter out, let it scale the number or add to it ("mode"), or state its value '
                    "as known in place of the variant"
                )
            )


def _relative(write: Write) -> bool:
    """Whether a write changes any number alike; a gain with an offset is made for the MJCF's, as 1 + value / mass."""
    return write.mode not in (Mode.SET, Mode.NEGATIVE) and (not write.offset or write.gain == 1.0)


def variant_text(numbers: Numbers) -> str:
    """The numbers that a recording states, in words."""
    each = [
        f"{name if field == OPTION else f'{field} of {name}'} {' '.join(f'{v:.4g}' for v in value)}"
        for field, name, value in _stated(json.dumps(lists_of_numbers(numbers)))
    ]
    more = f" and {len(each) - NAMED} more" if len(each) > NAMED else ""
    return ", ".join(each[:NAMED]) + more
