"""Check measured positions against commands: sign, unit and order of the joints, and plausible speeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding
from droid_jax.preflight.signals import LogMotion
from droid_jax.recordings.recording import Recording
from droid_jax.simulate.initial_state import commanded_positions

LEAST_TRAVEL = 0.01  # rad or m: joints with a smaller commanded travel are not checked
LONGEST_DELAY = 0.15  # s, largest lag of a position; no sign is checked for oscillations with a shorter half-period
FOLLOWING = 0.9  # correlation above which a position follows a command, and their sizes are compared
OPPOSING = -0.8  # correlation below which a position is opposite to its command
UNRELATED = 0.3  # correlation below which a position does not follow its own command
STATED_ORDER_RESIDUAL = 0.02  # unexplained share of the positions' variance above which another order is tested
OTHER_ORDER_SHARE = 0.2  # the other order must reduce that share below this factor
UNIT_RATIO = 3.0  # ratio of position to command, or its inverse, above which their units differ
RATIO_TOLERANCE = 0.25  # relative tolerance on the ratio of known units
STUCK_SHARE = 1e-3  # share of the commanded travel: a position that moves less is not measured, or in another unit
FASTEST = {"hinge": 30.0, "slide": 10.0}  # rad/s, m/s: faster than any arm, leg or gripper; wheels turn one way
TURN, TURN_TOLERANCE = 2 * np.pi, 0.1  # rad; relative tolerance on a step of one turn
_UNITS = {"hinge": {180 / np.pi: "degrees"}, "slide": {1000.0: "millimetres", 100.0: "centimetres"}}


def check_tracking(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """Findings about positions and commands."""
    where = f"recording {recording.name!r}"
    wrapped = _wrapped(scene, recording, motion, where)
    paths = {j: path for j, path in motion.position.items() if j not in wrapped}
    joints = [j for j in motion.command if j in paths and np.ptp(motion.command[j]) > LEAST_TRAVEL]
    found = _order(motion, joints, where)
    if not found:
        for joint in joints:
            found += _of_joint(scene, motion, joint, where)
    return [*wrapped.values(), *(found or _too_fast(scene, replace(motion, position=paths), where))]


def _wrapped(scene: Scene, recording: Recording, motion: LogMotion, where: str) -> dict[str, Finding]:
    """Joint -> finding for a hinge whose measured or commanded angle wraps after each turn."""
    hinges = [j for j in scene.single_joints if not scene.slides(j)]
    tracks = list[tuple[str, str, np.ndarray, np.ndarray]]()
    if channel := recording.channels.get("position"):
        seen = np.where(channel.mask, channel.values, np.nan)
        tracks += [("position", j, channel.time, p) for i, j in enumerate(channel.columns) for p in seen[..., i]]
    for joint, path in (commanded_positions(scene, recording) if recording.command.size else {}).items():
        position = np.interp(recording.time, motion.time, motion.position.get(joint, np.full_like(motion.time, np.nan)))
        if np.std(np.unwrap(path) - position) < np.std(path - position):  # otherwise the joint does make that turn
            tracks.append(("command", joint, recording.time, path))
    found = dict[str, Finding]()
    for what, joint, time, path in tracks:
        steps = np.nan_to_num(np.abs(np.diff(path)))
        turns = np.flatnonzero(np.abs(steps - TURN) < TURN_TOLERANCE * TURN)
        if joint not in hinges or not len(turns):
            continue
        # Degrees and counts have steps of all sizes, and on a slow clock a wheel may make one turn per row.
        others, longest = np.delete(steps, turns).max(initial=0.0), np.diff(time)[turns].max()
        if others < TURN / 2 and longest < TURN / FASTEST["hinge"]:
            at = float(time[turns[0]])
            sentence = (
                f"{where}: the {what} of {joint} jumps by one turn from one sample to the next, at {at:.4g} s: the log "
                "is wrapped to one turn; unwrap it (numpy.unwrap) before it is converted"
            )
            found.setdefault(joint, Finding("units", joint, float(steps[turns[0]]), 0.0, "certain", sentence))
    return found


def correlations(motion: LogMotion, sent: str, measured: str) -> tuple[np.ndarray, np.ndarray]:
    """Correlation [L] of a position with a command, and ratio [L] of their deviations, at lags up to LONGEST_DELAY."""
    most = max(1, min(round(LONGEST_DELAY / motion.step), len(motion.time) // 4))
    pairs = []
    for lag in range(most + 1):
        command = motion.command[sent][: len(motion.time) - lag]
        position = motion.position[measured][lag:]
        deviations = np.std(command), np.std(position)
        if min(deviations) < 1e-9:
            pairs.append((0.0, 0.0))
            continue
        pairs.append((float(np.corrcoef(command, position)[0, 1]), float(deviations[1] / deviations[0])))
    r, ratio = np.array(pairs).T
    return r, ratio


def _of_joint(scene: Scene, motion: LogMotion, joint: str, where: str) -> list[Finding]:
    if np.ptp(motion.position[joint]) < STUCK_SHARE * np.ptp(motion.command[joint]):
        unit = "m" if scene.slides(joint) else "rad"
        return [
            Finding(
                "sensor", joint, float(np.ptp(motion.position[joint])), float(np.ptp(motion.command[joint])), "likely",
                f"{where}: the position of {joint} moves by {np.ptp(motion.position[joint]):.2g} {unit} while its "
                f"command moves by {np.ptp(motion.command[joint]):.2g}: is the sensor dead, or in another unit?",
            )
        ]  # fmt: skip
    r, ratios = correlations(motion, joint, joint)
    if r.max() < 0 and r.min() < OPPOSING:
        return [
            Finding(
                "sign", joint, float(r.min()), 1.0, "certain",
                f"{where}: the position of {joint} runs against its command (correlation {r.min():.2f}, expected near "
                "1): one of the two has the wrong sign",
            )
        ]  # fmt: skip
    best = int(np.argmax(r))
    if r[best] < FOLLOWING or 1 / UNIT_RATIO < ratios[best] < UNIT_RATIO:
        return []
    return [_ratio(scene, joint, float(ratios[best]), where)]


def _ratio(scene: Scene, joint: str, ratio: float, where: str) -> Finding:
    """Finding for a position that follows its command but is `ratio` times as large."""
    units, certain = "are both in the same unit?", False
    for size, unit in _UNITS["slide" if scene.slides(joint) else "hinge"].items():
        for of, what in ((ratio / size, "position"), (1 / (ratio * size), "command")):
            if abs(of - 1) < RATIO_TOLERANCE:
                units, certain = f"is the {what} in {unit}?", what == "position"
    return Finding(
        "units", joint, ratio, 1.0, "certain" if certain else "likely",
        f"{where}: the position of {joint} is {ratio:.3g} times its command: {units}",
    )  # fmt: skip


def _order(motion: LogMotion, joints: list[str], where: str) -> list[Finding]:
    """Finding for positions that follow the commands of other joints, in the order that fits best."""
    if len(joints) < 2:
        return []
    r = np.array([[correlations(motion, sent, seen)[0].max() for sent in joints] for seen in joints])
    seen, sent = linear_sum_assignment(-r)
    wrong = [(i, j) for i, j in zip(seen, sent, strict=True) if i != j]
    if not wrong or any(r[i, j] < FOLLOWING for i, j in wrong):
        return []
    share = 1 - np.maximum(r, 0.0) ** 2  # unexplained share of each position's variance, for each command
    unlike = float(np.mean([share[i, i] for i, _ in wrong]))
    left = float(np.mean([share[i, j] for i, j in wrong]))
    if unlike < STATED_ORDER_RESIDUAL or left > OTHER_ORDER_SHARE * unlike:  # similar commands determine no order
        return []
    pairs = ", ".join(f"{joints[i]} follows the command of {joints[j]}" for i, j in wrong)
    first = int(wrong[0][0])
    sentence = (
        f"{where}: the joints seem to be in another order in positions than in commands ({pairs}): check the columns' "
        "names"
    )
    sure = all(r[i, i] < UNRELATED for i, _ in wrong)
    return [Finding("order", joints[first], float(r[first, first]), 1.0, "certain" if sure else "likely", sentence)]


def _too_fast(scene: Scene, motion: LogMotion, where: str) -> list[Finding]:
    """Finding for joints that move to and fro faster than any robot."""
    for joint, path in motion.position.items():
        slides = scene.slides(joint)
        speed = motion.rate_of(path)[motion.inner]
        if len(speed) and min(speed.max(), -speed.min()) > FASTEST["slide" if slides else "hinge"]:
            fastest, unit = float(np.abs(speed).max()), "m/s" if slides else "rad/s"
            units = "millimetres" if slides else "degrees, or normalised (-100 .. 100)"
            return [
                Finding(
                    "units", joint, fastest, FASTEST["slide" if slides else "hinge"], "likely",
                    f"{where}: the positions of {joint} mean a speed of {fastest:.3g} {unit}: are these {units}?",
                )
            ]  # fmt: skip
    return []
