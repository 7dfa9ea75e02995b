"""Notes about a recording before a replay: interpretation of its commands, limits of commands and torques, a start in
motion, and positions outside the joints' ranges."""

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
from droid_jax.simulate.initial_state import command_columns, commanded_positions, stated_start
from droid_jax.simulate.servo_gains import gains_note

START_SECONDS = 0.02  # s (six rows at least) over which the speed at the start is estimated
MOVING_SHARE = 0.25  # of the motion's largest speed: a joint that is faster at the start is not at rest
FIRST_STEPS_SHARE = 0.5  # of the speed at the start, which the first two steps must reach
RANGE_SLACK = 0.05  # of its range: a position outside by less causes no warning
PERCENT = 100.0  # end of the travel that drivers of small servos normalise to
MOST_TURNS = 4  # turns from zero of a hinge without a range; angles in degrees exceed it from 25 degrees on


def command_notes(scene: Scene, recording: Recording) -> list[str]:
    """Notes about the commands of a recording in a scene.

    They concern actuators without position feedback, servos with a gear, actuators without commands, gains and numbers
    that differ from the scene's, open loops, commands and torques beyond limits, and joints that creep.
    """
    scene = variant_scene(scene, recording.variant, recording.name)
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
    """Issue `command_notes` as warnings."""
    for text in command_notes(scene, recording):
        warnings.warn(text, stacklevel=2)


def open_loop(scene: Scene, recording: Recording) -> str:
    """Note about commands of actuators without position feedback; empty if there are none."""
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
    """Note about commands of position servos with a gear; empty if there are none."""
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
    """Note about actuators without commands in a commanded recording; empty if there are none."""
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
    held = "; ".join(f"{', '.join(names)} {what}" for what, names in said.items() if names)
    return f"recording {recording.name!r} has not all commands: {held}" if held else ""


def closed_loop(scene: Scene, recording: Recording) -> str:
    """Note about a kinematic loop that is open at the recorded start and is closed by other joints; empty if none."""
    if not recording.command.size or not scene.model.neq:
        return ""
    wide = [loop for loop in open_loops(scene, stated_start(scene, recording)) if loop.turn > OPEN]
    if not wide:
        return ""
    return (
        f"recording {recording.name!r} starts where {wide[0].name} would be open by {wide[0].gap:.3g} (m or rad): the "
        "joints of that loop that are neither commanded nor measured start where they close it"
    )


def warn_if_moving(recording: Recording) -> None:
    """Warn of joints that already move at the start of a commanded recording, since a replay begins at rest.

    The speed is the slope of a line through the mean of the repeats over the first START_SECONDS, too short for a servo
    at rest to gain speed.  It must exceed five times its own error.
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
    """Whether a position already changes at the start of the motion."""
    time, seen = channel.time - begin, channel.mask[..., column].all(axis=0)
    path = channel.values[..., column].mean(axis=0)
    rows = np.flatnonzero(seen & (time >= 0.0))
    first = rows[: max(6, int(np.sum(time[rows] <= START_SECONDS)))]
    if len(first) < 6:  # a line through two points has no error to be judged by
        return False
    (speed, _), covariance = np.polyfit(time[first], path[first], 1, cov=True)
    # In a slow log a servo that starts at rest is fast within six rows, but its first two steps are slower.
    begins = (path[first[2]] - path[first[0]]) / (time[first[2]] - time[first[0]])
    if begins * np.sign(speed) < FIRST_STEPS_SHARE * abs(speed):
        return False
    steps = rows[:: len(first)]  # as far apart as the beginning is long
    fastest = np.abs(np.diff(path[steps]) / np.diff(time[steps])).max(initial=0.0)
    return bool(abs(speed) > max(MOVING_SHARE * fastest, 5.0 * np.sqrt(covariance[0, 0])))


def check_range(scene: Scene, recording: Recording) -> None:
    """Check measured and commanded positions against the joints' ranges.

    Warns of positions outside the range by more than RANGE_SLACK of it, and of a hinge without a range (which may be a
    wheel) that is more than MOST_TURNS from zero.

    Raises:
        ValueError: a position is so far outside that its unit must be wrong.
    """
    sent = commanded_positions(scene, recording) if recording.command.size else {}
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
    """`check_range` for one joint's path [K], NaN where not measured; begin: first words of the message."""
    index = scene.id("joint", joint)
    slide = scene.slides(joint)
    low, high = scene.model.jnt_range[index]
    if low < high:  # whether or not the replay enforces the range
        beyond = np.maximum(low - path, path - high)
        worst = int(np.nanargmax(beyond))
        unit = (
            f"m: are these millimetres?{_other_units(path)}"
            if slide
            else f"rad: are these degrees?{_other_units(path)}"
        )
        if beyond[worst] > high - low:
            raise ValueError(f"{begin} {path[worst]:.4g}, far outside its range {low:.4g} .. {high:.4g} {unit}")
        if beyond[worst] > RANGE_SLACK * (high - low):
            warnings.warn(f"{begin} {path[worst]:.4g}, outside its range {low:.4g} .. {high:.4g} {unit}", stacklevel=3)
    elif not slide:
        turns = np.abs(path) / (2 * np.pi)
        worst = int(np.nanargmax(turns))
        if turns[worst] > MOST_TURNS:
            units = f"are these degrees?{_other_units(path)}"
            warnings.warn(f"{begin} {path[worst]:.4g} rad, {turns[worst]:.3g} turns: {units}", stacklevel=3)


def _other_units(path: np.ndarray) -> str:
    """Question about other possible units of a path [K] than degrees or millimetres; empty if there are none."""
    seen = path[~np.isnan(path)]
    counts = len(seen) > 1 and np.ptp(seen) > 1 and bool(np.all(seen == np.round(seen)))
    if counts and np.abs(seen).max() > PERCENT:
        return " Or encoder counts?"
    return " Or normalised to -100 .. 100, or 0 .. 100?" if np.abs(seen).max() <= PERCENT else ""


COMMAND_SLACK = 1e-6  # of ctrlrange: rounding of commands
TORQUE_SLACK = 0.05  # of a torque limit: noise of a torque at its limit
OUTLIER_SHARE = 0.001  # of the samples: fewer torques beyond a limit are outliers


def clipped_commands(scene: Scene, recording: Recording) -> str:
    """Note about commands beyond their actuators' ctrlrange; empty if there are none."""
    model = scene.model
    if not recording.command.size or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return ""
    said = []
    for actuator, column in command_columns(scene, recording).items():
        if not model.actuator_ctrllimited[actuator]:
            continue
        low, high = model.actuator_ctrlrange[actuator]
        sent, slack = recording.command[:, column], COMMAND_SLACK * (high - low)
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
    """Note about measured torques beyond the limits of the scene's actuators; empty if there are none."""
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
            float(np.mean((seen < low - TORQUE_SLACK * abs(low)) | (seen > high + TORQUE_SLACK * abs(high))))
            if seen.size
            else 0.0
        )
        if share > OUTLIER_SHARE:
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
    """Smallest and largest torque of the scene's actuators at a hinge (N m) or slide (N).

    Infinite if one of them has no limit, or drives a tendon, a site or a body, whose lever arm is unknown.
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
