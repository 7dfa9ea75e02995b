"""The signals of a recording on one clock, and the torques that the scene's nominal values predict for them.

The checks of `check_log` use them.  Everything runs in plain C MuJoCo and numpy, in a fraction of a second.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import scipy

from droid_jax.model.actuators import has_feedback
from droid_jax.model.scene import Scene
from droid_jax.recordings.recording import Channel, Recording, TorqueSide
from droid_jax.simulate.initial_state import commanded_positions, holding_controls, weight_share

CUTOFF = 5.0  # Hz, low-pass of all signals: joints of robots move below it, and positions are differentiated twice
RATE = 100.0  # Hz, highest rate of the common clock
FEWEST_ROWS = 40  # rows of the common clock below which a signal is not checked
MOST_ROWS = 1500  # most rows of a motion at which inverse dynamics is computed
EDGE_SECONDS = 0.1  # s left out at both ends of a motion, where the filter distorts derivatives
SIMULATED_SECONDS = 20.0  # s of the commands that are simulated if no position was measured
LEAST_MEASURED = 0.5  # share of a column's rows that must be measured

Traces = Mapping[str, np.ndarray]  # joint -> [K]


@dataclass(frozen=True, eq=False)
class LogMotion:
    """Means of the repeats on one regular clock, low-passed at CUTOFF.

    time: [K] s.  command: target of each position servo, rad (m).  position: measured, rad (m).  torque: measured,
    N m (N); each of them joint -> [K].  rows: most rows at which inverse dynamics is computed.
    """

    time: np.ndarray
    command: Traces
    position: Traces
    torque: Traces
    rows: int = MOST_ROWS

    @property
    def step(self) -> float:
        """s between rows."""
        return float(self.time[1] - self.time[0])

    def rate_of(self, trace: np.ndarray) -> np.ndarray:
        """[K] derivative of a trace [K] over time."""
        return np.gradient(trace, self.step)

    @property
    def inner(self) -> slice:
        """Rows away from both ends, where derivatives are accurate; at most `rows` of them."""
        edge = max(2, round(EDGE_SECONDS / self.step))
        return slice(edge, len(self.time) - edge, max(1, (len(self.time) - 2 * edge) // self.rows))

    def scaled(self, factor: float) -> LogMotion:
        """The same motion with positions and commands times `factor`."""
        return replace(
            self,
            command={j: factor * x for j, x in self.command.items()},
            position={j: factor * x for j, x in self.position.items()},
        )

    def turned(self, joint: str) -> LogMotion:
        """The same motion with a joint's position negated."""
        return replace(self, position={j: -x if j == joint else x for j, x in self.position.items()})

    def renamed(self, names: Mapping[str, str]) -> LogMotion:
        """The same motion with joints renamed in all signals; names: old name -> new name, of joints that change."""

        def exchanged(traces: Traces) -> dict[str, np.ndarray]:
            return {names.get(joint, joint): x for joint, x in traces.items()}

        command, position, torque = map(exchanged, (self.command, self.position, self.torque))
        return replace(self, command=command, position=position, torque=torque)


def log_motion(scene: Scene, recording: Recording) -> LogMotion | None:
    """The recording's signals of the scene's joints on one clock.

    Returns None if the recording is too short or too sparse, or lacks commands that the scene needs (which the replay
    reports).
    """
    if _commands(recording) and not set(scene.needs_command) <= set(recording.command_names):
        return None
    channels = {name: recording.channels[name] for name in ("torque", "position") if name in recording.channels}
    sent = (
        {j: q for j, q in commanded_positions(scene, recording).items() if j in scene.single_joints}
        if _commands(recording)
        else {}
    )
    clocks = [c.time for c in channels.values()] + ([recording.time] if sent else [])
    if not channels or min(len(clock) for clock in clocks) < 2:
        return None
    first, last = max(float(c[0]) for c in clocks), min(float(c[-1]) for c in clocks)
    rate = min(RATE, *(1.0 / float(np.median(np.diff(c.time))) for c in channels.values()))
    count = int((last - first) * rate) + 1
    if last <= first or count < FEWEST_ROWS:
        return None
    time = first + np.arange(count) / rate
    filtered = scipy.signal.butter(2, min(CUTOFF, rate / 5.0), fs=rate, output="sos")

    def smooth(trace: np.ndarray) -> np.ndarray:
        return scipy.signal.sosfiltfilt(filtered, trace)

    measured = {
        name: {j: smooth(x) for j, x in _means(channel, time, scene.single_joints).items()}
        for name, channel in channels.items()
    }
    command = {joint: smooth(np.interp(time, recording.time, path)) for joint, path in sent.items()}
    return LogMotion(time, command, measured.get("position", {}), measured.get("torque", {}))


def _commands(recording: Recording) -> bool:
    return recording.command.size > 0


def _means(channel: Channel, time: np.ndarray, joints: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Joint -> [K] mean over the repeats in which at least LEAST_MEASURED of its rows are measured."""
    found = {}
    for c, joint in enumerate(channel.columns):
        seen = channel.mask[:, :, c]
        traces = [
            np.interp(time, channel.time[mask], values[mask].astype(float))
            for mask, values in zip(seen, channel.values[:, :, c], strict=True)
            if mask.mean() > LEAST_MEASURED
        ]
        if joint in joints and traces:
            found[joint] = np.mean(traces, axis=0)
    return found


@dataclass(frozen=True, eq=False)
class Expected:
    """Torques of one joint along the measured motion, at the scene's nominal values, [K] N m (N) each.

    weight: gravity compensation.  inertial: inertia, Coriolis terms and springs.  velocity, acceleration: of the joint,
    rad/s (m/s) and rad/s^2 (m/s^2).
    """

    weight: np.ndarray
    inertial: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


def rigid_body(scene: Scene, recording: Recording, motion: LogMotion) -> dict[str, Expected]:
    """Joint -> expected torques at the rows `motion.inner`, by inverse dynamics of the measured positions.

    Empty if a measured joint of the scene has no measured position, or the joints move on a free base: the motion is
    then unknown.
    """
    moving = [j for j in motion.position if j in scene.single_joints]
    if not scene.joints or any(j not in moving for j in scene.joints) or scene.floating(scene.joints):
        return {}
    model, data, rows = scene.model, mujoco.MjData(scene.model), motion.inner
    paths = {scene.qpos(j): motion.position[j] for j in moving}
    paths |= {scene.qpos(j): q for j, q in motion.command.items() if j not in moving}
    qpos = np.tile(_pose(scene, recording), (len(motion.time), 1))
    qvel, qacc = np.zeros((2, len(motion.time), model.nv))
    dofs = {scene.qpos(j): scene.dof(j) for j in scene.single_joints}
    for address, path in paths.items():
        qpos[:, address] = path
        qvel[:, dofs[address]] = motion.rate_of(path)
        qacc[:, dofs[address]] = motion.rate_of(motion.rate_of(path))
    link = recording.torque.side is TorqueSide.LINK
    found, mass_times = [], np.zeros(model.nv)
    for q, v, a in zip(qpos[rows], qvel[rows], qacc[rows], strict=True):
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        weight = data.qfrc_bias.copy()
        data.qvel[:] = v
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_mulM(model, data, mass_times, a)
        inertial = mass_times + data.qfrc_bias - weight - data.qfrc_spring
        found.append((weight, inertial - (model.dof_armature * a if link else 0.0), v, a))
    if not found:
        return {}
    weight, inertial, velocity, acceleration = (np.array(part) for part in zip(*found, strict=True))
    return {
        j: Expected(*(part[:, scene.dof(j)] for part in (weight, inertial, velocity, acceleration)))
        for j in motion.torque
        if j in scene.joints
    }


def _pose(scene: Scene, recording: Recording) -> np.ndarray:
    """[nq] the scene's pose with the initial positions that the recording states."""
    return scene.initial_qpos({j: q for j, q in recording.qpos0.items() if j in scene.single_joints})


def servo_torque(scene: Scene, motion: LogMotion, joint: str, late: float) -> np.ndarray:
    """[K] N m (N), torque of a joint's position servo along the measured motion, for a command delay of `late` s.

    Force limits are ignored.
    """
    u = scene.command_names.index(joint)
    gear, gain, bias = (
        scene.model.actuator_gear[u, 0], scene.model.actuator_gainprm[u], scene.model.actuator_biasprm[u]
    )  # fmt: skip
    position = motion.position[joint]
    sent = np.interp(motion.time - late, motion.time, motion.command[joint])
    force = gain[0] * gear * (sent - position) + bias[0] + bias[2] * gear * motion.rate_of(position)
    return gear * force


def simulated_torques(scene: Scene, recording: Recording, motion: LogMotion) -> dict[str, np.ndarray]:
    """Joint -> [K] N m (N), actuator torques in a replay of the commands at nominal values; NaN after a divergence.

    Only the first SIMULATED_SECONDS are replayed.  The scene's gravity compensation is added if the recorded torque
    contains the weight.
    """
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = _pose(scene, recording)
    for joint, path in motion.command.items():
        if joint not in recording.qpos0:
            data.qpos[scene.qpos(joint)] = path[0]
    step = float(model.opt.timestep)
    clock = np.arange(motion.time[0], min(motion.time[-1], motion.time[0] + SIMULATED_SECONDS), step)
    control = np.tile(holding_controls(scene, data.qpos.copy()), (len(clock), 1))
    for u in np.flatnonzero(has_feedback(model) & scene.of_joint):
        if scene.command_names[u] in motion.command:
            path = motion.command[scene.command_names[u]]
            control[:, u] = model.actuator_gear[u, 0] * np.interp(clock, motion.time, path)
    share, dofs = weight_share(model, scene.joint_dofs, recording.torque.gravity), scene.joint_dofs
    out = np.full((len(clock), len(dofs)), np.nan)
    for k, now in enumerate(control):
        data.ctrl[:] = now
        mujoco.mj_step(model, data)
        if data.warning.number.any():  # the replay diverged, or ran out of memory
            break
        out[k] = data.qfrc_actuator[dofs] + share * data.qfrc_gravcomp[dofs]
    rows = np.where(motion.time <= clock[-1], np.searchsorted(clock, motion.time), -1)
    return {
        joint: np.where(rows >= 0, out[np.clip(rows, 0, len(clock) - 1), i], np.nan)
        for i, joint in enumerate(scene.joints)
        if joint in motion.torque
    }


def compensated(scene: Scene, recording: Recording, motion: LogMotion) -> dict[str, np.ndarray]:
    """Joint -> [K] N m (N), gravity compensation of the scene (gravcomp) along the motion."""
    model, data = scene.model, mujoco.MjData(scene.model)
    if not model.body_gravcomp.any():
        return {joint: np.zeros(len(motion.time)) for joint in scene.joints}
    known = {scene.qpos(joint): path for joint, path in {**motion.command, **motion.position}.items()}
    rows = np.arange(len(motion.time))[:: max(1, len(motion.time) // MOST_ROWS)]
    start, out = _pose(scene, recording), np.empty((len(rows), len(scene.joints)))
    for i, k in enumerate(rows):
        data.qpos[:] = start
        for address, path in known.items():
            data.qpos[address] = path[k]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        out[i] = data.qfrc_gravcomp[scene.joint_dofs]
    return {joint: np.interp(motion.time, motion.time[rows], out[:, j]) for j, joint in enumerate(scene.joints)}
