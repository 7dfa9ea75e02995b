"""Scale the library's effects, whose sizes are those of a light arm, to another machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect
from droid_jax.model.parameters import Parameter
from droid_jax.model.scene import Scene

TORQUE = "N m"
LENGTHS = (("(N m)", "N"), (TORQUE, "N"), ("rad", "m"), ("turn", "(2 pi m)"))  # units at hinges -> at slides

PANDA = 54.0  # N m, the largest of a Panda's `usual_torques`
FINEST = 2  # steps of a scale in a decade
FRICTION_SHARE = 10.0  # of torques, of a small machine in that of a Panda
POSES = 20  # in which a joint's weight is computed
AT_MOST = 1.0  # rad (m) from the model's own pose, in these poses
USUAL_ACCELERATION = 5.0  # rad/s^2 (m/s^2), of motions that are recorded


def usual_torques(scene: Scene, joints: Sequence[str]) -> np.ndarray:
    """[J] N m (N) that usual motions of these joints take, without friction: weight and inertia."""
    model, rng, dofs = scene.model, np.random.default_rng(0), [scene.dof(j) for j in joints]
    data, inertia, most = mujoco.MjData(model), np.empty((model.nv, model.nv)), np.zeros(len(dofs))
    for _ in range(POSES):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.uniform(-AT_MOST, AT_MOST, model.nv), 1.0)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        most = np.maximum(most, (np.abs(data.qfrc_bias) + USUAL_ACCELERATION * np.diagonal(inertia))[dofs])
    return most


def scale_of(largest: float) -> float:
    """The scale of the library for a machine whose largest torque this is, N m (N): 1 for one like a Panda.

    In half decades (0.1, 0.3, 1, 3), rounded towards 1, so that it does not depend on details of a model or a log.
    Friction of a small machine is a larger share of its torques (a hobby servo's up to a half of what it lifts): the
    scale falls from a tenth of a Panda's torque on.
    """
    if largest <= 0.0:
        return 1.0
    ratio = largest / PANDA
    steps = int(FINEST * np.log10(ratio if ratio > 1.0 else min(FRICTION_SHARE * ratio, 1.0)))
    return float(f"{10.0 ** (steps / FINEST):.1g}")


def sized(effect: Effect, scene: Scene, scale: float) -> Effect:
    """An effect with the torques' priors, bounds and minimum effect size multiplied by `scale`.

    Coefficients that are no torques (masses, gains, delays) are unchanged.  At slides units are N and m in place of N m
    and rad; those of shape parameters if all locations of the effect are slides.
    """
    location_of = {name: location for location, names in effect.locations.items() for name in names}
    slides = {name: _is_slide(scene, location) for name, location in location_of.items()}
    shapes = bool(slides) and all(slides.values())
    torques = {p.name for p in effect.parameters if p.name in location_of and p.unit.startswith(TORQUE)}
    parameters = (_sized(p, scale if p.name in torques else 1.0, slides.get(p.name, shapes)) for p in effect.parameters)
    return replace(effect, parameters=tuple(parameters), minimum_size=effect.minimum_size * (scale if torques else 1.0))


def _sized(p: Parameter, scale: float, slide: bool) -> Parameter:
    unit = p.unit
    for old, new in LENGTHS if slide else ():
        unit = unit.replace(old, new)
    return replace(p, unit=unit, std=scale * p.std, low=scale * p.low, high=scale * p.high)


def _is_slide(scene: Scene, location: str) -> bool:
    """Whether a location is a slide; it may also be a hinge, "commands", "grip" or a body."""
    return location in scene.joints and scene.slides(location)
