"""Replay the commands of a recording in simulation: servos, contacts and sensors in a loop over time steps.

`servo_replay` follows the recorded command, as the paper does.  `simulate.inverse_dynamics` replays recordings without
commands.  Both give a function Physics -> Rollout of one sample, of which `simulate.batching` makes a compiled,
sharded batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.arguments import lists_of_numbers
from droid_jax.model.actuators import has_servo_damping
from droid_jax.model.effect_interface import Effect, Rollout, Theta, column, complete
from droid_jax.model.encoders import encoder_error, misplaced_compensation
from droid_jax.model.mjx_internals import Contacts, constraint_rows, contacts
from droid_jax.model.parameters import Role
from droid_jax.model.physics import Physics
from droid_jax.model.scene import Scene
from droid_jax.model.step import servo_force
from droid_jax.model.unsupported_features import check_options
from droid_jax.quiet import mjx
from droid_jax.recordings.checks import check_joints
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.runtime import first_device
from droid_jax.simulate.batching import time_loop
from droid_jax.simulate.closed_loops import refuse_floating
from droid_jax.simulate.effect_laws import (
    Moving,
    apply_sensor_model,
    compose,
    held_gears,
    profiled,
    step_with_effects,
)
from droid_jax.simulate.initial_state import (
    DEFAULT_START,
    StartConfig,
    check_weight,
    holding_controls,
    start_pose,
    weight_share,
)
from droid_jax.simulate.servo_gains import check_gains, servo_factors, stated_gains, with_gains

Replay = Callable[[Physics], Rollout]
TORQUE_OFFSETS = "torque offset"  # name of the effect that adds them, in every replay in MJX


@dataclass(frozen=True, eq=False)
class Drive:
    """A recording's command on the simulation's clock.

    Attributes:
        command: [T, U] rad or m, in the scene's actuator order, at times k * timestep.
        qpos0: [nq] start pose, rad and m.
        timestep: s.
        torque: convention of the measured torque.
        stiffness, damping: [U] servo gains stated by the recording, N m/rad and N m s/rad; None: the scene's.
        sent: [U] bool, actuators that the recording commands, the others hold their start; None: all.
        known: parameter -> its value in this recording, or the parameter that replaces it; it overrides the fitted
            vector (`Recording.known`).
        variant: numbers of the scene that it was made for (`Recording.variant`).
    """

    command: np.ndarray
    qpos0: np.ndarray
    timestep: float
    torque: TorqueConvention
    stiffness: np.ndarray | None = None
    damping: np.ndarray | None = None
    sent: np.ndarray | None = None
    known: Mapping[str, float | str] = field(default_factory=dict[str, float | str])
    variant: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])

    @property
    def time(self) -> np.ndarray:
        """[T] s, from 0."""
        return np.arange(len(self.command)) * self.timestep


def end_on(recording: Recording, timestep: float) -> float:
    """s from the recording's first command to the last time step that its commands cover."""
    return timestep * float(np.floor((recording.time[-1] - recording.time[0]) / timestep + 1e-6))


def replayed_torque(recording: Recording) -> TorqueConvention:
    """The convention of the torques of a replay: the recording's; that of any actuator if none were measured."""
    return recording.torque if "torque" in recording.channels else TorqueConvention(TorqueSide.MOTOR, gravity=False)


def make_drive(scene: Scene, recording: Recording, *, weigh: bool = True, config: StartConfig = DEFAULT_START) -> Drive:
    """Resample a recording's command onto the simulation's clock, in the order of the scene's actuators.

    Args:
        scene: to be driven.
        recording: with commands.
        weigh: whether to check the gravity convention of its torques (`check_weight`); False if no torque is compared.
        config: thresholds of the start.

    Returns:
        The drive.

    Raises:
        ValueError: the recording has no commands, its joints or its gravity convention do not fit the scene, or the
            start of a joint is unknown (see `start_pose`).
    """
    if recording.command.size == 0:
        raise ValueError(
            f"recording {recording.name!r} holds no commands, so its servo cannot be replayed, only its "
            "measured motion (`simulate.inverse_dynamics`)"
        )
    _check_driven(scene, recording)
    columns = scene.command_index(recording.command_names)
    check_joints(recording, scene.needs_command, also=(*scene.command_names, *scene.single_joints))
    timestep = float(scene.model.opt.timestep)
    steps = round(end_on(recording, timestep) / timestep) + 1
    clock = float(recording.time[0]) + np.arange(steps) * timestep
    qpos0 = start_pose(scene, recording, config)
    held = holding_controls(scene, qpos0)
    refuse_floating(scene, recording, qpos0, held)
    command = np.tile(held, (steps, 1))
    sent = np.flatnonzero(columns >= 0)
    if sent.size:
        command[:, sent] = interpolate(clock, recording.time, recording.command[:, columns[sent]])
    stiffness, damping = stated_gains(scene, recording) or (None, None)
    if weigh:
        check_weight(scene, recording, qpos0)
    return Drive(
        command=command,
        qpos0=qpos0,
        timestep=timestep,
        torque=replayed_torque(recording),
        stiffness=stiffness,
        damping=damping,
        sent=columns >= 0,
        known=dict(recording.known),
        variant=lists_of_numbers(recording.variant),
    )


def _check_driven(scene: Scene, recording: Recording) -> None:
    """Raise ValueError if a commanded joint of the scene has no actuator."""
    joints = {scene.model.joint(i).name for i in range(scene.model.njnt)}
    undriven = [j for j in recording.command_names if j in joints and j not in scene.command_names]
    if undriven or not scene.command_names:
        missing = f"actuator for {', '.join(undriven)}" if scene.command_names else "actuators"
        coupled = int(np.sum(scene.model.eq_type == mujoco.mjtEq.mjEQ_JOINT))
        mimic = f"; its {coupled} <mimic> became <equality><joint>" if coupled else ""
        urdf = f" (a URDF has none: save it as MJCF and add them there{mimic})" if not scene.command_names else ""
        raise ValueError(
            f"scene {scene.name!r} has no {missing}, and recording {recording.name!r} holds commands: give each "
            f"commanded joint a <position> servo in the MJCF{urdf}"
        )


def check_stateless(scene: Scene) -> None:
    """Raise ValueError for actuators with an activation state, which the time loop does not carry."""
    if scene.model.na:
        stateful = np.flatnonzero(scene.model.actuator_actnum > 0)
        raise ValueError(
            f"scene {scene.name!r} has actuators with a state (activation), "
            f"{', '.join(scene.command_names[u] for u in stateful)}; a replay needs position servos or motors without "
            "one: remove dyntype or timeconst, and use <velocity> or <position> in place of <intvelocity>, <cylinder> "
            "and <muscle>"
        )


def servo_replay(
    scene: Scene, drive: Drive, effects: Sequence[Effect] = (), *, parity: bool = False, late: float = 0.5
) -> Replay:
    """A replay of one sample: the motion that follows the command (`servo_motion`), then the sensor model.

    Args:
        scene: what is simulated.
        drive: the commands.
        effects: in the replay.
        parity: step exactly as the C engine does (see `droid_jax.model.step`), for comparisons with it.
        late: steps by which commands are delayed if `parity` (see `_command`).

    Returns:
        physics -> Rollout [T, ...].
    """
    motion = servo_motion(scene, drive, effects, parity=parity, late=late)
    inputs = traced_part(scene, drive)

    def replay(physics: Physics) -> Rollout:
        return with_sensor_model(motion(physics, *inputs, len(drive.command)), physics.theta, effects, drive.timestep)

    return replay


def servo_motion(
    scene: Scene,
    drive: Drive,
    effects: Sequence[Effect] = (),
    *,
    parity: bool = False,
    late: float = 0.5,
    earlier: int = 0,
) -> Callable[..., Rollout]:
    """The loop over time steps that follows a command, before the sensor model.

    A torque has the time of the state on which it acts.  The state is position, velocity, the solver's warm start and
    the loads.  Everything else in mjx.Data is computed again in each step, so that XLA removes what is not used.

    Args:
        scene: what is simulated.
        drive: of which only the time step and the torque convention are used.
        effects: in the replay.
        parity: step exactly as the C engine does.
        late: steps by which commands are delayed if `parity`.
        earlier: commands in front of the first step, to which delays reach back in a replay that begins within a
            motion.

    Returns:
        (physics, *`traced_part` of a drive, steps, speed, origin) -> Rollout [T, ...].  speed: [nv] initial velocity;
        None: 0.  origin: s, time of the first row, for laws that depend on time; None: 0.  Rows from `steps` on are
        zero, so that recordings of different lengths share one program; their commands repeat the last one.
    """
    check_options(scene.model, parity, f"a replay of scene {scene.name!r}")
    check_gains(scene, drive)
    check_stateless(scene)
    template = mjx.make_data(scene.mjx, device=first_device())
    fingers = finger_geoms(scene)
    joints, positions = scene.joint_dofs, scene.joint_qpos
    hinge = scene.qpos(scene.object_joint) if scene.object_joint else None
    hinge_speed = scene.dof(scene.object_joint) if scene.object_joint else None
    shift = late if parity else 0.0  # steps by which commands are delayed and positions extrapolated
    half = late if parity else 0.5  # steps from the velocity before a step to the reported one
    damping = has_servo_damping(scene.model)

    def step(sample: Any, k: jax.Array, carry: Any) -> Any:
        model, theta, error, table, origin = sample
        moving, traces = carry
        time, qpos, qvel = k * drive.timestep, moving.qpos, moving.qvel
        state = moving.state(time if origin is None else origin + time, model)
        row = k + earlier if earlier else k
        command = _command(table, drive.timestep, row, shift, theta, effects)
        after, following, used, push, reading = step_with_effects(
            template, model, theta, state, moving, command, effects, error=error, parity=parity, servo_damping=damping
        )
        mean = 0.5 * (qvel + after.qvel)
        servo = servo_force(used, after, mean) if damping and not parity else after.qfrc_actuator
        torque = _joint_torque(used, qvel, after, servo, joints, drive, parity)
        if push is not None and reading is not None:
            torque = torque + (reading[2] if drive.torque.side is TorqueSide.MOTOR else push)[joints]
        astray = misplaced_compensation(model, after, error)
        if astray is not None and drive.torque.gravity:  # such a torque contains the gravity compensation
            torque = torque + astray[joints]
        position = qpos[positions] + shift * drive.timestep * qvel[joints]
        velocity = (qvel + half * (after.qvel - qvel))[joints]
        now = (
            torque,
            position if reading is None else position + reading[0, joints],
            velocity if reading is None else velocity + reading[1, joints],
            qpos[hinge] + shift * drive.timestep * qvel[hinge_speed] if hinge is not None else jnp.zeros(()),
            _touching(after, fingers),
        )
        traces = tuple(jax.lax.dynamic_update_index_in_dim(a, b, k, 0) for a, b in zip(traces, now, strict=True))
        return following, traces

    def motion(
        physics: Physics,
        table: jax.Array,
        start: jax.Array,
        gains: jax.Array,
        steps: Any,
        speed: jax.Array | None = None,
        origin: jax.Array | None = None,
    ) -> Rollout:
        model, theta, rows = with_gains(physics.model, gains), complete(physics.theta, effects), len(table) - earlier
        sent = profiled(table, drive.timestep, theta, effects)
        sample = model, theta, encoder_error(scene, model), sent, origin
        moving = Moving.at(start, jnp.zeros(scene.model.nv, jnp.float32) if speed is None else speed)
        if any(effect.gear or effect.twist for effect in effects):
            given = _command(sent, drive.timestep, jnp.int32(earlier), shift, theta, effects)
            state = moving.state(jnp.float32(0.0) if origin is None else origin, model)
            motors, ahead = held_gears(given, theta, state, effects)  # the recorded position is the encoder's
            moving = moving._replace(motors=motors, qpos=start.at[positions].add(-ahead[joints]))
        traces = jnp.zeros((3, rows, len(joints)), jnp.float32)
        angle, contact = jnp.zeros(rows, jnp.float32), jnp.zeros((rows, len(fingers)), bool)
        first = moving, (*traces, angle, contact)
        _, (torque, position, velocity, angle, contact) = time_loop(step, sample, first, steps)
        time = jnp.zeros(rows, jnp.float32)
        return Rollout(time, torque, position, velocity, angle, contact, jnp.array(True))

    return motion


def with_sensor_model(
    motion: Rollout,
    theta: Theta,
    effects: Sequence[Effect],
    timestep: float,
    steps: int | None = None,
    origin: jax.Array | None = None,
) -> Rollout:
    """The sensor model of a motion's first `steps` rows (None: all), and whether they are finite.

    origin: s, time of the first row; None: 0.
    """
    rows = len(motion.time) if steps is None else steps
    cut = jax.tree.map(lambda a: a[:rows] if a.ndim else a, motion)
    time = jnp.asarray(np.arange(rows) * timestep, jnp.float32)
    time = time if origin is None else origin + time
    return apply_sensor_model(replace(cut, time=time), complete(theta, effects), effects)


def traced_part(scene: Scene, drive: Drive) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The arrays of a drive that are inputs of a program: command [T, U], start [nq], factors on gains [U, 2]."""
    parts = (drive.command, drive.qpos0, servo_factors(scene, drive))
    command, start, gains = (jnp.asarray(part, jnp.float32) for part in parts)
    return command, start, gains


def _command(
    table: jax.Array, timestep: float, k: jax.Array, late: float, theta: Theta, effects: Sequence[Effect]
) -> jax.Array:
    """[U] the command of step k, delayed by `late` steps and by `time_offset` of theta [s].

    C MuJoCo's implicitfast damps with a velocity half a step ahead of the position from which it computes torques.  A
    delay of half a step removes most of that first-order error.  The second-order step of this replay needs none.
    """
    last = table.shape[0] - 1

    def at_time(time: jax.Array) -> jax.Array:
        at = jnp.clip(time / timestep, 0.0, float(last))
        low = jnp.minimum(at.astype(jnp.int32), last - 1)
        part = at - low
        return table[low] * (1 - part) + table[low + 1] * part

    # The delay is in steps: times in seconds, added up in float32, lose a fifth of a step in ten seconds.
    delay = late + jnp.asarray(theta.get(Role.TIME_OFFSET.value, 0.0), jnp.float32) / timestep
    steps = jnp.floor(delay)
    low = jnp.clip(k - steps.astype(jnp.int32) - 1, 0, last)
    high = jnp.clip(k - steps.astype(jnp.int32), 0, last)
    part = delay - steps
    ctrl = table[high] * (1 - part) + table[low] * part
    laws = [effect.command for effect in effects if effect.command is not None]
    for law in laws:  # each law gets the command as changed by the law before it
        at_time = compose(law, theta, at_time)
    return at_time((k - delay) * timestep) if laws else ctrl


def torque_offset_effect(joints: Sequence[str]) -> Effect:
    """The effect of constant torque-sensor errors, `torque_offset[joint]` of theta, N m; 0 if theta lacks it."""

    def observe(theta: Theta, rollout: Rollout) -> Rollout:
        return replace(rollout, torque=rollout.torque + column(theta, Role.TORQUE_OFFSET.value, joints))

    return Effect(TORQUE_OFFSETS, observe=observe)


def _joint_torque(
    model, before: jax.Array, after, servo: jax.Array, joints: np.ndarray, drive: Drive, parity: bool
) -> jax.Array:
    """[J] N m, torque on the side of the drive's convention: the motor's, or the one that reaches the link.

    The link side excludes rotor inertia (armature) and the damping and dry friction of the joint, as the step
    integrated them: with the velocity's difference over the step, and its mean (in the C engine its end).

    before: [nv] velocity before the step.  servo: [nv] N m, the actuators' forces in it.
    """
    torque = servo[joints]
    if drive.torque.side is TorqueSide.LINK:
        gain = (after.qvel - before)[joints]
        velocity = after.qvel[joints] - (0.0 if parity else 0.5) * gain
        torque = torque - model.dof_armature[joints] * gain / drive.timestep - model.dof_damping[joints] * velocity
        rows = constraint_rows(after)
        dry = slice(rows.equalities, rows.equalities + rows.frictions)
        torque = torque + (rows.jacobian[dry].T @ rows.force[dry])[joints]
    share = weight_share(model, joints, drive.torque.gravity)
    return torque + share * after.qfrc_gravcomp[joints] if share.any() else torque


def finger_geoms(scene: Scene) -> tuple[np.ndarray, ...]:
    """For each finger, [pairs, 2] sorted geom ids of its contact pairs."""
    both = np.sort(np.stack([scene.model.pair_geom1, scene.model.pair_geom2], axis=1), axis=1)
    return tuple(both[pairs] for pairs in scene.finger_pairs)


def of_fingers(found: Contacts, fingers: Sequence[np.ndarray]) -> list[jax.Array]:
    """For each finger, [contacts] bool: the MJX contacts that belong to its pairs (`finger_geoms`)."""
    geoms = jnp.sort(found.geoms, axis=1)  # [contacts, 2]
    return [jnp.any(jnp.all(geoms[:, None] == pairs[None], axis=-1), axis=1) for pairs in fingers]


def _touching(data, fingers: Sequence[np.ndarray]) -> jax.Array:
    """[F] bool: whether a contact of a finger's pairs penetrates."""
    if not fingers:
        return jnp.zeros((0,), bool)
    found = contacts(data)
    return jnp.stack([jnp.any(of_finger & (found.distance < 0)) for of_finger in of_fingers(found, fingers)])
