"""Write a fitted scene as MJCF."""

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
from droid_jax.model.visual_geoms import compiled, keep_inertia, state_inertia, visual_geoms

# Model field -> attribute of MuJoCo's spec that sets a row of it, or its first numbers.
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
# Attribute of MuJoCo's spec -> its name in MJCF, where they differ.
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
SLACK = 2e-6  # absolute difference that TINY_FRICTIONLOSS may cause
_WEIGHT = {"body_mass", "body_inertia", "body_ipos", "body_iquat"}  # written as the body's <inertial>
_FOLLOWING = {"geom_rbound", "geom_aabb"}  # derived by the compiler
_UNITS = {  # of fields; of hinge and slide, if they differ
    "dof_damping": ("N m s/rad", "N s/m"), "dof_frictionloss": ("N m", "N"), "dof_armature": ("kg m^2", "kg"),
    "jnt_stiffness": ("N m/rad", "N/m"), "qpos_spring": ("rad", "m"), "qpos0": ("rad", "m"), "jnt_range": ("rad", "m"),
    "jnt_margin": ("rad", "m"), "jnt_actfrcrange": ("N m", "N"), "body_mass": "kg", "body_inertia": "kg m^2",
    "body_pos": "m", "body_ipos": "m", "geom_pos": "m", "geom_size": "m", "geom_margin": "m", "geom_gap": "m",
    "jnt_pos": "m", "pair_margin": "m", "pair_gap": "m",
}  # fmt: skip
WORDS = frozenset({*_ATTRIBUTES, *_WEIGHT, *_FOLLOWING, PSEUDO_INERTIA})  # model fields that MJCF can express
_ANGLES = {"jnt_range", "qpos_spring", "qpos0"}  # written in the compiler's unit
_PLACE = {"body_pos", "body_quat"}  # written together
# Fields that are compared with the model after compilation, since the compiler may derive other numbers.
_SURE = (
    *("body_mass", "body_inertia", "jnt_stiffness", "dof_damping", "dof_frictionloss", "dof_armature"),
    *("actuator_gainprm", "actuator_biasprm"),
)
_SHAPE = {"geom_pos", "geom_quat", "geom_size"}
_OF_FILES = (int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD))  # geoms with a shape from a file


def fitted_mjcf(scene: Scene, space: Space, values: np.ndarray, effects: Sequence[Effect] = ()) -> str:
    """The scene as one MJCF text with fitted values; `unwritten` lists parameters that MJCF cannot express.

    MuJoCo writes the text from its spec; `fitted_files` keeps the user's file. Paths of meshes and textures are
    absolute, so that the text can be saved anywhere.

    Args:
        scene: of the fit.
        space: meaning of the values.
        values: [D] physical values.
        effects: in the model; those that MuJoCo's numbers can express are written too (`Effect.native`).

    Returns:
        The text of the MJCF.

    Raises:
        ValueError: values have another shape, or MuJoCo cannot compile them. A replay accepts an inertia that no body
            can have (such as a moment fitted about one axis), the compiler does not.
    """
    return _text(_fitted(scene, space, values, effects))


@dataclass(frozen=True, eq=False)
class FittedFiles:
    """A fitted scene as MJCF files.

    Attributes:
        files: name -> text, all for one folder; the first is the main file.
        changes: the numbers that differ from the scene's.
        in_place: whether these are the user's files, in which only these numbers and paths (absolute) are changed.
        patch: if in place, the same changes to the user's files as a unified diff, relative to the main file.
        reason: why it is not in place; else empty.
    """

    files: dict[str, str]
    changes: tuple[Change, ...]
    in_place: bool
    patch: str = ""
    reason: str = ""


def fitted_files(
    scene: Scene, space: Space, values: np.ndarray, effects: Sequence[Effect] = (), main: str = "fitted.xml"
) -> FittedFiles:
    """The user's MJCF with its numbers replaced by fitted values; layout, includes and comments are unchanged.

    If replacing numbers does not give the fitted model (see `mjcf_in_place`), or the scene has no file, it is the text
    of `fitted_mjcf`.  Arguments and errors are those of `fitted_mjcf`.

    main: name of the main file.
    """
    fitted = _fitted(scene, space, values, effects)
    try:
        if scene.path is None:
            raise NotInPlace("the scene was put together in memory")
        edited = edit(scene.path, fitted.before, fitted.wanted, fitted.new_inertia, main)
        _check_files(edited.files, main, fitted.written)
    except (ValueError, OSError) as error:
        reason = " ".join(str(error).split())
        return FittedFiles({main: _text(fitted)}, tuple(_changes(fitted, None)), False, reason=reason)
    return FittedFiles(edited.files, tuple(_changes(fitted, edited)), True, edited.patch)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A scene with fitted values in all its forms.

    Attributes:
        scene: of the fit.
        spec: with the fitted values.
        before: the scene's spec, compiled so that its elements are numbered.
        written: the model compiled from `spec`.
        model: the scene's model with the values.
        wanted: numbers that differ.
        new_inertia: body with another inertia -> `model`.
    """

    scene: Scene
    spec: mujoco.MjSpec
    before: mujoco.MjSpec
    written: mujoco.MjModel
    model: mujoco.MjModel
    wanted: tuple[WantedNumber, ...]
    new_inertia: dict[int, mujoco.MjModel]


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
    compiled(spec)  # numbers its elements
    compiled(before)
    changed: list[tuple[str, Any, int, str]] = []
    by_kind = _elements(spec, model)
    for kind, elements in by_kind.items():
        for row, element in elements.items():
            changed += [(kind, element, row, f) for f in _write_changed(kind, element, row, scene.model, model)]
    changed += [("actuator", a, a.id, "actuator_biasprm") for a in _state_derived(spec, model)]
    changed += [("dof", e, row, "dof_solimp") for row, e in by_kind["dof"].items() if e.name in scene.held]
    for joint in before.joints:  # the user's file has the soft default
        if joint.name in scene.held:
            joint.solimp_friction = list(SOFT_IMPEDANCE)
    keep_inertia(spec, model)
    try:
        written = compiled(spec)
    except ValueError as error:
        raise ValueError(f"the fitted values make no MJCF: {' '.join(str(error).split())}") from None
    other = [f for f in _SURE if not np.allclose(getattr(written, f), getattr(model, f), rtol=1e-3, atol=1e-5)]
    if other:
        raise ValueError(f"the fitted values make no MJCF: MuJoCo derives another {', '.join(other)} from it")
    old = _elements(before, model)
    wanted = tuple(_wanted(scene.model, model, kind, old[kind][row], e, row, f) for kind, e, row, f in changed)
    differs = np.any([_differ(getattr(scene.model, f), getattr(model, f)) for f in sorted(_WEIGHT)], axis=0)
    new_inertia = {int(b): model for b in np.flatnonzero(differs & (model.body_mass > 0))}
    unique = {(w.element, w.row, w.field): w for w in wanted}
    return _Fitted(scene, spec, before, written, model, tuple(unique.values()), new_inertia)


def _differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] bool, rows that differ by more than rounding."""
    return ~np.all(np.reshape(np.isclose(a, b, rtol=1e-9, atol=1e-14), (len(a), -1)), axis=1)


def _wanted(
    before: mujoco.MjModel, after: mujoco.MjModel, kind: str, old: Any, new: Any, row: int, field: str
) -> WantedNumber:
    attribute = _ATTRIBUTES[field]
    if field in _SHAPE | _PLACE:  # a spec may state them by other attributes
        numbers = getattr(before, field)[row], getattr(after, field)[row]
    else:
        numbers = getattr(old, attribute), getattr(new, attribute)
    pair = np.atleast_1d(np.array(numbers[0], float)), np.atleast_1d(np.array(numbers[1], float))
    element = "joint" if kind in ("dof", "jnt", "qpos") else kind
    return WantedNumber(element, new.id, _SPELLED.get(attribute, attribute), *pair, field)


def _changes(fitted: _Fitted, edited: Edited | None) -> Iterator[Change]:
    """Yield the numbers that differ, by element and entry; edited: the user's files with them, if there are any."""
    model, nominal = fitted.model, fitted.scene.model
    by_kind = {kind: rows.items() for kind, rows in _elements(fitted.before, model).items()}
    for i, want in enumerate(fitted.wanted):
        placed = PlacedNumber(want.attribute) if edited is None else edited.placed[i]
        row, named = next((r, e.name) for r, e in by_kind[_kind(want.field)] if e.id == want.row)
        width = np.asarray(getattr(model, want.field)).shape[1:]
        short = placed.attribute in ("kp", "kv")  # one number that sets several of the model's
        differing = np.flatnonzero(want.before != want.after) if placed.attribute else ()
        for k in [k for k in differing if not short or (want.field, k) in (_GAIN, _DAMPING)]:
            entry, before = ((row, int(k)) if width else (row,)), want.before[k]
            if want.element == "actuator":  # a spec may have a ratio from which the number is compiled
                before = getattr(nominal, want.field)[entry]
            sign = -1.0 if short and want.field == _DAMPING[0] else 1.0
            numbers = sign * float(before), sign * float(want.after[k])
            if numbers[0] == numbers[1]:
                continue
            where = placed.file, placed.line, placed.origin
            index = 0 if short else int(k)
            yield Change(want.element, named, placed.attribute, index, want.field, entry, *numbers, *where)
    for body in fitted.new_inertia:
        where = ("", 0) if edited is None else edited.bodies[body]
        for field in sorted(_WEIGHT):
            old, new = (np.atleast_1d(getattr(m, field)[body]) for m in (nominal, model))
            for k in np.flatnonzero(~np.isclose(old, new, rtol=1e-9, atol=1e-14)):
                entry = (body, int(k)) if np.ndim(getattr(model, field)[body]) else (body,)
                numbers = float(old[k]), float(new[k])
                yield Change("body", model.body(body).name, _INERTIAL[field], int(k), field, entry, *numbers, *where)


def _kind(field: str) -> str:
    """The prefix of a field's name: "dof" of "dof_damping", "qpos" of "qpos0"."""
    return field.split("_")[0].rstrip("0")


def _check_files(files: Mapping[str, str], main: str, expected: mujoco.MjModel) -> None:
    """Raise NotInPlace unless the files compile to the same numbers."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            (Path(folder) / name).parent.mkdir(exist_ok=True)
            (Path(folder) / name).write_text(text, encoding="utf-8")
        model = compiled(mujoco.MjSpec.from_file(str(Path(folder) / main)))
    for name in dir(expected):
        if not name.startswith(_COMPARED):
            continue
        got, wanted = np.asarray(getattr(model, name)), np.asarray(getattr(expected, name))
        if wanted.dtype.kind != "f" or not wanted.ndim:
            continue
        if got.shape != wanted.shape or not np.allclose(got, wanted, rtol=1e-5, atol=SLACK):
            raise NotInPlace(f"with its numbers changed the file makes another {name}")


def _text(fitted: _Fitted) -> str:
    _locate_assets(fitted.spec)
    return unwrapped(fitted.spec.to_xml())


def _state_derived(spec: mujoco.MjSpec, model: mujoco.MjModel) -> list[Any]:
    """State the model's numbers in a spec that would derive others from the fitted masses.

    Returns the actuators whose damping was a ratio and now is a number.
    """
    servos: list[Any] = []
    if max(spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.settotalmass) > 0:
        for body in spec.bodies[1:]:
            if model.body_mass[body.id] > 0:
                state_inertia(body, model, body.id)
    spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.settotalmass = 0.0, 0.0, -1.0
    for joint in spec.joints:
        if np.all(np.asarray(joint.springdamper) > 0):
            joint.springdamper = [0.0, 0.0]
            _set(joint, "stiffness", model.jnt_stiffness[joint.id : joint.id + 1])
            _set(joint, "damping", model.dof_damping[model.jnt_dofadr[joint.id] :][:1])
    for tendon in spec.tendons:
        if model.tendon_stiffness[tendon.id] > 0:  # by default the length at qpos0, which a moved body changes
            tendon.springlength = model.tendon_lengthspring[tendon.id].tolist()
    for actuator in spec.actuators:
        if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE and actuator.biasprm[2] > 0:  # a servo's dampratio
            _set(actuator, "biasprm", model.actuator_biasprm[actuator.id])
            servos.append(actuator)
    return servos


def native(
    effect: Effect, space: Space, values: np.ndarray, model: mujoco.MjModel
) -> Mapping[tuple[str, int], float] | None:
    """Increments of an effect to the numbers (field, row) of a model; None if only a replay can express it."""
    if effect.native is None:
        return None
    neutral = {p.name: p.mean for p in effect.parameters}  # for parameters that the space lacks
    return effect.native(neutral | dict(zip(space.names, np.asarray(values).tolist(), strict=True)), model)


def unwritten(scene: Scene, space: Space) -> tuple[str, ...]:
    """Names of the parameters that MJCF cannot express.

    These are parameters outside the model (offsets, laws of effects), fields without an attribute, and mesh shapes.
    """
    return tuple(p.name for p in space.parameters if not p.writes or not _expressible(scene, p))


def _expressible(scene: Scene, parameter: Parameter) -> bool:
    shaped = any(w.field in _SHAPE and scene.model.geom_type[w.index[0]] in _OF_FILES for w in parameter.writes)
    return all(w.field in WORDS for w in parameter.writes) and not shaped


def mjcf_attribute(field: str) -> tuple[str, str]:
    """Attributes of MuJoCo's spec and of MJCF that set a model field; empty if there is none."""
    if field in _WEIGHT:
        return "", _INERTIAL[field]
    of_spec = _ATTRIBUTES.get(field, "")
    return of_spec, _SPELLED.get(of_spec, of_spec)


def field_unit(field: str, slides: bool) -> str:
    """Unit of a model field's numbers, for a slide or a hinge; empty if there is none, or more than one."""
    unit = _UNITS.get(field, "")
    return unit if isinstance(unit, str) else unit[slides]


def is_angle(field: str) -> bool:
    """Whether MJCF states the field in the angle unit of its compiler for hinges."""
    return field in _ANGLES


def _elements(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, dict[int, Any]]:
    """Prefix of a field's name -> row in the scene's model (without visual geoms) -> element of the spec."""
    visual = {g.id for g in visual_geoms(spec)}
    geoms = sorted((g for g in spec.geoms if g.id not in visual), key=lambda g: g.id)
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
    """Write the numbers of an element that differ between two models; returns their fields."""
    fields = [f for f in _ATTRIBUTES if f.startswith((f"{kind}_", f"{kind}0"))]
    changed = {f for f in fields if np.any(getattr(before, f)[row] != getattr(after, f)[row])}
    if kind == "geom" and before.geom_type[row] in _OF_FILES:  # compiled numbers contain the file's frame
        changed -= _SHAPE
    differing = sorted(changed)
    for together in (_PLACE, _SHAPE):
        if changed & together:
            changed |= together
            _unplace(element)
    if kind == "actuator" and element.inheritrange:  # from its joint, whose range may have changed
        element.inheritrange = 0
        changed.add("actuator_ctrlrange")
    for field in changed:
        numbers = np.atleast_1d(getattr(after, field)[row])
        if field in _ANGLES and element.type != mujoco.mjtJoint.mjJNT_SLIDE and element.compiler.degree:
            numbers = np.degrees(numbers)
        _set(element, _ATTRIBUTES[field], numbers)
    return differing


def _unplace(element: Any) -> None:
    """Remove a body or geom from its frame, and remove all attributes of its pose other than pos and quat."""
    if element.frame is not None:
        element.set_frame(element.parent.add_frame())
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    if hasattr(element, "fromto"):
        element.fromto = [np.nan] * 6


def _set(element: Any, attribute: str, numbers: np.ndarray) -> None:
    """Set an attribute's number, or its first numbers (such as a damping's, whose others are a polynomial)."""
    old = np.array(getattr(element, attribute), dtype=float)
    if old.ndim == 0:
        setattr(element, attribute, float(numbers[0]))
    else:
        old[: len(numbers)] = numbers
        setattr(element, attribute, old.tolist())


def _locate_assets(spec: mujoco.MjSpec) -> None:
    """Make the folders of meshes and textures absolute."""
    files = [a.file for kind in (spec.meshes, spec.textures, spec.hfields, spec.skins) for a in kind]
    if spec.modelfiledir and any(files):
        folder = Path(spec.modelfiledir)
        spec.meshdir = str((folder / spec.meshdir).resolve())
        spec.texturedir = str((folder / spec.texturedir).resolve())


def unwrapped(xml: str) -> str:
    """MJCF without unnamed defaults inside the defaults, which attached files cause and MuJoCo does not read.

    Their classes move up by one level.  Equal classes of several files become one.
    """
    root = ElementTree.fromstring(xml)
    for defaults in root.findall("default"):
        lifted = [c for e in defaults for c in (e if e.tag == "default" and not e.get("class") else [e])]
        unique = {ElementTree.canonicalize(ElementTree.tostring(c, "unicode"), strip_text=True): c for c in lifted}
        defaults[:] = unique.values()
    return ElementTree.tostring(root, encoding="unicode") + "\n"
