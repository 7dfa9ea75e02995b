"""A fitted scene as MJCF: the numbers of its model written into the spec, in a file that MuJoCo reads."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from droid_jax.arguments import instance, instances, numeric, shown
from droid_jax.model.effect_interface import Effect
from droid_jax.model.fields import check_space
from droid_jax.model.inertia import PSEUDO_INERTIA
from droid_jax.model.mjcf_in_place import Change, Edited, NotInPlace, PlacedNumber, WantedNumber, edit
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import SOFT_IMPEDANCE, Scene
from droid_jax.model.visual_geoms import compiled, keep_inertia, visual_geoms, weigh

# Model field -> attribute of the element that holds a row of it, or its first numbers.
_ATTRIBUTES = {
    "dof_damping": "damping", "dof_frictionloss": "frictionloss", "dof_armature": "armature",
    "dof_solref": "solref_friction", "dof_solimp": "solimp_friction",
    "qpos_spring": "springref", "qpos0": "ref",
    "jnt_stiffness": "stiffness", "jnt_range": "range", "jnt_margin": "margin", "jnt_pos": "pos", "jnt_axis": "axis",
    "jnt_solref": "solref_limit", "jnt_solimp": "solimp_limit", "jnt_actfrcrange": "actfrcrange",
    "body_pos": "pos", "body_quat": "quat", "body_gravcomp": "gravcomp",
    "geom_pos": "pos", "geom_quat": "quat", "geom_size": "size", "geom_friction": "friction",
    "geom_solref": "solref", "geom_solimp": "solimp", "geom_margin": "margin", "geom_gap": "gap",
    "geom_solmix": "solmix",
    "pair_friction": "friction", "pair_solref": "solref", "pair_solreffriction": "solreffriction",
    "pair_solimp": "solimp", "pair_margin": "margin", "pair_gap": "gap",
    "actuator_gainprm": "gainprm", "actuator_biasprm": "biasprm", "actuator_gear": "gear",
    "actuator_ctrlrange": "ctrlrange", "actuator_forcerange": "forcerange",
}  # fmt: skip
# As MJCF spells attributes that MuJoCo's spec spells otherwise.
_SPELLED = {"solref_friction": "solreffriction", "solimp_friction": "solimpfriction", "solref_limit": "solreflimit",
            "solimp_limit": "solimplimit", "actfrcrange": "actuatorfrcrange"}  # fmt: skip
_INERTIAL = {
    "body_mass": "mass",
    "body_inertia": "diaginertia",
    "body_ipos": "inertial pos",
    "body_iquat": "inertial quat",
}
_COMPARED = ("body_", "jnt_", "dof_", "geom_", "pair_", "actuator_", "eq_", "tendon_", "qpos")
_GAIN, _DAMPING = ("actuator_gainprm", 0), ("actuator_biasprm", 2)  # of a servo: kp or a velocity servo's kv, and kv
SLACK = 2e-6  # what TINY_FRICTIONLOSS may differ by
_WEIGHT = {"body_mass", "body_inertia", "body_ipos", "body_iquat"}  # written as the body's own <inertial>
_FOLLOWING = {"geom_rbound", "geom_aabb"}  # the compiler works them out
_UNITS = {  # of fields by hinge and slide, where they are not the same
    "dof_damping": ("N m s/rad", "N s/m"), "dof_frictionloss": ("N m", "N"), "dof_armature": ("kg m^2", "kg"),
    "jnt_stiffness": ("N m/rad", "N/m"), "qpos_spring": ("rad", "m"), "qpos0": ("rad", "m"), "jnt_range": ("rad", "m"),
    "jnt_margin": ("rad", "m"), "jnt_actfrcrange": ("N m", "N"), "body_mass": "kg", "body_inertia": "kg m^2",
    "body_pos": "m", "body_ipos": "m", "geom_pos": "m", "geom_size": "m", "geom_margin": "m", "geom_gap": "m",
    "jnt_pos": "m", "pair_margin": "m", "pair_gap": "m",
}  # fmt: skip
WORDS = frozenset({*_ATTRIBUTES, *_WEIGHT, *_FOLLOWING, PSEUDO_INERTIA})  # model fields that MJCF can say
_ANGLES = {"jnt_range", "qpos_spring", "qpos0"}  # written in the compiler's unit
_PLACE = {"body_pos", "body_quat"}  # written together
# Compared with the model once more, a compiler may know more ways to work numbers out.
_SURE = (
    *("body_mass", "body_inertia", "jnt_stiffness", "dof_damping", "dof_frictionloss", "dof_armature"),
    *("actuator_gainprm", "actuator_biasprm"),
)
_SHAPE = {"geom_pos", "geom_quat", "geom_size"}
_OF_FILES = (int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD))  # geoms whose shape is not the MJCF's


def fitted_mjcf(scene: Scene, space: Space, values: np.ndarray, effects: Sequence[Effect] = ()) -> str:
    """The scene as one MJCF text with fitted values written in; `unwritten` says which have no place in it.

    It is MuJoCo's own way of writing the whole scene; `fitted_files` keeps the user's file. Files of meshes and
    textures are named by their absolute paths, wherever the text is saved.

    Args:
        scene: whose MJCF it is.
        space: meaning of the values.
        values: [D] physical values.
        effects: in the model; of those that are laws, what MuJoCo says in numbers of its own (`Effect.native`).

    Returns:
        The text of the MJCF.

    Raises:
        ValueError: values of another shape, or MuJoCo compiles no model of them: a replay takes an inertia that no body
            can have (fitted about one axis alone, say), the compiler does not.
    """
    return _text(_fitted(scene, space, values, effects))


@dataclass(frozen=True, eq=False)
class FittedFiles:
    """A fitted scene as MJCF files.

    files: name -> text, all for one folder; the first one is to be loaded.  changes: the numbers that differ from the
    scene's own.  in_place: whether these are the user's own files with only these numbers changed, and paths, which are
    absolute.  patch: then the same changes to the user's files, as a unified diff to be applied beside the main one.
    reason: why not in place, else empty.
    """

    files: dict[str, str]
    changes: tuple[Change, ...]
    in_place: bool
    patch: str = ""
    reason: str = ""


def fitted_files(
    scene: Scene, space: Space, values: np.ndarray, effects: Sequence[Effect] = (), main: str = "fitted.xml"
) -> FittedFiles:
    """The user's own MJCF with fitted values in the place of its numbers; layout, includes and comments stay.

    Where changed numbers alone do not make the fitted model (see `mjcf_in_place`), or the scene was never a file, it is
    the text of `fitted_mjcf`.  Arguments and errors are those of `fitted_mjcf`; main: name of the file to load.
    """
    fitted = _fitted(scene, space, values, effects)
    try:
        if scene.path is None:
            raise NotInPlace("the scene was put together in memory")
        made = edit(scene.path, fitted.before, fitted.wanted, fitted.weighed, main)
        _check_files(made.files, main, fitted.written)
    except (ValueError, OSError) as error:
        reason = " ".join(str(error).split())
        return FittedFiles({main: _text(fitted)}, tuple(_changes(fitted, None)), False, reason=reason)
    return FittedFiles(made.files, tuple(_changes(fitted, made)), True, made.patch)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """spec: with the values written in, `before` the scene's own, numbered.  written: what the spec compiles to.
    model: that was wished for.  wanted: numbers that differ.  weighed: bodies that weigh otherwise, with the whole
    model."""

    scene: Scene
    spec: mujoco.MjSpec
    before: mujoco.MjSpec
    written: mujoco.MjModel
    model: mujoco.MjModel
    wanted: tuple[WantedNumber, ...]
    weighed: dict[int, mujoco.MjModel]


def _fitted(scene: Scene, space: Space, values: np.ndarray, effects: Sequence[Effect]) -> _Fitted:
    check_space(instance(scene, "scene", Scene), instance(space, "space", Space))
    values, effects = numeric(values, "values"), instances(effects, "effects", Effect)
    if not np.isfinite(values).all():
        raise ValueError(f"values must be finite, got {shown(values)}")
    if np.shape(values) != (len(space),):
        raise ValueError(f"expected values [{len(space)}], one for each of {space.names}, got {list(np.shape(values))}")
    spec, before, model = scene.spec.copy(), scene.spec.copy(), make_c_model(scene, space, values)
    for effect in effects:
        for (field, row), more in (native(effect, space, values, model) or {}).items():
            getattr(model, field)[row] += more
    compiled(spec)  # numbers its elements, of which not all need a name
    compiled(before)
    changed: list[tuple[str, Any, int, str]] = []
    by_kind = _elements(spec, model)
    for kind, elements in by_kind.items():
        for row, element in elements.items():
            changed += [(kind, element, row, f) for f in _write_changed(kind, element, row, scene.model, model)]
    changed += [("actuator", a, a.id, "actuator_biasprm") for a in _settle(spec, model)]
    changed += [("dof", e, row, "dof_solimp") for row, e in by_kind["dof"].items() if e.name in scene.held]
    for joint in before.joints:  # friction that holds here creeps in the user's file
        if joint.name in scene.held:
            joint.solimp_friction = list(SOFT_IMPEDANCE)
    keep_inertia(spec, model)
    try:
        written = compiled(spec)
    except ValueError as error:
        raise ValueError(f"the fitted values make no MJCF: {' '.join(str(error).split())}") from None
    other = [f for f in _SURE if not np.allclose(getattr(written, f), getattr(model, f), rtol=1e-3, atol=1e-5)]
    if other:
        raise ValueError(f"the fitted values make no MJCF: MuJoCo works out another {', '.join(other)} from it")
    old = _elements(before, model)
    wanted = tuple(_wanted(scene.model, model, kind, old[kind][row], e, row, f) for kind, e, row, f in changed)
    heavier = np.any([_differ(getattr(scene.model, f), getattr(model, f)) for f in sorted(_WEIGHT)], axis=0)
    weighed = {int(b): model for b in np.flatnonzero(heavier & (model.body_mass > 0))}
    unique = {(w.element, w.row, w.field): w for w in wanted}
    return _Fitted(scene, spec, before, written, model, tuple(unique.values()), weighed)


def _differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] bool, rows that differ by more than rounding."""
    return ~np.all(np.reshape(np.isclose(a, b, rtol=1e-9, atol=1e-14), (len(a), -1)), axis=1)


def _wanted(
    before: mujoco.MjModel, after: mujoco.MjModel, kind: str, old: Any, new: Any, row: int, field: str
) -> WantedNumber:
    attribute = _ATTRIBUTES[field]
    if field in _SHAPE | _PLACE:  # a spec may say them in other words
        numbers = getattr(before, field)[row], getattr(after, field)[row]
    else:
        numbers = getattr(old, attribute), getattr(new, attribute)
    of = np.atleast_1d(np.array(numbers[0], float)), np.atleast_1d(np.array(numbers[1], float))
    element = "joint" if kind in ("dof", "jnt", "qpos") else kind
    return WantedNumber(element, new.id, _SPELLED.get(attribute, attribute), *of, field)


def _changes(fitted: _Fitted, made: Edited | None) -> Iterator[Change]:
    """The numbers that differ, by element and entry; made: the user's files with them, None where there are none."""
    model, own = fitted.model, fitted.scene.model
    by_kind = {kind: rows.items() for kind, rows in _elements(fitted.before, model).items()}
    for i, want in enumerate(fitted.wanted):
        placed = PlacedNumber(want.attribute) if made is None else made.placed[i]
        row, named = next((r, e.name) for r, e in by_kind[_kind(want.field)] if e.id == want.row)
        width = np.asarray(getattr(model, want.field)).shape[1:]
        short = placed.attribute in ("kp", "kv")  # one number, which is several of the model's
        differing = np.flatnonzero(want.before != want.after) if placed.attribute else ()
        for k in [k for k in differing if not short or (want.field, k) in (_GAIN, _DAMPING)]:
            entry, before = ((row, int(k)) if width else (row,)), want.before[k]
            if want.element == "actuator":  # a spec may have a ratio in place of the number that it compiles to
                before = getattr(own, want.field)[entry]
            sign = -1.0 if short and want.field == _DAMPING[0] else 1.0
            numbers = sign * float(before), sign * float(want.after[k])
            if numbers[0] == numbers[1]:
                continue
            where = placed.file, placed.line, placed.origin
            index = 0 if short else int(k)
            yield Change(want.element, named, placed.attribute, index, want.field, entry, *numbers, *where)
    for body in fitted.weighed:
        where = ("", 0) if made is None else made.bodies[body]
        for field in sorted(_WEIGHT):
            old, new = (np.atleast_1d(getattr(m, field)[body]) for m in (own, model))
            for k in np.flatnonzero(~np.isclose(old, new, rtol=1e-9, atol=1e-14)):
                entry = (body, int(k)) if np.ndim(getattr(model, field)[body]) else (body,)
                numbers = float(old[k]), float(new[k])
                yield Change("body", model.body(body).name, _INERTIAL[field], int(k), field, entry, *numbers, *where)


def _kind(field: str) -> str:
    """The beginning of a field's name: "dof" of "dof_damping", "qpos" of "qpos0"."""
    return field.split("_")[0].rstrip("0")


def _check_files(files: Mapping[str, str], main: str, expected: mujoco.MjModel) -> None:
    """NotInPlace unless the files compile to the same numbers."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            (Path(folder) / name).parent.mkdir(exist_ok=True)
            (Path(folder) / name).write_text(text, encoding="utf-8")
        made = compiled(mujoco.MjSpec.from_file(str(Path(folder) / main)))
    for name in dir(expected):
        if not name.startswith(_COMPARED):
            continue
        one, two = np.asarray(getattr(made, name)), np.asarray(getattr(expected, name))
        if two.dtype.kind != "f" or not two.ndim:
            continue
        if one.shape != two.shape or not np.allclose(one, two, rtol=1e-5, atol=SLACK):
            raise NotInPlace(f"with its numbers changed the file makes another {name}")


def _text(fitted: _Fitted) -> str:
    _locate_assets(fitted.spec)
    return unwrapped(fitted.spec.to_xml())


def _settle(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[Any]:
    """Say in numbers, as the model has them, what the compiler would derive from fitted masses.

    Returns the actuators whose damping was a ratio and now is a number.
    """
    servos: list[Any] = []
    if max(spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.settotalmass) > 0:
        for body in spec.bodies[1:]:
            if model.body_mass[body.id] > 0:
                weigh(body, model, body.id)
    spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.settotalmass = 0.0, 0.0, -1.0
    for joint in spec.joints:
        if np.all(np.asarray(joint.springdamper) > 0):
            joint.springdamper = [0.0, 0.0]
            _set(joint, "stiffness", model.jnt_stiffness[joint.id : joint.id + 1])
            _set(joint, "damping", model.dof_damping[model.jnt_dofadr[joint.id] :][:1])
    for tendon in spec.tendons:
        if model.tendon_stiffness[tendon.id] > 0:  # else its length at qpos0, which a moved body changes
            tendon.springlength = model.tendon_lengthspring[tendon.id].tolist()
    for actuator in spec.actuators:
        if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE and actuator.biasprm[2] > 0:  # a servo's dampratio
            _set(actuator, "biasprm", model.actuator_biasprm[actuator.id])
            servos.append(actuator)
    return servos


def native(
    effect: Effect, space: Space, values: np.ndarray, model: mujoco.MjModel
) -> Mapping[tuple[str, int], float] | None:
    """What an effect adds to the numbers (field, row) of a model; None where it acts in the replay alone."""
    if effect.native is None:
        return None
    neutral = {p.name: p.mean for p in effect.parameters}  # of what the space does not hold
    return effect.native(neutral | dict(zip(space.names, np.asarray(values).tolist(), strict=True)), model)


def unwritten(scene: Scene, space: Space) -> tuple[str, ...]:
    """Names of the parameters that MJCF has no words for: what lives outside the model (offsets, laws of effects),
    fields without an attribute, and the shape of a mesh."""
    return tuple(p.name for p in space.parameters if not p.writes or not _has_words(scene, p))


def _has_words(scene: Scene, parameter: Parameter) -> bool:
    shaped = any(w.field in _SHAPE and scene.model.geom_type[w.index[0]] in _OF_FILES for w in parameter.writes)
    return all(w.field in WORDS for w in parameter.writes) and not shaped


def mjcf_attribute(field: str) -> tuple[str, str]:
    """Attribute of MuJoCo's spec and of MJCF that says a model field; empty where none does."""
    if field in _WEIGHT:
        return "", _INERTIAL[field]
    of_spec = _ATTRIBUTES.get(field, "")
    return of_spec, _SPELLED.get(of_spec, of_spec)


def field_unit(field: str, slides: bool) -> str:
    """Unit of a model field's numbers, of a joint that turns or slides; empty for one that has none, or no single."""
    unit = _UNITS.get(field, "")
    return unit if isinstance(unit, str) else unit[slides]


def is_angle(field: str) -> bool:
    """Whether MJCF has a field of hinges in degrees where its compiler says so."""
    return field in _ANGLES


def _elements(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, dict[int, Any]]:
    """For each beginning of a field's name, the elements by their row in the scene's model, which has no looks."""
    looks = {g.id for g in visual_geoms(spec)}
    geoms = sorted((g for g in spec.geoms if g.id not in looks), key=lambda g: g.id)
    return {
        "dof": {int(model.jnt_dofadr[j.id]): j for j in spec.joints},
        "jnt": {j.id: j for j in spec.joints},
        "qpos": {int(model.jnt_qposadr[j.id]): j for j in spec.joints},
        "body": {b.id: b for b in spec.bodies[1:]},
        "geom": dict(enumerate(geoms)),
        "pair": {p.id: p for p in spec.pairs},
        "actuator": {a.id: a for a in spec.actuators},
    }


def _write_changed(kind: str, element: Any, row: int, before: mujoco.MjModel, after: mujoco.MjModel) -> Sequence[str]:
    """Write into an element what differs between its rows in two models; returns these fields."""
    fields = [f for f in _ATTRIBUTES if f.startswith((f"{kind}_", f"{kind}0"))]
    changed = {f for f in fields if np.any(getattr(before, f)[row] != getattr(after, f)[row])}
    if kind == "geom" and before.geom_type[row] in _OF_FILES:  # compiled numbers hold the file's own frame
        changed -= _SHAPE
    differing = sorted(changed)
    for together in (_PLACE, _SHAPE):
        if changed & together:
            changed |= together
            _unplace(element)
    if kind == "actuator" and element.inheritrange:  # from its joint, whose range may be another now
        element.inheritrange = 0
        changed.add("actuator_ctrlrange")
    for field in changed:
        numbers = np.atleast_1d(getattr(after, field)[row])
        if field in _ANGLES and element.type != mujoco.mjtJoint.mjJNT_SLIDE and element.compiler.degree:
            numbers = np.degrees(numbers)
        _set(element, _ATTRIBUTES[field], numbers)
    return differing


def _unplace(element: Any) -> None:
    """Take a body or geom out of its frame, and forget every other way in which its place was said."""
    if element.frame is not None:
        element.set_frame(element.parent.add_frame())
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if hasattr(element, "fromto"):
        element.fromto = [np.nan] * 6


def _set(element: Any, attribute: str, numbers: np.ndarray) -> None:
    """Set an attribute's number, or its first ones (of a damping that is a polynomial in the speed, say)."""
    old = np.array(getattr(element, attribute), dtype=float)
    if old.ndim == 0:
        setattr(element, attribute, float(numbers[0]))
    else:
        old[: len(numbers)] = numbers
        setattr(element, attribute, old.tolist())


def _locate_assets(spec: mujoco.MjSpec) -> None:
    """Have the folders of meshes and textures be found from anywhere."""
    files = [a.file for kind in (spec.meshes, spec.textures, spec.hfields, spec.skins) for a in kind]
    if spec.modelfiledir and any(files):
        folder = Path(spec.modelfiledir)
        spec.meshdir = str((folder / spec.meshdir).resolve())
        spec.texturedir = str((folder / spec.texturedir).resolve())


def unwrapped(xml: str) -> str:
    """MJCF without nameless defaults inside the defaults, which attached files leave and MuJoCo does not read.

    Their classes move up; of classes that several files define alike, one stays.
    """
    root = ElementTree.fromstring(xml)
    for defaults in root.findall("default"):
        lifted = [c for e in defaults for c in (e if e.tag == "default" and not e.get("class") else [e])]
        alike = {ElementTree.canonicalize(ElementTree.tostring(c, "unicode"), strip_text=True): c for c in lifted}
        defaults[:] = alike.values()
    return ElementTree.tostring(root, encoding="unicode") + "\n"
