"""Whether commands and positions mean torques that the scene's bodies take: of recordings without torques.

A position servo's torque follows from its gains and the tracking error.  Along the measured motion it must be what
weight, inertia and friction take.  Angles in degrees, gains of another robot and exchanged joints break that.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from droid_jax.model.actuators import has_feedback
from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding, Kind
from droid_jax.preflight.signals import Expected, LogMotion, rigid_body, servo_torque
from droid_jax.preflight.torques import BAD, DEGREE, GOOD, LATE, explains, factor, friction_terms, left_by_body
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide

FACTOR = 5.0  # by which gains must be off, as the median of the joints
VISIBLE = 0.1  # of a torque's deviation, that weight and inertia must make up to tell its size
ROWS = 400  # of the motion at which inverse dynamics is computed, for each alternative
_Balance = tuple[dict[str, float], dict[str, np.ndarray], dict[str, Expected]]  # shares left, torques, bodies


def check_servo_balance(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """What is wrong with positions, commands or gains, where no torque was measured."""
    servos = {scene.command_names[u] for u in np.flatnonzero(has_feedback(scene.model) & scene.of_joint)}
    known = [j for j in scene.joints if j in motion.command and j in motion.position and j in servos]
    if motion.torque or not scene.joints or len(known) < len(scene.joints):
        return []
    motion = replace(motion, rows=ROWS)
    gravity = not scene.model.body_gravcomp.any()
    stated_as = replace(recording, torque=TorqueConvention(TorqueSide.MOTOR, gravity=gravity))
    stated, torques, bodies = _balance(scene, stated_as, motion)
    bad = [joint for joint, left in stated.items() if left > BAD]
    if not bad:
        return _gains(recording, torques, bodies, gravity, stated)
    where, most = f"recording {recording.name!r}: ", max(bad, key=lambda joint: stated[joint])
    words = "positions and commands are not in the unit that is stated: are these degrees?"
    tried: list[tuple[Kind, str, str, LogMotion]] = [("units", most, words, motion.scaled(DEGREE))]
    for joint in bad:
        words = f"positions and commands of {joint} have the wrong sign, or its axis in the scene has"
        tried.append(("sign", joint, words, _negated(motion, joint)))
    for one, other in itertools.combinations(known, 2):
        if one in bad or other in bad:
            words = f"{one} and {other} seem to be exchanged in all channels: check the columns' names"
            tried.append(("order", one, words, motion.renamed({one: other, other: one})))
    lefts = [_balance(scene, stated_as, other)[0] for _, _, _, other in tried]
    right = [i for i, left in enumerate(lefts) if explains(left, stated, bad)]
    if right:
        best = min(right, key=lambda i: float(np.mean(list(lefts[i].values()))))
        kind, joint, words, _ = tried[best]
        return [_finding(kind, joint, where + words, stated[most], lefts[best][most], most)]
    return _gains(recording, torques, bodies, gravity, stated)


def _balance(scene: Scene, recording: Recording, motion: LogMotion) -> _Balance:
    """Joint -> share of the servo's torque that the body leaves, the torque, and what the body takes."""
    with_torques = replace(motion, torque={j: motion.position[j] for j in scene.joints})
    bodies = rigid_body(scene, recording, with_torques)
    gravity, rows = recording.torque.gravity, motion.inner
    lefts: dict[str, float] = {}
    torques: dict[str, np.ndarray] = {}
    for joint, body in bodies.items():
        every = [servo_torque(scene, motion, joint, late)[rows] for late in LATE]
        shares = [left_by_body(torque, body, gravity=gravity, motor=True) for torque in every]
        best = int(np.argmin(shares))
        lefts[joint], torques[joint] = shares[best], every[best]
    return lefts, torques, bodies


def _negated(motion: LogMotion, joint: str) -> LogMotion:
    def turned(traces: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {j: -x if j == joint else x for j, x in traces.items()}

    return replace(motion, command=turned(motion.command), position=turned(motion.position))


def _gains(
    recording: Recording,
    torques: Mapping[str, np.ndarray],
    bodies: Mapping[str, Expected],
    gravity: bool,
    stated: Mapping[str, float],
) -> list[Finding]:
    """Gains that are several times too large or too small, at the joints where weight and inertia tell it."""
    visible: dict[str, tuple[float, float]] = {}  # size, and the share that is left with it
    for joint, torque in torques.items():
        body = bodies[joint]
        expected = body.weight * gravity + body.inertial
        size = factor(torque, expected, *friction_terms(body))
        if size > 0 and size * np.std(expected) > VISIBLE * np.std(torque):
            left = left_by_body(torque / size, body, gravity=gravity, motor=True)
            if left < GOOD:
                visible[joint] = size, left
    size = float(np.median([size for size, _ in visible.values()])) if visible else 1.0
    if 1 / FACTOR < size < FACTOR:
        return []
    joint = min(visible, key=lambda joint: abs(np.log(visible[joint][0] / size)))
    words = (
        f"recording {recording.name!r}: the servos' torques, by their gains and the tracking errors, are "
        f"about {size:.2g} times what the motion takes: are these gains the robot's?"
    )
    return [_finding("gains", joint, words, stated[joint], visible[joint][1], joint, size)]


def _finding(kind: Kind, joint: str, words: str, stated: float, left: float, most: str, value: float = 0.0) -> Finding:
    grounds = (
        f"left unexplained of the servo's torque at {most} by weight, inertia and friction: {100 * stated:.0f} % as"
    )
    sentence = f"{words} ({grounds} recorded, {100 * left:.0f} % otherwise)"
    return Finding(kind, joint, value or stated, 1.0 if value else left, "likely", sentence)
