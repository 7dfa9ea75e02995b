"""A fitted scene as MJCF: the numbers of its model written into the spec, in a file that MuJoCo reads."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from droid_jax.arguments import instance, instances, numeric, shown
from droid_jax.model.effect_interface import Effect
from droid_jax.model.fields import check_space
from droid_jax.model.parameters import Parameter, Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene
from droid_jax.model.visual_geoms import compiled, keep_inertia, look_geoms, weigh

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
_WEIGHT = {"body_mass", "body_inertia", "body_ipos", "body_iquat"}  # written as the body's own <inertial>
_FOLLOWING = {"geom_rbound", "geom_aabb"}  # the compiler works them out
WORDS = frozenset({*_ATTRIBUTES, *_WEIGHT, *_FOLLOWING})  # model fields that MJCF can say
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
    """The scene as MJCF text with fitted values written in; `unwritten` says which have no place in it.

    Files of meshes and textures are named by their absolute paths, wherever the text is saved.

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
    check_space(instance(scene, "scene", Scene), instance(space, "space", Space))
    values, effects = numeric(values, "values"), instances(effects, "effects", Effect)
    if not np.isfinite(values).all():
        raise ValueError(f"values must be finite, got {shown(values)}")
    if np.shape(values) != (len(space),):
        raise ValueError(f"expected values [{len(space)}], one for each of {space.names}, got {list(np.shape(values))}")
    spec, model = scene.spec.copy(), make_c_model(scene, space, values)
    for effect in effects:
        for (field, row), more in (native(effect, space, values, model) or {}).items():
            getattr(model, field)[row] += more
    compiled(spec)  # numbers its elements, of which not all need a name
    for kind, elements in _elements(spec, model).items():
        for row, element in elements.items():
            _write_changed(kind, element, row, scene.model, model)
    _settle(spec, model)
    keep_inertia(spec, model)
    _locate_assets(spec)
    try:
        written = compiled(spec)
    except ValueError as error:
        raise ValueError(f"the fitted values make no MJCF: {' '.join(str(error).split())}") from None
    other = [f for f in _SURE if not np.allclose(getattr(written, f), getattr(model, f), rtol=1e-3, atol=1e-5)]
    if other:
        raise ValueError(f"the fitted values make no MJCF: MuJoCo works out another {', '.join(other)} from it")
    return _unwrapped(spec.to_xml())


def _settle(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Say in numbers, as the model has them, what the compiler would work out anew from fitted masses."""
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


def _elements(spec: mujoco.MjSpec, model: mujoco.MjModel) -> dict[str, dict[int, Any]]:
    """For each beginning of a field's name, the elements by their row in the scene's model, which has no looks."""
    looks = {g.id for g in look_geoms(spec)}
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


def _write_changed(kind: str, element: Any, row: int, before: mujoco.MjModel, after: mujoco.MjModel) -> None:
    """Write into an element what differs between its rows in two models."""
    fields = [f for f in _ATTRIBUTES if f.startswith((f"{kind}_", f"{kind}0"))]
    changed = {f for f in fields if np.any(getattr(before, f)[row] != getattr(after, f)[row])}
    if kind == "geom" and before.geom_type[row] in _OF_FILES:  # compiled numbers hold the file's own frame
        changed -= _SHAPE
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


def _unwrapped(xml: str) -> str:
    """MJCF without nameless defaults inside the defaults, which attached files leave and MuJoCo does not read.

    Their classes move up; of classes that several files define alike, one stays.
    """
    root = ElementTree.fromstring(xml)
    for defaults in root.findall("default"):
        lifted = [c for e in defaults for c in (e if e.tag == "default" and not e.get("class") else [e])]
        alike = {ElementTree.canonicalize(ElementTree.tostring(c, "unicode"), strip_text=True): c for c in lifted}
        defaults[:] = alike.values()
    return ElementTree.tostring(root, encoding="unicode") + "\n"
