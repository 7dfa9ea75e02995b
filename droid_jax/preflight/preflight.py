"""What is to be known of a recording before it is replayed: what its commands are taken for, whether they or the
measured torques lie beyond limits, whether it begins at rest, and whether its joints can be where it has them."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from droid_jax.model.actuators import drives_joint, has_feedback
from droid_jax.model.scene import Scene
from droid_jax.model.variant import variant_scene, variant_text
from droid_jax.preflight.creep import creep_note
from droid_jax.recordings.recording import Channel, Recording
from droid_jax.simulate.closed_loops import OPEN, open_loops
from droid_jax.simulate.initial_state import sent_columns, sent_to, stated_start
from droid_jax.simulate.servo_gains import gains_note

BEGINNING = 0.02  # s (six rows at least), in which the speed at the start is looked at
MOVING = 0.25  # of the motion's largest speed: a joint that is faster at the start does not begin at rest
AT_ONCE = 0.5  # of the speed at the start, that the first two steps must have
BEYOND = 0.05  # of its range, by which a joint may be outside of it unremarked
PERCENT = 100.0  # what drivers of small servos normalise a joint's travel to
TURNS = 4  # from its zero, that a hinge without a range is believed to make; degrees look like that from 25 on


def command_notes(scene: Scene, recording: Recording) -> list[str]:
    """What is to be known of the commands: a <motor> that takes radians for torques, geared servos, actuators that got
    none, other gains and numbers than the scene's, loops that are closed first, commands and torques beyond limits,
    joints that creep while friction holds them.
    """
    scene = variant_scene(scene, recording.variant)
    said = (
        open_loop(scene, recording),
        geared(scene, recording),
        left_alone(scene, recording),
        gains_note(scene, recording),
        variant_note(recording),
        closed_loop(scene, recording),
        clipped_commands(scene, recording),
        exceeded_torques(scene, recording),
        creep_note(scene, recording),
    )
    return [text for text in said if text]


def variant_note(recording: Recording) -> str:
    """What is to be known of numbers that a recording states in place of the MJCF's; empty where it states none."""
    if not recording.variant:
        return ""
    text = variant_text(recording.variant)
    return f"the replay of recording {recording.name!r} has numbers of its own (variant): {text}"


def warn_of_commands(scene: Scene, recording: Recording) -> None:
    """Warn of what is to be known of the commands."""
    for text in command_notes(scene, recording):
        warnings.warn(text, stacklevel=2)


def open_loop(scene: Scene, recording: Recording) -> str:
    """What is to be known where the recording's commands drive actuators without position feedback; else empty."""
    open_ones = np.flatnonzero(~has_feedback(scene.model) & scene.of_joint)
    joints = [scene.command_names[u] for u in open_ones if scene.command_names[u] in recording.command_names]
    if not joints or not recording.command.size:
        return ""
    return (
        f"the actuators of {', '.join(joints)} have no position feedback: the commands of recording "
        f"{recording.name!r} are taken as their torques (or forces, or speeds); for position commands use "
        "<position> servos"
    )


def geared(scene: Scene, recording: Recording) -> str:
    """What is to be known where the recording's commands go to position servos with a gear; else empty."""
    gear = scene.model.actuator_gear[:, 0]
    servos = np.flatnonzero(has_feedback(scene.model) & scene.of_joint & (gear != 1.0))
    joints = [scene.command_names[u] for u in servos if scene.command_names[u] in recording.command_names]
    if not joints or not recording.command.size:
        return ""
    return (
        f"the servos of {', '.join(joints)} have a gear: the commands of recording {recording.name!r} are taken as "
        "MuJoCo's controls, which are the joint's position times the gear"
    )


def left_alone(scene: Scene, recording: Recording) -> str:
    """What is to be known where the recording has commands, but none for some actuators; else empty."""
    if not recording.command.size:
        return ""
    left = [
        (n, f)
        for n, f in zip(scene.command_names, has_feedback(scene.model), strict=True)
        if n not in recording.command_names
    ]
    said = {
        "held where the motion starts": [n for n, feedback in left if feedback],
        "given 0 (no position feedback)": [n for n, feedback in left if not feedback],
    }
    told = "; ".join(f"{', '.join(names)} {what}" for what, names in said.items() if names)
    return f"recording {recording.name!r} has not all commands: {told}" if told else ""


def closed_loop(scene: Scene, recording: Recording) -> str:
    """What is to be known where the recording starts with a closed loop open, which other joints then close."""
    if not recording.command.size or not scene.model.neq:
        return ""
    wide = [loop for loop in open_loops(scene, stated_start(scene, recording)) if loop.turn > OPEN]
    if not wide:
        return ""
    return (
        f"recording {recording.name!r} starts where {wide[0].name} would be open by {wide[0].gap:.3g} (m or rad): the "
        "joints of that loop that nobody commands or measures start where they close it"
    )


def warn_if_moving(recording: Recording) -> None:
    """Warn where joints were measured to move already when a recording with commands begins: its replay is at rest.

    The speed at the start is that of a line through the mean of the repeats over so short a time that a servo that sets
    off from rest is not fast yet; it must be five times its own error.
    """
    channel = recording.channels.get("position")
    if channel is None:
        return
    moving = [j for i, j in enumerate(channel.columns) if _moves(recording.time[0], channel, i)]
    if moving:
        warnings.warn(
            f"recording {recording.name!r} begins while {' and '.join(moving)} move{'s' * (len(moving) == 1)}, and a "
            "replay begins at rest: let the recording begin where the robot stands still",
            stacklevel=2,
        )


def _moves(begin: float, channel: Channel, column: int) -> bool:
    """Whether a position's path has a speed of its own where the motion begins."""
    time, seen = channel.time - begin, channel.mask[..., column].all(axis=0)
    path = channel.values[..., column].mean(axis=0)
    rows = np.flatnonzero(seen & (time >= 0.0))
    first = rows[: max(6, int(np.sum(time[rows] <= BEGINNING)))]
    if len(first) < 6:  # a line through two points has no error to be judged by
        return False
    (speed, _), covariance = np.polyfit(time[first], path[first], 1, cov=True)
    # In a slow log a servo that sets off from rest is fast within six rows; its first two steps are slower.
    begins = (path[first[2]] - path[first[0]]) / (time[first[2]] - time[first[0]])
    if begins * np.sign(speed) < AT_ONCE * abs(speed):
        return False
    steps = rows[:: len(first)]  # as far apart as the beginning is long
    fastest = np.abs(np.diff(path[steps]) / np.diff(time[steps])).max(initial=0.0)
    return bool(abs(speed) > max(MOVING * fastest, 5.0 * np.sqrt(covariance[0, 0])))


def check_range(scene: Scene, recording: Recording) -> None:
    """Raise ValueError where a measured joint goes, or is sent, so far outside its range that the unit is wrong.

    One that is outside by more than BEYOND of its range is warned of, and a hinge without a range, which may be a
    wheel, where it goes more than TURNS from its zero.
    """
    sent = sent_to(scene, recording) if recording.command.size else {}
    paths = [("is sent to", joint, path) for joint, path in sent.items()]
    paths += [("starts at", joint, np.array([q])) for joint, q in recording.qpos0.items()]
    if channel := recording.channels.get("position"):
        seen = np.where(channel.mask, channel.values, np.nan).reshape(-1, len(channel.columns))
        paths += [("is measured at", joint, seen[:, i]) for i, joint in enumerate(channel.columns)]
    if (channel := recording.channels.get("object_angle")) and scene.object_joint is not None:
        paths.append(("is measured at", scene.object_joint, np.where(channel.mask, channel.values, np.nan).ravel()))
    for what, joint, path in paths:
        if joint in (*scene.joints, scene.object_joint) and not np.isnan(path).all():
            _check_reach(scene, joint, path, f"recording {recording.name!r}: {joint} {what}")


def _check_reach(scene: Scene, joint: str, path: np.ndarray, begin: str) -> None:
    """As `check_range`, of one joint's path [K], NaN where it was not seen; begin: of what is said."""
    index = scene.id("joint", joint)
    slide = scene.slides(joint)
    low, high = scene.model.jnt_range[index]
    if low < high:  # whether the replay holds it there or not
        beyond = np.maximum(low - path, path - high)
        worst = int(np.nanargmax(beyond))
        unit = (
            f"m: are these millimetres?{_other_units(path)}"
            if slide
            else f"rad: are these degrees?{_other_units(path)}"
        )
        if beyond[worst] > high - low:
            raise ValueError(f"{begin} {path[worst]:.4g}, far outside its range {low:.4g} .. {high:.4g} {unit}")
        if beyond[worst] > BEYOND * (high - low):
            warnings.warn(f"{begin} {path[worst]:.4g}, outside its range {low:.4g} .. {high:.4g} {unit}", stacklevel=3)
    elif not slide:
        turns = np.abs(path) / (2 * np.pi)
        worst = int(np.nanargmax(turns))
        if turns[worst] > TURNS:
            units = f"are these degrees?{_other_units(path)}"
            warnings.warn(f"{begin} {path[worst]:.4g} rad, {turns[worst]:.3g} turns: {units}", stacklevel=3)


def _other_units(path: np.ndarray) -> str:
    """What else than degrees or millimetres a path [K] may be in, as a question."""
    seen = path[~np.isnan(path)]
    counts = len(seen) > 1 and np.ptp(seen) > 1 and bool(np.all(seen == np.round(seen)))
    if counts and np.abs(seen).max() > PERCENT:
        return " Or encoder counts?"
    return " Or normalised to -100 .. 100, or 0 .. 100?" if np.abs(seen).max() <= PERCENT else ""


ROUNDING = 1e-6  # of a range, by which a command may miss it
SLACK = 0.05  # of a torque limit: noise on top of a torque at its limit is none beyond it
RARE = 0.001  # share of the samples: torques beyond a limit more rarely are outliers


def clipped_commands(scene: Scene, recording: Recording) -> str:
    """What is to be known where commands lie beyond their actuators' ctrlrange; else empty."""
    model = scene.model
    if not recording.command.size or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return ""
    said = []
    for actuator, column in sent_columns(scene, recording).items():
        if not model.actuator_ctrllimited[actuator]:
            continue
        low, high = model.actuator_ctrlrange[actuator]
        sent, slack = recording.command[:, column], ROUNDING * (high - low)
        share = float(np.mean((sent < low - slack) | (sent > high + slack)))
        if share:
            name = scene.command_names[actuator]
            said.append(
                f"{name} in {_percent(share)} of the samples (they run {sent.min():.3g} .. {sent.max():.3g}, its range "
                f"{low:.3g} .. {high:.3g})"
            )
    if not said:
        return ""
    return (
        f"commands of recording {recording.name!r} leave the actuator's ctrlrange at {'; '.join(said)}: the replay "
        "cuts them off there; widen ctrlrange in the MJCF if the robot followed them"
    )


def exceeded_torques(scene: Scene, recording: Recording) -> str:
    """What is to be known where measured torques are larger than the scene's actuators can be; else empty."""
    channel = recording.channels.get("torque")
    if channel is None or not recording.command.size:
        return ""
    said = []
    for i, joint in enumerate(channel.columns):
        if joint not in scene.joints:
            continue
        low, high = torque_range(scene, joint)
        seen = channel.values[..., i][channel.mask[..., i]]
        share = (
            float(np.mean((seen < low - SLACK * abs(low)) | (seen > high + SLACK * abs(high)))) if seen.size else 0.0
        )
        if share > RARE:
            said.append(
                f"{joint} in {_percent(share)} of the samples (up to {np.abs(seen).max():.3g} {channel.unit}, limits "
                f"{low:.3g} .. {high:.3g})"
            )
    if not said:
        return ""
    return (
        f"measured torques of recording {recording.name!r} exceed what the actuators of scene {scene.name!r} can do "
        f"(forcerange, actuatorfrcrange) at {'; '.join(said)}: the replay cannot follow them; check the unit and the "
        "limits in the MJCF"
    )


def torque_range(scene: Scene, joint: str) -> tuple[float, float]:
    """Smallest and largest torque (N m, N of slides) that the scene's actuators can have at a joint of one degree.

    Infinite where one of them is not limited, or where one drives a tendon, a site or a body, whose lever is not known.
    """
    model, index = scene.model, scene.id("joint", joint)
    low = high = 0.0
    of_joint = drives_joint(model)
    if not of_joint.all():
        low, high = -np.inf, np.inf
    for actuator in np.flatnonzero(of_joint & (model.actuator_trnid[:, 0] == index)):
        ends = model.actuator_forcerange[actuator] * model.actuator_gear[actuator, 0]
        limited = bool(model.actuator_forcelimited[actuator])
        low, high = (low + min(ends), high + max(ends)) if limited else (-np.inf, np.inf)
    if model.jnt_actfrclimited[index]:
        low, high = max(low, float(model.jnt_actfrcrange[index, 0])), min(high, float(model.jnt_actfrcrange[index, 1]))
    driven = bool(np.any(of_joint & (model.actuator_trnid[:, 0] == index)))
    return (low, high) if driven else (-np.inf, np.inf)


def _percent(share: float) -> str:
    return "< 1 %" if share < 0.005 else f"{min(round(100 * share), 99 if share < 1 else 100)} %"
