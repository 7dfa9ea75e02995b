"""Inverse dynamics along a measured motion, vectorised over time, for recordings without commands."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import STEERING, Effect, Rollout, State, Theta, column, complete, has_law
from droid_jax.model.encoders import encoder_error, misplaced_weight
from droid_jax.model.gravity import field_force
from droid_jax.model.parameters import Role
from droid_jax.model.physics import Physics
from droid_jax.model.scene import Scene
from droid_jax.model.unsupported_features import refuse_fluid
from droid_jax.quiet import mjx
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.runtime import first_device
from droid_jax.simulate.closed_loops import coupled_to_others
from droid_jax.simulate.effect_laws import apply_sensor_model
from droid_jax.simulate.measured_motion import CUTOFF, Motion, measured_throughout


def prescribed_joints(scene: Scene, recording: Recording, cutoff: float = CUTOFF) -> tuple[str, ...]:
    """The joints whose measured motion a replay prescribes: the scene's, then all others measured throughout.

    Only torques of the scene's joints are compared, but other joints that move act on them.  Joints that are not
    measured throughout stand still in their stated position (qpos0), else as in the scene.  A warning names those of
    them that carry a measured joint and are not stated, and those that were measured for a part of the time.

    Args:
        scene: the simulated one.
        recording: without commands.
        cutoff: Hz, of the positions' low-pass; it decides which gaps are bridged.

    Returns:
        Names of joints.

    Raises:
        ValueError: a free or ball joint carries a measured joint, or no positions were measured.
    """
    floating = scene.floating(scene.joints)
    if floating:
        raise ValueError(
            f"recording {recording.name!r} holds no commands, and {', '.join(floating)} of scene {scene.name!r} (a "
            "free or ball joint) carries measured joints: the log does not contain its motion; remove it from the MJCF "
            "if the robot is bolted down"
        )
    if "position" not in recording.channels:
        raise ValueError(
            f"recording {recording.name!r} holds no commands and no measured positions: there is no motion to replay; "
            "read the log with its commands (--command-topic of `convert`) or with positions"
        )
    channel = recording.channel("position")
    throughout = measured_throughout(channel, cutoff)
    others = [j for j in scene.single_joints if j in throughout and j not in scene.joints]
    joints = (*scene.joints, *others)
    if coupled := coupled_to_others(scene, joints):
        warnings.warn(
            f"recording {recording.name!r} holds no commands, so the replay ignores {', '.join(coupled)} of scene "
            f"{scene.name!r} and the joints that it moves: measure the positions of all its joints, or record the "
            "commands",
            stacklevel=3,
        )
    stated = {j for j in recording.qpos0 if j not in channel.columns}  # a measured joint's qpos0 is its start only
    still = [j for j in scene.carriers(scene.joints) if j not in joints and j not in stated]
    if still:
        warnings.warn(
            f"recording {recording.name!r} does not hold the positions of {', '.join(still)} throughout, which carry "
            "measured joints: the replay holds them still as in the scene (state where in qpos0)",
            stacklevel=3,
        )
    measured = dict(zip(channel.columns, np.any(channel.mask, axis=(0, 1)).tolist(), strict=True))
    partly = [j for j in scene.single_joints if measured.get(j) and j not in (*joints, *still)]
    if partly:
        warnings.warn(
            f"recording {recording.name!r} holds the positions of {', '.join(partly)} for a part of the time: the "
            "replay holds them still at their first position; cut the log (`convert --start S --end S`) to follow them",
            stacklevel=3,
        )
    return joints


class Path(NamedTuple):
    """The arrays of a `Motion` in single precision, an input of compiled replays.

    Attributes:
        time: [T] s.
        position, velocity, acceleration: [T, J] rad, rad/s, rad/s^2 (m for slides).
        at_rest: [T, J] bool, samples at rest, whose friction the speed does not determine.
        measured: [T, J] N m (N), measured torque, NaN if there is none.
        torque_slack: [J] N m (N), by which noise of the torque may leave the interval of friction.
        acceleration_slack: [J] rad/s^2 (m/s^2), likewise noise of the acceleration.
        still: [nq] pose, of which joints that are not prescribed keep their positions.
    """

    time: jax.Array
    position: jax.Array
    velocity: jax.Array
    acceleration: jax.Array
    at_rest: jax.Array
    measured: jax.Array
    torque_slack: jax.Array
    acceleration_slack: jax.Array
    still: jax.Array


def motion_path(scene: Scene, motion: Motion) -> Path:
    """The arrays of a motion as input of a compiled replay; ValueError if it states a joint that the scene lacks."""
    rest = motion.velocity == 0.0 if motion.rest is None else motion.rest
    measured = np.full(motion.velocity.shape, np.nan) if motion.measured is None else motion.measured
    given_slacks = [
        np.zeros(motion.velocity.shape[1]) if slack is None else slack
        for slack in (motion.torque_slack, motion.acceleration_slack)
    ]
    arrays = (motion.time, motion.position, motion.velocity, motion.acceleration, measured, *given_slacks)
    time, position, velocity, acceleration, measured, *slacks = (jnp.asarray(a, jnp.float32) for a in arrays)
    still = jnp.asarray(scene.initial_qpos(motion.others), jnp.float32)
    at_rest = jnp.asarray(rest)
    return Path(time, position, velocity, acceleration, at_rest, measured, slacks[0], slacks[1], still)


def path_replay(
    scene: Scene, convention: TorqueConvention, effects: Sequence[Effect] = (), joints: Sequence[str] = ()
) -> Callable[[Physics, Path], Rollout]:
    """Torques of the scene's joints along prescribed motions, vectorised over time.

    tau = M(q) qdd + c(q, qd) - passive forces [+ g(q)] and, on the motor side, + armature qdd + dry friction.

    - Passive forces are springs and dampers of joints and tendons; the joints' damping counts on the motor side only.
      On the link side no term of the motor appears.  Friction and offset of a link-side sensor are observation effects.
    - g(q) appears if the recording's torque convention contains gravity, whatever the MJCF's gravcomp is.
    - Dry friction of the model and of effects is loss * sgn(qd).  At rest it is set-valued: between -loss and loss,
      with a slack for noise, it takes the value nearest to the measured torque.  So a residual at rest is the distance
      to that interval.
    - The torque overcomes forces and friction of effects on either side.
    - Constraints (contacts, limits, equalities) are left out.
    - Positions of the path are those that encoders read.

    Args:
        scene: the simulated one.
        convention: of the torques.
        effects: in the replay.
        joints: those of the paths, the scene's first; empty: the scene's.

    Returns:
        (physics, path) -> Rollout [T, ...] of one sample.

    Raises:
        ValueError: an effect acts on commands or servos, which a prescribed motion does not have, or the scene has a
            fluid.
    """
    refuse_fluid(scene.model, f"a replay of scene {scene.name!r}")
    steering = [e.name for e in effects if has_law(e, STEERING)]
    if steering:
        raise ValueError(f"effects {', '.join(steering)} change commands, which a prescribed motion does not have")
    joints = joints or scene.joints
    dofs, positions = np.array([scene.dof(j) for j in joints]), np.array([scene.qpos(j) for j in joints])
    compensated = 1.0 - scene.model.jnt_actgravcomp[scene.model.dof_jntid]
    motor = convention.side is TorqueSide.MOTOR
    sense = path_sensors(scene, convention, effects, joints)

    def replay(physics: Physics, path: Path) -> Rollout:
        model, theta = physics.model, complete(physics.theta, effects)
        error = encoder_error(scene, model)
        none = {name: jnp.zeros_like(getattr(model, name)) for name in ("dof_armature", "dof_damping")}
        link_model = model if motor else model.replace(**none)
        if not convention.gravity:
            link_model = link_model.replace(opt=link_model.opt.replace(gravity=jnp.zeros(3)))

        def at(time, position, velocity, acceleration):
            full = jnp.zeros(scene.model.nv, jnp.float32)
            velocity = full.at[dofs].set(velocity)
            data = mjx.make_data(link_model, device=first_device())
            data = data.replace(qpos=path.still.at[positions].set(position), qvel=velocity)
            data = mjx.fwd_velocity(link_model, mjx.fwd_position(link_model, data))
            inertia = mjx.full_m(link_model, data)
            torque = inertia @ full.at[dofs].set(acceleration) + data.qfrc_bias
            springs = data.qfrc_passive - compensated * data.qfrc_gravcomp
            torque = torque - springs
            carried = jnp.zeros_like(velocity)  # weight that the gears carry but the torque convention excludes
            if not convention.gravity and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
                carried = -field_force(model, data, model.body_mass, model.opt.gravity)
            if error is not None and not convention.gravity:
                torque = torque + misplaced_weight(model, data, error)
            direction = jnp.sign(velocity)
            with_friction = torque + model.dof_frictionloss * direction if motor else torque
            links = springs + link_model.dof_damping * velocity - data.qfrc_bias
            motors = with_friction + (model.dof_damping - link_model.dof_damping) * velocity  # before joint damping
            gear = jnp.stack([motors + carried, links - carried])
            state = State(time, data.qpos, velocity, with_friction, model, data, gear)
            sensor_loss = _sensor_friction(scene, theta)
            base_loss = model.dof_frictionloss if motor else sensor_loss
            force, loss = _resistance(theta, state, base_loss, effects)
            # `joint_friction_effect` adds the sensor's friction, as an observation.
            friction = (loss if motor else loss - sensor_loss) * direction
            loss = loss + sensor_loss if motor else loss
            rows = (torque + force + friction, loss, jnp.diagonal(inertia))
            return PathTorques(*(row[scene.joint_dofs] for row in rows))

        torques = jax.vmap(at)(path.time, path.position, path.velocity, path.acceleration)
        return sense(theta, path, torques)

    return replay


class PathTorques(NamedTuple):
    """Inverse dynamics of the scene's joints before the sensor model, [T, J] each.

    Attributes:
        torque: N m (N).
        loss: N m (N), all dry friction, including that of `joint_friction_effect`.
        inertia: kg m^2 (kg), about the joint.
    """

    torque: Any
    loss: Any
    inertia: Any


def path_sensors(
    scene: Scene, convention: TorqueConvention, effects: Sequence[Effect] = (), joints: Sequence[str] = ()
) -> Callable[[Theta, Path, PathTorques], Rollout]:
    """The sensor model of torques along a path, with set-valued friction at rest.

    The arguments are those of `path_replay`.
    """
    joints, count = joints or scene.joints, len(scene.joints)
    motor = convention.side is TorqueSide.MOTOR
    hinge = joints.index(scene.object_joint) if scene.object_joint in joints else None

    def sense(theta: Theta, path: Path, torques: PathTorques) -> Rollout:
        rollout = Rollout(
            time=path.time,
            torque=torques.torque,
            position=path.position[:, :count],
            velocity=path.velocity[:, :count],
            object_angle=jnp.zeros(len(path.time)) if hinge is None else path.position[:, hinge],
            contact=jnp.zeros((len(path.time), 0), bool),
            finite=jnp.array(True),
        )
        sensed = apply_sensor_model(rollout, theta, effects)
        # A model without friction has the slack too.  Otherwise any friction would gain by absorbing noise at rest.
        slack = jnp.hypot(path.torque_slack[:count], torques.inertia * path.acceleration_slack[:count])
        bound = jnp.maximum(torques.loss, 0.0) + slack
        friction = torques.loss * jnp.sign(path.velocity[:, :count])
        held = held_torque(sensed.torque - friction, bound, path.measured[:, :count])
        rest = path.at_rest[:, :count] & _may_have_friction(scene, theta, effects, motor)
        return replace(sensed, torque=jnp.where(rest, held, sensed.torque))

    return sense


def _may_have_friction(scene: Scene, theta: Theta, effects: Sequence[Effect], motor: bool) -> np.ndarray:
    """[J] bool, joints that can have dry friction in this replay; only these are set-valued at rest.

    The names of parameters and effects decide, not their values.  So all models of a search treat the same samples
    alike, and none gains by absorbing noise.
    """
    if any(effect.frictionloss is not None for effect in effects):
        return np.ones(len(scene.joints), bool)
    of_sensor = np.array([Role.COULOMB.in_theta(joint) in theta for joint in scene.joints])
    return of_sensor | (motor & (scene.model.dof_frictionloss[scene.joint_dofs] > 0.0))


def held_torque(free: jax.Array, bound: jax.Array, measured: jax.Array) -> jax.Array:
    """Torque at rest: `free` plus the dry friction within +-bound that brings it nearest to `measured`.

    Args:
        free: N m (N for slides), torque without dry friction.
        bound: N m (N), largest friction, of the same shape.
        measured: N m (N), of the same shape; NaN: no friction is added.
    """
    friction = jnp.clip(measured - free, -bound, bound)
    return free + jnp.where(jnp.isnan(measured), 0.0, friction)


def _resistance(
    theta: Theta, state: State, base_loss: jax.Array, effects: Sequence[Effect]
) -> tuple[jax.Array, jax.Array]:
    """[nv] N m that overcomes the effects' forces, and [nv] dry friction: `base_loss` changed by the effects."""
    loss, resistance = base_loss, jnp.zeros_like(state.qvel)
    for effect in effects:
        if effect.frictionloss is not None:
            loss = effect.frictionloss(theta, state, loss)
        if effect.force is not None:
            resistance = resistance - effect.force(theta, state)
    return resistance, loss


def _sensor_friction(scene: Scene, theta: Theta) -> jax.Array:
    """[nv] the dry friction that `joint_friction_effect` adds to a link-side torque."""
    coulomb = column(theta, Role.COULOMB.value, scene.joints)
    return jnp.zeros(scene.model.nv, jnp.float32).at[scene.joint_dofs].set(coulomb)
