"""Creep of simulated joints that dry friction holds, where real joints stand still.

MuJoCo's friction loss is a soft constraint.  Below the loss F its force is -(b / R) v.  Here b is the damping of
`solreffriction`, R = (1 - d) / d times the joint's inverse inertia at qpos0, and d the impedance of `solimpfriction`.
Under a load T < F the joint therefore moves at the speed T R / b.
Source: MuJoCo documentation, "Computation", sections "Friction loss" and "Solver parameters".
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from droid_jax.model.scene import SOFT_IMPEDANCE, TINY_FRICTIONLOSS, Scene
from droid_jax.recordings.recording import Recording, TorqueSide
from droid_jax.simulate.initial_state import command_columns, start_pose, weight_share
from droid_jax.simulate.servo_gains import with_stated_gains

HOLDING_SOLIMP = "0.9999 0.9999 0.001 0.5 2"  # solimpfriction that reduces the default's creep to a thousandth
SHORTEST_HOLD = 0.5  # s; shorter rests are reversals of the motion
STILL_WITHIN = 2e-3  # rad or m: a joint that stays within this span stands still; above encoder noise
LEAST_CREEP = 5e-4  # rad or m; smaller creep is below the resolution of encoders
NOISE_FACTOR = 3.0  # creep must exceed so many noise deviations of the measured position
TRACKING_SHARE = 0.1  # and this share of the tracking error (root mean square)


@dataclass(frozen=True)
class Creep:
    """A joint that creeps while friction holds it.

    load: N m or N that friction holds.  speed: rad/s or m/s.  seconds: duration of the longest hold.  distance: rad or
    m that the joint moves in that time.  mended: speed with HOLDING_SOLIMP.
    """

    joint: str
    load: float
    speed: float
    seconds: float
    distance: float
    mended: float


def creep_per_load(model: mujoco.MjModel, dof: int, solimp: np.ndarray | None = None) -> float:
    """Creep speed per load of a degree of freedom, rad/s per N m (m/s per N); solimp: [5] in place of the model's."""
    reference, impedance = model.dof_solref[dof], model.dof_solimp[dof] if solimp is None else solimp
    start, end = np.clip(impedance[:2], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    if reference[1] <= 0:  # stated directly
        damping = -reference[1] / end
    else:
        safe = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE
        damping = 2.0 / (end * max(reference[0], 2.0 * model.opt.timestep if safe else 0.0))
    if damping <= 0:
        return np.inf
    return (1.0 - start) / start * float(model.dof_invweight0[dof]) / damping


def creeping(scene: Scene, recording: Recording, model: mujoco.MjModel | None = None) -> list[Creep]:
    """The joints whose creep in a commanded replay exceeds position noise and tracking error.

    The load on friction is weight and springs minus the motor's torque, in the middle of the longest interval in which
    the joint stands still (measured, or else commanded).  The motor's torque is the measured one if it was measured on
    the motor's side, otherwise that of the scene's actuators.

    Args:
        scene: of the replay.
        recording: of the replay; without commands the result is empty.
        model: the scene's model with other numbers, such as fitted ones.

    Returns:
        One entry for each such joint.
    """
    numbers = scene.model if model is None else model
    if not recording.command.size or numbers.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS:
        return []
    numbers = with_stated_gains(scene, recording, numbers)
    rubbed = [j for j in scene.joints if numbers.dof_frictionloss[scene.dof(j)] > 10 * TINY_FRICTIONLOSS]
    found = []
    qpos0 = start_pose(scene, recording) if rubbed else None
    for joint in rubbed:
        dof = scene.dof(joint)
        per_load, loss = creep_per_load(numbers, dof), float(numbers.dof_frictionloss[dof])
        if qpos0 is None or per_load * loss * recording.duration < LEAST_CREEP:
            continue
        begin, end = _longest_hold(scene, recording, joint)
        if end - begin < SHORTEST_HOLD:
            continue
        load = min(loss, abs(_left_to_friction(scene, numbers, recording, joint, qpos0, 0.5 * (begin + end))))
        distance = per_load * load * (end - begin)
        if (stiffness := _stiffness(scene, numbers, joint)) > 0:
            distance = min(distance, load / stiffness)  # the servo stops the joint at its target
        if distance > _seen_from(scene, recording, joint):
            stiff = np.array([float(n) for n in HOLDING_SOLIMP.split()])
            mended = creep_per_load(numbers, dof, stiff) * load
            found.append(Creep(joint, load, per_load * load, end - begin, distance, mended))
    return found


def creep_note(scene: Scene, recording: Recording, model: mujoco.MjModel | None = None) -> str:
    """Note about joints that creep, or would creep without the scene's correction (`Scene.held`); empty if none."""
    held = bool(scene.held) and model is None
    found = creeping(scene, recording, as_given(scene) if held else model)
    if not found:
        return ""
    said = []
    for c in found:
        angle, torque = ("m", "N") if scene.slides(c.joint) else ("rad", "N m")
        said.append(
            f"{c.joint} by {1e3 * c.speed:.2g} m{angle}/s at the {c.load:.2g} {torque} that it holds for "
            f"{c.seconds:.2g} s ({1e3 * c.distance:.2g} m{angle} in all; {1e3 * c.mended:.1g} m{angle}/s when mended)"
        )
    creep, why = ("would creep", "in its MJCF") if held else ("creep", "in the replay")
    do = (
        "the replay holds them, as the fitted MJCF will (--joint-friction scene keeps the MJCF's constraint)"
        if held
        else f'give these joints solimpfriction="{HOLDING_SOLIMP}" in the MJCF, otherwise gains, damping and '
        "friction of a fit are biased"
    )
    return (
        f"joints of scene {scene.name!r} that dry friction holds {creep} {why} with recording {recording.name!r}, "
        f"where real ones stand still, since MuJoCo's friction constraint is soft: {'; '.join(said)}; {do}"
    )


def as_given(scene: Scene) -> mujoco.MjModel:
    """The scene's model with the friction constraints of its MJCF."""
    model = scene.model.__copy__()
    for joint in scene.held:
        model.dof_solimp[model.dof_jntid == scene.id("joint", joint)] = SOFT_IMPEDANCE
    return model


def _longest_hold(scene: Scene, recording: Recording, joint: str) -> tuple[float, float]:
    """Start and end, s, of the longest interval in which a joint stands still: measured, or else commanded."""
    channel = recording.channels.get("position")
    if channel is not None and joint in channel.columns:
        i = channel.columns.index(joint)
        seen = channel.mask[..., i].any(axis=0)
        values = np.where(channel.mask[..., i], channel.values[..., i], np.nan)[:, seen]
        return _still(channel.time[seen], np.nanmean(values, axis=0), max(STILL_WITHIN, 4.0 * _noise(recording, joint)))
    columns = [c for u, c in command_columns(scene, recording).items() if scene.command_names[u] == joint]
    if not columns:
        return 0.0, 0.0
    command = recording.command[:, columns[0]]
    return _still(recording.time, command, 1e-6 + 1e-3 * float(np.ptp(command)))


def _still(time: np.ndarray, path: np.ndarray, within: float) -> tuple[float, float]:
    """Start and end, s, of the longest part of a path [K] whose span is at most `within`.

    A sliding window with monotonic queues of its minima and maxima.
    """
    best, first = (0.0, 0.0), 0
    lows, highs = (
        list[int](),
        list[int](),
    )  # rows of increasing and of decreasing values: the first is the window's minimum, maximum
    for last, value in enumerate(path):
        while lows and path[lows[-1]] >= value:
            lows.pop()
        while highs and path[highs[-1]] <= value:
            highs.pop()
        lows.append(last)
        highs.append(last)
        while path[highs[0]] - path[lows[0]] > within:
            first += 1
            if lows[0] < first:
                lows.pop(0)
            if highs[0] < first:
                highs.pop(0)
        if time[last] - time[first] > best[1] - best[0]:
            best = (float(time[first]), float(time[last]))
    return best


def _left_to_friction(
    scene: Scene, model: mujoco.MjModel, recording: Recording, joint: str, qpos0: np.ndarray, at: float
) -> float:
    """Load on a joint's friction at a time in s, N m or N: weight and springs minus the motor's torque."""
    data, dof = mujoco.MjData(model), scene.dof(joint)
    data.qpos[:] = qpos0
    for name, place in zip(scene.single_joints, map(scene.qpos, scene.single_joints), strict=True):
        if (value := _measured_at(recording, "position", name, at)) is not None:
            data.qpos[place] = value
    for actuator, column in command_columns(scene, recording).items():
        data.ctrl[actuator] = np.interp(at, recording.time, recording.command[:, column])
        name = scene.command_names[actuator]
        if _measured_at(recording, "position", name, at) is None and name in _position_servos(scene, model):
            data.qpos[scene.qpos(name)] = data.ctrl[actuator] / model.actuator_gear[actuator, 0]
    mujoco.mj_forward(model, data)
    motor = float(data.qfrc_actuator[dof])
    if recording.torque.side is TorqueSide.MOTOR:
        measured = _measured_at(recording, "torque", joint, at)
        if measured is not None:
            share = float(weight_share(model, np.array([dof]), recording.torque.gravity)[0])
            motor = measured - share * float(data.qfrc_gravcomp[dof])
    return float(data.qfrc_bias[dof] - data.qfrc_passive[dof]) - motor


def _measured_at(recording: Recording, name: str, joint: str, at: float) -> float | None:
    """Mean of a joint's channel over repeats and a tenth of a second around a time in s; None if not measured."""
    channel = recording.channels.get(name)
    if channel is None or joint not in channel.columns:
        return None
    i = channel.columns.index(joint)
    near = np.abs(channel.time - at) <= max(0.05, 2.0 * float(np.median(np.diff(channel.time))))
    values = channel.values[:, near, i][channel.mask[:, near, i]]
    return float(values.mean()) if values.size else None


def _position_servos(scene: Scene, model: mujoco.MjModel) -> set[str]:
    kp, position_gain = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1]
    return {scene.command_names[u] for u in np.flatnonzero((kp != 0) & (position_gain == -kp) & scene.of_joint)}


def _stiffness(scene: Scene, model: mujoco.MjModel, joint: str) -> float:
    """Stiffness of actuators and springs at a joint, N m/rad or N/m."""
    index = scene.id("joint", joint)
    mine = scene.of_joint & (model.actuator_trnid[:, 0] == index)
    servos = -model.actuator_biasprm[mine, 1] * model.actuator_gear[mine, 0] ** 2
    return float(model.jnt_stiffness[index] + servos.sum())


def _seen_from(scene: Scene, recording: Recording, joint: str) -> float:
    """Smallest creep, rad or m, that exceeds the position's noise and the tracking error of a joint."""
    channel = recording.channels.get("position")
    if channel is None or joint not in channel.columns:
        return LEAST_CREEP
    i = channel.columns.index(joint)
    tracking = 0.0
    for actuator, column in command_columns(scene, recording).items():
        if scene.command_names[actuator] == joint and joint in _position_servos(scene, scene.model):
            sent = np.interp(channel.time, recording.time, recording.command[:, column])
            error = channel.values[..., i] - sent / scene.model.actuator_gear[actuator, 0]
            tracking = float(np.sqrt(np.mean(error[channel.mask[..., i]] ** 2)))
    return max(LEAST_CREEP, NOISE_FACTOR * _noise(recording, joint), TRACKING_SHARE * tracking)


def _noise(recording: Recording, joint: str) -> float:
    """Noise deviation of a joint's measured position, rad or m, from its second differences."""
    channel = recording.channels["position"]
    i = channel.columns.index(joint)
    second = np.diff(np.where(channel.mask[..., i], channel.values[..., i], np.nan), n=2, axis=1)
    spread = np.nanmedian(np.abs(second)) if np.isfinite(second).any() else 0.0
    return float(1.4826 * spread / np.sqrt(6.0))  # of white noise
