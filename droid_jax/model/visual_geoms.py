"""What a scene has only for the eye, and how to leave it out: the bodies weigh what they weighed with it."""

from __future__ import annotations

import warnings
from typing import Any

import mujoco
import numpy as np

LOOK_GROUP = 2


def visual_geoms(spec: mujoco.MjSpec) -> list[Any]:
    """The geoms for the eye: of LOOK_GROUP, nothing can touch them, and no pair, tendon or sensor names them."""
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
    """A copy without `visual_geoms`, whose bodies weigh what they weighed with them."""
    bare = spec.copy()
    looks = visual_geoms(bare)
    if looks:
        whole = compiled(bare)
        _weigh_emptied(bare, whole, {geom.id for geom in looks})
        for geom in looks:
            bare.delete(geom)
        keep_inertia(bare, whole)
    return bare


def _weigh_emptied(spec: mujoco.MjSpec, model: mujoco.MjModel, looks: set[int]) -> None:
    """Weigh the bodies that have their mass of looks alone: without them the spec would not compile."""
    emptied = [b.id for b in spec.bodies[1:] if b.geoms and all(g.id in looks for g in b.geoms)]
    chosen = np.zeros(model.nbody, dtype=bool)
    chosen[emptied] = model.body_mass[emptied] > 0
    _weigh_chosen(spec, model, chosen)


def _weigh_chosen(spec: mujoco.MjSpec, model: mujoco.MjModel, chosen: np.ndarray) -> None:
    """Weigh the chosen bodies [nbody]; where what a body says of itself counts for nothing, all, so that it counts."""
    if not chosen.any():
        return
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        chosen = model.body_mass > 0
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for body in spec.bodies[1:]:
        if chosen[body.id]:
            weigh(body, model, body.id)


def keep_inertia(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Have every body of a spec weigh what it weighs in `model` (of the same bodies), whatever its geoms would give."""
    now = compiled(spec)  # numbers the bodies, of which not all need a name
    fields = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
    same = np.all([_rows_close(getattr(now, f), getattr(model, f)) for f in fields], axis=0)
    _weigh_chosen(spec, model, ~same & (model.body_mass > 0))


def _rows_close(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] bool, rows equal to rounding."""
    close = np.isclose(a, b, rtol=1e-9, atol=1e-14)
    return np.all(np.reshape(close, (len(a), -1)), axis=1)


def weigh(body: Any, model: mujoco.MjModel, index: int) -> None:
    """Mass, centre and inertia of a body, its own and not its geoms'."""
    body.explicitinertial = True
    body.mass = float(model.body_mass[index])
    body.ipos, body.iquat = model.body_ipos[index].tolist(), model.body_iquat[index].tolist()
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT  # of several ways to say how the inertia is turned
    body.inertia, body.fullinertia = model.body_inertia[index].tolist(), [np.nan] * 6


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a spec, without MuJoCo's warning of attached files that share a default (see door_scene._attach)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return spec.compile()
