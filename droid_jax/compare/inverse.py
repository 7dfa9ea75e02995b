"""Replay a measured motion by inverse dynamics: no servo, no scan, vectorised over time.

For recordings that hold no commands, such as logs of free motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from droid_jax.compare.replay import Replay, observed
from droid_jax.measure.motion import Motion
from droid_jax.measure.recording import TorqueConvention, TorqueSide
from droid_jax.model.joint_friction import SMOOTHING
from droid_jax.model.physics import Physics
from droid_jax.model.scene import Scene
from droid_jax.model.seam import Effect, Rollout, State, Theta, column


class Path(NamedTuple):
    """The arrays of a motion, single precision: [T] s, and [T, J] rad, rad/s, rad/s^2 (m for slides)."""

    time: jax.Array
    position: jax.Array
    velocity: jax.Array
    acceleration: jax.Array


def path_of(motion: Motion) -> Path:
    """What a compiled replay is given of a motion."""
    return Path(*(jnp.asarray(getattr(motion, name), jnp.float32) for name in Path._fields))


def inverse_replay(scene: Scene, motion: Motion, effects: Sequence[Effect] = ()) -> Replay:
    """Torques of one prescribed motion; see `path_replay`."""
    replay, path = path_replay(scene, motion.torque, effects), path_of(motion)
    return lambda physics: replay(physics, path)


def path_replay(
    scene: Scene, convention: TorqueConvention, effects: Sequence[Effect] = ()
) -> Callable[[Physics, Path], Rollout]:
    """Torques of prescribed motions, vectorised over time.

    tau = M(q) qdd + c(q, qd) + k (q - q_spring) [+ g(q)] and, on the motor side, + armature qdd +
    damping qd + dry friction sgn(qd).  On the link side none of the motor's own terms appear; what
    the joint adds there (Coulomb and viscous friction, offset) is an observation effect.
    Whether g(q) is there is the recording's word alone, not the MJCF's gravcomp.
    Forces and friction of effects are what the torque has to overcome, on either side.
    Raises ValueError for effects of command and servo: a prescribed motion has neither.
    """
    steering = [e.name for e in effects if e.command or e.servo]
    if steering:
        raise ValueError(f"a prescribed motion has no commands that an effect could change: {', '.join(steering)}")
    joints, positions = scene.joint_dofs, scene.joint_qpos
    springs = np.array([scene.id("joint", j) for j in scene.joints])
    base = jnp.asarray(scene.model.qpos0, jnp.float32)
    motor = convention.side is TorqueSide.MOTOR

    def replay(physics: Physics, path: Path) -> Rollout:
        model, theta = physics.model, physics.theta
        link_model = model if motor else model.replace(dof_armature=jnp.zeros_like(model.dof_armature))
        if not convention.gravity:
            link_model = link_model.replace(opt=link_model.opt.replace(gravity=jnp.zeros(3)))

        def at(time, position, velocity, acceleration):
            full = jnp.zeros(scene.model.nv, jnp.float32)
            velocity = full.at[joints].set(velocity)
            data = mjx.make_data(link_model).replace(qpos=base.at[positions].set(position), qvel=velocity)
            data = mjx.fwd_velocity(link_model, mjx.fwd_position(link_model, data))
            torque = mjx.full_m(link_model, data) @ full.at[joints].set(acceleration) + data.qfrc_bias
            if motor:
                torque = torque + model.dof_damping * velocity + model.dof_frictionloss * jnp.sign(velocity)
            stretch = position - model.qpos_spring[positions]
            torque = torque.at[joints].add(model.jnt_stiffness[springs] * stretch)
            state = State(time, data.qpos, velocity, torque)
            own = model.dof_frictionloss if motor else _behind_the_sensor(scene, theta)
            return (torque + _resistance(theta, state, own, effects))[joints]

        torque = jax.vmap(at)(*path)
        hinge = scene.joints.index(scene.object_joint) if scene.object_joint in scene.joints else None
        rollout = Rollout(
            time=path.time,
            torque=torque,
            position=path.position,
            velocity=path.velocity,
            object_angle=jnp.zeros(len(path.time)) if hinge is None else path.position[:, hinge],
            contact=jnp.zeros((len(path.time), 0), bool),
            finite=jnp.array(True),
        )
        return observed(rollout, theta, effects)

    return replay


def _resistance(theta: Theta, state: State, own: jax.Array, effects: Sequence[Effect]) -> jax.Array:
    """[nv] N m that the effects' forces, and their friction beyond the model's own [nv], take to overcome."""
    loss, resistance = own, jnp.zeros_like(state.qvel)
    for effect in effects:
        if effect.frictionloss is not None:
            loss = effect.frictionloss(theta, state, loss)
        if effect.force is not None:
            resistance = resistance - effect.force(theta, state)
    return resistance + (loss - own) * jnp.tanh(state.qvel / SMOOTHING)


def _behind_the_sensor(scene: Scene, theta: Theta) -> jax.Array:
    """[nv] the dry friction that `joint_friction_effect` adds to a link-side torque."""
    coulomb = column(theta, "coulomb", scene.joints)
    return jnp.zeros(scene.model.nv, jnp.float32).at[scene.joint_dofs].set(coulomb)
