"""Servo gains that a recording states, in place of the scene's: logs of several set-ups share one scene.

A replay takes them as factors on the actuators' gains, arrays of its program and no constants of it: recordings that
differ in their gains alone compile nothing again, and a parameter that scales a gain acts on the stated one.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Recording

if TYPE_CHECKING:
    from droid_jax.simulate.replay import Drive

ALIKE = 1e-3  # relative: gains that are closer are the same number, rounded
_VELOCITY = 2  # column of the velocity gain


def check_gains(scene: Scene, drive: Drive) -> None:
    """Raise ValueError where a recording states another gain for an actuator that is no position servo."""
    if drive.stiffness is None:
        return
    rows = zip(scene.command_names, drive.stiffness, own_stiffness(scene), position_servos(scene.model), strict=True)
    for name, stated, has, servo in rows:
        if not servo and not np.isclose(stated, has, rtol=ALIKE):
            raise ValueError(
                f"the recording states a servo gain of {stated:g} for {name}, the scene has {has:g} and its actuator "
                "is no position servo; make it a <position> servo in the MJCF"
            )


def position_servos(model: mujoco.MjModel) -> np.ndarray:
    """[U] bool, actuators whose force is gain * (control - length), with or without a velocity gain."""
    gain = model.actuator_gainprm[:, 0]
    return (gain != 0) & (model.actuator_biasprm[:, 1] == -gain)


def own_stiffness(scene: Scene) -> np.ndarray:
    """[U] N m/rad or N/m, the scene's gains at the joint."""
    return scene.model.actuator_gainprm[:, 0] * scene.model.actuator_gear[:, 0] ** 2


def own_damping(scene: Scene) -> np.ndarray:
    """[U] N m s/rad or N s/m, the scene's velocity gains at the joint; 0 for a servo without one."""
    return -scene.model.actuator_biasprm[:, _VELOCITY] * scene.model.actuator_gear[:, 0] ** 2


def servo_factors(scene: Scene, drive: Drive) -> np.ndarray:
    """[U, 2] what the position and the velocity gain of each actuator are multiplied with in a drive's replay.

    A velocity gain that the scene's servo does not have stays absent: its damping is the joint's.
    """
    return _factors(scene, drive.stiffness, drive.damping)


def _factors(scene: Scene, stiffness: np.ndarray | None, damping: np.ndarray | None) -> np.ndarray:
    """[U, 2] the same of stated gains [U], None where none are stated."""
    servos = position_servos(scene.model)
    pairs = ((stiffness, own_stiffness(scene)), (damping, own_damping(scene)))
    return np.stack([_ratio(stated, own, servos) for stated, own in pairs], axis=1)


def _ratio(stated: np.ndarray | None, own: np.ndarray, servos: np.ndarray) -> np.ndarray:
    """[U] stated over own gain; 1 where they are alike, nothing is stated, or there is nothing to be scaled."""
    if stated is None:
        return np.ones(len(own))
    scaled = servos & (own > 0) & ~np.isclose(stated, own, rtol=ALIKE)
    return np.where(scaled, stated / np.where(scaled, own, 1.0), 1.0)


def with_gains(model: Any, factors: Any) -> Any:
    """An mjx.Model with the gains of its actuators times factors [U, 2]."""
    gain, bias = jnp.asarray(model.actuator_gainprm), jnp.asarray(model.actuator_biasprm)
    return model.replace(
        actuator_gainprm=gain.at[:, 0].multiply(factors[:, 0]),
        actuator_biasprm=bias.at[:, 1 : _VELOCITY + 1].multiply(factors),
    )


def scale_gains(model: mujoco.MjModel, factors: np.ndarray) -> mujoco.MjModel:
    """The same of a model of the C engine, which is changed, and returned."""
    model.actuator_gainprm[:, 0] *= factors[:, 0]
    model.actuator_biasprm[:, 1 : _VELOCITY + 1] *= factors
    return model


def stated_gains(scene: Scene, recording: Recording) -> tuple[np.ndarray, np.ndarray] | None:
    """[U] stiffness and [U] damping of a recording's servos, the scene's where it states none; None: it has no gains.

    Raises ValueError where the recording lacks a command that the scene needs.
    """
    if recording.gains is None:
        return None
    columns = scene.command_index(recording.command_names)
    sent = np.flatnonzero(columns >= 0)
    stiffness, damping = own_stiffness(scene), own_damping(scene)
    stiffness[sent] = np.asarray(recording.gains.stiffness, dtype=float)[columns[sent]]
    if recording.gains.damping is not None:
        damping[sent] = np.asarray(recording.gains.damping, dtype=float)[columns[sent]]
    return stiffness, damping


def with_stated_gains(scene: Scene, recording: Recording, model: mujoco.MjModel | None = None) -> mujoco.MjModel:
    """The scene's model with the gains of a recording's replay: those that it states, else the scene's.

    model: the scene's with other numbers, in its place.  Raises ValueError as `stated_gains` does.
    """
    numbers = scene.model if model is None else model
    if not recording.command.size or (stated := stated_gains(scene, recording)) is None:
        return numbers
    return scale_gains(copy.copy(numbers), _factors(scene, *stated))


def gains_note(scene: Scene, recording: Recording) -> str:
    """What is to be known of stated gains that are not the scene's, for people; empty where they are.

    Damping that is neither the joint's nor that of a velocity gain takes part in no replay.
    """
    if not recording.command.size or (stated := stated_gains(scene, recording)) is None:
        return ""
    stiffness, damping = stated
    other = _in_place(scene, stiffness, own_stiffness(scene))
    damped = [f"damping of {text}" for text in _in_place(scene, damping, own_damping(scene))]
    if not other and not damped:
        return ""
    ignored = _ignored_damping(scene, damping)
    said = f"; of {', '.join(ignored)} not the stated damping is used, but the joint's own" if ignored else ""
    return (
        f"the replay of recording {recording.name!r} has the servo gains that it states, not the scene's: "
        f"{', '.join(other + damped)}{said}"
    )


def _in_place(scene: Scene, stated: np.ndarray, own: np.ndarray) -> list[str]:
    """Of each servo whose gain a replay scales: the stated one [U], and the scene's [U]."""
    rows = zip(scene.command_names, stated, own, _ratio(stated, own, position_servos(scene.model)), strict=True)
    return [f"{name} {here:g} in place of {has:g}" for name, here, has, factor in rows if factor != 1.0]


def _ignored_damping(scene: Scene, stated: np.ndarray) -> list[str]:
    """Joints whose stated damping [U] is another than the joint's, and whose servo has no velocity gain to take it."""
    return [
        name
        for name, here, own in zip(scene.command_names, stated, own_damping(scene), strict=True)
        if own == 0
        and here > 0
        and name in scene.driven_joints
        and not np.isclose(here, scene.model.dof_damping[scene.dof(name)], rtol=ALIKE)
    ]
