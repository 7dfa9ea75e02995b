"""The replays in plain C MuJoCo: the same inputs and outputs as those in MJX.

They are the reference of the parity tests, the CPU benchmark, and the engine of `--engine mujoco`.  They support
effects that write model fields, profiles of servos (`Effect.profile`) and torque offsets.  Other effects need MJX.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import MOVING, Effect, Rollout, complete, has_law
from droid_jax.model.parameters import Role, Space
from droid_jax.model.physics import make_c_model, theta_of
from droid_jax.model.scene import Scene
from droid_jax.recordings.clocks import interpolate
from droid_jax.recordings.recording import TorqueConvention, TorqueSide
from droid_jax.simulate.c_engine import instrument, simulate
from droid_jax.simulate.effect_laws import profiled
from droid_jax.simulate.initial_state import weight_share
from droid_jax.simulate.inverse_dynamics import Path, PathTorques
from droid_jax.simulate.replay import Drive, check_stateless
from droid_jax.simulate.servo_gains import check_gains, scale_gains, servo_factors

NOT_IN_C = tuple(law for law in (*MOVING, "observe") if law != "profile")  # laws that a servo replay in C lacks
CHUNK = 64  # samples whose full states are in memory at once


def c_replay(
    scene: Scene, space: Space, drive: Drive, effects: Sequence[Effect] = (), *, late: float = 0.5
) -> Callable[[np.ndarray], Rollout]:
    """A batch of servo replays in plain C: values [P, D] -> Rollout with a leading [P], float64, on all cores.

    Args:
        scene: what is simulated.
        space: meaning of the values [D].
        drive: the commands.
        effects: in the replay.
        late: steps by which commands are delayed, and by which positions and velocities are extrapolated.  Half a step
            removes most of the first-order error of C's integrators.  0 gives what mj_step itself logs.

    Returns:
        The batch, a function of the values.

    Raises:
        ValueError: plain C cannot replay this (`why_not_in_c`).
    """
    check_gains(scene, drive)
    check_stateless(scene)
    if why := why_not_in_c(scene, space, drive.torque, effects):
        raise ValueError(f"the C engine cannot replay this: {why}; use MJX")
    plain, factors = _instrumented(scene), servo_factors(scene, drive)
    sent_by = _profiles(drive, effects)

    def piece(values: np.ndarray) -> Rollout:
        models = _models(plain, space, values.tobytes(), len(values))
        if (factors != 1.0).any():
            models = [scale_gains(copy.copy(model), factors) for model in models]
        thetas = [theta_of(space, row.tolist()) for row in values]
        sent = sent_by(thetas)
        control = np.stack(
            [
                control_of(drive, table, t.get(Role.TIME_OFFSET.value, 0.0), late)
                for t, table in zip(thetas, sent, strict=True)
            ]
        )
        trace = simulate(plain, models, drive.qpos0[None], control)
        traces = (trace.torque, trace.position, trace.velocity, trace.object_angle[..., None])
        ahead = late * drive.timestep
        return Rollout(
            time=np.broadcast_to(drive.time, trace.object_angle.shape),
            torque=trace.torque + _offsets(scene, thetas)[:, None],
            position=trace.position + ahead * trace.velocity,
            velocity=_later(trace.velocity, late),
            object_angle=trace.object_angle + ahead * trace.object_velocity,
            contact=trace.contact,
            finite=np.all([np.isfinite(t).all(axis=(1, 2)) for t in traces], axis=0),
        )

    def replay(values: np.ndarray) -> Rollout:
        values = np.atleast_2d(np.asarray(values, dtype=np.float64))
        rows, again = np.unique(values, axis=0, return_inverse=True)  # blocks are padded with copies of a row
        pieces = [piece(rows[i : i + CHUNK]) for i in range(0, len(rows), CHUNK)]
        fields = Rollout.__dataclass_fields__
        return Rollout(**{f: np.concatenate([getattr(p, f) for p in pieces])[again.ravel()] for f in fields})

    return replay


@functools.lru_cache(maxsize=8)
def _instrumented(scene: Scene) -> Scene:
    """The scene with sensors, the same for all recordings."""
    return replace(scene, model=instrument(scene))


@functools.lru_cache(maxsize=1)
def _models(plain: Scene, space: Space, rows: bytes, count: int) -> Sequence[mujoco.MjModel]:
    """The models of `count` rows of values (float64).  The recordings of a cost are replayed with the same rows."""
    return [make_c_model(plain, space, row) for row in np.frombuffer(rows).reshape(count, -1)]


def why_not_in_c(scene: Scene, space: Space, torque: TorqueConvention, effects: Sequence[Effect]) -> str:
    """Why plain C cannot replay a commanded recording; empty if it can.

    MuJoCo's batch interface returns the torques of the actuators only, and cannot call functions of effects.

    Args:
        scene: what is simulated.
        space: the parameters.
        torque: the torque convention of the recording.
        effects: in the replay, without those of the torque offsets.
    """
    if active := [e.name for e in effects if has_law(e, NOT_IN_C)]:
        return f"effects depend on the state: {', '.join(active)}"
    if sensed := space.of_role(Role.VISCOUS, Role.COULOMB, Role.TORQUE_GAIN):
        return f"C does not have {', '.join(p.name for p in sensed)}"
    weight = scene.model.body_gravcomp.any() and weight_share(scene.model, scene.joint_dofs, torque.gravity).any()
    if torque.side is TorqueSide.LINK or weight:
        return "it gives actuator torques: motor-side, and without the gravity that the scene compensates"
    if scene.model.body_gravcomp.any() and any(w.field == "qpos0" for p in space.parameters for w in p.writes):
        return "it compensates gravity at the true joint positions, not at those that encoders read"
    return ""


def c_path_torques(
    scene: Scene, space: Space, convention: TorqueConvention, joints: Sequence[str]
) -> Callable[[np.ndarray, Path], PathTorques]:
    """A batch of inverse dynamics in plain C: values [P, D], path -> torques of the scene's joints [P, T, J], float64.

    The equation is that of `path_replay`.  Rows that differ in sensor parameters only share one computation.
    """
    dofs, positions = [scene.dof(j) for j in joints], [scene.qpos(j) for j in joints]
    motor, of_joints = convention.side is TorqueSide.MOTOR, scene.joint_dofs
    columns = [i for i, p in enumerate(space.parameters) if p.writes]
    off = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT

    def of_model(row: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[T, J] torques and inertias of a row of values [D], and [J] its motors' dry friction."""
        model = make_c_model(scene, space, row)
        model.opt.disableflags |= off
        if not motor:
            model.dof_armature[:] = model.dof_damping[:] = 0.0
        if not convention.gravity:
            model.opt.gravity[:] = 0.0
        data, mass = mujoco.MjData(model), np.empty((model.nv, model.nv))
        torques, inertias = np.empty((2, len(path.time), len(of_joints)))
        acceleration = np.zeros(model.nv)
        data.qpos[:] = np.asarray(path.still)
        rows = (np.asarray(a, np.float64) for a in (path.position, path.velocity, path.acceleration))
        for k, (q, v, a) in enumerate(zip(*rows, strict=True)):
            data.qpos[positions], data.qvel[dofs], acceleration[dofs] = q, v, a
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fullM(model, data, mass)
            force = mass @ acceleration + data.qfrc_bias - data.qfrc_spring - data.qfrc_damper
            torques[k], inertias[k] = force[of_joints], np.diagonal(mass)[of_joints]
        loss = model.dof_frictionloss[of_joints] if motor else np.zeros(len(of_joints))
        return torques + loss * np.sign(np.asarray(path.velocity)[:, : len(of_joints)]), inertias, loss

    def torques_of(values: np.ndarray, path: Path) -> PathTorques:
        values = np.atleast_2d(np.asarray(values, np.float64))
        first, again = np.unique(values[:, columns], axis=0, return_index=True, return_inverse=True)[1:]
        computed = [of_model(values[i], path) for i in first]
        torque, inertia, model_loss = (np.stack([c[k] for c in computed])[again.ravel()] for k in range(3))
        sensor_loss = np.array(  # dry friction between the sensor and the link
            [[theta_of(space, row).get(Role.COULOMB.in_theta(j), 0.0) for j in scene.joints] for row in values]
        )
        loss = np.broadcast_to((model_loss + sensor_loss)[:, None], torque.shape)
        return PathTorques(torque, loss, inertia)

    return torques_of


def why_no_path_in_c(space: Space, torque: TorqueConvention, effects: Sequence[Effect]) -> str:
    """Why plain C cannot replay a measured motion; empty if it can.  The arguments are those of `why_not_in_c`."""
    if active := [e.name for e in effects if has_law(e, MOVING)]:
        return f"effects depend on the state: {', '.join(active)}"
    if not torque.gravity and any(w.field == "qpos0" for p in space.parameters for w in p.writes):
        return "the robot subtracted gravity at the positions that encoders read, not at the true ones"
    return ""


def _later(velocity: np.ndarray, late: float) -> np.ndarray:
    """[P, T, J] velocities `late` steps later, the last one extrapolated: C's are half a step behind its positions."""
    after = np.concatenate([velocity[:, 1:], 2 * velocity[:, -1:] - velocity[:, -2:-1]], axis=1)
    return velocity + late * (after - velocity)


def control_of(
    drive: Drive, command: np.ndarray | None = None, time_offset: float = 0.0, late: float = 0.5
) -> np.ndarray:
    """[T, U] the drive's command (or the given one), delayed by `late` steps and by the time offset [s]."""
    at = drive.time - late * drive.timestep - time_offset
    return interpolate(at, drive.time, drive.command if command is None else command)


def _profiles(drive: Drive, effects: Sequence[Effect]) -> Callable[[Sequence[dict[str, float]]], Sequence[np.ndarray]]:
    """A function of P samples' parameters: the commands [T, U] after the servos' profiles (`Effect.profile`)."""
    profiles = [e for e in effects if e.profile is not None]
    if not profiles:
        return lambda thetas: [np.asarray(drive.command)] * len(thetas)
    table = jnp.asarray(drive.command, jnp.float32)
    each = jax.jit(jax.vmap(lambda theta: profiled(table, drive.timestep, complete(theta, profiles), profiles)))
    read = {p.name for e in profiles for p in e.parameters}

    def sent(thetas: Sequence[dict[str, float]]) -> Sequence[np.ndarray]:
        padded = [*thetas, *[thetas[-1]] * (-len(thetas) % CHUNK)]  # one number of samples compiles once
        given = {name: jnp.array([t[name] for t in padded]) for name in read if name in padded[0]}
        if not given:
            return [np.asarray(drive.command)] * len(thetas)
        return list(np.asarray(each(given), np.float64)[: len(thetas)])

    return sent


def _offsets(scene: Scene, thetas: Sequence[dict[str, float]]) -> np.ndarray:
    """[P, J] N m constant torque-sensor errors."""
    return np.array([[t.get(Role.TORQUE_OFFSET.in_theta(j), 0.0) for j in scene.joints] for t in thetas])
