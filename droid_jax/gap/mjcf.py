"""An extended model as MJCF, as far as MJCF has words for it: `fitted_mjcf`, and what that does not know yet."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from typing import Any

import numpy as np

from droid_jax.identify.results import fitted_mjcf
from droid_jax.model.parameters import Space
from droid_jax.model.physics import make_c_model
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect

# model fields of effects that end up in the file
_WORDS = {"body_mass", "body_inertia", "body_gravcomp", "actuator_gainprm", "actuator_biasprm", "pair_solref"}


def mjcf(scene: Scene, space: Space, values: np.ndarray) -> str:
    """The scene with the values [D] of base parameters and effects written in, where MJCF has an attribute for them."""
    fitted = make_c_model(scene, space, values)
    spec = scene.spec.copy()
    for pair in spec.pairs:
        pair.solref = fitted.pair_solref[scene.id("pair", pair.name)].tolist()
    for body in spec.bodies[1:]:
        _keep_inertia(scene, fitted, body)
    with warnings.catch_warnings():  # of what `_unwrapped` repairs
        warnings.simplefilter("ignore", UserWarning)
        return _unwrapped(fitted_mjcf(replace(scene, spec=spec), space, values))


def in_mjcf(effect: Effect, free: Space) -> bool:
    """Whether an effect is nothing but numbers of the model that `mjcf` writes; free: its parameters in use."""
    laws = (effect.command, effect.servo, effect.force, effect.frictionloss, effect.observe)
    fields = [{w.field for w in p.writes} for p in free.parameters]
    return not any(laws) and all(written and written <= _WORDS for written in fields)


def _keep_inertia(scene: Scene, fitted: Any, body: Any) -> None:
    """Undo beforehand that `fitted_mjcf` scales inertia with mass, where the fit changed the mass alone (a payload)."""
    index = scene.id("body", body.name)
    if scene.model.body_mass[index] <= 0:
        return
    scale = fitted.body_mass[index] / scene.model.body_mass[index]
    inertia = fitted.body_inertia[index] / scale
    if np.allclose(inertia, scene.model.body_inertia[index], rtol=1e-9):
        return
    body.explicitinertial = True
    body.mass = float(scene.model.body_mass[index])
    body.ipos, body.iquat = scene.model.body_ipos[index].tolist(), scene.model.body_iquat[index].tolist()
    body.inertia, body.fullinertia = inertia.tolist(), [np.nan] * 6


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
