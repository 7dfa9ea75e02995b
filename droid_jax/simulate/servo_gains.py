"""Servo gains that a recording states in place of the scene's, so that logs of several set-ups share one scene.

A replay gets them as factors on the actuators' gains, which are inputs of its program.  So recordings that differ in
their gains share a program, and a parameter that scales a gain scales the stated one.
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

EQUAL = 1e-3  # relative difference up to which two gains are the same number, rounded
_VELOCITY = 2  # column of the velocity gain


def check_gains(scene: Scene, drive: Drive) -> None:
    """Raise ValueError if a recording states another gain for an actuator that is no position servo; 0 states none."""
    if drive.stiffness is None:
        return
    rows = zip(scene.command_names, drive.stiffness, scene_stiffness(scene), position_servos(scene.model), strict=True)
    for name, stated, of_scene, servo in rows:
        if not servo and stated != 0.0 and not np.isclose(stated, of_scene, rtol=EQUAL):
            raise ValueError(
                f"the recording states a servo gain of {stated:g} for {name}, the scene has {of_scene:g} and its "
                "actuator is no position servo; make it a <position> servo in the MJCF, or state 0"
            )


def position_servos(model: mujoco.MjModel) -> np.ndarray:
    """[U] bool, actuators with force gain * (control - length), with or without a velocity gain."""
    gain = model.actuator_gainprm[:, 0]
    return (gain != 0) & (model.actuator_biasprm[:, 1] == -gain)


def scene_stiffness(scene: Scene) -> np.ndarray:
    """[U] N m/rad or N/m, the scene's position gains at the joint."""
    return scene.model.actuator_gainprm[:, 0] * scene.model.actuator_gear[:, 0] ** 2


def scene_damping(scene: Scene) -> np.ndarray:
    """[U] N m s/rad or N s/m, the scene's velocity gains at the joint; 0 for a servo without one."""
    return -scene.model.actuator_biasprm[:, _VELOCITY] * scene.model.actuator_gear[:, 0] ** 2


def servo_factors(scene: Scene, drive: Drive) -> np.ndarray:
    """[U, 2] factors on the position and the velocity gain of each actuator in a drive's replay.

    The factor is 1 if the scene's servo has no velocity gain: the joint's damping is its damping then.
    """
    return _factors(scene, drive.stiffness, drive.damping)


def _factors(scene: Scene, stiffness: np.ndarray | None, damping: np.ndarray | None) -> np.ndarray:
    """[U, 2] the same for stated gains [U]; None: none are stated."""
    servos = position_servos(scene.model)
    pairs = ((stiffness, scene_stiffness(scene)), (damping, scene_damping(scene)))
    return np.stack([_ratio(stated, of_scene, servos) for stated, of_scene in pairs], axis=1)


def _ratio(stated: np.ndarray | None, of_scene: np.ndarray, servos: np.ndarray) -> np.ndarray:
    """[U] stated gain over the scene's; 1 if they are equal, none is stated, or the scene's is zero or no servo's."""
    if stated is None:
        return np.ones(len(of_scene))
    scaled = servos & (of_scene > 0) & ~np.isclose(stated, of_scene, rtol=EQUAL)
    return np.where(scaled, stated / np.where(scaled, of_scene, 1.0), 1.0)


def with_gains(model: Any, factors: Any) -> Any:
    """An mjx.Model with its actuators' gains multiplied by factors [U, 2]."""
    gain, bias = jnp.asarray(model.actuator_gainprm), jnp.asarray(model.actuator_biasprm)
    return model.replace(
        actuator_gainprm=gain.at[:, 0].multiply(factors[:, 0]),
        actuator_biasprm=bias.at[:, 1 : _VELOCITY + 1].multiply(factors),
    )


def scale_gains(model: mujoco.MjModel, factors: np.ndarray) -> mujoco.MjModel:
    """The same for a model of the C engine, which is changed in place and returned."""
    model.actuator_gainprm[:, 0] *= factors[:, 0]
    model.actuator_biasprm[:, 1 : _VELOCITY + 1] *= factors
    return model


def stated_gains(scene: Scene, recording: Recording) -> tuple[np.ndarray, np.ndarray] | None:
    """[U] stiffness and [U] damping of the servos in a recording; None if it states no gains.

    Actuators that the recording does not command have the scene's gains.  Units are N m/rad and N m s/rad (N/m, N s/m).
    Raises ValueError if the recording lacks a command that the scene needs.
    """
    if recording.gains is None:
        return None
    columns = scene.command_index(recording.command_names)
    sent = np.flatnonzero(columns >= 0)
    stiffness, damping = scene_stiffness(scene), scene_damping(scene)
    stiffness[sent] = np.asarray(recording.gains.stiffness, dtype=float)[columns[sent]]
    if recording.gains.damping is not None:
        damping[sent] = np.asarray(recording.gains.damping, dtype=float)[columns[sent]]
    return stiffness, damping


def with_stated_gains(scene: Scene, recording: Recording, model: mujoco.MjModel | None = None) -> mujoco.MjModel:
    """The scene's model with the gains that a recording states, if any.

    model: used in place of the scene's model, such as one with fitted numbers.
    Raises ValueError as `stated_gains` does.
    """
    numbers = scene.model if model is None else model
    if not recording.command.size or (stated := stated_gains(scene, recording)) is None:
        return numbers
    return scale_gains(copy.copy(numbers), _factors(scene, *stated))


def gains_note(scene: Scene, recording: Recording) -> str:
    """A note on stated gains that differ from the scene's; empty if none differs.

    A replay ignores stated damping if the servo has no velocity gain; it uses the joint's damping.
    """
    if not recording.command.size or (stated := stated_gains(scene, recording)) is None:
        return ""
    stiffness, damping = stated
    other = _in_place(scene, stiffness, scene_stiffness(scene))
    damped = [f"damping of {text}" for text in _in_place(scene, damping, scene_damping(scene))]
    if not other and not damped:
        return ""
    ignored = _ignored_damping(scene, damping)
    note = f"; for {', '.join(ignored)} it uses the joint's damping, not the stated one" if ignored else ""
    return (
        f"the replay of recording {recording.name!r} uses the servo gains that it states, not the scene's: "
        f"{', '.join(other + damped)}{note}"
    )


def _in_place(scene: Scene, stated: np.ndarray, of_scene: np.ndarray) -> list[str]:
    """For each servo whose gain a replay scales: its stated gain and the scene's, in words; both gains are [U]."""
    factors = _ratio(stated, of_scene, position_servos(scene.model))
    rows = zip(scene.command_names, stated, of_scene, factors, strict=True)
    return [f"{name} {new:g} in place of {old:g}" for name, new, old, factor in rows if factor != 1.0]


def _ignored_damping(scene: Scene, stated: np.ndarray) -> list[str]:
    """Joints whose stated damping [U] differs from the joint's and whose servo has no velocity gain."""
    return [
        name
        for name, new, of_scene in zip(scene.command_names, stated, scene_damping(scene), strict=True)
        if of_scene == 0
        and new > 0
        and name in scene.driven_joints
        and not np.isclose(new, scene.model.dof_damping[scene.dof(name)], rtol=EQUAL)
    ]
