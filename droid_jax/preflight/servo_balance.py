"""Check commands, positions and gains of recordings without torques by the balance of torques.

A position servo's torque is its gain times the tracking error.  Along the measured motion it must balance weight,
inertia and friction.  Angles in degrees, gains of another robot and exchanged joints violate this balance.
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
from droid_jax.preflight.torques import (
    DEGREE,
    DELAYS,
    EXPLAINED,
    UNEXPLAINED,
    body_residual_share,
    explains,
    factor,
    friction_terms,
)
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide

GAIN_FACTOR = 5.0  # factor by which gains must be wrong, in the median over joints, to be reported
LEAST_BODY_SHARE = 0.1  # smallest share of weight and inertia in a torque's deviation from which its size is estimated
BALANCE_ROWS = 400  # rows of the motion at which inverse dynamics is computed, for each alternative
_Balance = tuple[dict[str, float], dict[str, np.ndarray], dict[str, Expected]]  # unexplained shares, torques, bodies


def check_servo_balance(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """Findings about positions, commands or gains of a recording without torques."""
    servos = {scene.command_names[u] for u in np.flatnonzero(has_feedback(scene.model) & scene.of_joint)}
    known = [j for j in scene.joints if j in motion.command and j in motion.position and j in servos]
    if motion.torque or not scene.joints or len(known) < len(scene.joints):
        return []
    motion = replace(motion, rows=BALANCE_ROWS)
    gravity = not scene.model.body_gravcomp.any()
    stated_as = replace(recording, torque=TorqueConvention(TorqueSide.MOTOR, gravity=gravity))
    stated, torques, bodies = _balance(scene, stated_as, motion)
    bad = [joint for joint, unexplained in stated.items() if unexplained > UNEXPLAINED]
    if not bad:
        return _gains(recording, torques, bodies, gravity, stated)
    where, most = f"recording {recording.name!r}: ", max(bad, key=lambda joint: stated[joint])
    words = "positions and commands are not in the stated unit: are these degrees?"
    tried: list[tuple[Kind, str, str, LogMotion]] = [("units", most, words, motion.scaled(DEGREE))]
    for joint in bad:
        words = f"positions and commands of {joint} have the wrong sign, or the joint's axis in the scene has"
        tried.append(("sign", joint, words, _negated(motion, joint)))
    for one, other in itertools.combinations(known, 2):
        if one in bad or other in bad:
            words = f"{one} and {other} seem to be exchanged in all channels: check the columns' names"
            tried.append(("order", one, words, motion.renamed({one: other, other: one})))
    residuals = [_balance(scene, stated_as, other)[0] for _, _, _, other in tried]
    right = [i for i, unexplained in enumerate(residuals) if explains(unexplained, stated, bad)]
    if right:
        best = min(right, key=lambda i: float(np.mean(list(residuals[i].values()))))
        kind, joint, words, _ = tried[best]
        return [_finding(kind, joint, where + words, stated[most], residuals[best][most], most)]
    return _gains(recording, torques, bodies, gravity, stated)


def _balance(scene: Scene, recording: Recording, motion: LogMotion) -> _Balance:
    """For each joint: unexplained share of the servo's torque, that torque, and the rigid body's torques."""
    with_torques = replace(motion, torque={j: motion.position[j] for j in scene.joints})
    bodies = rigid_body(scene, recording, with_torques)
    gravity, rows = recording.torque.gravity, motion.inner
    residuals: dict[str, float] = {}
    torques: dict[str, np.ndarray] = {}
    for joint, body in bodies.items():
        every = [servo_torque(scene, motion, joint, late)[rows] for late in DELAYS]
        shares = [body_residual_share(torque, body, gravity=gravity, motor=True) for torque in every]
        best = int(np.argmin(shares))
        residuals[joint], torques[joint] = shares[best], every[best]
    return residuals, torques, bodies


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
    """Finding for gains that are wrong by GAIN_FACTOR, from joints with visible weight or inertia."""
    visible: dict[str, tuple[float, float]] = {}  # factor on the gains, and the unexplained share with it
    for joint, torque in torques.items():
        body = bodies[joint]
        expected = body.weight * gravity + body.inertial
        size = factor(torque, expected, *friction_terms(body))
        if size > 0 and size * np.std(expected) > LEAST_BODY_SHARE * np.std(torque):
            unexplained = body_residual_share(torque / size, body, gravity=gravity, motor=True)
            if unexplained < EXPLAINED:
                visible[joint] = size, unexplained
    size = float(np.median([size for size, _ in visible.values()])) if visible else 1.0
    if 1 / GAIN_FACTOR < size < GAIN_FACTOR:
        return []
    joint = min(visible, key=lambda joint: abs(np.log(visible[joint][0] / size)))
    words = (
        f"recording {recording.name!r}: the servos' torques, by their gains and the tracking errors, are "
        f"about {size:.2g} times what the motion needs: are these gains the robot's?"
    )
    return [_finding("gains", joint, words, stated[joint], visible[joint][1], joint, size)]


def _finding(
    kind: Kind, joint: str, words: str, stated: float, unexplained: float, most: str, value: float = 0.0
) -> Finding:
    grounds = f"weight, inertia and friction leave {100 * stated:.0f} % of the servo's torque at {most} unexplained as"
    sentence = f"{words} ({grounds} recorded, {100 * unexplained:.0f} % with this change)"
    return Finding(kind, joint, value or stated, 1.0 if value else unexplained, "likely", sentence)
