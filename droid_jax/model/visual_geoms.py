"""Visual geoms of a scene, and their removal without a change of the bodies' inertias."""

from __future__ import annotations

import warnings
from typing import Any

import mujoco
import numpy as np

LOOK_GROUP = 2  # MuJoCo's group of visual geoms


def visual_geoms(spec: mujoco.MjSpec) -> list[Any]:
    """The geoms of LOOK_GROUP that cannot collide and that no pair, tendon or sensor names."""
    used = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    used |= {w.target.name for t in spec.tendons for w in t.path if isinstance(w.target, mujoco.MjsGeom)}
    for s in spec.sensors:
        ends = ((s.objtype, s.objname), (s.reftype, s.refname))
        used |= {name for kind, name in ends if kind == mujoco.mjtObj.mjOBJ_GEOM}
    return [
        g
        for g in spec.geoms
        if g.group == LOOK_GROUP and not g.contype and not g.conaffinity and (not g.name or g.name not in used)
    ]


def without_visual_geoms(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """A copy of a spec without `visual_geoms`, with unchanged inertias of its bodies."""
    bare = spec.copy()
    visual = visual_geoms(bare)
    if visual:
        complete = compiled(bare)
        _state_emptied(bare, complete, {geom.id for geom in visual})
        for geom in visual:
            bare.delete(geom)
        keep_inertia(bare, complete)
    return bare


def _state_emptied(spec: mujoco.MjSpec, model: mujoco.MjModel, visual: set[int]) -> None:
    """State the inertias of bodies whose mass comes from visual geoms only; else the spec would not compile."""
    emptied = [b.id for b in spec.bodies[1:] if b.geoms and all(g.id in visual for g in b.geoms)]
    chosen = np.zeros(model.nbody, dtype=bool)
    chosen[emptied] = model.body_mass[emptied] > 0
    _state_chosen(spec, model, chosen)


def _state_chosen(spec: mujoco.MjSpec, model: mujoco.MjModel, chosen: np.ndarray) -> None:
    """State the inertias of the chosen bodies [nbody]; of all if the compiler ignores stated ones (inertiafromgeom)."""
    if not chosen.any():
        return
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        chosen = model.body_mass > 0
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for body in spec.bodies[1:]:
        if chosen[body.id]:
            state_inertia(body, model, body.id)


def keep_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """State inertias in a spec so that all its bodies have those of `model`, a model of the same bodies."""
    now = compiled(spec)  # also numbers the bodies
    fields = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
    same = np.all([_rows_close(getattr(now, f), getattr(model, f)) for f in fields], axis=0)
    _state_chosen(spec, model, ~same & (model.body_mass > 0))


def _rows_close(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] bool, rows that are equal up to rounding."""
    close = np.isclose(a, b, rtol=1e-9, atol=1e-14)
    return np.all(np.reshape(close, (len(a), -1)), axis=1)


def state_inertia(body: Any, model: mujoco.MjModel, index: int) -> None:
    """State mass, centre of mass and inertia of a body of a spec, in place of those of its geoms."""
    body.explicitinertial = True
    body.mass = float(model.body_mass[index])
    body.ipos, body.iquat = model.body_ipos[index].tolist(), model.body_iquat[index].tolist()
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT  # no other attribute states the orientation
    body.inertia, body.fullinertia = model.body_inertia[index].tolist(), [np.nan] * 6


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The compiled model of a spec, without MuJoCo's warning about attached files that share a default class."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return spec.compile()
