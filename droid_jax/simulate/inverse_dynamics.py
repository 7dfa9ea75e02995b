"""Replay a measured motion by inverse dynamics: no servo, no scan, vectorised over time.

For recordings that hold no commands, such as logs of free motion.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from droid_jax.model.effect_interface import Effect, Rollout, State, Theta, column, complete
from droid_jax.model.encoders import encoder_error, misplaced_weight
from droid_jax.model.gravity import field_force
from droid_jax.model.parameters import Role
from droid_jax.model.physics import Physics
from droid_jax.model.quiet_mjx import mjx
from droid_jax.model.scene import Scene
from droid_jax.model.unsupported_features import refuse_fluid
from droid_jax.recordings.recording import Recording, TorqueConvention, TorqueSide
from droid_jax.runtime import first_device
from droid_jax.simulate.closed_loops import coupled_to_others
from droid_jax.simulate.measured_motion import CUTOFF, Motion, measured_throughout
from droid_jax.simulate.replay import apply_sensor_model


def prescribed(scene: Scene, recording: Recording, cutoff: float = CUTOFF) -> tuple[str, ...]:
    """The joints whose measured motion a replay follows: the scene's, then all others that the log holds throughout.

    Torques are compared of the scene's joints alone, but what else moved carries them, or is carried.  All other joints
    stand still, where the recording states it (qpos0) or else as in the scene; one that carries a measured joint and is
    not stated is warned of, and so is one that was measured for a part of the time.
    cutoff: Hz, of the filter of the positions, on which it depends which gaps are bridged.
    Raises ValueError where a joint of several degrees carries a measured one: a log does not tell how it moves.
    """
    floating = scene.floating(scene.joints)
    if floating:
        raise ValueError(
            f"recording {recording.name!r} holds no commands, and {', '.join(floating)} of scene {scene.name!r}, of "
            "several degrees, carries measured joints: how it moves is not in the log, nor what holds it; take it out "
            "of the MJCF where the robot is bolted down"
        )
    if "position" not in recording.channels:
        raise ValueError(
            f"recording {recording.name!r} holds no commands and no measured positions: there is no motion to replay; "
            "read the log with its commands (--command-topic of `convert`) or with positions"
        )
    channel = recording.channel("position")
    whole = measured_throughout(channel, cutoff)
    others = [j for j in scene.single_joints if j in whole and j not in scene.joints]
    joints = (*scene.joints, *others)
    if coupled := coupled_to_others(scene, joints):
        warnings.warn(
            f"recording {recording.name!r} holds no commands, and a prescribed motion leaves {', '.join(coupled)} of "
            f"scene {scene.name!r} out, with what it moves: measure the positions of all its joints, or record the "
            "commands",
            stacklevel=3,
        )
    stated = {j for j in recording.qpos0 if j not in channel.columns}  # of a measured one it is where it began
    still = [j for j in scene.carriers(scene.joints) if j not in joints and j not in stated]
    if still:
        warnings.warn(
            f"recording {recording.name!r} does not hold the positions of {', '.join(still)} throughout, which carry "
            "measured joints: they are taken to stand still as in the scene (state where in qpos0)",
            stacklevel=3,
        )
    seen = dict(zip(channel.columns, np.any(channel.mask, axis=(0, 1)).tolist(), strict=True))
    partly = [j for j in scene.single_joints if seen.get(j) and j not in (*joints, *still)]
    if partly:
        warnings.warn(
            f"recording {recording.name!r} holds the positions of {', '.join(partly)} for a part of the time: they are "
            "taken to stand still where they were first; cut the log (`convert --start S --end S`) to follow them",
            stacklevel=3,
        )
    return joints


class Path(NamedTuple):
    """The arrays of a motion, single precision: [T] s, [T, J] rad, rad/s, rad/s^2 (m for slides).

    at_rest: [T, J] bool, samples at which friction is not known from the speed.  measured: [T, J] N m (N), the torque
    measured there, NaN where none was.  torque_slack: [J] N m (N), acceleration_slack: [J] rad/s^2 (m/s^2), by which
    noise may take it out of the interval of friction.  still: [nq] where all joints that do not move stand.
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
    """What a compiled replay is given of a motion; ValueError where it states a joint that the scene has not."""
    rest = motion.velocity == 0.0 if motion.rest is None else motion.rest
    measured = np.full(motion.velocity.shape, np.nan) if motion.measured is None else motion.measured
    given = [
        np.zeros(motion.velocity.shape[1]) if slack is None else slack
        for slack in (motion.torque_slack, motion.acceleration_slack)
    ]
    arrays = (motion.time, motion.position, motion.velocity, motion.acceleration, measured, *given)
    time, position, velocity, acceleration, measured, *slacks = (jnp.asarray(a, jnp.float32) for a in arrays)
    still = jnp.asarray(scene.initial_qpos(motion.others), jnp.float32)
    at_rest = jnp.asarray(rest)
    return Path(time, position, velocity, acceleration, at_rest, measured, slacks[0], slacks[1], still)


def path_replay(
    scene: Scene, convention: TorqueConvention, effects: Sequence[Effect] = (), joints: Sequence[str] = ()
) -> Callable[[Physics, Path], Rollout]:
    """Torques of the scene's joints along prescribed motions, vectorised over time.

    joints: those of the paths, the scene's first (default: these alone).

    tau = M(q) qdd + c(q, qd) - passive forces [+ g(q)] and, on the motor side, + armature qdd + dry friction.
    Dry friction, the model's own and that of effects, is loss * sgn(qd).  At rest it is set-valued: of all values
    between -loss and loss, and a slack for noise, the one that comes nearest to the measured torque, so that a residual
    is the distance to that interval.
    Passive are springs and dampers of joints and tendons; joints' damping on the motor side only: on the link side none
    of the motor's own terms appear, and what the joint adds there (Coulomb and viscous friction, offset) is an
    observation effect.  Constraints (contacts, limits, equalities) take no part.
    Whether g(q) is there is the recording's word alone, not the MJCF's gravcomp.
    The path is what encoders read.
    Forces and friction of effects are what the torque has to overcome, on either side.
    Raises ValueError for effects of command and servo, which a prescribed motion has not, and for air or water.
    """
    refuse_fluid(scene.model, f"a replay of scene {scene.name!r}")
    steering = [e.name for e in effects if e.profile or e.command or e.servo]
    if steering:
        raise ValueError(f"a prescribed motion has no commands that an effect could change: {', '.join(steering)}")
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
            carried = jnp.zeros_like(velocity)  # weight that gears carry and the torque does not hold
            if not convention.gravity and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
                carried = -field_force(model, data, model.body_mass, model.opt.gravity)
            if error is not None and not convention.gravity:
                torque = torque + misplaced_weight(model, data, error)
            direction = jnp.sign(velocity)
            felt = torque + model.dof_frictionloss * direction if motor else torque
            links = springs + link_model.dof_damping * velocity - data.qfrc_bias
            motors = felt + (model.dof_damping - link_model.dof_damping) * velocity  # before the joints' damping
            gear = jnp.stack([motors + carried, links - carried])
            state = State(time, data.qpos, velocity, felt, model, data, gear)
            behind = _behind_the_sensor(scene, theta)
            own = model.dof_frictionloss if motor else behind
            force, loss = _resistance(theta, state, own, effects)
            # What is behind the sensor `joint_friction_effect` adds, as an observation.
            friction = (loss if motor else loss - behind) * direction
            loss = loss + behind if motor else loss
            rows = (torque + force + friction, loss, jnp.diagonal(inertia))
            return PathTorques(*(row[scene.joint_dofs] for row in rows))

        felt = jax.vmap(at)(path.time, path.position, path.velocity, path.acceleration)
        return sense(theta, path, felt)

    return replay


class PathTorques(NamedTuple):
    """What a path takes of the scene's joints, before their sensors, [T, J] each.

    torque: N m (N).  loss: all dry friction, N m (N), that behind a sensor too.  inertia: kg m^2 (kg), about the joint.
    """

    torque: Any
    loss: Any
    inertia: Any


def path_sensors(
    scene: Scene, convention: TorqueConvention, effects: Sequence[Effect] = (), joints: Sequence[str] = ()
) -> Callable[[Theta, Path, PathTorques], Rollout]:
    """What sensors read of the torques along a path, which at rest are those nearest to the measured ones.

    The arguments are those of `path_replay`.
    """
    joints, count = joints or scene.joints, len(scene.joints)
    motor = convention.side is TorqueSide.MOTOR
    hinge = joints.index(scene.object_joint) if scene.object_joint in joints else None

    def sense(theta: Theta, path: Path, felt: PathTorques) -> Rollout:
        rollout = Rollout(
            time=path.time,
            torque=felt.torque,
            position=path.position[:, :count],
            velocity=path.velocity[:, :count],
            object_angle=jnp.zeros(len(path.time)) if hinge is None else path.position[:, hinge],
            contact=jnp.zeros((len(path.time), 0), bool),
            finite=jnp.array(True),
        )
        seen = apply_sensor_model(rollout, theta, effects)
        # The slack is there without friction too: else any friction would pay by taking the noise at rest.
        slack = jnp.hypot(path.torque_slack[:count], felt.inertia * path.acceleration_slack[:count])
        bound = jnp.maximum(felt.loss, 0.0) + slack
        friction = felt.loss * jnp.sign(path.velocity[:, :count])
        held = held_torque(seen.torque - friction, bound, path.measured[:, :count])
        rest = path.at_rest[:, :count] & _may_rub(scene, theta, effects, motor)
        return replace(seen, torque=jnp.where(rest, held, seen.torque))

    return sense


def _may_rub(scene: Scene, theta: Theta, effects: Sequence[Effect], motor: bool) -> np.ndarray:
    """[J] bool, joints that dry friction of this replay could hold; at rest the others are compared as ever.

    Which could is known before any value is: every model of a search has the same, so that none of them takes noise.
    """
    if any(effect.frictionloss is not None for effect in effects):
        return np.ones(len(scene.joints), bool)
    behind = np.array([Role.COULOMB.in_theta(joint) in theta for joint in scene.joints])
    return behind | (motor & (scene.model.dof_frictionloss[scene.joint_dofs] > 0.0))


def held_torque(free: jax.Array, bound: jax.Array, measured: jax.Array) -> jax.Array:
    """Torque at rest: `free`, without dry friction, and the friction within +-bound that comes nearest to `measured`.

    All N m (N for slides) and of one shape; where nothing was measured (NaN), no friction.
    """
    friction = jnp.clip(measured - free, -bound, bound)
    return free + jnp.where(jnp.isnan(measured), 0.0, friction)


def _resistance(theta: Theta, state: State, own: jax.Array, effects: Sequence[Effect]) -> tuple[jax.Array, jax.Array]:
    """[nv] N m that the effects' forces take to overcome, and [nv] all dry friction, `own` [nv] and that of effects."""
    loss, resistance = own, jnp.zeros_like(state.qvel)
    for effect in effects:
        if effect.frictionloss is not None:
            loss = effect.frictionloss(theta, state, loss)
        if effect.force is not None:
            resistance = resistance - effect.force(theta, state)
    return resistance, loss


def _behind_the_sensor(scene: Scene, theta: Theta) -> jax.Array:
    """[nv] the dry friction that `joint_friction_effect` adds to a link-side torque."""
    coulomb = column(theta, Role.COULOMB.value, scene.joints)
    return jnp.zeros(scene.model.nv, jnp.float32).at[scene.joint_dofs].set(coulomb)
