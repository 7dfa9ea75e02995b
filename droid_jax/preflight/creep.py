"""How fast a joint that dry friction holds creeps in the simulation, where a real one stands still.

MuJoCo's friction loss is a soft constraint.  Below the loss F its force is -(b / R) v, with the damping b of
`solreffriction` and R = (1 - d) / d times the joint's inverse inertia at qpos0, d being the impedance of
`solimpfriction`: under a load T < F the joint moves at T R / b for as long as it is held.
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

STIFF = "0.9999 0.9999 0.001 0.5 2"  # solimpfriction with which joints hold: a thousandth of the default's creep
HOLDS = 0.5  # s: a joint that stands still for less is turning round
STILL = 2e-3  # rad or m: a joint that stays within it stands still, whatever its encoder's noise
VISIBLE = 5e-4  # rad or m: creep by less than this is below what encoders of robots resolve
BESIDE_NOISE = 3.0  # deviations of the measured position, which creep must exceed to be seen beside it
BESIDE_TRACKING = 0.1  # of the tracking error (root mean square), likewise


@dataclass(frozen=True)
class Creep:
    """A joint that creeps while it is held.

    load: N m or N that friction holds.  speed: rad/s or m/s.  seconds: of the longest hold.  distance: rad or m that
    it moves in that time.  mended: speed with STIFF.
    """

    joint: str
    load: float
    speed: float
    seconds: float
    distance: float
    mended: float


def creep_per_load(model: mujoco.MjModel, dof: int, solimp: np.ndarray | None = None) -> float:
    """rad/s per N m (m/s per N) at which a held degree of freedom creeps; solimp: [5] in place of the model's."""
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
    """The joints that creep visibly in a commanded replay, beside position noise and tracking error.

    What friction holds is what weight, springs and the motor leave: of the measured torque on the motor's side, else of
    the scene's actuators, in the middle of the longest time for which the joint was measured, or sent, to stand still.

    Args:
        scene: of the replay.
        recording: with commands; without any nothing creeps.
        model: the scene's with other numbers, such as fitted ones.
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
        if qpos0 is None or per_load * loss * recording.duration < VISIBLE:
            continue
        begin, end = _longest_hold(scene, recording, joint)
        if end - begin < HOLDS:
            continue
        load = min(loss, abs(_left_to_friction(scene, numbers, recording, joint, qpos0, 0.5 * (begin + end))))
        distance = per_load * load * (end - begin)
        if (stiffness := _stiffness(scene, numbers, joint)) > 0:
            distance = min(distance, load / stiffness)  # a servo that creeps towards its target stops there
        if distance > _seen_from(scene, recording, joint):
            stiff = np.array([float(n) for n in STIFF.split()])
            mended = creep_per_load(numbers, dof, stiff) * load
            found.append(Creep(joint, load, per_load * load, end - begin, distance, mended))
    return found


def creep_note(scene: Scene, recording: Recording, model: mujoco.MjModel | None = None) -> str:
    """What is to be known of joints that creep, or would where the scene holds them (`Scene.held`); else empty."""
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
        "the replay holds them, as the fitted MJCF will (--joint-friction scene replays them as they are)"
        if held
        else f'give these joints solimpfriction="{STIFF}" in the MJCF, else gains, damping and friction of a fit make '
        "up for it"
    )
    return (
        f"joints of scene {scene.name!r} that dry friction holds {creep} {why} with recording {recording.name!r}, "
        f"where real ones stand still, since MuJoCo's friction constraint is soft: {'; '.join(said)}; {do}"
    )


def as_given(scene: Scene) -> mujoco.MjModel:
    """The scene's model with the friction constraints that its MJCF had."""
    model = scene.model.__copy__()
    for joint in scene.held:
        model.dof_solimp[model.dof_jntid == scene.id("joint", joint)] = SOFT_IMPEDANCE
    return model


def _longest_hold(scene: Scene, recording: Recording, joint: str) -> tuple[float, float]:
    """s, the longest time for which a joint was measured to stand still, else was commanded the same."""
    channel = recording.channels.get("position")
    if channel is not None and joint in channel.columns:
        i = channel.columns.index(joint)
        seen = channel.mask[..., i].any(axis=0)
        values = np.where(channel.mask[..., i], channel.values[..., i], np.nan)[:, seen]
        return _still(channel.time[seen], np.nanmean(values, axis=0), max(STILL, 4.0 * _noise(recording, joint)))
    columns = [c for u, c in command_columns(scene, recording).items() if scene.command_names[u] == joint]
    if not columns:
        return 0.0, 0.0
    command = recording.command[:, columns[0]]
    return _still(recording.time, command, 1e-6 + 1e-3 * float(np.ptp(command)))


def _still(time: np.ndarray, path: np.ndarray, within: float) -> tuple[float, float]:
    """s, the longest stretch of a path [K] that stays within so much: two ends that move along it."""
    best, first = (0.0, 0.0), 0
    lows, highs = list[int](), list[int]()  # rows whose values rise, fall: the ends' smallest and largest come first
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
    """N m or N that is left to a joint's friction at a time, s: weight and springs less the motor's torque."""
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
    """What a channel has of a joint about a time, s: the mean over repeats and a tenth of a second; None: nothing."""
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
    """N m/rad or N/m with which actuators and springs draw a joint back."""
    index = scene.id("joint", joint)
    mine = scene.of_joint & (model.actuator_trnid[:, 0] == index)
    servos = -model.actuator_biasprm[mine, 1] * model.actuator_gear[mine, 0] ** 2
    return float(model.jnt_stiffness[index] + servos.sum())


def _seen_from(scene: Scene, recording: Recording, joint: str) -> float:
    """rad or m that a joint must creep to be seen beside its position's noise and its tracking error."""
    channel = recording.channels.get("position")
    if channel is None or joint not in channel.columns:
        return VISIBLE
    i = channel.columns.index(joint)
    tracking = 0.0
    for actuator, column in command_columns(scene, recording).items():
        if scene.command_names[actuator] == joint and joint in _position_servos(scene, scene.model):
            sent = np.interp(channel.time, recording.time, recording.command[:, column])
            error = channel.values[..., i] - sent / scene.model.actuator_gear[actuator, 0]
            tracking = float(np.sqrt(np.mean(error[channel.mask[..., i]] ** 2)))
    return max(VISIBLE, BESIDE_NOISE * _noise(recording, joint), BESIDE_TRACKING * tracking)


def _noise(recording: Recording, joint: str) -> float:
    """rad or m, deviation of a joint's measured position from row to row."""
    channel = recording.channels["position"]
    i = channel.columns.index(joint)
    second = np.diff(np.where(channel.mask[..., i], channel.values[..., i], np.nan), n=2, axis=1)
    spread = np.nanmedian(np.abs(second)) if np.isfinite(second).any() else 0.0
    return float(1.4826 * spread / np.sqrt(6.0))  # of white noise
