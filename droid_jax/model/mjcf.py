"""A fitted scene as MJCF: the numbers of its model written into the spec, in a file that MuJoCo reads."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from typing import Any

import mujoco
import numpy as np

from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene

# Model fields that have an attribute, and are written.
WORDS = frozenset({
    "dof_damping", "dof_frictionloss", "jnt_stiffness", "body_pos", "body_quat", "body_mass", "body_inertia",
    "body_gravcomp", "pair_friction", "pair_solref", "actuator_gainprm", "actuator_biasprm", "geom_size",
})  # fmt: skip


def fitted_mjcf(scene: Scene, space: Space, values: np.ndarray) -> str:
    """The scene with the values [D] of `space` written in, as far as MJCF has attributes for them (`WORDS`).

    What lives outside the model (offsets, laws of effects) is not in it.
    """
    spec, model = scene.spec.copy(), make_c_model(scene, space, values)
    spec.compile()  # numbers its elements, of which not all need a name
    fields = {w.field for p in space.parameters for w in p.writes}
    for joint in spec.joints:
        dof, index = model.jnt_dofadr[joint.id], joint.id
        if "dof_damping" in fields:
            joint.damping = [float(model.dof_damping[dof]), 0, 0]
        if "jnt_stiffness" in fields:
            joint.stiffness = [float(model.jnt_stiffness[index]), 0, 0]
        if "dof_frictionloss" in fields:
            joint.frictionloss = float(model.dof_frictionloss[dof])
    heavier = not (
        np.allclose(model.body_mass, scene.model.body_mass, rtol=1e-12)
        and np.allclose(model.body_inertia, scene.model.body_inertia, rtol=1e-12)
    )
    for body in spec.bodies[1:]:
        index = body.id
        if {"body_pos", "body_quat"} & fields:
            body.pos, body.quat = model.body_pos[index].tolist(), model.body_quat[index].tolist()
        if "body_gravcomp" in fields:
            body.gravcomp = float(model.body_gravcomp[index])
        if heavier and model.body_mass[index] > 0:
            _weigh(body, model, index)
    if heavier:  # every body says what it weighs, so none is left to its geoms
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for pair in spec.pairs:
        index = pair.id
        if "pair_friction" in fields:
            pair.friction = model.pair_friction[index].tolist()
        if "pair_solref" in fields:
            pair.solref = model.pair_solref[index].tolist()
    for index, actuator in enumerate(spec.actuators):
        if {"actuator_gainprm", "actuator_biasprm"} & fields:
            actuator.gainprm = model.actuator_gainprm[index].tolist()
            actuator.biasprm = model.actuator_biasprm[index].tolist()
    for geom in spec.geoms:
        index = mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_GEOM, geom.name) if geom.name else -1
        if "geom_size" in fields and index >= 0:
            geom.size[0] += model.geom_size[index, 0] - scene.model.geom_size[index, 0]
    with warnings.catch_warnings():  # of what `_unwrapped` repairs
        warnings.simplefilter("ignore", UserWarning)
        spec.compile()
        return _unwrapped(spec.to_xml())


def _weigh(body: Any, model: Any, index: int) -> None:
    """Mass, centre and inertia of a body, its own and not its geoms'."""
    body.explicitinertial = True
    body.mass = float(model.body_mass[index])
    body.ipos, body.iquat = model.body_ipos[index].tolist(), model.body_iquat[index].tolist()
    body.inertia, body.fullinertia = model.body_inertia[index].tolist(), [np.nan] * 6


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
